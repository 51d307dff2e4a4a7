"""Evaluation protocols: which views are tested, how labels are compared. One module each, quirks in
its docstring; `ingest.protocol` calls it by its name, with hyphens.

A figure measured under one protocol is never put beside one measured under another: the protocol's
name and parameters go with every figure. Every module but `task` has

    RULE                  which views are tested, and against what (`task.Rule`)
    measure(views, task)  -> dict with `classes`, `scene`, what each mIoU rests on (`task.counted`)
                          by the figure's name, and `teacher` where the truth is the capture's
    over_scenes(scenes)   -> dict, where figures of several scenes together are no plain mean of
                          every run's

None is imported here: the key of a scene is of its own protocol alone
(`stages.registry.Stage.of_protocol`).
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

NAMES = tuple(
    module.name.replace("_", "-") for module in iter_modules(__path__) if module.name != "task"
)


def module_of(name: str) -> str:
    """The dotted name of a protocol's module."""
    return f"{__name__}.{name.replace('-', '_')}"


def load(name: str) -> ModuleType:
    """The module of a protocol, one of NAMES."""
    return import_module(module_of(name))
