"""`scene/4`: the exported scene: PLY and SPZ for viewers, ragged arrays, label names, a summary."""

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
SEMANTIC = ("features", "meanings", "labels", "label_embeddings")
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

    SCHEMA: ClassVar[str] = "chebsplat.scene/4"
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
        Raises:  ValueError on more than MOST_MEANINGS distinct features.
        Choices: `scene.ply` is trimmed to the highest degree in use, and `scene.spz` beside it
          if SPZ can represent the scene; both are in the source's world. Features are rows of a
          dictionary, in 16-bit fixed point: as small as halves, 20 times as exact. Degrees are
          stored in the checkpoint's order, which they then tell.
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
        steps, meanings = {}, {}
        if "features" in p:
            step = float(np.abs(p["features"]).max(initial=0)) / 32767 or 1.0
            fixed = np.round(p["features"] / step).astype(np.int16)
            dictionary, rows = np.unique(fixed, axis=0, return_inverse=True)
            if len(dictionary) > MOST_MEANINGS:
                raise ValueError(f"{len(dictionary):,} features differ, {MOST_MEANINGS:,} may")
            steps["features"] = step
            meanings = {"features": dictionary, "meanings": rows.reshape(-1).astype(np.uint16)}
        stored = RaggedScene(
            **{name: p[name] for name in ("means", "log_scales", "quats", "logit_opacities")},
            sh0=p["sh0"][:, 0],
            degrees=unsorted.astype(np.uint8),
            cameras=self.cameras,
            steps=steps,
            summary=self.summary | {"max_degree": top, "n": len(degrees)},
            labels=self.labels,
            label_embeddings=self.label_embeddings,
            **bands,
            **meanings,
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
        if stored.features is not None and stored.meanings is not None:
            if stored.meanings.max(initial=0) >= len(stored.features):
                raise InputError(f"{path / 'meanings'} names a row that features lack; {REMEDY}")
            dictionary = stored.features * np.float32(stored.steps["features"])
            parameters["features"] = dictionary[stored.meanings]
        names = (
            read_label_names(path, artifact.read_manifest(path))
            if stored.labels is not None
            else None
        )
        return cls(
            parameters,
            stored.cameras,
            order,
            stored.labels,
            names,
            stored.label_embeddings,
            stored.summary,
        )


@dataclass
class RaggedScene(Record):
    """`Scene` as stored: SH bands up to each Gaussian's degree, features as rows of a dictionary.

    All but `degrees` are in order of degree. sh1, sh2, sh3: rows of the Gaussians that keep the
    band. features: the dictionary in fixed point, with `meanings` as its rows; steps: their unit.
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
    steps: dict[str, float]
    summary: dict[str, Any]
    sh1: Annotated[np.ndarray | None, Array("float32", ("gaussian_1", 9))] = None
    sh2: Annotated[np.ndarray | None, Array("float32", ("gaussian_2", 15))] = None
    sh3: Annotated[np.ndarray | None, Array("float32", ("gaussian_3", 21))] = None
    features: Annotated[np.ndarray | None, Array("int16", ("meaning", "channel"), "a step")] = None
    meanings: Annotated[np.ndarray | None, Array("uint16", ("gaussian",), "row of features")] = None
    labels: Annotated[np.ndarray | None, Array("int32", ("gaussian",), "class index, -1 none")] = (
        None
    )
    label_embeddings: Annotated[np.ndarray | None, Array("float32", ("label", "channel"))] = None


def read_label_names(path: Path, manifest: Manifest) -> list[str]:
    """The label dictionary alone, in order of ids. Raises InputError naming file and remedy."""
    return list(read_document(path, manifest, LABELS).values())


def _bytes_of(out: Path, names: tuple[str, ...]) -> int:
    return sum(
        file.stat().st_size for name in names for file in (out / name).rglob("*") if file.is_file()
    )
