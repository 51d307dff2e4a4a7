"""A finished scene from other cameras: render, cameras."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import click

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
@click.option("--against", default="", help="phrases the query is weighed against, with commas")
@SIZE
@click.option("--fps", type=click.IntRange(1, 240), default=24, show_default=True, help="of a video")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="a folder of frames, or a .mp4")
def render(
    scene: str,
    path: str,
    frames: int,
    what: str,
    query: str | None,
    against: str,
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
    from chebsplat.stages.video import library, render_video

    logging.basicConfig(stream=sys.stderr, format="render: %(message)s", level="WARNING", force=True)
    logging.getLogger("chebsplat").setLevel("INFO")
    opened, wanted = load(scene), size_of(size)
    kinds = kinds_of(what, opened, query is not None)
    if out.suffix == ".mp4":
        library()
    phrases = [word.strip() for word in against.split(",") if word.strip()]
    asked = None if query is None else opened.understood(query, phrases)
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


COMMANDS = (render, cameras)
