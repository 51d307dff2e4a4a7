"""What is done with a finished scene, or before one: query, mesh, extract, encode, lift, label,
check-teacher, get-teacher, knowledge, calibrate, import.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

from chebsplat.errors import ConfigError


@click.command()
@click.argument("scene")
@click.argument("text")
@click.option("--against", default="", help="phrases it is weighed against; default: object,things,stuff,texture")
@click.option("--out", type=click.Path(path_type=Path), help="default: query/<text> in the scene's folder")
@click.option("--top", type=click.IntRange(1), default=8, show_default=True, help="labels in the table")
def query(scene: str, text: str, against: str, out: Path | None, top: int) -> None:
    """Where in a finished SCENE is TEXT, such as "something to sit on"? Relevancy by Gaussian, and heat maps."""
    import logging

    from chebsplat.pipelines.finished import scene_folder
    from chebsplat.pipelines.plan import suffix
    from chebsplat.stages.query import run as answer

    logging.basicConfig(stream=sys.stderr, format="query: %(message)s", level="WARNING", force=True)
    logging.getLogger("chebsplat").setLevel("INFO")
    folder = scene_folder(scene)
    if not text.strip():
        raise ConfigError("the query is empty; say what to look for")
    target = (out or folder / "query" / suffix(text.strip())).absolute()
    answer(folder, text.strip(), [word.strip() for word in against.split(",") if word.strip()], target, top)
    print(target)


@click.command("check-teacher")
@click.argument("model", type=click.Path(path_type=Path))
@click.option("--photo", type=click.Path(path_type=Path), help="default: a view of a generated room")
@click.option("--labels", help="text file of labels; default: the teacher's own")
def check_teacher(model: Path, photo: Path | None, labels: str | None) -> None:
    """Run one image through a teacher MODEL (.onnx): what it is, what it costs, what it sees."""
    from chebsplat.stages.teacher_check import check

    for what, finding in check(model, photo, labels):
        print(f"{what:9s}{finding}")


@click.command("get-teacher")
@click.argument("name")
@click.option("--out", type=click.Path(path_type=Path), help="folder to make; default: called like the teacher, here")
@click.option("--file", "graph", default="onnx/model.onnx", show_default=True, help="the ONNX file in the repository")
def get_teacher(name: str, out: Path | None, graph: str) -> None:
    """Fetch a segmenter from the Hugging Face hub as a teacher: segformer-b0-ade, or hf:OWNER/NAME[@REVISION]."""
    from chebsplat.stages.get_teacher import get_teacher as fetch

    model, findings = fetch(name, out, graph)
    for what, finding in findings:
        print(f"{what:9s}{finding}", file=sys.stderr)
    print(f"use it: set=teacher.model={model},teacher.n_channels=32", file=sys.stderr)
    print(model)


@click.command()
@click.argument("scene")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the .ply to write")
@click.option("--keep-label", "labels", multiple=True, help="a name of labels.json; may be given again")
@click.option("--min-opacity", type=click.FloatRange(0, 1), default=0.0, help="activated")
@click.option("--box", help="x0,y0,z0,x1,y1,z1 that centres lie in, scene units")
@click.option("--query", "text", help="words: what is likelier than not these, in parts that hang together")
@click.option("--against", default="", help="phrases that the words are weighed against, as of query")
def extract(
    scene: str, out: Path, labels: tuple[str, ...], min_opacity: float, box: str | None, text: str | None, against: str
) -> None:
    """Write part of a finished scene as one PLY: by words, label, opacity, box."""
    from chebsplat.pipelines.api import load
    from chebsplat.pipelines.finished import artifact_of
    from chebsplat.stages.extract import corners
    from chebsplat.stages.extract import extract as write

    phrases = [word.strip() for word in against.split(",") if word.strip()]
    if phrases and text is None:
        raise ConfigError("--against is of a query; add --query TEXT")
    asked = None if text is None else load(scene).understood(text, phrases)
    counts = write(artifact_of(scene, "export"), out, labels, min_opacity, corners(box), asked)
    print(", ".join(f"{name} {number:,}" for name, number in counts.items()), file=sys.stderr)
    print(out)


@click.command()
@click.argument("scene")
@click.option("--encoder", help="an onnx artifact, or a model in it; default: the scene's")
@click.option("--features", type=click.Path(path_type=Path), help="of a PLY: .npy [N, C], float32, before fusion")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the .npz to write")
@click.option("--device", type=click.Choice(["cpu", "cuda"]), default="cpu", show_default=True, help="of the models")
def encode(scene: str, encoder: str | None, features: Path | None, out: Path, device: str) -> None:
    """Fused features of a finished SCENE (or a .ply), by onnxruntime, without torch."""
    from chebsplat.pipelines.finished import artifact_of, scene_folder
    from chebsplat.stages.encode import encode as write

    if scene.endswith(".ply"):
        if encoder is None:
            raise ConfigError(f"{scene} is a PLY, which has no encoder of its own; add --encoder")
        source = Path(scene)
    else:
        source = artifact_of(scene, "export")
        encoder = encoder or str(scene_folder(scene) / "onnx")
    model = Path(encoder) if encoder.endswith(".onnx") else artifact_of(encoder, "onnx")
    figures = write(source, model, features, out, device)
    print(", ".join(f"{name} {value}" for name, value in figures.items()), file=sys.stderr)
    print(out)


@click.command()
@click.argument("ply", type=click.Path(path_type=Path))
@click.option("--capture", required=True, help="a finished scene of the same photos, or an ingest artifact")
@click.option("--teacher", type=click.Path(path_type=Path), help=".onnx; default: the scene's, else the embedded one")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the folder to make")
def lift(ply: Path, capture: str, teacher: Path | None, out: Path) -> None:
    """Give the Gaussians of a .PLY, trained elsewhere on the photos of a capture, the 2D teacher's features and labels.

    Without a .PLY, the stage of this name: --help says more.
    """
    from chebsplat.pipelines.finished import artifact_of, is_artifact, links, scene_folder
    from chebsplat.stages.lift_ply import lift_ply

    source = artifact_of(capture, "ingest")
    beside = {} if is_artifact(Path(capture)) else links(scene_folder(capture))
    features = None if teacher else beside.get("teacher")
    figures = lift_ply(ply, source, beside.get("sfm"), features, teacher, out)
    print(", ".join(f"{name} {value}" for name, value in figures.items()), file=sys.stderr)
    print(out)


@click.command("import")
@click.argument("ply", type=click.Path(path_type=Path))
@click.option("--capture", help="a finished scene of the same photos, or an ingest artifact: gives features and labels")
@click.option("--teacher", type=click.Path(path_type=Path), help=".onnx, with --capture; default: the scene's own")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the folder to make")
@click.pass_context
def import_(context: click.Context, ply: Path, capture: str | None, teacher: Path | None, out: Path) -> None:
    """Make a scene of any 3DGS .PLY: to render, page and extract from; with --capture to query, too (as `lift`)."""
    from chebsplat.stages.lift_ply import import_ply

    if capture is not None:
        context.invoke(lift, ply=ply, capture=capture, teacher=teacher, out=out)
        return
    if teacher is not None:
        raise ConfigError("--teacher looks at photos; add --capture, or label by shape alone: chebsplat label")
    figures = import_ply(ply, out)
    print(", ".join(f"{name} {value:,}" for name, value in figures.items()), file=sys.stderr)
    print(out)


@click.command()
@click.option("--teacher", type=click.Path(path_type=Path), help=".onnx; default: the embedded teacher")
@click.option("--set", "settings", default="", help="section.key=value,... of knowledge and channels")
@click.option("--out", type=click.Path(path_type=Path), help="folder to copy it to; later: refine.knowledge=FOLDER")
@click.option("--cores", type=click.IntRange(1), default=os.cpu_count())
def knowledge(teacher: Path | None, settings: str, out: Path | None, cores: int) -> int:
    """Teach what shapes look like to a TEACHER, over generated rooms; scenes of that teacher start from it."""
    from chebsplat.formats import artifact
    from chebsplat.pipelines import store
    from chebsplat.pipelines.knowledge import teaching
    from chebsplat.pipelines.plan import Planner
    from chebsplat.pipelines.run import execute

    if out is not None and os.path.lexists(out):
        raise ConfigError(f"{out} exists; remove it, or choose another --out")
    planner = Planner(running=True)
    try:
        store.make_work()
        plan = teaching(planner, teacher, settings)
    finally:
        planner.save()
    code = execute([plan], "teach", cores)
    if code == 0 and out is not None:
        made = plan.targets["teach"]
        artifact.copy(made, out, artifact.verify(made))
        print(out.absolute())
    return code


@click.command()
@click.argument("model", type=click.Path(path_type=Path), required=False)
@click.option("--rooms", type=int, default=12, show_default=True, help="generated rooms")
@click.option("--force", is_flag=True, help="replace the calibration that is there")
def calibrate(model: Path | None, rooms: int, force: bool) -> None:
    """Find out on generated rooms what the relevancy of a teacher MODEL (.onnx) means; kept beside it, for `query`."""
    import logging

    from chebsplat.formats.calibration import beside, write_calibration
    from chebsplat.formats.teacher_model import EMBEDDED
    from chebsplat.stages.calibration import calibrate as measure
    from chebsplat.stages.progress import Progress

    logging.basicConfig(stream=sys.stderr, format="calibrate: %(message)s", level="WARNING", force=True)
    logging.getLogger("chebsplat").setLevel("INFO")
    path = beside(model or EMBEDDED)
    if path.exists() and not force:
        raise ConfigError(f"{path} exists; remove it, or add --force")
    found = measure(model or EMBEDDED, rooms, Progress())
    write_calibration(path, found)
    for name, value in found.made["on_rooms_left_out"].items():
        print(f"{name.replace('_', ' '):16s}{value:6.1%}", file=sys.stderr)
    print(path)


@click.command()
@click.argument("ply", type=click.Path(path_type=Path))
@click.option("--words", help="to choose among, with commas; default: the classes of generated rooms")
@click.option("--up", default="0,0,1", show_default=True, help="x,y,z against gravity, in the PLY's frame")
@click.option("--unit", type=click.FloatRange(0, min_open=True), help="PLY units in a metre; default: by its extent")
@click.option("--knowledge", type=click.Path(path_type=Path), help="an artifact; default: the one that is shipped")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the .ply to write; an .npz beside it")
def label(ply: Path, words: str | None, up: str, unit: float | None, knowledge: Path | None, out: Path) -> None:
    """Name the Gaussians of any .PLY of a room by shape alone, with a confidence: no photo, no 2D teacher."""
    import numpy as np

    from chebsplat.formats.knowledge import SHIPPED
    from chebsplat.stages.label_ply import label_ply
    from chebsplat.synthetic import CLASS_NAMES

    try:
        direction = np.array([float(part) for part in up.split(",")])
    except ValueError:
        direction = np.zeros(0)
    length = np.linalg.norm(direction)
    if direction.shape != (3,) or not 0 < length < np.inf:
        raise ConfigError(f"--up {up}: three numbers are needed, such as 0,0,1")
    names = [word.strip() for word in words.split(",") if word.strip()] if words else list(CLASS_NAMES)
    figures = label_ply(ply, knowledge or SHIPPED, names, direction / length, unit, out)
    for name, share in sorted(figures["shares"].items(), key=lambda entry: -entry[1]):
        if share > 0:
            print(f"{name:12s}{share:6.1%}", file=sys.stderr)
    print(out)


@click.command()
@click.argument("scene")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="the .ply or .glb to write")
@click.option("--voxel", type=click.FloatRange(0, min_open=True), help="edge, scene units; default: 1/250 of the room")
@click.option("--triangles", type=click.IntRange(4), default=200_000, show_default=True, help="at most")
@click.option("--raw", is_flag=True, help="as it was fused: nothing removed, closed or decimated")
def mesh(scene: str, out: Path, voxel: float | None, triangles: int, raw: bool) -> None:
    """Write the surface of a finished SCENE as triangles with colours and labels, in the scene's frame."""
    import logging

    from chebsplat.pipelines.api import load
    from chebsplat.stages.mesh import write

    logging.basicConfig(stream=sys.stderr, format="mesh: %(message)s", level="WARNING", force=True)
    logging.getLogger("chebsplat").setLevel("INFO")
    opened = load(scene)
    facts = write(opened.exported, opened.source, out, voxel, triangles, raw)
    print("voxels of {voxel:.3g}: {n_fused:,} triangles, {n_triangles:,} of them written, {n_vertices:,} vertices"
          .format(**facts), file=sys.stderr)  # fmt: skip
    print(out)


COMMANDS = (query, calibrate, check_teacher, get_teacher, extract, encode, lift, import_, label, knowledge, mesh)
