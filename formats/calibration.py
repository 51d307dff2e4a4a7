"""`NAME.relevancy.json` beside a teacher's `NAME.onnx`: what its relevancy means, and the rooms
that say so.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from typing_extensions import TypedDict

from chebsplat.errors import InputError
from chebsplat.formats.files import atomic_write, parse_json
from chebsplat.formats.names import check_names
from chebsplat.formats.onnx_files import model_sha256
from chebsplat.formats.teacher_model import EMBEDDED

SCHEMA = "chebsplat.relevancy/1"
REMEDY = "remove it, or make it again (chebsplat calibrate)"
COEFFICIENTS = ("margin", "cosine", "bias", "strength", "offset")


class Document(TypedDict):
    schema: str
    teacher: str
    sha256: str
    rivals: list[str]
    calibration: dict[str, float]
    made: dict[str, Any]


@dataclass(frozen=True)
class TeacherCalibration:
    """teacher, sha256: the model that it is of; rivals: words that any other is weighed against;
    calibration: the coefficients of `labels.calibration.Calibration` by name; made: rooms, views,
      words and figures on rooms left out.
    """

    teacher: str
    sha256: str
    rivals: list[str]
    calibration: dict[str, float]
    made: dict[str, Any]


def beside(model: Path) -> Path:
    """Where the calibration of a teacher's .onnx lies."""
    return model.with_suffix(".relevancy.json")


def write_calibration(path: Path, of: TeacherCalibration) -> None:
    """Write it, whole or not at all."""
    document = {"schema": SCHEMA} | vars(of)
    atomic_write(path, json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def calibration_of(model: Path) -> TeacherCalibration | None:
    """What lies beside a teacher's .onnx, or beside the embedded teacher where that is the same
    file elsewhere.

    Raises: as `read_calibration`.
    """
    found = read_calibration(model)
    same = found is None and model != EMBEDDED and model_sha256(model) == model_sha256(EMBEDDED)
    return read_calibration(EMBEDDED) if same else found


def read_calibration(model: Path) -> TeacherCalibration | None:
    """That of a teacher's .onnx; None where there is none.

    Raises: InputError naming the file where it is damaged, or of another model than the one beside
      it.
    """
    path = beside(model)
    if not path.is_file():
        return None
    document = parse_json(path, REMEDY, finite=True)
    try:
        TypeAdapter(Document).validate_python(document, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part)[:60] for part in first["loc"]) or "the document"
        raise InputError(f"{path}: {field}: {first['msg']}; {REMEDY}") from None
    if document.pop("schema") != SCHEMA:
        raise InputError(f"{path} is not of {SCHEMA}; {REMEDY}")
    found = TeacherCalibration(**document)
    if sorted(found.calibration) != sorted(COEFFICIENTS):
        raise InputError(f"{path}: calibration: {', '.join(COEFFICIENTS)} are needed; {REMEDY}")
    if not found.rivals:
        raise InputError(f"{path}: rivals: at least one word is needed; {REMEDY}")
    check_names(found.rivals, "rivals", path, REMEDY)
    if found.sha256 != model_sha256(model):
        raise InputError(f"{path} is of another model than {model.name}; {REMEDY}")
    return found
