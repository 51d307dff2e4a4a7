"""Videos from outside, read by PyAV: containers that cameras write, recognised by content."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.extras import extra
from chebsplat.formats.files import regular
from chebsplat.formats.images import MAX_PIXELS, MAX_SIDE

SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts", ".3gp")
# FFmpeg reads playlists, too, which name other files
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts"
HDR = (16, 18)  # transfer functions PQ and HLG, ITU-T H.273


def is_video(name: str) -> bool:
    """True for the name of a video; hidden files are none."""
    return os.path.splitext(name)[1].lower() in SUFFIXES and not name.startswith(".")


@dataclass(frozen=True)
class Video:
    """width, height: upright, square pixels; n_frames, rate (frames/s): estimates; hdr: colours
    coded for a brighter screen than a photo's.
    """

    width: int
    height: int
    n_frames: int
    rate: float
    hdr: bool


class VideoFrame:
    """A decoded frame, upright. time: seconds by the file; None where it gives none."""

    def __init__(self, frame: Any, width: int, height: int):
        self.time: float | None = frame.time
        self._frame, self._size, self._turns = frame, (width, height), quarters(frame)

    def pixels(self, grey_side: int | None = None) -> np.ndarray:
        """u8 [H, W, 3], or grey [H, W] whose longer side is at most `grey_side`."""
        (width, height), kind = self._size, "rgb24"
        if grey_side is not None:
            factor, kind = min(1.0, grey_side / max(width, height)), "gray"
            width, height = max(round(width * factor), 1), max(round(height * factor), 1)
        if self._turns % 2:
            width, height = height, width
        array = self._frame.to_ndarray(
            format=kind, width=width, height=height, interpolation="AREA"
        )
        return np.ascontiguousarray(np.rot90(array, self._turns))


def quarters(frame: Any) -> int:
    """Quarter turns, counter-clockwise, that bring a frame upright."""
    return round(float(frame.rotation) / 90) % 4


def require_av(path: Path) -> Any:
    """The package av. Raises InputError with the command that installs it, if it is missing."""
    return extra("av", f"{path} is a video, which", error=InputError)


def describe(path: Path) -> Video:
    """Size, length and rate of a video; decodes its first frame. Raises InputError."""
    with _opened(path) as (container, stream):
        first = next(container.decode(stream), None)
        if first is None:
            raise InputError(f"{path} holds no frame; copy it again")
        width, height = _upright_size(path, stream, first)
        rate = float(stream.average_rate or stream.guessed_rate or 30)
        seconds = container.duration / 1e6 if container.duration else 0
        return Video(
            width,
            height,
            max(stream.frames or round(seconds * rate), 1),
            rate,
            first.color_trc in HDR,
        )


def frames(path: Path) -> Iterator[VideoFrame]:
    """All frames in order of presentation. Raises InputError naming a damaged file."""
    size: tuple[int, int] | None = None
    with _opened(path) as (container, stream):
        for frame in container.decode(stream):
            size = size or _upright_size(path, stream, frame)
            yield VideoFrame(frame, *size)


def _upright_size(path: Path, stream: Any, frame: Any) -> tuple[int, int]:
    """(width, height) of an upright frame of square pixels. Raises InputError if too large."""
    width, height = (
        max(round(frame.width * float(stream.sample_aspect_ratio or 1)), 1),
        frame.height,
    )
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        raise InputError(
            f"{path} is too large ({width}x{height}; {MAX_PIXELS // 10**6} megapixels are read); "
            "reduce it"
        )
    return (height, width) if quarters(frame) % 2 else (width, height)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """(container, its first stream of video)."""
    regular(path, "correct source.path")
    av = require_av(path)
    try:
        options = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
        with av.open(os.fspath(path), options=options, metadata_errors="replace") as container:
            if not container.streams.video:
                raise InputError(f"{path} holds no video; name another file")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            yield container, stream
    except (av.error.FFmpegError, OSError) as error:
        fault = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{path} is not a readable video ({fault}); copy or export it again"
        ) from None
