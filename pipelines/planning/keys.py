"""Identity of a step: one digest of all that its result depends on, and of nothing else."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from chebsplat.stages.registry import Stage

# Settings that say where raw files lie. Their content is hashed instead: where it lies is no matter.
PLACES = (
    ("source", "path"),
    ("channels", "model"),
    ("channels", "reference"),
    ("teacher", "model"),
    ("teacher", "labels"),
    ("train", "start"),
    ("knowledge", "model"),
    ("evaluate", "lpips_weights"),
)


def step_key(
    stage: Stage,
    sections: dict[str, Any],
    inputs: dict[str, str],
    code: dict[str, Any],
    raw: str | None = None,
    device: str = "cpu",
) -> str:
    """Key of a stage's artifact, 16 hex digits.

    Args: sections: the config that the stage reads; inputs: keys of artifacts by role;
          code: of `Code.stage`; raw: `raw.content_hash` of the files outside the store that the stage reads;
          device: that computes it. The CPU's keys do not name it.
    """
    identity = {
        "stage": stage.name,
        "schema": stage.schema,
        "config": placeless(sections),
        "inputs": inputs,
        "code": code,
    } | ({} if raw is None else {"raw": raw})
    if device != "cpu":
        identity["device"] = device
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def placeless(sections: dict[str, Any]) -> dict[str, Any]:
    """Sections that name raw files by their last part only."""
    kept = {name: dict(section) for name, section in sections.items()}
    for section, key in PLACES:
        if kept.get(section, {}).get(key):
            kept[section][key] = Path(kept[section][key]).name
    return kept
