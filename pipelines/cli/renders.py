"""Commands that show a finished scene: render, cameras, page, view."""

from __future__ import annotations

import os
import sys
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.splats import is_splat
from chebsplat.pipelines.cli.group import AGAINST, SCENE, UP, NewPath

VIDEO = ".mp4"
PATHS = "flight (along the capture's cameras, smoothed and level; of a splat alone within it), \
orbit, capture, or a cameras.json or transforms.json"
FRAMES = click.option(
    "--frames",
    type=click.IntRange(1, 100_000),
    help="of an orbit (default: 120) or a flight (by its length), or of a path through other "
    "cameras (default: none)",
)
SIZE = click.option(
    "--size", help="WIDTHxHEIGHT in pixels, such as 1280x960; default: the cameras' own"
)
SH = click.option(
    "--sh",
    type=click.IntRange(0, 1),
    default=0,
    show_default=True,
    help="SH degree of the colours",
)
WORDS = click.option(
    "--words",
    type=click.Path(path_type=Path),
    help="text file of more words to ask for, one a line",
)


class FramesPath(click.ParamType):
    """A folder, which has no ending, or a video, whose ending is .mp4."""

    name = "path"

    def convert(self, value: Any, param: Any, context: click.Context | None) -> Path:
        path = Path(value)
        if path.suffix[1:2].isalpha() and path.suffix.lower() != VIDEO and not path.is_dir():
            raise ConfigError(
                f"{path}: frames go into a folder, whose name has no ending, or into a video that "
                f"ends in {VIDEO}; choose another --out"
            )
        return path


@click.command()
@SCENE
@click.option(
    "--path",
    default="auto",
    help=f"{PATHS}; default: orbit where the cameras look inwards, else flight",
)
@FRAMES
@UP
@click.option(
    "--what",
    default="color",
    show_default=True,
    help="color,labels,depth,relevancy, or some of these",
)
@click.option("--query", help="words of the relevancy")
@AGAINST
@SIZE
@click.option(
    "--fps", type=click.IntRange(1, 240), default=24, show_default=True, help="of a video"
)
@click.option("--out", type=FramesPath(), required=True, help="a folder of frames, or a .mp4")
def render(
    scene: str,
    path: str,
    frames: int | None,
    up: Any,
    what: str,
    size: str | None,
    fps: int,
    out: Path,
    **of_query: Any,
) -> None:
    """Render a finished SCENE along a path of cameras, as frames or a video; old frames stay."""
    from chebsplat.formats.artifact import read_manifest
    from chebsplat.pipelines.api import load
    from chebsplat.pipelines.work.finished import artifact_of
    from chebsplat.stages.runtime.progress import Progress
    from chebsplat.stages.tools.camera_paths import fitted, path_of, size_of
    from chebsplat.stages.tools.frames import Shot, kinds_of, library, render_frames, render_video

    is_video = out.suffix.lower() == VIDEO
    if is_video:
        library()  # fails on a missing extra before a scene is opened
    opened, pixels, query = load(scene), size_of(size), of_query["query"]
    kinds = kinds_of(what, opened, query is not None)
    query_vectors = None if query is None else opened.understood(query, of_query["against"])
    shot = Shot(kinds, read_manifest(artifact_of(scene, "export")).key, query_vectors)
    cameras = [fitted(camera, pixels) for camera in path_of(opened, path, frames, up)]
    if is_video:
        render_video(opened, cameras, shot, out, fps, Progress())
    else:
        render_frames(opened, cameras, shot, out, Progress())
    print(out.absolute())


@click.command()
@SCENE
@click.option("--path", default="capture", show_default=True, help=PATHS)
@FRAMES
@UP
@SIZE
@click.option(
    "--full", is_flag=True, help="all that others train on: undistorted photos and points, too"
)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="the folder to write into"
)
def cameras(
    scene: str, path: str, frames: int | None, up: Any, size: str | None, full: bool, out: Path
) -> None:
    """Write a SCENE's cameras as COLMAP's model, transforms.json and 3DGS' cameras.json."""
    from chebsplat.formats.capture import Capture
    from chebsplat.formats.points import Points
    from chebsplat.pipelines.api import load
    from chebsplat.pipelines.work.finished import artifact_of, scene_folder
    from chebsplat.stages.tools.camera_files import write_cameras, write_capture
    from chebsplat.stages.tools.camera_paths import fitted, path_of, size_of

    if full and (path, frames, up, size) != ("capture", None, None, None):
        raise ConfigError(
            "--full writes the views as they were captured; leave out --path, --frames, --up, "
            "--size"
        )
    if full:
        of = str(scene_folder(scene))
        read = Capture.read(artifact_of(of, "ingest")), Points.read(artifact_of(of, "sfm"))
        paths = write_capture(out, *read)
    else:
        pixels = size_of(size)
        cameras_of_path = path_of(load(scene), path, frames, up)
        paths = write_cameras(out, [fitted(camera, pixels) for camera in cameras_of_path])
    print(*(path.absolute() for path in paths), sep="\n")


@click.command()
@SCENE
@click.option("--out", type=NewPath(), required=True, help="the .html to write")
@SH
@WORDS
@AGAINST
@UP
def page(scene: str, out: Path, sh: int, words: Path | None, against: list[str], up: Any) -> None:
    """Write a finished SCENE (or a splat) as one HTML page to fly through and query."""
    _write_page(scene, out, sh, words, against, up)


@click.command()
@SCENE
@SH
@WORDS
@AGAINST
@UP
def view(scene: str, sh: int, words: Path | None, against: list[str], up: Any) -> None:
    """Look at a finished SCENE (or a splat): write it as `page` does, and open that in a browser.

    The page lies in the scene's folder, that of a .ply where you stand; each call writes it anew.
    """
    from chebsplat.pipelines.work.finished import scene_folder
    from chebsplat.pipelines.work.inventory import PAGE

    out = Path(f"{_name(scene)}.{PAGE}")
    if not is_splat(scene):
        with suppress(InputError):  # an artifact of no scene
            out = scene_folder(scene) / PAGE
    out = out.absolute()
    _write_page(scene, out, sh, words, against, up)
    graphical = any(map(os.environ.get, ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY")))
    if not (
        graphical and webbrowser.open(out.as_uri())
    ):  # without a screen it may be a text browser
        print("no browser can be opened from here; open this file in one", file=sys.stderr)


def _name(scene: str) -> str:
    path = Path(os.path.abspath(scene))
    return path.stem if path.suffix and is_splat(scene) else path.name


def _write_page(
    scene: str, out: Path, sh: int, words: Path | None, against: list[str], up: Any
) -> None:
    """Write the page and say where it is."""
    from chebsplat.formats.scene import Scene
    from chebsplat.formats.teacher_model import read_label_set
    from chebsplat.pipelines.work.finished import artifact_of, teacher_of
    from chebsplat.stages.tools.page import foreign, with_own_semantics, write_page

    if is_splat(scene):
        splat = Path(scene).expanduser()
        opened, teacher, up = with_own_semantics(foreign(splat, up), splat), None, None
    else:
        opened, teacher = Scene.read(artifact_of(scene, "export")), teacher_of(scene)
    more = list(read_label_set(words)) if words else []
    counts = write_page(opened, _name(scene), teacher, out, sh, against, more, up)
    print(", ".join(f"{name} {number:,}" for name, number in counts.items()), file=sys.stderr)
    print(out, flush=True)


COMMANDS = (render, cameras, page, view)
