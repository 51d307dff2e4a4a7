"""Functions of tensors that a GPU runs in one launch, forward and backward."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

log = logging.getLogger("chebsplat")
Function = Callable[..., dict[str, Tensor]]


@dataclass
class Recording:
    """Layout of a call's inputs beside leaves; its CUDA graph from the second call on."""

    layout: list[tuple[Any, ...]]
    graph: Function | None = None


class Replay:
    """Calls functions; on a GPU it records each as a CUDA graph and replays that.

    A small scene's step is hundreds of small operations, which take longer to launch than to
    compute. A recording holds for the same `key` and tensors of the same shapes, and all of them
    for the same leaves: after growth and pruning they are made again. A first call is not recorded,
    so that libraries have prepared what they need, nor is one without gradients. Where torch or the
    driver cannot record, a warning says so, and `records` becomes false: then nothing is. Results
    of a recording are overwritten by its next replay.
    """

    def __init__(self, records: bool):
        self.records = records
        self.leaves: list[Tensor] = []
        self.recordings: dict[Hashable, Recording] = {}

    def __call__(
        self, key: Hashable, function: Function, leaves: Sequence[Tensor], inputs: Sequence[Tensor]
    ) -> dict[str, Tensor]:
        """`function(*leaves, *inputs)`, a dictionary of tensors.

        Args: key: what the function depends on beside its tensors; leaves: read where they lie, so
          that what an optimizer wrote there is seen, or none; inputs: copied into the recording at
          each call.
        """
        if not self.records or not torch.is_grad_enabled():
            return function(*leaves, *inputs)
        if leaves and [id(leaf) for leaf in leaves] != [id(leaf) for leaf in self.leaves]:
            self.leaves = list(leaves)
            self.recordings.clear()  # of other Gaussians
        layout = [(value.shape, value.dtype, value.requires_grad) for value in inputs]
        recording = self.recordings.get(key)
        if recording is None or recording.layout != layout:
            self.recordings[key] = Recording(layout)
            return function(*leaves, *inputs)
        if recording.graph is None:  # of aliases, so that gradients of the leaves are no part of it
            samples = [
                *(leaf.detach() for leaf in leaves),
                *(value.detach().clone() for value in inputs),
            ]
            for sample, value in zip(samples, (*leaves, *inputs), strict=True):
                sample.requires_grad_(value.requires_grad)
            try:
                graph: Any = torch.cuda.make_graphed_callables(
                    function, tuple(samples), 0, allow_unused_input=True
                )
            except RuntimeError as error:
                log.warning(
                    "a step's operations are launched one by one; no CUDA graph: %s",
                    str(error).splitlines()[0],
                )
                self.records, self.leaves = False, []
                self.recordings.clear()  # whose memory the step may need
                return function(*leaves, *inputs)
            recording.graph = graph
        return recording.graph(*leaves, *inputs)
