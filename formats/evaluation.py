"""`evaluation/2`: figures per view and per class, rendered pictures, timings; `agreement/2`: share
of points for which the views of a capture agree, by their 2D teacher.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from chebsplat.formats import artifact
from chebsplat.formats.artifact import read_document, write_document
from chebsplat.formats.manifest import Manifest
from chebsplat.formats.record import Array, Record, Stack, layout_of

FIGURES = "figures.json"
PIXELS = ("view", "row", "column")


@dataclass
class Evaluation:
    """figures: everything measured, JSON-able, `None` where it was not measured (never 0).
    pictures: by name as in `Pictures`, one entry a test view.
    """

    SCHEMA: ClassVar[str] = "chebsplat.evaluation/2"
    figures: dict[str, Any]
    pictures: dict[str, Stack] = field(default_factory=dict)

    def write(self, out: Path) -> None:
        """Fill the directory of `artifact.publish`. Raises ValueError on a nan or infinity."""
        write_document(out / FIGURES, self.figures)
        Pictures(**self.pictures).write(out)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Figures at `path`; pictures stay on disk until indexed.

        Raises: InputError naming the damaged file and the remedy.
        """
        path = Path(path)
        stored = Pictures.read(path)
        pictures = {name: getattr(stored, name) for name in layout_of(Pictures).arrays}
        figures = read_figures(path, artifact.read_manifest(path))
        return cls(figures, {name: stack for name, stack in pictures.items() if stack is not None})


@dataclass
class Pictures(Record):
    """Of the test views: `truth`, `renders` u8 [V, H, W, 3]; label maps i16 [V, H, W], -1 none."""

    SCHEMA: ClassVar[str] = Evaluation.SCHEMA
    truth: Annotated[Stack | None, Array("uint8", (*PIXELS, 3), "sRGB", by_view=True)] = None
    renders: Annotated[Stack | None, Array("uint8", (*PIXELS, 3), "sRGB", by_view=True)] = None
    labels: Annotated[Stack | None, Array("int16", PIXELS, "class index", by_view=True)] = None
    predicted: Annotated[Stack | None, Array("int16", PIXELS, "class index", by_view=True)] = None
    teacher: Annotated[Stack | None, Array("int16", PIXELS, "class index", by_view=True)] = None


def read_figures(path: Path, manifest: Manifest) -> dict[str, Any]:
    """The figures alone. Raises InputError naming file and remedy."""
    figures: dict[str, Any] = read_document(path, manifest, FIGURES)
    return figures


def rests(segmentation: Any, figure: str = "miou") -> str:
    """Classes and pixels (or points) of truth behind a mIoU, in words; empty where not counted."""
    of = segmentation.get("counted", {}).get(figure)
    return (
        (
            f"{of['classes']} classes, {of['pixels']:,} "
            f"{'points' if figure == 'point_miou' else 'pixels'}"
        )
        if of
        else ""
    )


@dataclass
class ViewAgreement(Record):
    """agreement: 1 if views always agree, 0 if by chance alone, None without points in two views.

    n_points: seen by at least two of the `n_views` training views.
    labels:   by name, of those that any view gives: `share` of all votes, and `agreement` of the
      views on this label.
    """

    SCHEMA: ClassVar[str] = "chebsplat.agreement/2"
    agreement: float | None
    n_points: int
    n_views: int
    labels: dict[str, dict[str, float]]
