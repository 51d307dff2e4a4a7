"""Features are read when they are needed, and what stays in memory is bounded."""

import numpy as np
import pytest
import torch

from chebsplat.views import remembered


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
