"""Artifacts that are damaged, as input of every stage and of the commands that read them.

Small artifacts of every schema that fit together, made without a training.
"""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.encoding import Encoding
from chebsplat.formats.evaluation import Evaluation, ViewAgreement
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.knowledge import Knowledge, write_knowledge
from chebsplat.formats.lesson import Lesson, write_lesson
from chebsplat.formats.lifted import Lifted, Refined
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.points import Points
from chebsplat.formats.scene import Scene
from chebsplat.settings import DescribeSection
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.config import Config
from malformed.edits import DEEP, Edit, changed, cut, flipped, no_file, put, remove
from malformed.row import Arguments, Row, stage

# Gaussians, views, channels, of shape, width and height
N, V, C, FEATURES, SIZE = 40, 3, 5, 7, (24, 16)
KEY = "0123456789abcdef"
MEMBER = "data/values.bin"
VIEWS, LABELS = [f"view_{k}" for k in range(V)], ["wall", "floor", "sofa"]
NOTES = {"left_out": {}, "n_initial": N}
DESCRIBED = {"n_angles": 2, "max_degree": 3, "anisotropy": 10.0, "bandwidth": 0.7}


@functools.cache
def artifacts() -> Path:
    """A folder with an artifact of each schema, by the name of its stage; made once a process."""
    root = Path(tempfile.mkdtemp(prefix="malformed-artifacts-"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    for name, write in WRITERS.items():
        _publish(root / name, name, write)
    return root


def copied(stage: str, folder: Path) -> Path:
    """A copy below `folder` that may be damaged."""
    return Path(shutil.copytree(artifacts() / stage, folder / stage))


def fake(path: Path, of: str) -> Path:
    """An artifact of stage `of` whose manifest is right, with one member that nobody gets as far as
    to read.
    """
    with artifact.publish(path, Manifest(STAGES[of].schema, KEY, of)) as tmp:
        put(MEMBER, bytes(64))(tmp)
    return path


def manifest(**values: Any) -> Edit:
    """A manifest that says something else; None: not at all."""

    def change(said: dict[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in (said | values).items() if value is not None}

    return changed("artifact.json", change)


def listed(name: str) -> Edit:
    """The one member under another name."""
    return changed("artifact.json", lambda said: said | {"files": {name: said["files"][MEMBER]}})


Damage = tuple[str, Edit, str]  # what is wrong with an artifact, the edit, a word of the message
OF_INPUTS: list[Damage] = [
    ("gone", shutil.rmtree, "artifact.json is missing"),
    ("no manifest", remove("artifact.json"), "artifact.json is missing"),
    (
        "a manifest that leads to itself",
        no_file("artifact.json", "looping link"),
        "artifact.json is missing",
    ),
    ("another schema", manifest(schema="chebsplat.other/9"), "has schema chebsplat.other/9"),
    ("a member gone", remove(MEMBER), "values.bin is missing"),
    ("a member cut short", cut(MEMBER, 1), "has 63 bytes, expected 64"),
]
OF_ANY: list[Damage] = [
    ("a key that climbs", manifest(key="../../../x"), "key"),
    ("an absolute key", manifest(key="/tmp/elsewhere"), "key"),
    ("an empty key", manifest(key=""), "key"),
    ("a key with a line end", manifest(key=KEY + "\n"), "key"),
    ("no key", manifest(key=None), "artifact.json"),
    (
        "an input whose key climbs",
        manifest(inputs={"capture": {"key": "../x", "schema": "s/1"}}),
        "inputs",
    ),
    ("a file that climbs", listed("../in/" + MEMBER), "files"),
    ("an absolute file", listed("/etc/hostname"), "files"),
    ("a file's name with a null byte", listed("data/\0"), "files"),
    ("a file's name too long", listed("x" * 300), "x" * 300),
    ("a manifest that is empty", put("artifact.json", ""), "artifact.json does not parse"),
    (
        "a manifest cut short",
        put("artifact.json", '{"schema": "chebsplat.'),
        "artifact.json does not parse",
    ),
    ("a manifest of other bytes", put("artifact.json", b"\xff\xfe\0"), "UTF-8"),
    ("a manifest nested too deeply", put("artifact.json", DEEP), "nested too deeply"),
    ("a manifest that is a list", put("artifact.json", "[]"), "artifact.json"),
    ("a member that is a folder", no_file(MEMBER, "folder"), "values.bin is missing"),
    ("a member that is a pipe", no_file(MEMBER, "pipe"), "values.bin is missing"),
    ("another byte", flipped(MEMBER), "does not match its sha256"),
    ("a file more", put("more", ""), "not listed"),
]


def met(
    name: str, ask: Callable[[Path], Arguments], word: str, edit: Edit, of: str = "describe"
) -> Row:
    """A damaged artifact in folder/in."""

    def build(folder: Path) -> Arguments:
        edit(fake(folder / "in", of))
        return ask(folder)

    return Row("artifact", name, build, ("/in", word), alone="pipe" in name)


def planned(folder: Path) -> Arguments:
    return ["plan", "--scene", "toy", "--set", f"knowledge.start={folder}/in"]


def rows() -> Iterator[Row]:
    for what, edit, word in OF_ANY:
        yield met(f"{what}, in verify", lambda folder: ["verify", folder / "in"], word, edit)
    for what, edit, word in (OF_ANY[0], OF_ANY[6], OF_INPUTS[5]):
        yield met(f"{what}, in plan", planned, word, edit, "teach")
    roles = [(name, role) for name, one in STAGES.items() for role in one.roles]
    for number, (name, role) in enumerate(roles):
        what, edit, word = OF_INPUTS[number % len(OF_INPUTS)]

        def ask(folder: Path, name: str = name, role: str = role) -> Arguments:
            needed = {r: fake(folder / r, of) for r, of in STAGES[name].inputs if r != role}
            return stage(name, folder, {}, **needed, **{role: folder / "in"})

        yield met(f"{what}, in {name} --in-{role}", ask, word, edit, STAGES[name].roles[role])
    for what, content, word in SPLATS:
        yield splats(what, put("scene.ply", content), word)
    yield splats("a pipe", no_file("scene.ply", "pipe"), "a pipe", alone=True)


# Gaussians from elsewhere, met by `lift`

HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n"
AXES = b"property float y\nproperty float z\nend_header\n"
SPLATS: list[tuple[str, bytes, str]] = [
    ("nothing", b"", "has no PLY header"),
    ("text", b"a splat\n", "has no PLY header"),
    ("a cloud", HEADER + AXES + bytes(24), "has no property f_dc_0"),
    ("10^12 Gaussians", HEADER.replace(b"2", b"1000000000000") + AXES, "declares 3,000,000,000"),
]


def splats(what: str, edit: Edit, word: str, alone: bool = False) -> Row:
    def build(folder: Path) -> Arguments:
        edit(folder)
        return ["lift", folder / "scene.ply", "--out", folder / "out"]

    return Row("splats", what, build, ("scene.ply", word), alone=alone)


# small artifacts of every schema


def _publish(path: Path, stage: str, write: Callable[[Path], Any]) -> None:
    config = Config.model_validate(
        {"describe": DESCRIBED | {"n_regions": 4, "region_size": 8}, "sfm": {}}
    )
    manifest = Manifest(
        STAGES[stage].schema, KEY, stage, config=config.sections(("describe", "train"))
    )
    manifest.facts = {
        "teacher": {"kind": "labels", "n_labels": len(LABELS), "convention": {"confusion": 0.1}},
        "agree": {"agreement": 0.375, "n_points": N},
        "train": {"milliseconds": {"render": 1.0}},
        "export": {"by_degree": [N, 0, 0, 0]},
    }.get(stage, {})
    with artifact.publish(path, manifest) as tmp:
        write(tmp)


def _poses() -> tuple[np.ndarray, np.ndarray]:
    K = np.array([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]])
    poses = np.tile(np.eye(4), (V, 1, 1))
    poses[:, 0, 3] = np.arange(V) * 0.1
    return np.tile(K, (V, 1, 1)), poses


def _parameters() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {
        "means": (N, 3),
        "log_scales": (N, 3),
        "quats": (N, 4),
        "logit_opacities": (N,),
        "sh0": (N, 1, 3),
    }
    shapes["features"] = (N, C)
    p = {name: rng.normal(0, 0.5, shape).astype(np.float32) for name, shape in shapes.items()}
    p["means"][:, 2] += 3
    return p | {"shN": np.zeros((N, 15, 3), np.float32), "degrees": np.zeros(N, np.uint8)}


def _cameras() -> Any:
    return Cameras(VIEWS, *_poses(), *SIZE)


def _capture(out: Path) -> None:
    rng, (width, height) = np.random.default_rng(1), SIZE
    Ks, poses = _poses()
    images = rng.integers(0, 255, (V, height, width, 3), dtype=np.uint8)
    depth = np.full((V, height, width), 3, np.float32)
    labels = rng.integers(-1, len(LABELS), (V, height, width)).astype(np.int16)
    is_test = np.arange(V) == 0
    source, protocol = (
        {"name": "toy", "kind": "generated"},
        {"name": "labels", "split": "every third"},
    )
    Capture(VIEWS, images, Ks, poses, is_test, depth, labels, None, LABELS, source, protocol).write(
        out
    )


def _points(out: Path) -> None:
    normals = np.tile(np.array([0, 0, 1], np.float32), (N, 1))
    shape = np.tile(np.eye(3, dtype=np.float32), (N, 1, 1))
    means = _parameters()["means"].astype(np.float64)
    tracks = np.zeros((0, 2), np.int32)
    Points(VIEWS, *_poses(), means, np.zeros((N, 3), np.uint8), normals, shape, tracks, {}).write(
        out
    )


def _embeddings() -> np.ndarray:
    return np.eye(len(LABELS), C, dtype=np.float32)


def _features(out: Path) -> None:
    maps = np.random.default_rng(2).normal(0, 0.3, (V, 4, 6, C)).astype(np.float16)
    pseudo, sure = np.zeros((V, 4, 6), np.int16), np.ones((V, 4, 6), np.float16)
    convention = {"kind": "labels", "normalized": True}
    Features(VIEWS, maps, LABELS, _embeddings(), pseudo, sure, convention).write(out)


def _descriptors(out: Path) -> None:
    own, place, values = (np.zeros((N, width), np.float32) for width in (6, 3, 8))
    neighbors = np.full((N, 4, 2), -1, np.int32)
    notes = {"settings": DESCRIBED, "of": "depth"}
    Descriptors(own, place, place, values, neighbors, [0.0] * 3, [0.0, 0.0, 1.0], 1.0, notes).write(
        out
    )


def _encoding(out: Path) -> None:
    Encoding(np.ones((N, FEATURES), np.float16)).write(out)


def _lesson(out: Path) -> None:
    sums = np.eye(FEATURES), np.ones((FEATURES, C)), 1.0
    notes = {"scene": "toy", "given": True, "novelty": 0.5, "n_points": N}
    write_lesson(out, Lesson(sums, notes))


def _gaussians(out: Path) -> None:
    trace = [{"step": 10.0, "seconds": 1.0, "n": float(N), "psnr": 20.0}]
    notes = NOTES | {"label_names": LABELS}
    modules = {"printed.gate.weight": np.ones((1, C), np.float32)}
    Gaussians(_parameters(), _cameras(), modules, trace, notes).write(out)


def _agreement(out: Path) -> None:
    labels = {
        "wall": {"share": 0.75, "agreement": 0.5},
        "floor": {"share": 0.25, "agreement": 0.25},
    }
    ViewAgreement(0.375, N, V - 1, labels).write(out)


def _lifted(out: Path) -> None:
    ones, views = np.ones(N, np.float32), np.full((2, N), 2, np.int32)
    features = np.random.default_rng(3).normal(size=(N, C)).astype(np.float32)
    notes = {"views": VIEWS[1:], "n_observations": 4 * N}
    Lifted(
        features, ones, views.sum(0, dtype=np.int32), ones, np.stack([features] * 2), views, notes
    ).write(out)


def _refined(out: Path) -> None:
    features = np.random.default_rng(4).normal(size=(N, C)).astype(np.float32)
    notes = {
        "start": "trained",
        "smooth": True,
        "strength": 0.0,
        "halves": {"without": 0.8, "with": 0.9},
    }
    Refined(features, np.ones(N, np.float32), notes).write(out)


def _knowledge(out: Path) -> None:
    encoder = {
        "n_channels": C,
        "n_descriptors": 0,
        "n_components": 0,
        "width": 4,
        "hidden": 4,
        "n_scales": 4,
    }
    weights = {"embed.0.weight": np.zeros((64, 6), np.float32)}
    describe, card = DescribeSection().model_dump(mode="json"), {"n_rooms": 1}
    matrix = np.eye(C + 2, C, dtype=np.float32)
    words = ["wall"], np.ones((1, C), np.float16)
    answers = (
        np.ones((FEATURES, C), np.float32),
        np.eye(FEATURES, 2, dtype=np.float32),
        np.ones(FEATURES, np.float32),
        ["wall"],
        np.ones((1, FEATURES), np.float32),
    )
    knowledge = Knowledge(
        "tiny", "0" * 64, encoder, weights, matrix, describe, *words, *answers, card
    )
    write_knowledge(out, knowledge)


def _scene(out: Path) -> None:
    p = _parameters()
    labels = np.arange(N, dtype=np.int32) % len(LABELS)
    Scene(p, _cameras(), np.arange(N), labels, LABELS, _embeddings(), NOTES).write(out)


def _evaluation(out: Path) -> None:
    (width, height), blank = SIZE, np.zeros((1, SIZE[1], SIZE[0], 3), np.uint8)
    sizes = dict.fromkeys(("unpruned_ply", "ply", "spz", "ragged", "semantic"), 100)
    whole = {"miou": 0.5, "macc": 0.5, "oa": 0.5, "boundary_miou": None, "iou": {"wall": 0.5}}
    figures = {
        "names": VIEWS[:1],
        "image": {"psnr": 20.0, "ssim": 0.5, "per_view": {"psnr": [20.0], "ssim": [0.5]}},
    }
    figures["source"] = {"name": "toy", "kind": "generated", "notes": []}
    figures["protocol"] = {"name": "labels", "split": "every third", "resolution": "32x24"}
    figures |= {
        "n_gaussians": N,
        "bytes": sizes,
        "frames_per_second": {},
        "milliseconds": {},
        "lpips": None,
    }
    figures |= {
        "left_out": {},
        "segmentation": {"classes": LABELS, "scene": whole, "teacher": whole},
    }
    labels = np.zeros((1, height, width), np.int16)
    pictures = {
        "truth": blank,
        "renders": blank,
        "labels": labels,
        "predicted": labels,
        "teacher": labels,
    }
    Evaluation(figures, pictures).write(out)


WRITERS: dict[str, Callable[[Path], None]] = {
    "ingest": _capture,
    "sfm": _points,
    "teacher": _features,
    "agree": _agreement,
    "describe": _descriptors,
    "encode": _encoding,
    "learn": _lesson,
    "teach": _knowledge,
    "train": _gaussians,
    "lift": _lifted,
    "refine": _refined,
    "export": _scene,
    "evaluate": _evaluation,
}
