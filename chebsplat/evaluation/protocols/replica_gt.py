"""`replica-gt` (ours): Replica's own semantic ids as truth, on the views that `replica-f3` tests.

Resolution: as there. Split: index % 8 == 2 by name, not the source's. Classes: Replica's names,
none merged or dropped. One confusion matrix over all test views, as in `labels`: never to be put
beside `replica-f3`, whose truth is a teacher.
"""

from __future__ import annotations

from chebsplat.evaluation.protocols.labels import measure
from chebsplat.evaluation.protocols.task import Rule

RULE = Rule(test_offset=2)

__all__ = ["measure"]
