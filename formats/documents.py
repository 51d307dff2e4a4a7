"""Small JSON documents inside artifacts, checked against their digest on reading."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.artifact import Manifest


def write_document(path: Path, value: Any) -> None:
    """Write `value` as JSON. Raises ValueError on a value JSON does not have, nan among them."""
    path.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_document(root: Path, manifest: Manifest, name: str, fields: tuple[str, ...] = ()) -> Any:
    """Read a listed document that has at least `fields`. Raises InputError naming file and remedy."""
    path = artifact.checked(root, manifest, name)
    try:
        value = json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"{path} does not parse ({error}); {artifact.remedy(root)}") from None
    absent = [field for field in fields if field not in value]
    if absent:
        raise InputError(f"{path} has no {absent[0]}; {artifact.remedy(root)}")
    return value
