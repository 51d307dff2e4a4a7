"""Small JSON documents inside artifacts, held against their digest on reading."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from chebsplat.formats import artifact
from chebsplat.formats.files import parse_json
from chebsplat.formats.manifest import Manifest, remedy_of


def write_document(path: Path, value: Any) -> None:
    """Write `value` as JSON. Raises ValueError on a value JSON or UTF-8 does not have, nan among them."""
    path.write_text(json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def read_document(root: Path, manifest: Manifest, name: str) -> Any:
    """A listed document, after comparing its digest. Raises InputError naming file and remedy."""
    return parse_json(artifact.checked(root, manifest, name), remedy_of(root))
