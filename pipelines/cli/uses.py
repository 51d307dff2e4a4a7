"""Commands on a finished scene (query, mesh, extract, export, lift, label) and on teachers."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from chebsplat.errors import ConfigError
from chebsplat.formats.splats import WRITTEN
from chebsplat.pipelines.cli.group import AGAINST, SCENE, UP, NewPath, Phrases, Upward


def report(figures: Mapping[str, Any], out: Path) -> None:
    """Print figures to stderr and the path of what was written to stdout."""
    print(", ".join(f"{name} {value:,}" for name, value in figures.items()), file=sys.stderr)
    print(out)


@click.command()
@SCENE
@click.argument("text")
@AGAINST
@click.option(
    "--top", type=click.IntRange(1), default=8, show_default=True, help="labels in the table"
)
def query(scene: str, text: str, against: list[str], top: int) -> None:
    """Tell if TEXT, such as "something to sit on", is in a finished SCENE, and where, by label."""
    from chebsplat.pipelines.api import load
    from chebsplat.stages.tools.query import table

    opened = load(scene)
    answer = opened.ask(text, against)
    assert (
        opened.labels is not None and opened.label_names is not None
    )  # a scene that can be queried has labels
    print(answer, *table(answer, opened.labels, opened.label_names, top), sep="\n")


@click.command("check-teacher")
@click.argument("model", type=click.Path(path_type=Path))
@click.option(
    "--photo",
    "photos",
    type=click.Path(path_type=Path),
    multiple=True,
    help="a photo or folder; eight reveal the usual mistakes; default: a view of a generated room",
)
@click.option("--labels", help="text file of labels; default: the teacher's own")
def check_teacher(model: Path, photos: tuple[Path, ...], labels: str | None) -> None:
    """Run images through a teacher MODEL (.onnx): settings, cost, labels and likely mistakes."""
    from chebsplat.stages.tools.get_teacher import check

    for what, finding in check(model, photos, labels):
        print(f"{what:9s}{finding}")


@click.command("get-teacher")
@click.argument("name")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="folder to make; default: called like the teacher, here",
)
@click.option(
    "--file",
    "graph",
    default="onnx/model.onnx",
    show_default=True,
    help="the ONNX file in the hub's repository",
)
@click.option(
    "--settings",
    metavar="FILE|URL",
    help="the TOML of an ONNX file that brings none beside it",
)
@click.option("--sha256", help="that the model must have")
def get_teacher(
    name: str, out: Path | None, graph: str, settings: str | None, sha256: str | None
) -> None:
    """Fetch a 2D teacher: a segmenter of the Hugging Face hub (segformer-b0-ade,
    hf:OWNER/NAME[@REVISION]), or any .onnx by its URL or path, with the TOML beside it.
    """
    from chebsplat.stages.tools.get_teacher import get_teacher as fetch

    model, findings = fetch(name, out, graph, settings, sha256)
    for what, finding in findings:
        print(f"{what:9s}{finding}", file=sys.stderr)
    use = shlex.quote(f"set=teacher.model={model},teacher.n_channels=32")
    print(f"use it: {use}", file=sys.stderr)
    print(model)


@click.command()
@SCENE
@click.option("--out", type=NewPath(*WRITTEN), required=True, help="the .ply, .spz, .sog or .glb")
@click.option(
    "--keep-label", "labels", multiple=True, help="a name of labels.json; may be given again"
)
@click.option("--min-opacity", type=click.FloatRange(0, 1), default=0.0, help="activated")
@click.option("--box", help="x0,y0,z0,x1,y1,z1 that centres lie in, scene units")
@click.option("--query", "text", help="words: the connected Gaussians that are probably these")
@AGAINST
def extract(
    scene: str,
    out: Path,
    labels: tuple[str, ...],
    min_opacity: float,
    box: str | None,
    text: str | None,
    against: list[str],
) -> None:
    """Write part of a finished scene as one splat: by words, label, opacity, box."""
    from chebsplat.pipelines.api import load
    from chebsplat.stages.tools.extract import corners
    from chebsplat.stages.tools.extract import extract as write

    if against and text is None:
        raise ConfigError("--against is of a query; add --query TEXT")
    opened = load(scene)
    query_vectors = None if text is None else opened.understood(text, against)
    report(write(opened, out, labels, min_opacity, corners(box), query_vectors), out)


@click.command()
@SCENE
@click.option(
    "--as",
    "kind",
    type=click.Choice([suffix[1:] for suffix in WRITTEN]),
    default="spz",
    show_default=True,
)
@click.option("--out", type=click.Path(path_type=Path), help="default: named like the scene, here")
@UP
def export(scene: str, kind: str, out: Path | None, up: Any) -> None:
    """Write a finished SCENE as one file for viewers; with --up turned upright, a .glb always.

    Without a SCENE, this is the stage of the same name (--help).
    """
    from chebsplat.pipelines.api import load
    from chebsplat.stages.tools.up import up_of

    opened = load(scene)
    path = NewPath(f".{kind}").convert(out or f"{Path(scene).resolve().name}.{kind}", None, None)
    if up is not None:
        up = up_of(up, opened.parameters, opened.exported.cameras.cam_from_world)
    opened.export(path, up)
    report({"Gaussians": len(opened), "bytes": path.stat().st_size}, path)


@click.command()
@click.argument("ply", type=click.Path(path_type=Path))
@click.option(
    "--capture",
    help="a finished scene of the same photos, or an ingest artifact: gives features and labels",
)
@click.option(
    "--teacher",
    type=click.Path(path_type=Path),
    help=".onnx, with --capture; default: the scene's own",
)
@UP
@click.option("--out", type=NewPath(), required=True, help="the folder to make")
def lift(ply: Path, capture: str | None, teacher: Path | None, up: Any, out: Path) -> None:
    """Make a scene of any splat (.PLY, .spz, .sog, .glb, .splat, a folder of 3DGS): to render, page
    and extract from; with --capture, in whose frame it lies, to query, too.

    Without a .PLY, the stage of this name: --help says more.
    """
    from chebsplat.pipelines.work.finished import artifact_of, is_artifact, links, scene_folder
    from chebsplat.stages.tools.lift_ply import import_ply, lift_ply

    if capture is None:
        if teacher is not None:
            raise ConfigError(
                "--teacher looks at photos; add --capture, or label by shape alone: chebsplat label"
            )
        report(import_ply(ply, out, up), out)
        return
    if up is not None:
        raise ConfigError("--up is of a splat alone; with --capture its cameras tell")
    source = artifact_of(capture, "ingest")
    beside = {} if is_artifact(Path(capture)) else links(scene_folder(capture))
    features = None if teacher else beside.get("teacher")
    report(lift_ply(ply, source, beside.get("sfm"), features, teacher, out), out)


@click.command()
@click.argument("model", type=click.Path(path_type=Path), required=False)
@click.option("--rooms", type=int, default=12, show_default=True, help="generated rooms")
@click.option("--force", is_flag=True, help="replace the calibration that is there")
def calibrate(model: Path | None, rooms: int, force: bool) -> None:
    """Calibrate the relevancy of a teacher MODEL (.onnx) on generated rooms; stored beside it."""
    from chebsplat.formats.calibration import beside, write_calibration
    from chebsplat.formats.teacher_model import EMBEDDED
    from chebsplat.stages.runtime.progress import Progress
    from chebsplat.stages.tools.calibrate import calibrate as measure

    path = beside(model or EMBEDDED)
    if path.exists() and not force:
        raise ConfigError(f"{path} exists; remove it, or add --force")
    calibration = measure(model or EMBEDDED, rooms, Progress())
    write_calibration(path, calibration)
    for name, value in calibration.made["on_rooms_left_out"].items():
        print(f"{name.replace('_', ' '):16s}{value:6.1%}", file=sys.stderr)
    print(path)


@click.command()
@click.argument("ply", type=click.Path(path_type=Path))
@click.option(
    "--words",
    type=Phrases(),
    help="label set, with commas; default: the classes of generated rooms",
)
@click.option(
    "--up",
    type=Upward(),
    default="auto",
    show_default=True,
    help="against gravity: auto (by the room's shape), z, -y, 0,0,1, ...",
)
@click.option(
    "--unit",
    type=click.FloatRange(0, min_open=True),
    help="PLY units in a metre; default: by its extent",
)
@click.option(
    "--knowledge",
    type=click.Path(path_type=Path),
    help="an artifact; default: the one that is shipped",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="the .ply to write; an .npz beside it",
)
def label(
    ply: Path,
    words: list[str] | None,
    up: Any,
    unit: float | None,
    knowledge: Path | None,
    out: Path,
) -> None:
    """Name the Gaussians of any .PLY of a room by shape alone: no photo, no 2D teacher needed."""
    from chebsplat.formats.knowledge import SHIPPED
    from chebsplat.stages.tools.lift_ply import label_ply
    from chebsplat.synthetic import CLASS_NAMES

    names = words or list(CLASS_NAMES)
    figures = label_ply(ply, knowledge or SHIPPED, names, up, unit, out)
    for name, share in sorted(figures["shares"].items(), key=lambda entry: -entry[1]):
        if share > 0:
            print(f"{name:12s}{share:6.1%}", file=sys.stderr)
    print(out)


@click.command()
@SCENE
@click.option(
    "--out", type=NewPath(".ply", ".glb"), required=True, help="the .ply or .glb to write"
)
@click.option(
    "--voxel",
    type=click.FloatRange(0, min_open=True),
    help="edge, scene units; default: 1/250 of the room",
)
@click.option(
    "--triangles", type=click.IntRange(4), default=200_000, show_default=True, help="at most"
)
@click.option("--raw", is_flag=True, help="as it was fused: nothing removed, closed or decimated")
@UP
def mesh(scene: str, out: Path, voxel: float | None, triangles: int, raw: bool, up: Any) -> None:
    """Write the surface of a finished SCENE as triangles with colours and labels, in the scene's
    frame; with --up turned, so that up is z. A .glb is turned in any case, up to y.
    """
    from chebsplat.formats.meshes import meshlab, write_mesh
    from chebsplat.pipelines.api import load
    from chebsplat.stages.runtime.progress import Progress
    from chebsplat.stages.tools.mesh import mesh_of, turned
    from chebsplat.stages.tools.up import up_of

    if not raw:
        meshlab()  # missed before a scene is opened
    opened = load(scene)
    surface, facts = mesh_of(opened, voxel, triangles, raw, Progress())
    if up is not None or out.suffix.lower() == ".glb":
        up, poses = "auto" if up is None else up, opened.exported.cameras.cam_from_world
        surface = turned(surface, up_of(up, opened.parameters, poses), out.suffix)
    write_mesh(out, surface, opened.label_names)
    report(facts, out)


COMMANDS = (query, calibrate, check_teacher, get_teacher, extract, export, lift, label, mesh)
