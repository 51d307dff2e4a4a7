"""Meanings of the Gaussians of a splat, a table of rows that they share, to travel with it.

A GLB holds it itself (`gltf.write_splat_glb`). Beside an SPZ or SOG lies `office0.spz.labels.npz`,
which numpy reads alone (`examples/count_labels.py`): `meanings` u16 [N], each Gaussian's row in the
order of the file; of each row `labels` i16 [R], the index of its class or -1 for none, and
`features` f16 [R, C]; of each class `names` [L] and `embeddings` f32 [L, C], in the channels of the
features; and `splat`, the sha256 of the file that it is of.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats.artifact import sha256_file
from chebsplat.formats.files import atomic_path
from chebsplat.formats.names import check_names
from chebsplat.formats.tensors import read_npz

FIELDS = ("meanings", "labels", "features", "names", "embeddings", "splat")
REMEDY = "remove it, or export the scene again"


@dataclass(frozen=True)
class Semantics:
    """Meanings of N Gaussians: meanings [N], rows of labels [R] (class index, -1 none) and of
    features f32 [R, C]; names of L classes and embeddings f32 [L, C]. Raises ValueError where these
    do not fit together.
    """

    meanings: np.ndarray
    labels: np.ndarray
    features: np.ndarray
    names: list[str]
    embeddings: np.ndarray

    def __post_init__(self) -> None:
        (n_rows, width), n_labels = self.features.shape, len(self.names)
        fits = self.labels.shape == (n_rows,) and self.embeddings.shape == (n_labels, width)
        if not fits or self.meanings.ndim != 1:
            raise ValueError("its arrays are of different sizes")
        for name, values, low, end in (
            ("meanings", self.meanings, 0, n_rows),
            ("labels", self.labels, -1, n_labels),
        ):
            if not ((values >= low) & (values < end)).all():
                raise ValueError(f"{name} holds more than {low} to {end - 1}")
        if not (np.isfinite(self.features).all() and np.isfinite(self.embeddings).all()):
            raise ValueError("features or embeddings are not finite")

    @classmethod
    def of(
        cls, features: np.ndarray, labels: np.ndarray, names: list[str], embeddings: np.ndarray
    ) -> Self:
        """The table of features [N, C] and labels [N], a row for each that differs."""
        rows, meanings = np.unique(np.c_[labels, features], axis=0, return_inverse=True)
        shared = rows[:, 1:].astype(np.float32)
        return cls(meanings.reshape(-1), rows[:, 0].astype(np.int32), shared, names, embeddings)

    def write(self, splat: Path, content: Path, order: np.ndarray) -> None:
        """Write it beside a splat whose Gaussians are these in `order`, i64 [N]; content: a file of
        the same bytes.

        Raises: ValueError on more rows than two bytes count.
        """
        if len(self.labels) > 65_536:
            raise ValueError(f"{len(self.labels):,} meanings differ, 65,536 may")
        with atomic_path(beside(splat)) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(
                stream,
                meanings=self.meanings[order].astype(np.uint16),
                labels=self.labels.astype(np.int16),
                features=self.features.astype(np.float16),
                names=np.array(self.names),
                embeddings=self.embeddings,
                splat=np.array(sha256_file(content)),
            )


def beside(splat: Path) -> Path:
    """The file of meanings beside a splat."""
    return splat.with_name(f"{splat.name}.labels.npz")


def read_beside(splat: Path) -> Semantics | None:
    """The meanings beside a splat, None where there are none.

    Raises: InputError naming the file: damaged, or of another splat, whose order is another.
    """
    path = beside(splat)
    if not path.exists():
        return None
    stored = read_npz(path, FIELDS, REMEDY)
    try:
        if str(stored["splat"]) != sha256_file(splat):
            raise ValueError(f"it is not of the {splat.name} beside it")
        features, embeddings = (stored[name].astype(np.float32) for name in FIELDS[2:5:2])
        names = [name.item() for name in stored["names"]]
        check_names(names, "names of classes", path, REMEDY)
        meanings, labels = (stored[name].astype(np.int64) for name in FIELDS[:2])
        return Semantics(meanings, labels, features, names, embeddings)
    except (ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} does not fit ({error}); {REMEDY}") from None
