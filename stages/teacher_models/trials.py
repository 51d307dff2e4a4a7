"""Trials of a teacher on photos, to detect errors of its TOML, graph or names."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from PIL import Image

from chebsplat.errors import DataFailure
from chebsplat.formats.teacher_model import TeacherModel
from chebsplat.labels.names import folded
from chebsplat.labels.plausible import QUARTERS, changes, entropy, information, sense, soft, spread
from chebsplat.labels.scores import LOGITS, logits_of, probabilities
from chebsplat.stages.teacher_models.image_encoder import TeacherInference, unit
from chebsplat.stages.teacher_models.label_space import IN_ROOMS

IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
BYTE = (1 / 255,) * 3
RANGES = {  # usual ranges of models' input colours: mean and std
    "0 to 1": ((0.0,) * 3, (1.0,) * 3),
    "-1 to 1": ((0.5,) * 3, (0.5,) * 3),
    "ImageNet's mean and std": IMAGENET,
    "0 to 255": ((0.0,) * 3, BYTE),
    "0 to 255 less ImageNet's mean": (IMAGENET[0], BYTE),
}
# Measured with a real segmenter on six sets of eight photos: the right range has 1.14 to 60 times
# the information of any other; the right order 1.015 to 1.6 times less entropy; in rooms names have
# a sense of 0.74 to 1.44, and one class off at most 0.15.
MORE, LESS, SENSIBLE, BETTER = 1.1, 1.05, 0.7, 0.4
ENOUGH = 4  # photos: on one alone a wrong range may be more informative
LEAST = 0.02  # nats of information, below which there is no verdict
CLEARLY = 1.2  # more change in one quarter than in any other
GAMMA, INNER = 1.3, 8  # of the changed photo, and the eighth that it lacks on each side
SATURATED = 1 - 1e-6, 0.9  # a confidence, and the share of pixels that are surer
UNTOLD = "cannot be told from these photos"


class Trials:
    """Outputs of a teacher for the middle windows of photos, under variants of its input."""

    def __init__(self, network: TeacherInference, images: list[np.ndarray], embeddings: np.ndarray):
        self.network, self.own, self.embeddings = network, network.teacher, embeddings
        heights, widths = zip(
            *(network.window(network.scaled_size(image, 1.0)) for image in images), strict=True
        )
        self.windows = [network.middle(image, (min(heights), min(widths))) for image in images]
        self.turned = False
        self.plain = self.outputs(self.own)

    def outputs(
        self, teacher: TeacherModel, change: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> np.ndarray:
        """Values [V, L, h, w] of the windows after `change`, by a teacher's mean, std, order."""
        self.network.teacher = teacher
        try:
            windows = [window if change is None else change(window) for window in self.windows]
            outputs = [self.network.run(window, "a photo") for window in windows]
        finally:
            self.network.teacher = self.own
        if self.own.output == "logits":
            values = np.stack([logits_of(output, self.network.scores) for output in outputs])
        else:
            values = np.stack(
                [np.tensordot(self.embeddings, unit(output, 0), 1) for output in outputs]
            )
        return values.swapaxes(2, 3) if self.turned else values

    def measure(self, teacher: TeacherModel) -> tuple[float, np.ndarray]:
        """Information, nats, that photos and their changed middles share; the values."""
        plain = self.plain if teacher == self.own else self.outputs(teacher)
        changed = self.outputs(teacher, closer)[..., ::-1]
        inner = [slice(n // INNER, n - n // INNER) for n in plain.shape[2:]]
        there = plain[:, :, inner[0], inner[1]]
        rows, columns = (
            (np.arange(n) + 0.5) * m / n
            for n, m in zip(there.shape[2:], changed.shape[2:], strict=True)
        )
        same = changed[:, :, rows.astype(int)][..., columns.astype(int)]
        return information(soft(there, spread(plain)), soft(same, spread(changed))), plain


def try_variants(
    network: TeacherInference, images: list[np.ndarray], names: list[str], embeddings: np.ndarray
) -> list[tuple[str, str]]:
    """(topic, finding) on the map's layout, the range and order of colours, the names of classes.

    Args: names: of the channels of a segmenter, or of the rows of `embeddings` of other teachers.
    """
    trials = Trials(network, images, embeddings)
    findings = [("layout", layout_of(trials))]
    if len(images) < ENOUGH:
        return [
            *findings,
            (
                "more",
                "with eight photos, or a folder, range and order of colours and "
                "names are tried, too",
            ),
        ]
    finding, best, plain = range_of(trials)
    findings += [("range", finding), ("order", order_of(trials, best, plain))]
    return (
        [*findings, ("names", names_of(plain, names))]
        if trials.own.output == "logits"
        else findings
    )


def layout_of(trials: Trials) -> str:
    """Finding on the map's layout, by a change of the photos' top right; turns a transposed map."""
    before, after = trials.plain, trials.outputs(trials.own, top_right_inverted)
    deviation = spread(before)
    moved = changes(soft(before, deviation), soft(after, deviation))
    second, first = np.argsort(moved)[-2:]
    if moved[first] < CLEARLY * moved[second]:
        return UNTOLD
    how = ("mirrored", "as the photos", "transposed", "upside down")[first]
    if how == "as the photos":
        return how
    if how == "transposed":
        trials.turned = True
        trials.plain = before.swapaxes(2, 3)
    return (
        f"{how}: a change of the photos' top right is seen at the {QUARTERS[first]}; export it "
        "again"
    )


def range_of(trials: Trials) -> tuple[str, TeacherModel, np.ndarray]:
    """Finding on mean and std; the teacher with the most informative ones; its values."""
    teacher = trials.own
    own, plain = trials.measure(teacher)
    candidates = []
    for name, (mean, std) in RANGES.items():
        if not np.allclose((mean, std), (teacher.mean, teacher.std), rtol=0.05):
            fed = replace(teacher, mean=mean, std=std)
            with suppress(DataFailure):  # a range that makes it overflow
                candidates.append((*trials.measure(fed), name, fed))
    most, values, name, best = max(
        candidates, key=lambda of: of[0], default=(0.0, plain, "", teacher)
    )
    measure = "nats outlive a change of the photos"
    if most > max(MORE * own, LEAST):
        verdict = f"{name} tells more: {most:.2f} {measure}, {own:.2f} as given"
        right = ", ".join(
            f"{key} = {[round(v, 6) for v in getattr(best, key)]}" for key in ("mean", "std")
        )
        return f"{verdict}; try {right} in {teacher.settings.name}", best, values
    sure = probabilities(np.moveaxis(plain, 1, 0), LOGITS).max(0)
    if teacher.output == "logits" and (sure > SATURATED[0]).mean() > SATURATED[1]:
        why = (
            "as a model of 0 to 1 is that is fed colours in 0 to 255, or as a map of the "
            "likeliest class alone is"
        )
        return f"sure of everything, {why}", teacher, plain
    if own < LEAST or own < MORE * most:
        return f"{UNTOLD}: {own:.2f} {measure}, {most:.2f} in another range", teacher, plain
    return f"as given: {own:.2f} {measure}, at most {most:.2f} in others", teacher, plain


def order_of(trials: Trials, teacher: TeacherModel, plain: np.ndarray) -> str:
    """Finding on the order of colours."""
    other = {"RGB": "BGR", "BGR": "RGB"}[teacher.order]
    deviation = spread(plain)
    own, swapped = (
        entropy(soft(values, deviation))
        for values in (plain, trials.outputs(replace(teacher, order=other)))
    )
    if own > LESS * swapped:
        verdict = f"{other} is surer: {swapped:.3f} nats of doubt, {own:.3f} of {teacher.order}"
        return f'{verdict}; try order = "{other}" in {teacher.settings.name}'
    return (
        f"{teacher.order}: {own:.3f} nats of doubt, {swapped:.3f} of {other}"
        if swapped > LESS * own
        else UNTOLD
    )


def names_of(plain: np.ndarray, names: list[str]) -> str:
    """Finding on the names of classes: off by one or not, nothing else."""
    shares = soft(plain, spread(plain))
    words = [folded(name.replace(",", " ").replace(";", " ")) for name in names]
    indoors = frozenset(word for name in IN_ROOMS for word in name.split())
    off = {by: sense(shares, list(np.roll(words, by)), indoors) for by in (-1, 0, 1)}
    second, by = sorted(off, key=lambda of: off[of])[1:]
    if off[by] < max(SENSIBLE, off[0 if by else second] + BETTER):
        return (
            f"{UNTOLD}: too little is seen of floors, ceilings, and what rooms hold and others "
            "do not"
        )
    if by == 0:
        return f"make sense of a room ({off[0]:.2f} of 2)"
    which = "after" if by < 0 else "before"
    verdict = (
        f"one class off, if these are rooms: each makes more sense with the name {which} its own"
    )
    question = "is a background named that the model has not, or the other way round?"
    return f"{verdict} ({off[by]:.2f} of 2, {off[0]:.2f} as given); {question}"


def closer(window: np.ndarray) -> np.ndarray:
    """The middle of a window, mirrored and darker, at its size."""
    height, width = window.shape[:2]
    inner = window[
        height // INNER : height - height // INNER, width // INNER : width - width // INNER
    ]
    large = Image.fromarray(np.ascontiguousarray(inner[:, ::-1])).resize(
        (width, height), Image.Resampling.BILINEAR
    )
    return np.asarray((np.asarray(large) / 255.0) ** GAMMA * 255, np.uint8)


def top_right_inverted(window: np.ndarray) -> np.ndarray:
    """A window whose top right quarter is its negative."""
    changed, (height, width) = window.copy(), window.shape[:2]
    changed[: height // 2, width // 2 :] = 255 - changed[: height // 2, width // 2 :]
    return changed
