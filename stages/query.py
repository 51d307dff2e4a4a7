"""query: where in a finished scene is what some words mean? Relevancy by Gaussian, and heat maps of the test views."""

from __future__ import annotations

import itertools
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from chebsplat.errors import ConfigError, DataFailure, InputError

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.features import Features
    from chebsplat.formats.scene import Scene

log = logging.getLogger("chebsplat")

CANONICAL = ("object", "things", "stuff", "texture")  # LERF's: phrases that fit anything
N_SHEET = 6  # views on the contact sheet


@dataclass
class Query:
    """A query in a scene's own channels: what is asked for [C], and what it is weighed against [K, C]."""

    text: str
    embedding: np.ndarray
    phrases: list[str]
    against: np.ndarray


def run(folder: Path, text: str, phrases: list[str], out: Path, n_rows: int) -> None:
    """Answer a query about the scene whose artifacts lie in `folder`; fill `out`, tell the labels that fit best.

    Args: phrases: what to weigh the query against; empty: LERF's, or all other labels where a scene knows only these.
    Raises: InputError naming what is missing or damaged; ConfigError on words that the scene cannot know.
    """
    import numpy as np

    from chebsplat.formats.scene import read_scene
    from chebsplat.labels.relevancy import relevancy

    for name in ("ingest", "export", "teacher"):
        if not (folder / name).is_dir():
            raise InputError(f"{folder / name} is missing: no finished scene with semantics; run the scene first")
    scene = read_scene(folder / "export")
    if scene.labels is None or scene.label_names is None:
        raise InputError(f"{folder / 'export'} has no semantics; train the scene with a teacher")
    query = understood(folder / "teacher", text, phrases)
    scores = relevancy(scene.parameters["features"], query.embedding, query.against)
    out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(out / "relevancy.npz", relevancy=scores, query=np.array(text), against=np.array(query.phrases))
    for line in table(scores, scene.labels, scene.label_names, n_rows):
        log.info("%s", line)
    draw(scene, test_views(folder / "ingest", scene), query, out)


def taught(path: Path) -> tuple[Features, str | None]:
    """A scene's `features` artifact, and the model that it was made with; None: the embedded one."""
    from types import NoneType

    from chebsplat.formats.artifact import read_manifest, stated
    from chebsplat.formats.features import read_features

    return read_features(path), stated(path, read_manifest(path), "config", "teacher", "model", kind=(str, NoneType))


def is_closed(features: Features) -> bool:
    """Whether the teacher knows its labels and no other words."""
    return features.convention["kind"] in ("labels", "given") or features.convention.get("output") == "logits"


def understood(path: Path, text: str, phrases: list[str]) -> Query:
    """The words as vectors of the scene's channels, by the teacher that the scene was trained from."""
    features, model = taught(path)
    if is_closed(features):
        return among_labels(features, text, phrases)
    try:
        vectors = embedded([text, *(phrases or CANONICAL)], features, model)
    except InputError as error:
        if phrases or repr(CANONICAL[0]) not in str(error):
            raise
        raise InputError(f"{error}; or choose with --against what the query is weighed against") from None
    return Query(text, vectors[0], phrases or list(CANONICAL), vectors[1:])


def embedded(words: list[str], features: Features, model: str | None) -> np.ndarray:
    """Words [L] -> f32 [L, C] by the text space of the ONNX teacher. Raises InputError if it is no longer the same."""
    import numpy as np

    from chebsplat.formats.artifact import sha256_file
    from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
    from chebsplat.stages.text import text_embeddings

    teacher = read_teacher(Path(model) if model else EMBEDDED)
    if sha256_file(teacher.path) != features.convention["sha256"]:
        raise InputError(f"{teacher.path} is not the model that this scene was trained from; run the scene again")
    vectors = text_embeddings(words, teacher)
    if features.channels is not None:
        vectors = features.channels.embed(vectors)
        kept = float(np.linalg.norm(vectors[0]))
        log.info("%.0f %% of the query's length lies in the scene's channels", 100 * kept)
    return vectors


def among_labels(features: Features, text: str, phrases: list[str]) -> Query:
    """A query of a scene whose teacher knows its labels and no other words."""
    from chebsplat.formats.names import suggest
    from chebsplat.stages.text import folded

    names = features.label_names
    row = {folded(name): k for k, name in enumerate(names)}
    for word in (text, *phrases):
        if folded(word) not in row:
            near = suggest(folded(word), row)
            raise ConfigError(
                f"{word!r} is no label of this scene, and its teacher (kind {features.convention['kind']}) knows no "
                f"other words{'; near: ' + ', '.join(near) if near else ''}. Labels: {', '.join(names)}. For free text "
                "run the scene with teacher.kind=auto"
            )
    asked = row[folded(text)]
    others = [row[folded(word)] for word in phrases] or [k for k in range(len(names)) if k != asked]
    if not others:
        raise ConfigError(f"{text!r} is the scene's only label: there is nothing to weigh it against")
    return Query(text, features.label_embeddings[asked], [names[k] for k in others], features.label_embeddings[others])


def table(scores: np.ndarray, labels: np.ndarray, names: list[str], n_rows: int) -> list[str]:
    """Lines: how many Gaussians are relevant, then the labels of the highest mean relevancy."""
    import numpy as np

    lines = [f"{np.sum(scores > 0.5)} of {len(scores)} Gaussians have a relevancy above 0.5"]
    rows = [(float(scores[labels == k].mean()), k) for k in np.unique(labels) if k >= 0]
    width = max([len(name) for name in names] + [5])
    lines.append(f"{'label':{width}s}  mean relevancy  Gaussians  above 0.5")
    for mean, k in sorted(rows, reverse=True)[:n_rows]:
        mine = scores[labels == k]
        lines.append(f"{names[k]:{width}s}  {mean:14.3f}  {len(mine):9d}  {np.sum(mine > 0.5):9d}")
    return lines


def test_views(path: Path, scene: Scene) -> list[int]:
    """Places of the capture's test views among the scene's cameras."""
    from chebsplat.formats.capture import read_capture

    capture = read_capture(path)
    tests = {name for name, is_test in zip(capture.names, capture.is_test, strict=True) if is_test}
    rows = [k for k, name in enumerate(scene.cameras.names) if name in tests]
    if not rows:
        raise DataFailure("no test view has a camera; lower ingest.test_every")
    return rows


def draw(scene: Scene, views: list[int], query: Query, out: Path) -> None:
    """`heat/<view>.png` of every view, and `sheet.png` of renders beside heat maps."""
    import numpy as np

    from chebsplat.labels.relevancy import relevancy
    from chebsplat.render import SceneRenderer
    from chebsplat.stages.evaluate import camera
    from chebsplat.stages.pages.pictures import heat, heat_scale, png

    renderer, rows = SceneRenderer(scene.parameters), []
    shown = {views[round(k)] for k in np.linspace(0, len(views) - 1, min(N_SHEET, len(views)))}
    (out / "heat").mkdir(exist_ok=True)
    files = dict(zip(views, file_names([scene.cameras.names[k] for k in views]), strict=True))
    for k in views:
        image, features = renderer.render(camera(scene, k), with_features=True)
        assert features is not None
        warm = heat(image, relevancy(features, query.embedding, query.against))
        png(warm, out / "heat" / f"{files[k]}.png")
        if k in shown:
            rows.append(np.concatenate([image, warm], 1))
    title = heat_scale(f"{query.text}  (against {', '.join(query.phrases)})", rows[0].shape[1])
    png(np.concatenate([title, *rows]), out / "sheet.png")


def file_names(views: list[str]) -> list[str]:
    """A file's name for each view: its path with every separator replaced, and a number where two would be alike."""
    names: list[str] = []
    for view in views:
        name = re.sub(r"[^\w.-]+", "-", view.removesuffix(Path(view).suffix)).strip(".-") or "view"
        name = name.encode()[:200].decode(errors="ignore")
        taken = {held.lower() for held in names}  # some file systems fold case
        names.append(
            next(new for k in itertools.count(1) if (new := name if k == 1 else f"{name}-{k}").lower() not in taken)
        )
    return names
