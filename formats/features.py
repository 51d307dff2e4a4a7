"""`features/2`: per-view semantic features of a 2D teacher, and the labels they are scored by."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from chebsplat.formats.channels import ChannelMap
from chebsplat.formats.files import atomic_write, sync
from chebsplat.formats.names import check_names
from chebsplat.formats.record import METADATA, Array, Record, Stack, create_array, layout_of

PIXELS = ("view", "row", "column")


@dataclass
class Features(Record):
    """Features of V views at the teacher's resolution h x w.

    names:            of the views, for joins.
    features:         f16 [V, h, w, C].
    label_names:      L names; label_embeddings: f32 [L, C], no row longer than 1; a pixel's label
      is the one of the largest inner product. Rows are unit unless `channels` keeps a part of them.
    pseudo_labels:    i16 [V, h, w] or None; confidence: f16 [V, h, w] in [0, 1] or None.
    convention:       n_scales, flips, normalized and the teacher's own parameters: a loss needs to
      know them.
    channels:         from the teacher's channels to these C; None: they are the teacher's own.
    """

    SCHEMA: ClassVar[str] = "chebsplat.features/2"
    names: list[str]
    features: Annotated[Stack, Array("float16", (*PIXELS, "channel"), by_view=True)]
    label_names: list[str]
    label_embeddings: Annotated[np.ndarray, Array("float32", ("label", "channel"))]
    pseudo_labels: Annotated[
        Stack | None, Array("int16", PIXELS, "label index, -1 none", by_view=True)
    ] = None
    confidence: Annotated[Stack | None, Array("float16", PIXELS, "0 to 1", by_view=True)] = None
    convention: dict[str, Any] = field(default_factory=dict)
    channels: ChannelMap | None = None


class FeatureWriter:
    """Writes features view by view, in any order, into a folder that survives a kill.

    A marker per view is written once the view's files are synced; a view without one is written
    again. The bytes do not depend on the order or the number of attempts.

    Args:
      folder:    of this writer alone, on the disk of the artifact that `finish` fills.
      names:     of the V views; shape: (h, w, C) of each.
      made_with: further settings behind the values; a folder with other names, shape or settings is
        emptied.
    """

    def __init__(
        self,
        folder: Path,
        names: Sequence[str],
        shape: tuple[int, int, int],
        made_with: Mapping[str, Any] | None = None,
    ):
        self.folder, self.names, self.shape = Path(folder), list(names), shape
        settings = json.dumps(
            {"names": self.names, "shape": list(shape), "made_with": dict(made_with or {})}
        )
        state = self.folder / "writer.json"
        if not state.is_file() or state.read_text() != settings:
            shutil.rmtree(self.folder, ignore_errors=True)
            (self.folder / "done").mkdir(parents=True)
            atomic_write(state, settings)
        self._arrays: dict[str, Any] = {}
        self._holds: dict[int, list[str]] = {}  # names of arrays by view
        for marker in (self.folder / "done").iterdir():
            arrays = marker.read_text().split()
            if marker.name.isdigit() and all(
                self._file(name, int(marker.name)).is_file() for name in arrays
            ):
                self._holds[int(marker.name)] = arrays

    @property
    def finished(self) -> set[int]:
        """Views on disk, which need not be added again."""
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
        arrays = {"features": features, "pseudo_labels": pseudo_labels, "confidence": confidence}
        values = {name: value for name, value in arrays.items() if value is not None}
        for name, value in values.items():
            array = self._array(name)
            if value.shape != array.shape[1:]:
                raise ValueError(
                    f"view {self.names[view]}: {name} {value.shape}, expected {array.shape[1:]}"
                )
            with np.errstate(over="ignore"):  # reported below
                stored = value.astype(array.dtype, copy=False)
            if stored.dtype.kind == "f" and not np.isfinite(stored).all():
                bad = np.sum(~np.isfinite(stored))
                raise ValueError(
                    f"view {self.names[view]}: {name} hold {bad} non-finite values in float16"
                )
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
    ) -> Features:
        """Link the views into `out`, which `artifact.publish` yields; the writer's folder stays.

        Raises: ValueError naming a view that was not added, or was added without its labels or
          confidence.
        """
        absent = [name for view, name in enumerate(self.names) if view not in self._holds]
        if absent:
            raise ValueError(f"view {absent[0]} was not added ({len(absent)} such)")
        stored = {}
        for name in sorted({name for arrays in self._holds.values() for name in arrays}):
            stored[name] = self._array(name)
            for view, arrays in self._holds.items():
                if name not in arrays:
                    raise ValueError(f"view {self.names[view]} was added without {name}")
                file = self._file(name, view)
                _link(file, out / file.relative_to(self.folder))
            _link(self.folder / name / METADATA, out / name / METADATA)
        check_names(label_names, "label names", "features", "correct the labels")
        fixed = (label_names, label_embeddings)
        record = Features(
            self.names,
            stored.pop("features"),
            *fixed,
            **stored,
            convention=convention,
            channels=channels,
        )
        record.write(out)
        return record

    def _array(self, name: str) -> Any:
        """The open array. Its metadata are written anew, always the same; chunks on disk stay."""
        if name not in self._arrays:
            spec = layout_of(Features).arrays[name]
            shape = (len(self.names), *self.shape)[: len(spec.axes)]
            (self.folder / name / METADATA).unlink(missing_ok=True)
            self._arrays[name] = create_array(self.folder / name, shape, spec)
        return self._arrays[name]

    def _file(self, name: str, view: int) -> Path:
        """The chunk that holds a view's values."""
        zeros = ".0" * (len(layout_of(Features).arrays[name].axes) - 1)
        return self.folder / name / f"c.{view}{zeros}"


def _link(source: Path, target: Path) -> None:
    """Hard-link a file: no bytes are copied, and a kill before publication loses no view."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)
