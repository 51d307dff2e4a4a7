"""The video source: one file, or a folder that holds one and no photos. Frames are chosen, poses are unknown."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats import videos
from chebsplat.photos.frames import BLOCK, choose, laplacian_variance, progress, shifts
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.sources import assembly, cameras
from chebsplat.stages.sources.photos import GUESS

MOST = 150  # frames, where ingest.max_views says nothing
SIDE, THUMBNAIL = 640, 192  # pixels of the longer side, on which sharpness and movement are measured


def read(path: Path, settings: Any, shown: Progress | None = None) -> dict[str, Any]:
    """The fields of a capture, without poses; views are named by their time in seconds.

    Raises:  InputError where the video cannot be read; DataFailure where its picture hardly moves.
    Choices: the file is decoded twice, once to measure and once to take, since frames do not fit into memory.
    """
    (file,) = files(path)
    video = videos.describe(file)
    times, sharpness, moves = _measured(file, video, shown)
    at_most = settings.max_views or MOST
    taken = choose(progress(moves), sharpness, at_most)
    if len(taken) < settings.min_views:
        raise DataFailure(
            f"{file}: its picture moves by {progress(moves)[-1]:.1f} steps of 7.5 % of its width, which gives "
            f"{len(taken)} views; ingest.min_views is {settings.min_views}: walk around what is filmed"
        )
    focal = GUESS * max(video.width, video.height)
    camera = cameras.camera_of(
        file, "SIMPLE_PINHOLE", (focal, video.width / 2, video.height / 2), video.width, video.height
    )
    view = assembly.geometry(camera, settings.max_side)
    images = _taken(file, set(taken.tolist()), camera, view)
    notes = [
        f"{len(taken)} of {len(times)} frames are used, one for each time that the picture moves by 7.5 % of its "
        f"width, at most {at_most} (ingest.max_views).",
        f"The video has no focal length; {GUESS} times the longer side is the first guess.",
    ]
    if view.factor < 1:
        notes.append(f"Images are reduced by {view.factor:.3f} (ingest.max_side).")
    if video.hdr:
        notes.append("The video is HDR, and its colours are read as they are coded: film in SDR, or convert it.")
    return {
        "names": [f"{times[k]:08.3f}" for k in taken],
        "images": images,
        "Ks": np.tile(view.K, (len(taken), 1, 1)),
        "cam_from_world": None,
        "source": {"kind": "video", "notes": notes},
    }


def probe(path: Path) -> dict[str, bool]:
    """What a video brings beside its frames: nothing."""
    return {"poses": False, "depth": False, "labels": False}


def files(path: Path) -> list[Path]:
    """The video. Raises InputError where there is none, or several."""
    if not path.is_dir():
        return [path]
    found = sorted(name for name in os.listdir(path) if videos.is_video(name))
    if len(found) != 1:
        raise InputError(f"{path} holds {len(found)} videos, one is read at a time; name its file as scene=")
    return [path / found[0]]


def _measured(file: Path, video: videos.Video, shown: Progress | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each frame its time in s [F], its sharpness [F] and the moves of its blocks [F, B, 2] in widths."""
    times: list[float | None] = []
    sharpness, moves, before = [], [], None
    frames: Any = videos.frames(file)
    if shown is not None:
        frames = (item for item, _ in shown.track(frames, lambda: max(video.n_frames, len(times)), "frames"))
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


def _taken(file: Path, wanted: set[int], camera: cameras.Camera, view: assembly.Geometry) -> np.ndarray:
    """The frames of these numbers, u8 [V, H, W, 3]."""
    at, images = assembly.positions(camera, view), []
    for k, frame in enumerate(videos.frames(file)):
        if k in wanted:
            images.append(assembly.resampled(Image.fromarray(frame.pixels()), camera, view, at))
        if len(images) == len(wanted):
            break
    return np.stack(images)
