"""The video source: one file, or a folder with one and no photos. The stage `pose` finds poses."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats import videos
from chebsplat.formats.photo_model import PhotoModel
from chebsplat.photos.frames import BLOCK, STEP, choose, laplacian_variance, progress, shifts
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.settings import IngestSection, PoseSection
from chebsplat.stages.sources import assembly, cameras
from chebsplat.stages.sources.colmap import points_of
from chebsplat.stages.sources.colmap_model import Cloud
from chebsplat.stages.sources.common import Shot, file_of

MOST, LEAST = 150, 3  # frames: at most without pose.max_views, and at least
# pixels of the longer side, on which sharpness and movement are measured
SIDE, THUMBNAIL = 640, 192


def shots(
    path: Path, settings: PoseSection, reporter: Progress | None, finer: int
) -> tuple[list[Shot], list[str]]:
    """The frames to pose, named by their time in seconds, and notes about them.

    Args:    finer: so many frames in place of one.
    Raises:  InputError where the video cannot be read; DataFailure where its picture hardly moves;
      ConfigError on pose.camera EQUIRECTANGULAR.
    Choices: the file is decoded anew whenever frames are read, since they do not fit into memory.
    """
    (file,) = files(path)
    if settings.camera == cameras.EQUIRECTANGULAR:
        raise ConfigError(
            "pose.camera EQUIRECTANGULAR is of photos: take frames of the video as photos"
        )
    video = videos.describe(file)
    times, sharpness, moves = _measured(file, video, reporter)
    at_most = settings.max_views or finer * MOST
    rows = choose(progress(moves, STEP / finer), sharpness, at_most)
    if len(rows) < LEAST:
        raise DataFailure(
            f"{file}: its picture moves by {progress(moves)[-1]:.1f} steps of 7.5 % of its width, "
            f"which gives {len(rows)} views; {LEAST} are needed: walk around what is filmed"
        )
    notes = [
        f"{len(rows)} of {len(times)} frames are used, one for each time that the picture moves by "
        f"{STEP / finer:.1%} of its width, or fewer: at most {at_most} (pose.max_views)."
    ]
    if video.hdr:
        notes.append(
            "The video is HDR, and its colours are read as they are coded: film in SDR, "
            "or convert it."
        )
    size = video.width, video.height
    return [Shot(f"{times[k]:08.3f}", file, size, frame=int(k)) for k in rows], notes


def save(frames: Sequence[Shot], _: Path, pictures: Path, max_side: int) -> None:
    """Write frames, reduced until no side exceeds `max_side`."""
    row = {shot.frame: k for k, shot in enumerate(frames)}
    for number, image in _read_frames(frames[0].path, set(row)):
        size = frames[0].reduced(max_side)
        small = image if image.size == size else image.resize(size, Image.Resampling.BOX)
        small.save(pictures / file_of(row[number]), compress_level=1)


def read(path: Path, settings: IngestSection, model: PhotoModel) -> dict[str, Any]:
    """The fields of a capture: the frames of a model, undistorted, and its points."""
    (file,) = files(path)
    notes, rows = list(model.notes), np.arange(len(model.names))
    if settings.max_views is not None and settings.max_views < len(rows):
        rows = np.linspace(0, len(rows) - 1, settings.max_views).round().astype(int)
        notes.append(f"{len(rows)} of {len(model.names)} views are used (ingest.max_views).")
    lenses = [cameras.camera_of(file, *model.cameras[k]) for k in model.camera[rows]]
    shapes = assembly.geometries(lenses, settings.max_side, most_cut=1)  # frames are one stack
    if (least := min(shape.factor for shape in shapes)) < 1:
        notes.append(f"Images are reduced by {least:.3f} (ingest.max_side).")
    names = [model.names[row] for row in rows]
    view_of = {model.frames[row]: view for view, row in enumerate(rows)}
    lookup = functools.lru_cache(1)(assembly.positions)
    images, shares, step = [], [], max(len(rows) // assembly.COMPARED, 1)
    for frame, image in _read_frames(file, set(view_of)):
        view = view_of[frame]
        at = lookup(lenses[view], shapes[view])
        images.append(assembly.resampled(image, lenses[view], shapes[view], at))
        if view % step == 0:
            shares.append(assembly.variance_kept(image, images[-1], at))

    def altered(asked: set[str]) -> Iterator[tuple[str, cameras.Camera, Any]]:
        changed = {
            frame
            for frame, view in view_of.items()
            if names[view] in asked
            and (lenses[view].model in cameras.DISTORTED or shapes[view].factor < 1)
        }
        for frame, image in _read_frames(file, changed):
            yield names[view_of[frame]], lenses[view_of[frame]], image

    fields = {
        "names": names,
        "images": np.stack(images),
        "Ks": np.stack([shape.K for shape in shapes]),
        "cam_from_world": model.cam_from_world[rows],
        "source": {"kind": "video", "notes": notes},
        "altered": altered,
        "variance_kept": float(np.mean(shares)),
    }
    return fields | points_of(
        Cloud(model.points, model.colors, model.errors, model.tracks), model.names, fields
    )


def probe(path: Path) -> dict[str, bool]:
    """A video has neither poses, depth nor labels."""
    return {"poses": False, "depth": False, "labels": False}


def files(path: Path) -> list[Path]:
    """The video. Raises InputError where there is none, or several."""
    if not path.is_dir():
        return [path]
    names = sorted(name for name in os.listdir(path) if videos.is_video(name))
    if len(names) != 1:
        raise InputError(
            f"{path} holds {len(names)} videos, one is read at a time; name its file as scene="
        )
    return [path / names[0]]


def _measured(
    file: Path, video: videos.Video, reporter: Progress | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times of the frames, s [F], sharpness [F], and moves of their blocks [F, B, 2] in widths."""
    times: list[float | None] = []
    sharpness, moves, before = [], [], None
    frames: Any = videos.frames(file)
    if reporter is not None:
        frames = (
            item
            for item, _ in reporter.track(frames, lambda: max(video.n_frames, len(times)), "frames")
        )
    for frame in frames:
        small = _thumbnail(frame.pixels(THUMBNAIL))
        offsets = shifts(small if before is None else before, small)
        times.append(frame.time)
        sharpness.append(laplacian_variance(frame.pixels(SIDE)))
        moves.append(offsets / small.shape[1])
        before = small
    stamps = np.array([np.nan if time is None else time for time in times])
    if (
        not np.isfinite(stamps).all() or (np.diff(stamps) < 0.001).any()
    ):  # none, or damaged: then frames are evenly spaced
        stamps = np.arange(len(times)) / video.rate
    return stamps - stamps[0], np.array(sharpness), np.stack(moves)


def _thumbnail(grey: np.ndarray) -> np.ndarray:
    """A picture padded to the size of a block at least, by repeating its border."""
    lack = [max(BLOCK - side, 0) for side in grey.shape]
    return np.pad(grey, [(0, lack[0]), (0, lack[1])], mode="edge")


def _read_frames(file: Path, numbers: set[int]) -> Iterator[tuple[int, Any]]:
    """The frames of these numbers, each with its number, as RGB images."""
    left = len(numbers)
    for k, frame in enumerate(videos.frames(file) if left else ()):
        if k in numbers:
            yield k, Image.fromarray(frame.pixels())
            left -= 1
        if not left:
            break
