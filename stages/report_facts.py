"""What a report relies on in its inputs' manifests and figures, and the types it relies on."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from chebsplat.formats.documents import Count, NotRequired, Positive, TypedDict, conform
from chebsplat.formats.manifest import remedy_of

if TYPE_CHECKING:
    from chebsplat.formats.manifest import Manifest


class Facts(TypedDict):
    left_out: NotRequired[dict[str, str]]


class Convention(TypedDict):
    confusion: NotRequired[float]
    n_scales: NotRequired[Count]
    flips: NotRequired[bool]
    teacher: NotRequired[str]
    output: NotRequired[str]


class Teacher(Facts):
    kind: Literal["labels", "given", "onnx"]
    n_labels: Count
    convention: Convention


class Agreement(TypedDict):
    agreement: float
    commonest: float


class Trained(Facts):
    milliseconds: dict[str, float]
    peak_device_bytes: NotRequired[Count]
    encoder: NotRequired[Agreement]


class Exported(Facts):
    by_degree: list[Count]


class AnyManifest(TypedDict):
    """Of any manifest."""

    stage: str
    key: str
    seconds: float
    device: str
    threads: int
    versions: dict[str, str]
    config: dict[str, Any]
    code: dict[str, Any]
    facts: Facts


class Protocol(TypedDict):
    name: str
    split: str


class Bytes(TypedDict):
    unpruned_ply: Positive
    ply: Count
    split: Count
    ragged: Count
    semantic: Count


class Split(TypedDict, total=False):
    projection: float
    sh: float
    sort: float
    blend: float
    width: Count
    height: Count
    threads: Count
    device: str


class Reported(TypedDict):
    """What a report needs of figures.json, beside what every reader does."""

    source: dict[str, Any]
    protocol: Protocol
    bytes: Bytes
    frames_per_second: dict[Literal["color", "color_and_features"], float]
    milliseconds: Split
    lpips: float | None


class Refined(Facts):
    start: Literal["trained", "lifted", "both"]
    smooth: bool
    strength: float
    familiar: NotRequired[float]
    curve: dict[Literal["off", "on"], dict[str, float]]
    changed_by_smoothing: NotRequired[float]
    changed_by_knowledge: NotRequired[float]


class Agreed(Facts):
    agreement: float | None
    n_points: Count
    doubt: NotRequired[str]


FACTS: dict[str, Any] = {  # by role
    "features": Teacher,
    "agreement": Agreed,
    "gaussians": Trained,
    "refined": Refined,
    "scene": Exported,
}


def facts_of(role: str, path: Path, manifest: Manifest) -> dict[str, Any]:
    """The facts of an input's manifest. Raises InputError naming the file and what is wrong in it."""
    file = path / "artifact.json"
    conform(asdict(manifest), AnyManifest, file, remedy_of(path))
    return conform(manifest.facts, FACTS.get(role, Facts), file, remedy_of(path))
