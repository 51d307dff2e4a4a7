"""What a segmenter gives is told by its values, and stands for the same probabilities however it
was exported.
"""

import numpy as np
import pytest
from scipy import special

from chebsplat.labels.scores import kind_of, probabilities, sureness


def logits_of(rng, n=32):
    """As a segmenter has them: most classes far below the likeliest."""
    values = rng.normal(-4, 2, (n, 12, 16))
    np.put_along_axis(values, rng.integers(0, n, (1, 12, 16)), rng.normal(5, 2, (1, 12, 16)), 0)
    return values.astype(np.float32)


def blurred(values):
    """Overshooting, as bicubic resizes do."""
    return 1.3 * values - 0.15 * np.roll(values, 1, -1) - 0.15 * np.roll(values, -1, -1)


def softmax(logits):
    return special.softmax(logits, axis=0)


FORMS = {
    "logits": ("logits", lambda v: v),
    "logits without negative ones": ("logits", lambda v: v - v.min()),
    "log-softmax": ("logits", lambda v: special.log_softmax(v, axis=0)),
    "softmax": ("softmax", softmax),
    "softmax in float16": ("softmax", lambda v: softmax(v).astype(np.float16).astype(np.float32)),
    "one-hot": ("softmax", lambda v: (v == v.max(0)).astype(np.float32)),
    "softmax, resized": ("softmax", lambda v: blurred(softmax(v))),
    "sigmoid": ("sigmoid", special.expit),
    "cosines": ("cosines", lambda v: v / 40),
    "cosines, all above 0": ("cosines", lambda v: 0.2 + v / 100),
}


@pytest.mark.parametrize("form", FORMS)
def test_values_tell_what_they_are_and_keep_the_order_of_classes(form):
    kind, of = FORMS[form]
    logits = logits_of(np.random.default_rng(0))
    values = of(logits)
    assert kind_of([values, values[:, :4]]) == kind
    found = probabilities(values, kind)
    assert np.allclose(found.sum(0), 1, atol=1e-5) and found.min() >= 0
    if "resized" not in form:
        assert np.array_equal(found.argmax(0), values.argmax(0))
    if kind == "sigmoid" or form in ("log-softmax", "softmax", "logits without negative ones"):
        assert np.allclose(found, softmax(logits), atol=1e-3)


def test_a_segmenter_is_as_sure_as_it_is_above_chance():
    for confidence, n, sure in ((0.25, 4, 0), (1, 4, 1), (0.625, 4, 0.5), (1, 1, 1)):
        assert sureness(confidence, n) == sure


def test_windows_that_differ_are_judged_together():
    logits = logits_of(np.random.default_rng(0))
    assert kind_of([np.zeros((32, 4, 4), np.float32), logits]) == "logits"
    assert kind_of([softmax(logits), logits]) == "logits"
