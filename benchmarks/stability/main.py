"""Every stiff and extreme case of the maths: errors of the plain way and of ours, and a verdict."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Sequence

import torch

from benchmarks import shared
from benchmarks.stability import (  # noqa: F401  # importing a module registers its cases
    blending,
    depth,
    descriptor,
    exposures,
    graphs,
    growth,
    inputs,
    lessons,
    lifting,
    losses,
    meshes,
    packing,
    poses,
    pruning,
    regions,
    smoothing,
    splats,
    sweeps,
    training,
)
from benchmarks.stability.case import CASES, Row, run


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("stability", __doc__)
    parser.add_argument("--only", default="", help="run cases whose `module: name` holds this text")
    options = parser.parse_args(arguments)
    keys = [key for key in CASES if options.only in f"{key[0]}: {key[1]}"]
    if not keys:
        print(f"no case is called {options.only!r}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)  # matrices this small wait longer for threads than they compute
    print(shared.machine())
    rows = []
    for key in keys:
        row = run(key)
        rows.append(row)
        verdict = "pass" if row.passed else f"FAIL  {row.note}"
        naive = "" if math.isnan(row.naive) else f"{row.naive:.1e}"
        print(
            f"{row.module:<11} {row.case:<52} {naive:>8} | {row.error:8.1e} <= "
            f"{row.tolerance:7.1e}  {verdict}",
            flush=True,
        )
    path = options.out / "stability.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as handle:
        csv.writer(handle).writerows([Row._fields, *rows])
    failed = sum(not row.passed for row in rows)
    beside = [row for row in rows if not math.isnan(row.naive)]
    missed = sum(not row.naive <= row.tolerance for row in beside)
    print(f"the plain way in float32 misses {missed} of the {len(beside)} cases that have one")
    print(f"{len(rows)} cases, {failed} failed, {sum(row.seconds for row in rows):.0f} s; {path}")
    return int(failed > 0)
