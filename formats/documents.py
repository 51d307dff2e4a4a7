"""Small JSON documents inside artifacts, held against their digest and their declared type on reading."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypeVar

from annotated_types import Ge, Gt, Le
from typing_extensions import TypedDict

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.files import parse_json
from chebsplat.formats.manifest import Manifest, remedy_of

__all__ = ["Count", "NotRequired", "Positive", "Side", "TypedDict", "conform", "read_document", "write_document"]

Value = TypeVar("Value")
Count = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0)]
Side = Annotated[int, Ge(1), Le(65_536)]  # of an image, pixels


def write_document(path: Path, value: Any) -> None:
    """Write `value` as JSON. Raises ValueError on a value JSON or UTF-8 does not have, nan among them."""
    path.write_text(json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def read_document(root: Path, manifest: Manifest, name: str, kind: Any = dict[str, Any]) -> Any:
    """Read a listed document of a type, such as a TypedDict. Raises InputError naming file, field and remedy."""
    path = artifact.checked(root, manifest, name)
    return conform(parse_json(path, remedy_of(root), finite=True), kind, path, remedy_of(root))


def conform(value: Value, kind: Any, where: object, remedy: str) -> Value:
    """`value` itself, if it is of a type. Raises InputError naming the first field that is not."""
    from pydantic import TypeAdapter, ValidationError

    try:
        TypeAdapter(kind).validate_python(value, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part)[:60] for part in first["loc"]) or "the document"
        raise InputError(f"{where}: {field}: {first['msg']}; {remedy}") from None
    return value
