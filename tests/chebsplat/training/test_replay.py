"""Recordings are of the Gaussians that there are, and of none once a device cannot record."""

import weakref

import pytest
import torch

from chebsplat.training.replay import Replay


@pytest.mark.parametrize("refused", [False, True], ids=["other Gaussians", "no memory"])
def test_recordings_that_nobody_needs_are_gone_and_so_are_their_leaves(refused, monkeypatch):
    def graphed(function, samples, warm_ups, allow_unused_input):
        if refused and len(samples[0]) == 3:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return function

    monkeypatch.setattr(torch.cuda, "make_graphed_callables", graphed)
    replay, leaf = Replay(True), torch.ones(2, requires_grad=True)

    def call(key, leaf):
        seen = replay(key, lambda values: {"seen": 2 * values}, [leaf], [])["seen"]
        loss = replay((key, "loss"), lambda values: {"loss": values.sum()}, [], [seen])["loss"]
        assert loss.item() == 2 * len(leaf)

    for key in ("coarse", "coarse", "fine", "fine"):
        call(key, leaf)
    assert len(replay.recordings) == 4 and all(
        one.graph is not None for one in replay.recordings.values()
    )
    gone, leaf = weakref.ref(leaf), torch.ones(3, requires_grad=True)
    call("finer", leaf)  # no step is coarse, or as fine as before, again
    call("finer", leaf)
    assert gone() is None
    assert list(replay.recordings) == ([] if refused else ["finer", ("finer", "loss")])
