"""Features are read when they are needed, and what stays in memory is bounded."""

import weakref

import numpy as np
import pytest
import torch

from chebsplat.views import Views, remembered, stacked


@pytest.mark.parametrize("budget", [0, 3, 100])
def test_no_more_views_are_kept_than_the_budget_holds(budget):
    rng, reads = np.random.default_rng(0), []

    def read(index):
        reads.append(index)
        return torch.full((8,), index, dtype=torch.float16)

    recall = remembered(read, budget * 16 + 15)
    for _ in range(5):
        for index in rng.permutation(10).tolist():
            assert (recall(index) == index).all()
    kept = min(budget, 10)
    assert len(reads) == kept + 5 * (10 - kept)


@pytest.mark.parametrize("budget", [0, 5 * 4 * 6 * 3 - 1, 10**6])
def test_photos_that_do_not_fit_are_read_when_they_are_looked_at(budget):
    photos = torch.randint(0, 255, (5, 4, 6, 3), dtype=torch.uint8)
    reads = []

    def read(index):
        reads.append(index)
        return photos[index]

    held = stacked(read, 5, budget)
    assert isinstance(held, torch.Tensor) == (budget >= photos.nbytes) and tuple(held.shape) == (
        5,
        4,
        6,
        3,
    )
    reads.clear()
    cameras = torch.eye(3).repeat(5, 1, 1), torch.eye(4).repeat(5, 1, 1)
    whole, stored = (Views(list("abcde"), images, *cameras) for images in (photos, held))
    for index, factor in ((3, 1), (0, 2), (3, 2)):
        assert torch.equal(whole.photo(index)[0], stored.to("cpu").photo(index)[0])
        assert stored.camera(index, factor).width == 6 // factor
    assert bool(reads) == (budget < photos.nbytes)


def test_views_on_their_device_keep_no_more_of_depth_than_its_reader_does():
    whole = []

    def depth(index, factor):
        read = torch.zeros(4, 6)
        whole.append(weakref.ref(read))
        return read[::factor, ::factor]

    cameras = torch.eye(3)[None], torch.eye(4)[None]
    views = Views(["a"], torch.zeros(1, 4, 6, 3, dtype=torch.uint8), *cameras, depth=depth).to(
        "cpu"
    )
    assert views.depth(0, 2).shape == (2, 3)
    assert whole[0]() is None
