"""Labels and features that break printed losses: cross-entropy and L1 (docs/method.md, section 8).

Errors are the larger of a loss' and its gradient's, relative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mpmath
import torch
from torch import Tensor

from benchmarks.stability.case import Outcome, case, relative
from chebsplat.training.losses import feature_distance, feature_distance_reference, label_entropy
from chebsplat.views import TaughtLabels

HEIGHT, WIDTH, CHANNELS, CLASSES = 8, 12, 5, 4
# logits of 10 are rounded by 1e-6, and a gradient is a difference of two of their exponentials
TOLERANCE = 1e-5


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


class LabelledView(NamedTuple):
    """A view: its render, and labels of cells of 2 x 2 pixels."""

    render: Tensor
    labels: TaughtLabels
    temperature: float = 0.5
    mask: Tensor | None = None


def labelled_view(
    size: float = 1.0, n_classes: int = CLASSES, confidence: float = 1.0, unlabelled: bool = False
) -> LabelledView:
    g = torch.Generator().manual_seed(1)
    classes = torch.randint(n_classes, (HEIGHT // 2, WIDTH // 2), generator=g)
    certainty = confidence * torch.rand(classes.shape, generator=g)
    labels = TaughtLabels(classes - 10 * unlabelled, certainty, normal(n_classes, CHANNELS, seed=2))
    return LabelledView(size * normal(HEIGHT, WIDTH, CHANNELS), labels)


VIEWS: dict[str, Callable[[], LabelledView]] = {
    "no votes at all": lambda: labelled_view(unlabelled=True),
    "confidence 0": lambda: labelled_view(confidence=0.0),
    "confidence 1e-30": lambda: labelled_view(confidence=1e-30),
    "nothing counts": lambda: labelled_view()._replace(
        mask=torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    ),
    "one class": lambda: labelled_view(n_classes=1),
    "logits of 0": lambda: labelled_view(0.0),
    "logits of 1e-20": lambda: labelled_view(1e-20),
    "logits of 1e20": lambda: labelled_view(1e20),
    "logits of 1e20, one class": lambda: labelled_view(1e20, n_classes=1),
    "temperature 1e-3": lambda: labelled_view()._replace(temperature=1e-3),
    "temperature 1e6": lambda: labelled_view()._replace(temperature=1e6),
}


def exact_entropy(view: LabelledView) -> float:
    """In 60 digits, cell by cell."""
    if view.mask is not None:
        return 0.0
    labels, terms = view.labels, []
    with mpmath.workdps(60):
        for i, j in (labels.classes >= 0).nonzero().tolist():
            cell = (
                view.render[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].reshape(4, -1).double().tolist()
            )
            mean = [mpmath.fsum(column) / 4 for column in zip(*cell, strict=True)]
            logits = [
                mpmath.fdot(mean, code) / view.temperature
                for code in labels.class_codes.double().tolist()
            ]
            highest = max(logits)
            total = mpmath.log(mpmath.fsum(mpmath.exp(logit - highest) for logit in logits))
            terms.append(
                labels.confidence[i, j].item()
                * (highest + total - logits[int(labels.classes[i, j])])
            )
        return float(mpmath.fsum(terms) / max(len(terms), 1))


def gradient(loss: Tensor, render: Tensor) -> Tensor:
    (slope,) = torch.autograd.grad(loss, render)
    return slope.detach()


@case("cross-entropy, {name}", name=VIEWS)
def cross_entropy(name: str) -> Outcome:
    """The loss against 60 digits, its gradient against float64."""
    view = VIEWS[name]()
    render, double = (
        view.render.to(kind).requires_grad_(True) for kind in (torch.float32, torch.float64)
    )
    loss = label_entropy(render, view.labels, view.mask, view.temperature)
    slope = gradient(loss, render)
    exact = gradient(label_entropy(double, view.labels, view.mask, view.temperature), double)
    error = max(relative(loss.detach(), exact_entropy(view)), relative(slope, exact))
    return Outcome(error, TOLERANCE)


@case(
    "L1 of features {size:.0e} to {target:.0e}", size=[0.0, 1e-20, 1e20], target=[0.0, 1e-20, 1e20]
)
def feature_l1(size: float, target: float) -> Outcome:
    """The fused loss against float64 in plain torch."""
    features = target * normal(HEIGHT // 2, WIDTH // 2, CHANNELS, seed=3)
    drawn = size * normal(HEIGHT, WIDTH, CHANNELS)
    render, double = (
        drawn.to(kind).requires_grad_(True) for kind in (torch.float32, torch.float64)
    )
    loss, exact = (
        feature_distance(render, features, kind="l1"),
        feature_distance_reference(double, features, kind="l1"),
    )
    error = max(
        relative(loss.detach(), exact.detach()),
        relative(gradient(loss, render), gradient(exact, double)),
    )
    return Outcome(error, TOLERANCE)
