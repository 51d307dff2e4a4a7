"""Frames as a video: H.264 in MP4, through PyAV."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import ConfigError
from chebsplat.formats.files import atomic_path

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.stages.frames import Shot
    from chebsplat.stages.opened import Camera, OpenedScene
    from chebsplat.stages.progress import Progress

INSTALL = ".venv/bin/pip install -e '.[video]'"
CRF = "18"  # x264's constant rate factor: hardly told from the frames by eye


def library() -> Any:
    """PyAV. Raises ConfigError with the command that installs it."""
    try:
        import av
    except ImportError:
        raise ConfigError(f"videos need the extra `video`: {INSTALL}; or render into a folder") from None
    return av


def render_video(
    scene: OpenedScene, cameras: Sequence[Camera], shot: Shot, out: Path, rate: int, progress: Progress
) -> None:
    """Render one kind of frames into a video; frames lie beside it, and stay there until it is written.

    Raises: ConfigError where `out` exists, on two kinds, and on sizes that no video has.
    """
    import numpy as np

    from chebsplat.stages.frames import render_frames, shown

    library()
    if out.exists():
        raise ConfigError(f"{out} exists; remove it, or choose another --out")
    if len(shot.kinds) != 1:
        raise ConfigError(f"a video shows one of {','.join(shot.kinds)}; choose one, or a folder for --out")
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise ConfigError("the cameras have several sizes, a video has one; choose a --size")
    check_size(next(iter(sizes)))
    kind, folder = shot.kinds[0], out.with_name(f".frames-{out.name}")
    files = render_frames(scene, cameras, shot, folder, progress)[kind]
    far = 1.0
    if kind == "depth":
        far = max(float(np.nanmax(np.load(path), initial=1e-6)) for path in files)
    write_video(out, (shown(kind, path, far) for path in files), next(iter(sizes)), rate)
    shutil.rmtree(folder)


def check_size(size: tuple[int, int]) -> None:
    """Raise ConfigError where a video cannot have this size (width, height)."""
    if size[0] % 2 or size[1] % 2:
        raise ConfigError(f"a video's sides are even, not {size[0]}x{size[1]}; choose another --size")


def write_video(path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], rate: int) -> None:
    """Write pictures u8 [H, W, 3] of `size` (width, height), `rate` a second, whole or not at all."""
    av = library()
    check_size(size)
    with atomic_path(path) as temporary, av.open(str(temporary), "w") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": CRF})
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        for picture in frames:
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
