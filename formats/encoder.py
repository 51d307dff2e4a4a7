"""`encoder/2`: the local encoder and the fusion behind it in ONNX, their contract, and their parity with torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document, write_document

SCHEMA = "chebsplat.encoder/2"
FLOAT, DYNAMIC, FUSED = "encoder.onnx", "encoder.int8.onnx", "fusion.onnx"


@dataclass
class Encoder:
    """models: paths by name, FLOAT, DYNAMIC (quantised to 8 bits) and FUSED; contract: see
    `stages.shape_models.point_graph.contract`; parity: by model, sizes and largest difference from torch.
    """

    models: dict[str, Path]
    contract: dict[str, Any]
    parity: dict[str, list[dict[str, Any]]]


def write_encoder(out: Path, contract: dict[str, Any], parity: dict[str, list[dict[str, Any]]]) -> None:
    """Write the documents beside the models, which the exporter itself writes into `out`."""
    write_document(out / "contract.json", contract)
    write_document(out / "parity.json", parity)


def read_encoder(path: Path) -> Encoder:
    """Paths of the models at `path`, their contract and their parity with torch.

    Raises: InputError naming the damaged file and the remedy.
    """
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    models = {name: artifact.checked(path, manifest, name) for name in (FLOAT, DYNAMIC, FUSED)}
    contract = read_document(path, manifest, "contract.json")
    return Encoder(models, contract, read_document(path, manifest, "parity.json"))
