"""Semantic 3D Gaussian Splatting that understands shape.

load       Open a finished scene: render it, ask it in words, take a part of it.
train      Bring a scene up to date from photos to report, and open it.
run_stage  Run one stage in this process and publish its artifact.

Errors are those of `chebsplat.errors`; docs/python.md shows all three in use.
"""

import os
from importlib import import_module
from typing import Any

# Idle OpenMP threads of torch must sleep: spinning ones cost an order of magnitude on a busy
# machine. But not at once: a few microseconds of waiting spare most wake-ups. Must precede torch.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
# onnxruntime writes an id of the machine into the home folder and reports to its maker, from its
# import on, unless this is set before. ORT_DISABLE_TELEMETRY=0 is for who wants that.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.2.0"

__all__ = ("load", "run_stage", "train")


def __getattr__(name: str) -> Any:
    """`chebsplat.load`, `train` and `run_stage`, imported on first use: most commands need none."""
    if name in __all__:  # not an import statement: no stage depends on what the API imports
        return getattr(import_module("chebsplat.pipelines.api"), name)
    raise AttributeError(f"module 'chebsplat' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
