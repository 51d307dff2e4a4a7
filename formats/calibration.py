"""`NAME.relevancy.json` beside a teacher's `NAME.onnx`: the calibration of its relevancy."""

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
    """Path of the calibration of a teacher's .onnx."""
    return model.with_suffix(".relevancy.json")


def write_calibration(path: Path, of: TeacherCalibration) -> None:
    """Write it, whole or not at all."""
    document = {"schema": SCHEMA} | vars(of)
    atomic_write(path, json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def calibration_of(model: Path) -> TeacherCalibration | None:
    """The calibration of a teacher's .onnx, also where that is a copy of the embedded one's.

    Raises: as `read_calibration`.
    """
    calibration = read_calibration(model)
    same = (
        calibration is None and model != EMBEDDED and model_sha256(model) == model_sha256(EMBEDDED)
    )
    return read_calibration(EMBEDDED) if same else calibration


def read_calibration(model: Path) -> TeacherCalibration | None:
    """The calibration beside a teacher's .onnx; None where there is none.

    Raises: InputError naming the file where it is damaged, or belongs to another model.
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
    record = TeacherCalibration(**document)
    if sorted(record.calibration) != sorted(COEFFICIENTS):
        raise InputError(f"{path}: calibration: {', '.join(COEFFICIENTS)} are needed; {REMEDY}")
    if not record.rivals:
        raise InputError(f"{path}: rivals: at least one word is needed; {REMEDY}")
    check_names(record.rivals, "rivals", path, REMEDY)
    if record.sha256 != model_sha256(model):
        raise InputError(f"{path} is of another model than {model.name}; {REMEDY}")
    return record
