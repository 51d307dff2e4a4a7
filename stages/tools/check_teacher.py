"""One image through a teacher, before a scene is: what it is, what it costs, what it sees."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from chebsplat.formats.images import read_rgb
from chebsplat.formats.teacher_model import read_teacher
from chebsplat.labels.tiling import window_starts
from chebsplat.stages.runtime.command import n_threads
from chebsplat.stages.settings import TeacherSection
from chebsplat.stages.teacher_models.label_space import MAX_CHANNELS, closed_set, label_set, open_vocabulary
from chebsplat.synthetic.layout import REFERENCE

SHOWN = 8  # labels


def check(model: Path, photo: Path | None = None, labels: str | None = None) -> list[tuple[str, str]]:
    """(what, finding) of a teacher. Raises what the teacher stage would.

    Args: photo: None: a view of a generated room; labels: as teacher.labels, None: the teacher's own.
    """
    from chebsplat.stages.teacher_models.image_encoder import TeacherInference

    settings = TeacherSection()
    teacher = read_teacher(model)
    network = TeacherInference(teacher, n_threads())
    name, image = shown(photo)
    grid, n_channels = network.grid(image, settings.downscale)
    if teacher.output == "logits":
        asked = label_set(teacher, labels, None) if labels else None
        space = closed_set(teacher, asked, n_channels, settings.n_channels)
    else:
        space = open_vocabulary(teacher, label_set(teacher, labels, None), n_channels, None)
    began = time.perf_counter()
    _, pseudo_labels, confidence = space.split(network.features(image, grid, settings.scales, settings.flips, name))
    seconds = time.perf_counter() - began
    size = network.scaled_size(image, 1.0)
    window = network.window(size)
    counts = np.bincount(pseudo_labels.ravel(), minlength=len(space.names))
    seen = [f"{space.names[k]} {counts[k] / pseudo_labels.size:.0%}" for k in np.argsort(-counts, kind="stable")[:SHOWN] if counts[k]]  # fmt: skip  # noqa: E501
    wide = teacher.output == "features" and n_channels > MAX_CHANNELS
    return [
        ("name", f"{teacher.name} ({model}, {model.stat().st_size / 2**20:.1f} MB)"),
        ("output", f"{teacher.output}, {n_channels} channels" + (", reduced to fewer in a scene" if wide else "")),
        ("image", f"{name}, {image.shape[1]} x {image.shape[0]}, seen at {size[1]} x {size[0]}"),
        (
            "windows",
            f"{n_windows(size, window)} of {window[1]} x {window[0]}{'' if network.size else ' (any size)'}",
        ),
        ("map", f"{grid[1]} x {grid[0]}: one feature every {image.shape[0] / grid[0]:.3g} pixels"),
        ("labels", f"{len(space.names)}, from {labels or teacher.labels}"),
        ("seconds", f"{seconds:.2f} a view, on {n_threads()} threads"),
        ("sees", f"{', '.join(seen)} (mean confidence {confidence.mean():.2f})"),
    ]


def n_windows(size: tuple[int, int], window: tuple[int, int]) -> int:
    """How many windows (H, W) cover an image (H, W)."""
    rows, columns = (window_starts(n, side) for n, side in zip(size, window, strict=True))
    return len(rows) * len(columns)


def shown(photo: Path | None) -> tuple[str, np.ndarray]:
    """(name, image u8 [H, W, 3])."""
    from chebsplat.stages.channels import generated

    if photo is None:
        return next(generated(REFERENCE[:1]))
    return photo.name, read_rgb(photo, "give another --photo")
