"""The video source: one file, or a folder that holds one and no photos. Poses come from the stage
`pose`.
"""

from __future__ import annotations

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

MOST, LEAST = 150, 3  # frames: where pose.max_views says nothing, and that a scene needs
# pixels of the longer side, on which sharpness and movement are measured
SIDE, THUMBNAIL = 640, 192


def shots(
    path: Path, settings: PoseSection, shown: Progress | None, finer: int
) -> tuple[list[Shot], list[str]]:
    """The frames to pose, named by their time in seconds, and notes about them.

    Args:    finer: so many frames in place of one.
    Raises:  InputError where the video cannot be read; DataFailure where its picture hardly moves;
      ConfigError where it
             is asked to show all directions.
    Choices: the file is decoded anew whenever frames are taken, since they do not fit into memory.
    """
    (file,) = files(path)
    if settings.camera == cameras.EQUIRECTANGULAR:
        raise ConfigError(
            "pose.camera EQUIRECTANGULAR is of photos: take frames of the video as photos"
        )
    video = videos.describe(file)
    times, sharpness, moves = _measured(file, video, shown)
    at_most = settings.max_views or finer * MOST
    taken = choose(progress(moves, STEP / finer), sharpness, at_most)
    if len(taken) < LEAST:
        raise DataFailure(
            f"{file}: its picture moves by {progress(moves)[-1]:.1f} steps of 7.5 % of its width, "
            "which gives "
            f"{len(taken)} views; {LEAST} are needed: walk around what is filmed"
        )
    notes = [
        f"{len(taken)} of {len(times)} frames are used, one for each time that the picture moves "
        "by "
        f"{STEP / finer:.1%} of its width, or fewer: at most {at_most} (pose.max_views)."
    ]
    if video.hdr:
        notes.append(
            "The video is HDR, and its colours are read as they are coded: film in SDR, "
            "or convert it."
        )
    size = video.width, video.height
    return [Shot(f"{times[k]:08.3f}", file, size, frame=int(k)) for k in taken], notes


def save(found: Sequence[Shot], _: Path, pictures: Path, max_side: int) -> None:
    """Write frames, reduced until no side exceeds `max_side`."""
    row = {shot.frame: k for k, shot in enumerate(found)}
    for number, image in _taken(found[0].path, set(row)):
        size = found[0].reduced(max_side)
        small = image if image.size == size else image.resize(size, Image.Resampling.BOX)
        small.save(pictures / file_of(row[number]), compress_level=1)


def read(path: Path, settings: IngestSection, model: PhotoModel) -> dict[str, Any]:
    """The fields of a capture: the frames of a model, without what the lens bends, and its
    points.
    """
    (file,) = files(path)
    camera = cameras.camera_of(file, *model.cameras[0])
    view = assembly.geometry(camera, settings.max_side)
    at = assembly.positions(camera, view)
    notes, rows = list(model.notes), np.arange(len(model.names))
    if settings.max_views is not None and settings.max_views < len(rows):
        rows = np.linspace(0, len(rows) - 1, settings.max_views).round().astype(int)
        notes.append(f"{len(rows)} of {len(model.names)} views are used (ingest.max_views).")
    if view.factor < 1:
        notes.append(f"Images are reduced by {view.factor:.3f} (ingest.max_side).")
    named = {model.frames[row]: model.names[row] for row in rows}
    images, kept, step = [], [], max(len(named) // assembly.COMPARED, 1)
    for k, (_, image) in enumerate(_taken(file, set(named))):
        images.append(assembly.resampled(image, camera, view, at))
        if k % step == 0:
            kept.append(assembly.variance_kept(image, images[-1], at))

    def altered(wanted: set[str]) -> Iterator[tuple[str, cameras.Camera, Any]]:
        changed = camera.model in cameras.DISTORTED or view.factor < 1
        numbers = {frame for frame, name in named.items() if name in wanted and changed}
        return ((named[frame], camera, image) for frame, image in _taken(file, numbers))

    fields = {
        "names": list(named.values()),
        "images": np.stack(images),
        "Ks": np.tile(view.K, (len(images), 1, 1)),
        "cam_from_world": model.cam_from_world[rows],
        "source": {"kind": "video", "notes": notes},
        "altered": altered,
        "variance_kept": float(np.mean(kept)),
    }
    return fields | points_of(
        Cloud(model.points, model.colors, model.errors, model.tracks), model.names, fields
    )


def probe(path: Path) -> dict[str, bool]:
    """What a video brings beside its frames: nothing."""
    return {"poses": False, "depth": False, "labels": False}


def files(path: Path) -> list[Path]:
    """The video. Raises InputError where there is none, or several."""
    if not path.is_dir():
        return [path]
    found = sorted(name for name in os.listdir(path) if videos.is_video(name))
    if len(found) != 1:
        raise InputError(
            f"{path} holds {len(found)} videos, one is read at a time; name its file as scene="
        )
    return [path / found[0]]


def _measured(
    file: Path, video: videos.Video, shown: Progress | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each frame its time in s [F], its sharpness [F] and the moves of its blocks [F, B, 2] in
    widths.
    """
    times: list[float | None] = []
    sharpness, moves, before = [], [], None
    frames: Any = videos.frames(file)
    if shown is not None:
        frames = (
            item
            for item, _ in shown.track(frames, lambda: max(video.n_frames, len(times)), "frames")
        )
    for frame in frames:
        small = _thumbnail(frame.pixels(THUMBNAIL))
        found = shifts(small if before is None else before, small)
        times.append(frame.time)
        sharpness.append(laplacian_variance(frame.pixels(SIDE)))
        moves.append(found / small.shape[1])
        before = small
    given = np.array([np.nan if time is None else time for time in times])
    if (
        not np.isfinite(given).all() or (np.diff(given) < 0.001).any()
    ):  # none, or damaged: then frames are evenly spaced
        given = np.arange(len(times)) / video.rate
    return given - given[0], np.array(sharpness), np.stack(moves)


def _thumbnail(grey: np.ndarray) -> np.ndarray:
    """A picture that no side of is shorter than a block: its border is repeated."""
    lack = [max(BLOCK - side, 0) for side in grey.shape]
    return np.pad(grey, [(0, lack[0]), (0, lack[1])], mode="edge")


def _taken(file: Path, wanted: set[int]) -> Iterator[tuple[int, Any]]:
    """The frames of these numbers, each with its number, as RGB images."""
    left = len(wanted)
    for k, frame in enumerate(videos.frames(file) if left else ()):
        if k in wanted:
            yield k, Image.fromarray(frame.pixels())
            left -= 1
        if not left:
            break
