"""Evaluation protocols: which views are tested, how labels are compared. One module each, quirks in
its docstring.

A figure measured under one protocol is never put beside one measured under another: the protocol's
name and parameters go with every figure. Every module has

    NAME         what `ingest.protocol` calls it
    TEST_EVERY, TEST_OFFSET   a view is a test view if its index among the names, modulo the one, is
    the other ADJUSTABLE   whether a config may change these two (they are recorded)
    OWN_SPLIT    whether a source's own split goes first
    ON_TRAINING  whether the training views are evaluated, and none is held out
    TRUTH        "labels" of the capture, or "teacher": the teacher's own
    measure(views, task) -> dict with `classes`, `scene` and what its mIoU rests on
    (`task.counted`), by name of the
                 figure; `teacher` where the truth is the capture's
    over_scenes(scenes) -> dict, where figures of several scenes together are no plain mean of every
    run's
"""

from __future__ import annotations

from types import ModuleType

from chebsplat.evaluation.protocols import (
    deep_blending,
    labels,
    replica_f3,
    replica_gt,
    scannet_closed,
    scannet_open,
)

ALL: dict[str, ModuleType] = {
    module.NAME: module
    for module in (labels, replica_f3, replica_gt, scannet_open, scannet_closed, deep_blending)
}
