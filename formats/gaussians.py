"""`gaussians/2`: the checkpoint of a trained scene, all raw parameters, and its training trace."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np

from chebsplat.formats import artifact
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.files import read_text
from chebsplat.formats.manifest import Manifest, remedy_of
from chebsplat.formats.record import Array, Record, layout_of, reading

TRACE = "trace.csv"


@dataclass
class Gaussians:
    """Raw parameters in float32; the name of each carries its transform.

    parameters: `means` [N,3] scene units, `log_scales` [N,3], `quats` [N,4] wxyz, `logit_opacities`
      [N], `sh0` [N,1,3], `shN` [N,15,3], `degrees` u8 [N] highest SH band kept, and, where the
      scene has a semantic branch, `features` [N,C].
    cameras:    of the views it was trained and may be evaluated on.
    modules:    of the printed method: weights of its modules and bases of its knowledge, by name.
    trace:      one row a report interval: error against run time.
    notes:      label names, and what the scene left out and why.
    """

    SCHEMA: ClassVar[str] = "chebsplat.gaussians/2"
    parameters: dict[str, np.ndarray]
    cameras: Cameras
    modules: dict[str, np.ndarray] = field(default_factory=dict)
    trace: list[dict[str, float]] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)

    def write(self, out: Path) -> None:
        """Fill the directory that `artifact.publish` yields. Raises ValueError on nan or infinity.

        Choices: SH bands above every Gaussian's degree are not stored; reading fills in zeros.
        """
        degrees, shN = self.parameters["degrees"], self.parameters["shN"]
        used_bands = shN[:, : (int(degrees.max(initial=0)) + 1) ** 2 - 1]
        weights = [np.zeros(0, np.float32), *map(np.ravel, self.modules.values())]
        Checkpoint(
            **self.parameters | {"shN": used_bands},
            cameras=self.cameras,
            modules=np.concatenate(weights),
            module_shapes={name: list(values.shape) for name, values in self.modules.items()},
            notes=self.notes,
        ).write(out)
        with (out / TRACE).open("w", newline="") as handle:
            columns = list(self.trace[0]) if self.trace else ["step", "seconds"]
            writer = csv.DictWriter(handle, columns)
            writer.writeheader()
            writer.writerows(self.trace)

    @classmethod
    def read(cls, path: Path) -> Self:
        """The checkpoint at `path`; SH bands that it leaves out are zeros.

        Raises: InputError naming the damaged file and the remedy.
        """
        stored = Checkpoint.read(path)
        values = {
            name: getattr(stored, name)
            for name in layout_of(Checkpoint).arrays
            if name != "modules"
        }
        parameters = {name: value for name, value in values.items() if value is not None}
        n, n_stored = stored.shN.shape[:2]
        parameters["shN"] = np.concatenate(
            [stored.shN, np.zeros((n, 15 - n_stored, 3), np.float32)], 1
        )
        ends = np.cumsum([math.prod(shape) for shape in stored.module_shapes.values()])
        parts = np.split(stored.modules, ends[:-1]) if len(ends) else []
        shapes = stored.module_shapes.items()
        modules = {
            name: part.reshape(shape) for (name, shape), part in zip(shapes, parts, strict=True)
        }
        trace = read_trace(path, artifact.read_manifest(path))
        return cls(parameters, stored.cameras, modules, trace, stored.notes)


@dataclass
class Checkpoint(Record):
    """`Gaussians` as stored: uncompressed, as random mantissas hardly shrink, in used SH bands.

    modules: f32 [W], all weights one after the other, in the order of module_shapes.
    """

    SCHEMA: ClassVar[str] = Gaussians.SCHEMA
    COMPRESSED: ClassVar[bool] = False
    means: Annotated[np.ndarray, Array("float32", ("gaussian", 3), "scene units")]
    log_scales: Annotated[np.ndarray, Array("float32", ("gaussian", 3), "ln of scene units")]
    quats: Annotated[np.ndarray, Array("float32", ("gaussian", 4), "wxyz")]
    logit_opacities: Annotated[np.ndarray, Array("float32", ("gaussian",))]
    sh0: Annotated[np.ndarray, Array("float32", ("gaussian", 1, 3))]
    shN: Annotated[np.ndarray, Array("float32", ("gaussian", "coefficient", 3))]
    degrees: Annotated[np.ndarray, Array("uint8", ("gaussian",), "highest SH band")]
    cameras: Cameras
    modules: Annotated[np.ndarray, Array("float32", ("weight",))]
    module_shapes: dict[str, list[int]]
    notes: dict[str, Any]
    features: Annotated[np.ndarray | None, Array("float32", ("gaussian", "channel"))] = None


def read_trace(path: Path, manifest: Manifest) -> list[dict[str, float]]:
    """The trace alone, without the parameters. Raises InputError naming file and remedy."""
    file = artifact.checked(path, manifest, TRACE)
    with reading(path):
        table = csv.DictReader(read_text(file, remedy_of(path)).splitlines())
        return [{name: float(value) for name, value in row.items()} for row in table]
