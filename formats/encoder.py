"""`encoder/1`: the local encoder in ONNX, the contract of its inputs, and the record of its parity with torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chebsplat.formats import artifact
from chebsplat.formats.documents import read_document, write_document

SCHEMA = "chebsplat.encoder/1"


@dataclass
class Encoder:
    """model: path of `encoder.onnx`; contract: inputs and outputs; parity: largest difference by (regions, size)."""

    model: Path
    contract: dict[str, Any]
    parity: list[dict[str, float]]


def write_encoder(out: Path, contract: dict[str, Any], parity: list[dict[str, float]]) -> None:
    """Write the documents beside `encoder.onnx`, which the exporter itself writes into `out`."""
    write_document(out / "contract.json", contract)
    write_document(out / "parity.json", parity)


def read_encoder(path: Path) -> Encoder:
    """Raises: InputError naming the damaged file and the remedy."""
    path = Path(path)
    manifest = artifact.read_manifest(path, SCHEMA)
    model = artifact.checked(path, manifest, "encoder.onnx")
    contract = read_document(path, manifest, "contract.json", ("inputs", "outputs"))
    return Encoder(model, contract, read_document(path, manifest, "parity.json"))
