"""render: a finished scene as frames of colour, labels, depth, relevancy; whole frames are kept.

A video of them is H.264 in MP4, through PyAV.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.extras import extra
from chebsplat.formats.files import atomic_path, atomic_write, parse_json
from chebsplat.formats.images import opened, read_rgb
from chebsplat.labels.decode import decode_labels
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.tools.camera_files import file_names, gs_cameras
from chebsplat.stages.tools.query import Query
from chebsplat.stages.tools.scene import COVERED, Camera, OpenedScene

log = logging.getLogger("chebsplat")

KINDS = ("color", "labels", "depth", "relevancy")
SEMANTIC = ("labels", "relevancy")
REQUEST = "frames.json"
EMPTY = 0.05  # of a frame that is covered, below which it shows next to nothing
N_LOOKED_AT, SMALL = 60, 64  # frames of a path that are looked at before, pixels of a side
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"  # the last chunk
CRF = "18"  # x264's constant rate factor, visually almost lossless


@dataclass(frozen=True)
class Shot:
    """Kinds of frames (of KINDS) to render of every camera; identity of the scene, so that frames
    of another are recognised; query, if relevancy is among the kinds.
    """

    kinds: tuple[str, ...]
    identity: str
    query: Query | None = None


def kinds_of(text: str, scene: OpenedScene, has_query: bool) -> tuple[str, ...]:
    """The kinds in "color,depth". Raises ConfigError on one that the scene or query cannot give.

    Args: has_query: true where a query is given.
    """
    kinds = tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    if not kinds or set(kinds) - set(KINDS):
        raise ConfigError(f"--what {text}: one or more of {','.join(KINDS)} are needed")
    if "relevancy" in kinds and not has_query:
        raise ConfigError("--what relevancy needs --query TEXT")
    if has_query and "relevancy" not in kinds:
        raise ConfigError("--query is of relevancy; add relevancy to --what")
    if scene.labels is None and (missing := [kind for kind in kinds if kind in SEMANTIC]):
        raise ConfigError(
            f"{scene.source} has no semantics, so no {missing[0]}; render color,depth"
        )
    return kinds


def render_frames(
    scene: OpenedScene, cameras: Sequence[Camera], shot: Shot, out: Path, progress: Progress
) -> dict[str, list[Path]]:
    """Render every camera's frames into OUT/<kind>/<view>.png (depth: .npy), unless they are there.

    Returns: the files of each kind, in the cameras' order.
    Raises:  ConfigError where `out` holds something else than frames of this request.
    Choices: colour is 8-bit RGB, as `evaluate` measures it. Labels are a palette PNG whose values
      are row of label_names + 1, 0 where a pixel is less than half covered; 16-bit grey without
      palette beyond 255 labels. Depth is float32 .npy, scene units along the camera's axis, nan
      where nothing is: units are the source's own, and 16-bit thousandths would clip or coarsen
      units other than metres. Relevancy is the render under its heat.
    """
    names = file_names([f"{camera.name}.png" for camera in cameras])
    claim(out, cameras, shot, scene)
    warn_of_empty(scene, cameras)
    files = {kind: [out / kind / f"{name}{ending(kind)}" for name in names] for kind in shot.kinds}
    missing = []
    for k, camera in enumerate(cameras):
        absent = tuple(kind for kind in shot.kinds if not whole(files[kind][k], camera))
        missing += [(k, absent)] if absent else []
    n_whole = len(cameras) - len(missing)
    if n_whole:
        log.info("%d of %d frames are there and kept", n_whole, len(cameras))
    for (k, absent), _ in progress.track(missing, len(cameras), "render", start=n_whole):
        for kind, values in pictures(scene, cameras[k], shot, absent).items():
            with atomic_path(files[kind][k]) as temporary:
                save(kind, values, temporary, len(scene.label_names or []))
    return files


def warn_of_empty(scene: OpenedScene, cameras: Sequence[Camera]) -> None:
    """Warn of the share of the frames of which less than 5 % is covered, before they are rendered.

    Choices: of more than 60 every n-th is looked at, in a few pixels: a path shows much the same
      in frames that follow each other.
    """
    sample = cameras[:: -(-len(cameras) // N_LOOKED_AT)]
    empty = 0
    for camera in sample:
        scale = min(SMALL / max(camera.width, camera.height), 1.0)
        small = camera.resized(*(max(round(scale * s), 1) for s in (camera.width, camera.height)))
        covered = scene.depth(scene.inside(small).view())[1] >= COVERED
        empty += int(covered.mean() < EMPTY)
    if empty:
        log.warning(
            "%.0f %% of the frames show next to nothing (less than %.0f %% of each is covered); "
            "choose another --path",
            100 * empty / len(sample),
            100 * EMPTY,
        )


def ending(kind: str) -> str:
    """Suffix of the files of a kind."""
    return ".npy" if kind == "depth" else ".png"


def claim(out: Path, cameras: Sequence[Camera], shot: Shot, scene: OpenedScene) -> None:
    """Record the request that the frames of `out` answer, or check that existing ones answer it."""
    request = {"scene": shot.identity, "labels": scene.label_names, "cameras": gs_cameras(cameras)}
    request |= {"query": None if shot.query is None else [shot.query.text, *shot.query.phrases]}
    path = out / REQUEST
    if path.exists():
        if parse_json(path) != json.loads(json.dumps(request)):
            raise ConfigError(
                f"{out} holds frames of another scene, path, size or query; remove "
                "it, or choose --out"
            )
    elif out.exists() and any(out.iterdir()):
        raise ConfigError(f"{out} holds something else than frames; choose another --out")
    else:
        atomic_write(path, json.dumps(request, indent=1))


def whole(path: Path, camera: Camera) -> bool:
    """True where a frame is there, readable to its last byte, and of the camera's size."""
    if not path.is_file():
        return False
    size = camera.width, camera.height
    try:
        if path.suffix == ".npy":
            return bool(np.load(path, allow_pickle=False).shape == size[::-1])
        with opened(path) as image:
            # Pillow reads a file without its end
            return bool(image.size == size) and path.read_bytes().endswith(PNG_END)
    except (InputError, ValueError, OSError, EOFError) as error:
        log.warning("%s is rendered again: %s", path, error)
        return False


def pictures(
    scene: OpenedScene, camera: Camera, shot: Shot, kinds: Sequence[str]
) -> dict[str, np.ndarray]:
    """Arrays of these kinds: color, relevancy u8 [H, W, 3], labels i32 [H, W], depth f32 [H, W]."""
    from chebsplat.stages.pages.pictures import heat

    view, renderer = scene.inside(camera).view(), scene.renderer
    arrays: dict[str, np.ndarray] = {}
    features = None
    if set(kinds) != {"depth"}:
        arrays["color"], features = renderer.render(
            view, with_features=bool(set(kinds) & set(SEMANTIC))
        )
    if "depth" in kinds or "labels" in kinds:
        arrays["depth"], alpha = scene.depth(view)
        if "labels" in kinds and features is not None and scene.label_embeddings is not None:
            arrays["labels"] = np.where(
                alpha < COVERED, -1, decode_labels(features, scene.label_embeddings)
            )
    if "relevancy" in kinds and features is not None and shot.query is not None:
        arrays["relevancy"] = heat(arrays["color"], shot.query.scores(features))
    return {kind: arrays[kind] for kind in kinds}


def save(kind: str, values: np.ndarray, path: Path, n_labels: int) -> None:
    """Write one frame in its kind's form."""
    from chebsplat.stages.pages.pictures import palette, png

    if kind == "depth":
        with path.open("wb") as handle:
            np.save(handle, values, allow_pickle=False)
    elif kind != "labels":
        png(values, path)
    elif n_labels > 255:
        Image.fromarray((values + 1).astype(np.uint16)).save(path, "PNG")
    else:
        image = Image.fromarray((values + 1).astype(np.uint8)).convert("L")
        image = Image.frombytes("P", image.size, image.tobytes())
        image.putpalette([0, 0, 0, *palette(n_labels).ravel().tolist()])
        image.save(path, "PNG")


def depth_colors(depth: np.ndarray, far: float) -> np.ndarray:
    """Depth [H, W], nan unknown, as u8 [H, W, 3]: turbo, red near; far: the darkest depth."""
    from matplotlib import colormaps

    colors = colormaps["turbo"](1 - (np.nan_to_num(depth, nan=far) / far).clip(0, 1))[..., :3]
    return np.where(np.isnan(depth)[..., None], 0, np.round(255 * colors)).astype(np.uint8)


def library() -> Any:
    """PyAV. Raises ConfigError with the command that installs it."""
    return extra("av", "writing a video", "render into a folder")


def render_video(
    scene: OpenedScene,
    cameras: Sequence[Camera],
    shot: Shot,
    out: Path,
    rate: int,
    progress: Progress,
) -> None:
    """Render one kind of frames into a video; its frames are kept beside it until it is written.

    Raises: ConfigError where `out` exists, on two kinds, and on sizes that no video has.
    """
    if out.exists():
        raise ConfigError(f"{out} exists; remove it, or choose another --out")
    if len(shot.kinds) != 1:
        raise ConfigError(
            f"a video shows one of {','.join(shot.kinds)}; choose one, or a folder for --out"
        )
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise ConfigError("the cameras have several sizes, a video has one; choose a --size")
    check_size(next(iter(sizes)))
    kind, folder = shot.kinds[0], out.with_name(f".frames-{out.name}")
    files = render_frames(scene, cameras, shot, folder, progress)[kind]
    images: Iterable[np.ndarray] = map(read_rgb, files)
    if kind == "depth":
        far = max(float(np.nanmax(np.load(path), initial=1e-6)) for path in files)
        images = (depth_colors(np.load(path), far) for path in files)
    write_video(out, images, next(iter(sizes)), rate)
    shutil.rmtree(folder)


def check_size(size: tuple[int, int]) -> None:
    """Raise ConfigError where a video cannot have this size (width, height)."""
    if size[0] % 2 or size[1] % 2:
        raise ConfigError(
            f"a video's sides are even, not {size[0]}x{size[1]}; choose another --size"
        )


def write_video(path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], rate: int) -> None:
    """Write pictures u8 [H, W, 3] of `size` (width, height), `rate` a second, atomically."""
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
