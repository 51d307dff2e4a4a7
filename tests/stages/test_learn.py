"""What a scene's lesson says that its points are."""

import numpy as np

from chebsplat.lifting.blend import Shape
from chebsplat.stages.learn import decide_labels

L, N = 5, 2000
CODES = np.eye(L, dtype=np.float32)
TRUE = np.arange(N) % L
WRONG = np.random.default_rng(3).random(N) < 0.2  # of the points


OWN = np.arange(L)


def answering(answers, confused=OWN):
    """Shape that has a word for every label."""
    return Shape(answers, CODES, confused, np.full(L, True))


def by_half(labels, n_views):
    """Mean codes of each half of the views [2, N, L], and numbers of views, of labels [V, N]."""
    halves = np.stack([CODES[labels[half::2]].mean(0) for half in (0, 1)])
    return halves, np.full((2, N), n_views // 2)


def right(halves, half_views, shape):
    """Share of the points whose label is decided right."""
    return (decide_labels(halves, half_views, shape)[1] == TRUE).mean()


def test_shape_outvotes_what_all_views_have_wrong_alike():
    shape = answering(CODES[TRUE])
    labels = np.tile(np.where(WRONG, (TRUE + 1) % L, TRUE), (100, 1))
    assert (labels[0] == TRUE).mean() < 0.85
    for n_views in (4, 10, 100):
        assert right(*by_half(labels[:n_views], n_views), shape) == 1
    # but not where shape is known to give that label to such things
    blind = answering(CODES[TRUE], np.array([4, 0, 1, 2, 3]))
    assert right(*by_half(labels[:10], 10), blind) == (~WRONG).mean()


def test_views_whose_errors_are_their_own_need_no_shape():
    rng = np.random.default_rng(4)
    labels = np.where(rng.random((60, N)) < 0.3, rng.integers(0, L, (60, N)), TRUE)
    shape = answering(CODES[np.where(WRONG, (TRUE + 2) % L, TRUE)])
    assert right(*by_half(labels, 60), shape) > 0.999


def test_shape_that_is_wrong_about_most_things_decides_nothing():
    shape = answering(CODES[(TRUE + 1) % L])
    labels = np.tile(TRUE, (10, 1))
    assert right(*by_half(labels, 10), shape) == 1
