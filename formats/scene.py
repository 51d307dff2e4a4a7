"""`scene/5`: the exported scene: PLY and SPZ for viewers, ragged arrays, label names, a summary."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np

from chebsplat.errors import DataFailure, InputError
from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document, write_document
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.ply import REST, write_ply
from chebsplat.formats.record import Array, Record
from chebsplat.formats.spz import write_spz
from chebsplat.formats.world import World

LABELS = "labels.json"
MOST_MEANINGS = 65_536  # rows of the dictionary, which two bytes count
REMEDY = "export the scene again"
SEMANTIC = ("features", "steps", "labels", "meanings", "label_embeddings")
RAGGED = ("means", "log_scales", "quats", "sh0", "logit_opacities", "sh1", "sh2", "sh3")


@dataclass
class Scene:
    """N Gaussians sorted by SH degree, stably; raw float32 parameters as in `gaussians/2`.

    parameters: `means`, `log_scales`, `quats`, `logit_opacities`, `sh0` [N,1,3], `shN` [N,15,3]
      (zero above a Gaussian's degree), `degrees` u8 [N] ascending; where there are semantics
      `features` [N,C].
    cameras:    of the views it can be evaluated on.
    order:      i64 [N], row of each Gaussian in the checkpoint.
    labels:     i32 [N] class index, -1 none; None without semantics. label_names, label_embeddings
      f32 [L, C].
    summary:    counts, bytes, what was left out and why, and where the scene's
      `formats.world.World` is another.
    """

    SCHEMA: ClassVar[str] = "chebsplat.scene/5"
    parameters: dict[str, np.ndarray]
    cameras: Cameras
    order: np.ndarray
    labels: np.ndarray | None = None
    label_names: list[str] | None = None
    label_embeddings: np.ndarray | None = None
    summary: dict[str, Any] = field(default_factory=dict)

    def write(self, out: Path, rounded: dict[str, np.ndarray] | None = None) -> dict[str, int]:
        """Fill the directory that `artifact.publish` yields; returns bytes by part.

        Args:    rounded: the parameters of `scene.spz`, where light is rounded for it.
        Raises:  ValueError on more than MOST_MEANINGS distinct meanings.
        Choices: `scene.ply` is trimmed to the highest degree in use, and `scene.spz` beside it
          if SPZ can represent the scene; both are in the source's world. Features take 8 bits a
          channel, in steps of each row's own, so that a long row does not coarsen others; labels
          are of the features before. Degrees are stored in the checkpoint's order, which they then
          tell.
        """
        p, degrees, world = self.parameters, self.parameters["degrees"], World.read(self.summary)
        unsorted = np.empty_like(degrees)
        unsorted[self.order] = degrees
        if not np.array_equal(np.argsort(unsorted, kind="stable"), self.order):
            raise ValueError("Gaussians are not sorted by degree, stably")
        top = int(degrees.max(initial=0))
        write_ply(out / "scene.ply", p, top, self.labels, self.label_names, world)
        try:
            write_spz(out / "scene.spz", rounded or p, top, world)
        except DataFailure as error:
            self.summary["left_out"] = self.summary.get("left_out", {}) | {"scene.spz": str(error)}
        bands = {}
        for band in range(1, top + 1):
            rows = p["shN"][degrees >= band, REST[band - 1] : REST[band]]
            bands[f"sh{band}"] = rows.reshape(len(rows), -1)
        stored = RaggedScene(
            **{name: p[name] for name in ("means", "log_scales", "quats", "logit_opacities")},
            sh0=p["sh0"][:, 0],
            degrees=unsorted.astype(np.uint8),
            cameras=self.cameras,
            summary=self.summary | {"max_degree": top, "n": len(degrees)},
            label_embeddings=self.label_embeddings,
            **bands,
            **self._dictionary(),
        )
        stored.write(out)
        write_document(out / LABELS, dict(enumerate(self.label_names or [])))
        sizes = {
            "unpruned_ply": 62 * 4 * len(degrees),
            "ply": (out / "scene.ply").stat().st_size,
            "ragged": _bytes_of(out, RAGGED),
            "semantic": _bytes_of(out, SEMANTIC),
        }
        if (out / "scene.spz").exists():
            sizes["spz"] = (out / "scene.spz").stat().st_size
        stored.summary["bytes"] = sizes
        stored.write_attributes(out)
        return sizes

    def _dictionary(self) -> dict[str, np.ndarray]:
        """Rows that Gaussians share, `meanings`, and of each row its features and label; empty
        without semantics.
        """
        columns = []
        if self.labels is not None:
            columns.append(self.labels[:, None])
        features = self.parameters.get("features")
        if features is not None:
            columns.append(np.ascontiguousarray(features, np.float32).view(np.int32))
        if not columns:
            return {}
        _, first, meanings = np.unique(
            np.concatenate(columns, 1), axis=0, return_index=True, return_inverse=True
        )
        if len(first) > MOST_MEANINGS:
            raise ValueError(f"{len(first):,} meanings differ, {MOST_MEANINGS:,} may")
        stored = {"meanings": meanings.reshape(-1).astype(np.uint16)}
        if self.labels is not None:
            stored["labels"] = self.labels[first]
        if features is not None:
            rows = features[first]
            if not np.isfinite(rows).all():
                raise ValueError("features are not finite")
            steps = (np.abs(rows).max(1) / 127).astype(np.float32)
            stored["steps"] = np.where(steps > 0, steps, np.float32(1))
            stored["features"] = np.round(rows / stored["steps"][:, None]).clip(-127, 127)
            stored["features"] = stored["features"].astype(np.int8)
        return stored

    @classmethod
    def read(cls, path: Path) -> Self:
        """The exported scene at `path`, all in memory. Raises InputError naming file and remedy."""
        path = Path(path)
        stored = RaggedScene.read(path)
        order = np.argsort(stored.degrees, kind="stable")
        degrees = stored.degrees[order]
        parameters = {
            name: getattr(stored, name)
            for name in ("means", "log_scales", "quats", "logit_opacities")
        }
        parameters["sh0"] = stored.sh0[:, None]
        parameters["shN"] = np.zeros((len(order), 15, 3), np.float32)
        for band in range(1, int(degrees.max(initial=0)) + 1):
            width = REST[band] - REST[band - 1]
            rows = getattr(stored, f"sh{band}").reshape(-1, width, 3)
            parameters["shN"][degrees >= band, REST[band - 1] : REST[band]] = rows
        parameters["degrees"] = degrees
        labels = None
        if (rows := stored.meanings) is not None:
            dictionary = stored.labels if stored.features is None else stored.features
            if dictionary is None or rows.max(initial=0) >= len(dictionary):
                raise InputError(f"{path / 'meanings'} names a row that is lacking; {REMEDY}")
            if stored.features is not None and stored.steps is not None:
                parameters["features"] = (stored.features * stored.steps[:, None])[rows]
            if stored.labels is not None:
                labels = stored.labels[rows]
        names = read_label_names(path, artifact.read_manifest(path)) if labels is not None else None
        return cls(
            parameters,
            stored.cameras,
            order,
            labels,
            names,
            stored.label_embeddings,
            stored.summary,
        )


@dataclass
class RaggedScene(Record):
    """`Scene` as stored: SH bands up to each Gaussian's degree, meanings as rows of a dictionary.

    Arrays of Gaussians are in order of degree, but for `degrees`. sh1, sh2, sh3: rows of the
    Gaussians that keep the band. meanings: each Gaussian's row of `features`, in `steps` of that
    row, and of `labels`.
    """

    SCHEMA: ClassVar[str] = Scene.SCHEMA
    means: Annotated[np.ndarray, Array("float32", ("gaussian", 3), "scene units")]
    log_scales: Annotated[np.ndarray, Array("float32", ("gaussian", 3), "ln of scene units")]
    quats: Annotated[np.ndarray, Array("float32", ("gaussian", 4), "wxyz")]
    logit_opacities: Annotated[np.ndarray, Array("float32", ("gaussian",))]
    sh0: Annotated[np.ndarray, Array("float32", ("gaussian", 3))]
    degrees: Annotated[
        np.ndarray, Array("uint8", ("gaussian",), "highest SH band, in the checkpoint's order")
    ]
    cameras: Cameras
    summary: dict[str, Any]
    sh1: Annotated[np.ndarray | None, Array("float32", ("gaussian_1", 9))] = None
    sh2: Annotated[np.ndarray | None, Array("float32", ("gaussian_2", 15))] = None
    sh3: Annotated[np.ndarray | None, Array("float32", ("gaussian_3", 21))] = None
    features: Annotated[
        np.ndarray | None, Array("int8", ("meaning", "channel"), "steps of its row")
    ] = None
    steps: Annotated[np.ndarray | None, Array("float32", ("meaning",), "of a row of features")] = (
        None
    )
    labels: Annotated[np.ndarray | None, Array("int32", ("meaning",), "class index, -1 none")] = (
        None
    )
    meanings: Annotated[
        np.ndarray | None, Array("uint16", ("gaussian",), "row of features, steps, labels")
    ] = None
    label_embeddings: Annotated[np.ndarray | None, Array("float32", ("label", "channel"))] = None


def read_label_names(path: Path, manifest: Manifest) -> list[str]:
    """The label dictionary alone, in order of ids. Raises InputError naming file and remedy."""
    return list(read_document(path, manifest, LABELS).values())


def _bytes_of(out: Path, names: tuple[str, ...]) -> int:
    return sum(
        file.stat().st_size for name in names for file in (out / name).rglob("*") if file.is_file()
    )
