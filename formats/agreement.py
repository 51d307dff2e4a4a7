"""`agreement/2`: how far the views of a capture agree on what the same points are, by their 2D teacher."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from chebsplat.formats.record import Record


@dataclass
class ViewAgreement(Record):
    """agreement: 1 if views always agree, 0 if by chance alone, None where no point was seen twice.

    n_points: that two of the `n_views` training views see.
    labels:   by name, of those that are said at all: `share` of what views say, and the `agreement` of the views on
              this label.
    """

    SCHEMA: ClassVar[str] = "chebsplat.agreement/2"
    agreement: float | None
    n_points: int
    n_views: int
    labels: dict[str, dict[str, float]]
