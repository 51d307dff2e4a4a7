"""Which seeds generated rooms may be drawn from, and for what: no room serves two ends."""

from __future__ import annotations

SCENES = range(1000)  # named scenes and tests
REFERENCE = range(8000, 8100)  # views that a teacher's channels are computed from
HELD_OUT = range(9000, 9020)  # the embedded teacher is measured on these: the first half offices, the others rooms
TRAINING = range(10_000, 20_000)  # the embedded teacher is trained on these
KNOWLEDGE = range(20_000, 21_000)  # knowledge is taught on these
