"""What is done with a finished scene, or before one: query, extract, encode, check-teacher."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from chebsplat.errors import ConfigError


def scene_folder(scene: str) -> Path:
    """The folder of a finished scene, given itself or by the name of its links. Raises ConfigError with near names."""
    from chebsplat.pipelines import store

    for folder in (store.work() / scene, Path(scene)):
        if store.is_fresh(folder / "export"):
            return folder
    import difflib

    known = sorted(path.parent.parent.name for path in store.work().glob("*/export/artifact.json"))
    near = difflib.get_close_matches(scene, known, 3) or known
    raise ConfigError(
        f"{scene} is no finished scene in {store.work()}, and no folder of one; "
        + (f"there is {', '.join(near)}" if near else f"run it first: make scene={scene}")
    )


@click.command()
@click.argument("scene")
@click.argument("text")
@click.option("--against", default="", help="phrases it is weighed against; default: object,things,stuff,texture")
@click.option("--out", type=click.Path(path_type=Path), help="default: query/<text> in the scene's folder")
@click.option("--top", type=click.IntRange(1), default=8, show_default=True, help="labels in the table")
def query(scene: str, text: str, against: str, out: Path | None, top: int) -> None:
    """Where in a finished SCENE is TEXT, such as "something to sit on"? Relevancy by Gaussian, and heat maps."""
    import logging

    from chebsplat.pipelines.plan import suffix
    from chebsplat.stages.query import run as answer

    logging.basicConfig(stream=sys.stderr, format="query: %(message)s", level="WARNING", force=True)
    logging.getLogger("chebsplat").setLevel("INFO")
    folder = scene_folder(scene)
    if not text.strip():
        raise ConfigError("the query is empty; say what to look for")
    place = (out or folder / "query" / suffix(text.strip())).absolute()
    answer(folder, text.strip(), [word.strip() for word in against.split(",") if word.strip()], place, top)
    print(place)


@click.command("check-teacher")
@click.argument("model", type=click.Path(path_type=Path))
@click.option("--photo", type=click.Path(path_type=Path), help="default: a view of a generated room")
@click.option("--labels", help="text file of labels; default: the teacher's own")
def check_teacher(model: Path, photo: Path | None, labels: str | None) -> None:
    """Run one image through a teacher MODEL (.onnx): what it is, what it costs, what it sees."""
    from chebsplat.stages.teacher_check import check

    for what, finding in check(model, photo, labels):
        print(f"{what:9s}{finding}")


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the .ply to write")
@click.option("--keep-label", "labels", multiple=True, help="a name of labels.json; may be given again")
@click.option("--min-opacity", type=click.FloatRange(0, 1), default=0.0, help="activated")
@click.option("--box", help="x0,y0,z0,x1,y1,z1 that centres lie in, scene units")
def extract(scene: Path, out: Path, labels: tuple[str, ...], min_opacity: float, box: str | None) -> None:
    """Write part of a finished scene (an export artifact) as one PLY: by label, opacity, box."""
    from chebsplat.stages.extract import corners
    from chebsplat.stages.extract import extract as write

    counts = write(scene, out, labels, min_opacity, corners(box))
    print(", ".join(f"{name} {number:,}" for name, number in counts.items()), file=sys.stderr)
    print(out)


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--encoder", type=click.Path(path_type=Path), required=True, help="an onnx artifact, or a model in it")
@click.option("--features", type=click.Path(path_type=Path), help="of a PLY: .npy [N, C], float32, before fusion")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the .npz to write")
def encode(scene: Path, encoder: Path, features: Path | None, out: Path) -> None:
    """Fused features of a finished scene (an export artifact, or a PLY), by onnxruntime, without torch."""
    from chebsplat.stages.encode import encode as write

    figures = write(scene, encoder, features, out)
    print(", ".join(f"{name} {value}" for name, value in figures.items()), file=sys.stderr)
    print(out)


COMMANDS = (query, check_teacher, extract, encode)
