"""One HTML page of a scene that opens without a server: Gaussians, labels, and words to query."""

from __future__ import annotations

import base64
import gzip
import logging
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.calibration import calibration_of
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.files import atomic_path
from chebsplat.formats.packed import pack, signed, to_bytes
from chebsplat.formats.scene import Scene
from chebsplat.formats.splats import read_semantics, read_splats
from chebsplat.formats.teacher_model import EMBEDDED, read_label_set, read_label_table, read_teacher
from chebsplat.formats.world import HERE, World
from chebsplat.labels.calibration import Calibration
from chebsplat.labels.names import folded
from chebsplat.stages.pages.parts import rendered
from chebsplat.stages.tools.query import (
    are_words,
    embed_words,
    is_closed,
    read_features,
    teacher_of,
    understood,
)
from chebsplat.stages.tools.up import Up, up_of, up_of_room

log = logging.getLogger("chebsplat")

TEMPLATE = Path(__file__).parents[1] / "pages/scene/page.html"
WARM = 16  # colours of the heat scale


@dataclass
class Words:
    """The words of a page, embeddings f32 [L, C], and those of phrases to compare with [K, C].

    against: None where words are the scene's labels, each compared with all others.
    rivals, calibration: f32 [R, C] and coefficients, where the teacher's relevancy is calibrated:
      scores of all words but the rows `uncalibrated` are then probabilities, as of `query`.
    """

    words: list[str]
    embeddings: np.ndarray
    against: list[str] | None
    phrases: np.ndarray
    rivals: np.ndarray | None = None
    calibration: Calibration | None = None
    uncalibrated: Sequence[int] = ()


def write_page(
    scene: Scene,
    name: str,
    teacher: Path | None,
    out: Path,
    sh_degree: int = 0,
    phrases: Sequence[str] = (),
    more: Sequence[str] = (),
    up: Up | None = None,
) -> dict[str, int]:
    """Write the page; an existing one is replaced.

    Args:
      scene:     from `Scene.read`, or `foreign`; name: the page's title.
      teacher:   the scene's `features` artifact, whose teacher's words are embedded; None: the
        labels alone.
      sh_degree: 0 or 1; phrases: compared with words, as in `query`; more: words beside the
        teacher's own.
      up:        against gravity; None: the cameras' own.
    Returns: counts: Gaussians, views, labels, words, bytes.
    Raises:  InputError where the teacher is not the scene's or does not know a word.
    """
    from chebsplat.stages.pages.pictures import palette, warm

    means = scene.parameters["means"].astype(np.float64)
    center = np.median(means, axis=0)
    own, extent = up_and_extent(scene)
    up = own if up is None else up_of(up, scene.parameters, scene.cameras.cam_from_world)
    world = World.read(scene.summary)
    packed = pack(scene.parameters, sh_degree)
    arrays: dict[str, np.ndarray] = packed.arrays | {"views": camera_rows(scene, center)}
    about: dict[str, Any] = {
        "name": name,
        "ranges": packed.ranges,
        "center": center.tolist(),
        "up": up.tolist(),
        "extent": extent,
        "origin": list(world.origin),
        "scale": world.scale,
        "width": scene.cameras.width,
        "height": scene.cameras.height,
        "views": scene.cameras.names,
    }
    counts = {"Gaussians": len(means), "views": len(scene.cameras.names)}
    words = None
    if (
        scene.labels is not None
        and scene.label_names is not None
        and scene.label_embeddings is not None
    ):
        words = vocabulary(scene, teacher, list(phrases), list(more))
        colors = ["#" + bytes(color).hex() for color in palette(len(scene.label_names))]
        about["labels"] = [
            {"name": n, "color": c} for n, c in zip(scene.label_names, colors, strict=True)
        ]
        about |= {"words": words.words, "against": words.against}
        about["warm"] = (warm(np.linspace(0, 1, WARM)[:, None]) / 255).round(4).tolist()
        embedded, steps = signed(words.embeddings)
        about["word_step"] = steps["step"]
        arrays |= {
            "words": embedded.T,
            "against": words.phrases.astype(np.float32),
            "label_embeddings": scene.label_embeddings.astype(np.float32),
            "labels": (scene.labels + 1).astype(np.uint16),
        }
        if words.calibration is not None and words.rivals is not None:
            about |= {
                "calibration": words.calibration._asdict(),
                "uncalibrated": list(words.uncalibrated),
            }
            arrays["rivals"] = words.rivals.astype(np.float32)
        counts |= {"labels": len(scene.label_names), "words": len(words.words)}
    blob, about["places"] = to_bytes(arrays)
    text = rendered(
        TEMPLATE,
        name=name,
        path=shlex.quote(f"{name}.cameras.json"),
        points=shlex.quote(f"{name}.points.csv"),
        n=len(means),
        labels=about.get("labels"),
        words=f"{len(words.words):,}" if words else None,
        weighed=scoring_note(words),
        example=next((n for n in (scene.label_names or []) if n in ("chair", "sofa")), "a word"),
        note=f"SH degree {sh_degree}, quantised; made by chebsplat. Nothing is fetched or sent.",
        about=about,
        data=base64.b64encode(gzip.compress(blob, 9, mtime=0)).decode(),
    )
    with atomic_path(out) as temporary:
        temporary.write_text(text)
    return counts | {"bytes": len(text.encode())}


def foreign(ply: Path, up: Up | None = None, world: World | None = None) -> Scene:
    """A scene of a splat from elsewhere: no semantics, one upright camera on its middle half.

    Args: up: None: by the shape of a room; of any other splat -y, as in COLMAP's and 3DGS' own
      frames; world: to transform it into, from that of its source; None: a suitable one.
    Raises: InputError naming the file.
    """
    target = world or HERE
    parameters, degree, _ = read_splats(ply, target)
    if world is None and (target := World.of(parameters["means"].astype(np.float64))) != HERE:
        parameters, degree, _ = read_splats(ply, target)
    degrees = parameters.setdefault("degrees", np.full(len(parameters["means"]), degree, np.uint8))
    order = np.argsort(degrees, kind="stable")  # the order of renderers
    parameters = {name: values[order] for name, values in parameters.items()}
    means = parameters["means"]
    low, high = np.quantile(means.astype(np.float64), (0.25, 0.75), axis=0)
    pose = np.eye(4)
    against_gravity = up_of_room(parameters) if up is None else up_of(up, parameters)
    if against_gravity is not None:
        down = -against_gravity
        # along y where z is up, along z as in COLMAP otherwise
        ahead = np.eye(3)[1 if abs(down[2]) > 0.9 else 2]
        ahead = ahead - (ahead @ down) * down
        ahead /= np.linalg.norm(ahead)
        pose[:3, :3] = [np.cross(down, ahead), down, ahead]
    pose[:3, 3] = [0, 0, 2 * max(float((high - low).max()), 1e-3)] - pose[:3, :3] @ (low + high) / 2
    K = np.array([[554.0, 0, 320], [0, 554, 240], [0, 0, 1]])  # 60 degrees across
    return Scene(
        parameters, Cameras(["start"], K[None], pose[None], 640, 480), order, summary=target.notes
    )


def with_own_semantics(scene: Scene, splat: Path) -> Scene:
    """The scene of a splat from elsewhere (`foreign`), with what is told of it in or beside it.

    Raises: InputError where that is of another number of Gaussians.
    """
    semantics = read_semantics(splat)
    if semantics is None:
        return scene
    if len(semantics.meanings) != len(scene.order):
        raise InputError(
            f"{splat} has {len(scene.order)} Gaussians that can be shown and tells the meanings of "
            f"{len(semantics.meanings)}; export the scene again"
        )
    rows = semantics.meanings[scene.order]
    return replace(
        scene,
        parameters=scene.parameters | {"features": semantics.features[rows]},
        labels=semantics.labels[rows].astype(np.int32),
        label_names=semantics.names,
        label_embeddings=semantics.embeddings,
    )


def camera_rows(scene: Scene, center: np.ndarray) -> np.ndarray:
    """f32 [V, 16]: three rows of cam_from_world, with origin at `center`, then fx, fy, cx, cy."""
    poses = scene.cameras.cam_from_world[:, :3].copy()
    poses[:, :, 3] += poses[:, :, :3] @ center
    Ks = scene.cameras.Ks
    lenses = np.stack([Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]], 1)
    return np.concatenate([poses.reshape(-1, 12), lenses], 1).astype(np.float32)


def up_and_extent(scene: Scene) -> tuple[np.ndarray, float]:
    """Mean up of the views, unit [3]; longest side of the box with 90 % of centres by axis."""
    up = -scene.cameras.cam_from_world[:, 1, :3].mean(0)
    length = np.linalg.norm(up)
    up = up / length if length > 0.1 else -scene.cameras.cam_from_world[0, 1, :3]
    low, high = np.quantile(scene.parameters["means"].astype(np.float64), (0.05, 0.95), axis=0)
    return up, max(float((high - low).max()), 1e-6)


def vocabulary(scene: Scene, teacher: Path | None, phrases: list[str], more: list[str]) -> Words:
    """The words of a page: the scene's labels, `more`, and the teacher's table or nouns.

    Raises: as `query.understood`; ConfigError on phrases or more where a scene knows its labels
      alone.
    """
    names, rows = scene.label_names, scene.label_embeddings
    assert names is not None and rows is not None  # checked by the caller
    features, model = (None, None) if teacher is None else read_features(teacher)
    if teacher is None or features is None or is_closed(features):
        if phrases or more:
            raise ConfigError(
                "this scene knows its labels and no other words; leave out --against and --words"
            )
        log.info(
            "only the scene's labels can be asked for%s",
            "" if teacher else ": it has no teacher's artifact",
        )
        return Words(names, rows, None, rows)
    label_words = {folded(name) for name in names}
    others = [
        word
        for word in dict.fromkeys([*more, *table_words(model)])
        if folded(word) not in label_words
    ]
    reference = understood(teacher, others[0], phrases, calibrated=False)
    vectors = embed_words(others, features, model)
    order = sorted(range(len(names) + len(others)), key=[*names, *others].__getitem__)
    every = [*names, *others]
    words = Words(
        [every[k] for k in order],
        np.concatenate([rows, vectors])[order],
        reference.phrases,
        reference.against,
    )
    onnx_teacher = teacher_of(features, model)
    if not phrases and (calibration := calibration_of(onnx_teacher.path)) is not None:
        words.rivals, words.calibration = (
            embed_words(calibration.rivals, features, model),
            Calibration(**calibration.calibration),
        )
        words.uncalibrated = [
            k for k, covered in enumerate(are_words(words.words, onnx_teacher)) if not covered
        ]
    return words


def scoring_note(words: Words | None) -> str:
    """A page's sentence on how its words are scored."""
    if words is None or words.against is None:
        return "the labels alone"
    if words.calibration is None:
        return f"weighed against {', '.join(words.against)}"
    others = f", but {len(words.uncalibrated):,} by LERF's relevancy" * bool(words.uncalibrated)
    return f"answered in probabilities{others}"


def table_words(model: str | None) -> list[str]:
    """The words of a teacher's table; indoor nouns where it has a text encoder and no table."""
    teacher = read_teacher(Path(model) if model else EMBEDDED)
    if teacher.labels is not None:
        names, embeddings = read_label_table(teacher.labels)
        if embeddings is not None:
            return names
    log.info("the words of a page are embedded by %s; that takes a while", teacher.text)
    return list(read_label_set(EMBEDDED.with_name("nouns.txt")))
