"""A finished scene from other cameras: render, cameras, view."""

from __future__ import annotations

import logging
import sys
import time
from contextlib import suppress
from pathlib import Path

import click

from chebsplat.errors import ConfigError, InputError
from chebsplat.pipelines.cli.options import AGAINST

PATH = click.option(
    "--path", default="capture", show_default=True, help="orbit, capture, or a cameras.json or transforms.json"
)
FRAMES = click.option("--frames", type=click.IntRange(1, 100_000), default=120, show_default=True, help="of an orbit")
SIZE = click.option("--size", help="WIDTHxHEIGHT in pixels, such as 1280x960; default: the cameras' own")


@click.command()
@click.argument("scene")
@PATH
@FRAMES
@click.option("--what", default="color", show_default=True, help="of color,labels,depth,relevancy; with commas")
@click.option("--query", help="words that relevancy is of")
@AGAINST
@SIZE
@click.option("--fps", type=click.IntRange(1, 240), default=24, show_default=True, help="of a video")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="a folder of frames, or a .mp4")
def render(
    scene: str,
    path: str,
    frames: int,
    what: str,
    query: str | None,
    against: list[str],
    size: str | None,
    fps: int,
    out: Path,
) -> None:
    """Render a finished SCENE along a path of cameras, as frames or a video; frames that are there are kept."""
    from chebsplat.formats.artifact import read_manifest
    from chebsplat.pipelines.api import load
    from chebsplat.pipelines.finished import artifact_of
    from chebsplat.stages.camera_paths import fitted, path_of, size_of
    from chebsplat.stages.frames import Shot, kinds_of, render_frames
    from chebsplat.stages.progress import Progress
    from chebsplat.stages.video import render_video

    opened, wanted = load(scene), size_of(size)
    kinds = kinds_of(what, opened, query is not None)
    asked = None if query is None else opened.understood(query, against)
    shot = Shot(kinds, read_manifest(artifact_of(scene, "export")).key, asked)
    cameras = [fitted(camera, wanted) for camera in path_of(opened, path, frames)]
    if out.suffix == ".mp4":
        render_video(opened, cameras, shot, out, fps, Progress())
    else:
        render_frames(opened, cameras, shot, out, Progress())
    print(out.absolute())


@click.command()
@click.argument("scene")
@PATH
@FRAMES
@SIZE
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the folder to write into")
def cameras(scene: str, path: str, frames: int, size: str | None, out: Path) -> None:
    """Write the cameras of a SCENE as COLMAP's text model, transforms.json and 3DGS' cameras.json."""
    from chebsplat.pipelines.api import load
    from chebsplat.stages.camera_files import write_cameras
    from chebsplat.stages.camera_paths import fitted, path_of, size_of

    wanted = size_of(size)
    for file in write_cameras(out, [fitted(camera, wanted) for camera in path_of(load(scene), path, frames)]):
        print(file.absolute())


@click.command()
@click.argument("scene")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="the next free one from it"
)
@click.option("--host", default="127.0.0.1", show_default=True, help="0.0.0.0: whoever reaches this machine may look")
@click.option("--frames", type=click.Path(path_type=Path), help="where camera paths go; default: frames-of-SCENE, here")
def view(scene: str, port: int, host: str, frames: Path | None) -> None:
    """Look at a finished SCENE (or a .ply) in a browser, live: fly, point at things, ask for words. Ctrl-C ends it."""
    import gc
    import os
    import warnings

    from chebsplat.pipelines.finished import artifact_of, links, scene_folder
    from chebsplat.stages.view import Viewer, photos_of

    logging.basicConfig(stream=sys.stderr, format="view: %(message)s", level="WARNING", force=True)
    warnings.filterwarnings("ignore", "Queued a .* closed connection", UserWarning)  # a page was closed; all is well
    theirs = scene.endswith(".ply")
    source = Path(os.path.expanduser(scene)) if theirs else artifact_of(scene, "export")
    if theirs and not source.is_file():
        raise InputError(f"{source} is missing; correct the path")
    name = (source.stem if theirs else Path(os.path.abspath(scene)).name).partition("@")[0]
    gc.disable()  # until the scene is there: what is imported stays, and looking for garbage costs a tenth of the wait
    viewer = Viewer(name, host, port)
    try:
        print(f"http://{'localhost' if host == '0.0.0.0' else host}:{viewer.port}", flush=True)
        if viewer.port != port:
            print(f"port {port} is taken; this is the next free one", file=sys.stderr)
        from chebsplat.pipelines.api import load
        from chebsplat.stages.opened import OpenedScene
        from chebsplat.stages.page import foreign
        from chebsplat.stages.viewing import Viewing

        opened, photos = OpenedScene(foreign(source), source) if theirs else load(scene), None
        with suppress(ConfigError, InputError, KeyError):  # a .ply or an artifact alone has no photos
            photos = None if theirs else photos_of(links(scene_folder(scene))["ingest"])
        viewer.show(Viewing(opened, photos), (frames or Path(f"frames-of-{name}")).absolute())
        gc.freeze()
        gc.enable()
        while True:
            time.sleep(3600)
    finally:
        viewer.end()


COMMANDS = (render, cameras, view)
