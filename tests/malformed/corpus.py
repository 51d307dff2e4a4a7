"""All malformed inputs, by kind."""

from __future__ import annotations

from malformed import (
    arguments,
    colmap,
    commands,
    documents,
    images,
    manifests,
    photos,
    references,
    replica,
    resealed,
    scannet,
    settings,
    seven_scenes,
    teachers,
    transforms,
    uses,
)
from malformed.case import Case

ARTIFACTS = (manifests, resealed, teachers, uses)
SOURCES = (photos, images, references, colmap, transforms, replica, scannet, seven_scenes)
MODULES = (settings, documents, commands, arguments, *ARTIFACTS, *SOURCES)
CASES: list[Case] = [case for module in MODULES for case in module.cases()]


def sample(size: int) -> list[Case]:
    """Evenly through the corpus, so that every kind is among them; the same on every call."""
    size = min(size, len(CASES))
    return [CASES[k * len(CASES) // size] for k in range(size)]
