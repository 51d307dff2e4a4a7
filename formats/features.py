"""`features/1`: per-view semantic features of a 2D teacher, and the labels they can be asked for."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.arrays import StoredArray, create_array, has_array, open_array
from chebsplat.formats.channels import SPECS, ChannelMap, from_parts, tensors
from chebsplat.formats.channels import Document as ChannelsDocument
from chebsplat.formats.documents import NotRequired, TypedDict, read_document, write_document
from chebsplat.formats.files import atomic_write, sync
from chebsplat.formats.manifest import remedy_of
from chebsplat.formats.names import check_names
from chebsplat.formats.tensors import read_tensors, write_tensors

SCHEMA = "chebsplat.features/1"
AXES = ("view", "row", "column", "channel")
DTYPES = {"features": np.float16, "pseudo_labels": np.int16, "confidence": np.float16}
LARGEST = 65_504.0  # of float16
PATCH = 64  # longest side, in feature pixels, of a patch that is read on its own


class Document(TypedDict):
    names: list[str]
    label_names: list[str]
    convention: dict[str, Any]
    projection: NotRequired[ChannelsDocument]  # `Features.channels`; on disk the name stays, so that older files open


@dataclass
class Features:
    """Features of V views at the teacher's resolution h x w.

    names:            of the views, for joins.
    features:         f16 [V, h, w, C].
    label_names:      L names; label_embeddings: f32 [L, C], no row longer than 1; a pixel's label is the one of the
                      largest inner product. Rows are unit unless `channels` keeps a part of them.
    pseudo_labels:    i16 [V, h, w] or None; confidence: f16 [V, h, w] in [0, 1] or None.
    convention:       n_scales, flips, normalized and the teacher's own parameters: a loss needs to know them.
    channels:         from the teacher's channels to these C; None: they are the teacher's own.
    """

    names: list[str]
    features: np.ndarray | StoredArray
    label_names: list[str]
    label_embeddings: np.ndarray
    pseudo_labels: np.ndarray | StoredArray | None = None
    confidence: np.ndarray | StoredArray | None = None
    convention: dict[str, Any] = field(default_factory=dict)
    channels: ChannelMap | None = None


class FeatureWriter:
    """Writes one view at a time, in any order, into a folder that survives a kill; the same bytes however often.

    A view is done once a mark says so, and the mark is written when the view's files are safe on disk. Whatever a kill
    left of another view is written anew.

    Args:
      folder:    of this writer alone, on the disk of the artifact that `finish` fills.
      names:     of the V views; shape: (h, w, C) of each.
      made_with: what else the values depend on; a folder made with other names, shape or settings starts anew.
    """

    def __init__(
        self,
        folder: Path,
        names: Sequence[str],
        shape: tuple[int, int, int],
        made_with: Mapping[str, Any] | None = None,
    ):
        self.folder, self.names, self.shape = Path(folder), list(names), shape
        wanted = json.dumps({"names": self.names, "shape": list(shape), "made_with": dict(made_with or {})})
        state = self.folder / "writer.json"
        if not state.is_file() or state.read_text() != wanted:
            shutil.rmtree(self.folder, ignore_errors=True)
            (self.folder / "done").mkdir(parents=True)
            atomic_write(state, wanted)
        self._arrays: dict[str, Any] = {}
        self._holds: dict[int, list[str]] = {}  # view -> names of its arrays
        for mark in (self.folder / "done").iterdir():
            held = mark.read_text().split()
            if mark.name.isdigit() and all(self._file(name, int(mark.name)).is_file() for name in held):
                self._holds[int(mark.name)] = held

    @property
    def done(self) -> set[int]:
        """Views that need not be added again."""
        return set(self._holds)

    def add(
        self,
        view: int,
        features: np.ndarray,
        pseudo_labels: np.ndarray | None = None,
        confidence: np.ndarray | None = None,
    ) -> None:
        """Write one view: features [h, w, C], labels and confidence [h, w].

        Raises: ValueError naming the view on another shape, or on a value that float16 cannot hold.
        """
        given = {"features": features, "pseudo_labels": pseudo_labels, "confidence": confidence}
        values = {name: value for name, value in given.items() if value is not None}
        for name, value in values.items():
            array = self._array(name)
            if value.shape != array.shape[1:]:
                raise ValueError(f"view {self.names[view]}: {name} {value.shape}, expected {array.shape[1:]}")
            with np.errstate(over="ignore"):  # reported below
                stored = value.astype(array.dtype, copy=False)
            if stored.dtype.kind == "f" and not np.isfinite(stored).all():
                bad = np.sum(~np.isfinite(stored))
                raise ValueError(f"view {self.names[view]}: {name} hold {bad} non-finite values in float16")
            shutil.rmtree(self.folder / name / "c" / str(view), ignore_errors=True)  # what a kill left of it
            array[view] = stored
            sync(self._file(name, view))
        atomic_write(self.folder / "done" / str(view), " ".join(values))
        self._holds[view] = list(values)

    def finish(
        self,
        out: Path,
        label_names: list[str],
        label_embeddings: np.ndarray,
        convention: dict[str, Any],
        channels: ChannelMap | None = None,
    ) -> None:
        """Fill the directory that `artifact.publish` yields; the writer's own folder stays as it is.

        Raises: ValueError naming a view that was not added, or was added without its labels or confidence.
        """
        absent = [name for view, name in enumerate(self.names) if view not in self._holds]
        if absent:
            raise ValueError(f"view {absent[0]} was not added ({len(absent)} such)")
        for name in sorted({name for held in self._holds.values() for name in held}):
            self._array(name)  # its metadata
            for view, held in self._holds.items():
                if name not in held:
                    raise ValueError(f"view {self.names[view]} was added without {name}")
                file = self._file(name, view)
                _link(file, out / file.relative_to(self.folder))
            _link(self.folder / name / "zarr.json", out / name / "zarr.json")
        check_names(label_names, "label names", "features", "correct the labels")
        write_tensors(out / "labels.safetensors", {"embeddings": label_embeddings.astype(np.float32)})
        document: dict[str, Any] = {"names": self.names, "label_names": label_names, "convention": convention}
        if channels is not None:
            write_tensors(out / "projection.safetensors", tensors(channels))
            document["projection"] = {"teacher": channels.teacher, "notes": channels.notes}
        write_document(out / "features.json", document)

    def _array(self, name: str) -> Any:
        """The open array. Metadata are written anew, always the same; what chunks there are stay."""
        if name not in self._arrays:
            h, w, c = self.shape
            path, n_views = self.folder / name, len(self.names)
            (path / "zarr.json").unlink(missing_ok=True)
            if name == "features":
                counts = (-(-h // PATCH), -(-w // PATCH))
                patch = (-(-h // counts[0]), -(-w // counts[1]))
                shard = (1, patch[0] * counts[0], patch[1] * counts[1], c)
                found = create_array(path, (n_views, h, w, c), DTYPES[name], AXES, "", (1, *patch, c), shard)
            else:
                units = "label index" if name == "pseudo_labels" else ""
                found = create_array(path, (n_views, h, w), DTYPES[name], AXES[:3], units)
            self._arrays[name] = found
        return self._arrays[name]

    def _file(self, name: str, view: int) -> Path:
        """Where a view's values lie; every view is one file."""
        return self.folder / name / "c" / str(view) / ("0/0/0" if name == "features" else "0/0")


def _link(source: Path, target: Path) -> None:
    """A second name for a file: no bytes are copied, and a kill before publication loses no view."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)


def write_features(out: Path, features: Features) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError naming a view with a non-finite value."""
    _, h, w, c = features.features.shape
    writer = FeatureWriter(out / ".writer", features.names, (h, w, c))
    extra = (features.pseudo_labels, features.confidence)
    for view in range(len(features.names)):
        writer.add(view, features.features[view], *(None if array is None else array[view] for array in extra))
    writer.finish(out, features.label_names, features.label_embeddings, features.convention, features.channels)
    shutil.rmtree(writer.folder)


def read_features(path: Path) -> Features:
    """Features stay on disk until indexed. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    document, file = read_document(path, manifest, "features.json", Document), path / "features.json"
    names, label_names = document["names"], document["label_names"]
    check_names(names, "names", file, remedy_of(path))
    check_names(label_names, "label names", file, remedy_of(path))
    features = open_array(path, manifest, "features", (len(names), None, None, None), "float16", (-LARGEST, LARGEST))
    spec = {"embeddings": ("float32", len(label_names), features.shape[3])}
    embeddings = read_tensors(path, manifest, "labels.safetensors", spec)["embeddings"]
    kinds = {"pseudo_labels": ("int16", (-1, len(label_names) - 1)), "confidence": ("float16", (0, 1))}
    optional = {
        name: open_array(path, manifest, name, features.shape[:3], dtype, within)
        for name, (dtype, within) in kinds.items()
        if has_array(manifest, name)
    }
    longest = np.linalg.norm(embeddings, axis=1).max(initial=0)
    if longest > 1 + 1e-3:
        raise InputError(
            f"{path / 'labels.safetensors'}: an embedding is {longest:.3g} long, at most 1 is right; {remedy_of(path)}"
        )
    channels = None
    if "projection" in document:
        specs = SPECS | {"matrix": ("float32", "C", features.shape[3])}
        arrays = read_tensors(path, manifest, "projection.safetensors", specs)
        channels = from_parts(arrays, document["projection"])
    return Features(names, features, label_names, embeddings, **optional, convention=document["convention"],
                    channels=channels)  # fmt: skip
