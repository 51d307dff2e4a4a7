"""`agreement/1`: how far the views of a capture agree on what the same points are, by their 2D teacher."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from chebsplat.formats import artifact
from chebsplat.formats.documents import Count, TypedDict, read_document, write_document

SCHEMA = "chebsplat.agreement/1"
FILE = "agreement.json"


class OfLabel(TypedDict):
    """share: of what views say; agreement: of the views on this label, None where too little is said to tell."""

    share: Annotated[float, Ge(0), Le(1)]
    agreement: Annotated[float, Ge(-1.001), Le(1.001)] | None


class Document(TypedDict):
    agreement: Annotated[float, Ge(-1.001), Le(1.001)] | None
    n_points: Count
    n_views: Count
    labels: dict[str, OfLabel]


@dataclass
class ViewAgreement:
    """agreement: 1 if views always agree, 0 if by chance alone, None where no point was seen twice.

    n_points: that two of the `n_views` training views see; labels: by name, those that are said at all.
    """

    agreement: float | None
    n_points: int
    n_views: int
    labels: dict[str, OfLabel]


def write_agreement(out: Path, record: ViewAgreement) -> None:
    """Fill the directory that `artifact.publish` yields. Raises ValueError on a non-finite value."""
    write_document(out / FILE, asdict(record))


def read_agreement(path: Path) -> ViewAgreement:
    """The agreement at `path`. Raises InputError naming the damaged file and the remedy."""
    path = Path(path)
    return ViewAgreement(**read_document(path, artifact.read_manifest(path, SCHEMA), FILE, Document))
