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
    """What a call was made of: leaves, and the layout of what else it was given; its CUDA graph from the second on."""

    leaves: list[Tensor]
    layout: list[tuple[Any, ...]]
    graph: Function | None = None


class Replay:
    """Calls functions; on a GPU it records each as a CUDA graph and replays that.

    A small scene's step is hundreds of small operations, which take longer to launch than to compute.
    A recording holds for the same `key`, the same leaves and tensors of the same shapes: it is made
    again after growth and pruning. What is called for the first time is not recorded, so that
    libraries have prepared what they need, nor is what needs no gradient, or where `records` is false,
    as it becomes, with a warning, where torch or the driver cannot record.
    Results of a recording are overwritten by its next replay.
    """

    def __init__(self, records: bool):
        self.records = records
        self.recordings: dict[Hashable, Recording] = {}

    def __call__(
        self, key: Hashable, function: Function, leaves: Sequence[Tensor], given: Sequence[Tensor]
    ) -> dict[str, Tensor]:
        """`function(*leaves, *given)`, a dictionary of tensors.

        Args: key: what the function depends on beside its tensors; leaves: read where they lie, so that
          what an optimizer wrote there is seen; given: copied into the recording at each call.
        """
        if not self.records or not torch.is_grad_enabled():
            return function(*leaves, *given)
        layout = [(value.shape, value.dtype, value.requires_grad) for value in given]
        recording = self.recordings.get(key)
        if recording is not None and any(a is not b for a, b in zip(recording.leaves, leaves, strict=True)):
            self.recordings.clear()  # of other Gaussians, as are all the others
            recording = None
        if recording is None or recording.layout != layout:
            self.recordings[key] = Recording(list(leaves), layout)
            return function(*leaves, *given)
        graph: Any = recording.graph
        if graph is None:  # of aliases, so that gradients of the leaves are no part of it
            samples = [*(leaf.detach() for leaf in leaves), *(value.detach().clone() for value in given)]
            for sample, value in zip(samples, (*leaves, *given), strict=True):
                sample.requires_grad_(value.requires_grad)
            try:
                graph = torch.cuda.make_graphed_callables(function, tuple(samples), 0, allow_unused_input=True)
            except RuntimeError as error:
                log.warning(
                    "a step's operations are launched one by one; no CUDA graph: %s", str(error).splitlines()[0]
                )
                self.records = False
                return function(*leaves, *given)
            recording.graph = graph
        values: dict[str, Tensor] = graph(*leaves, *given)
        return values
