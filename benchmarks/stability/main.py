"""Every stiff and extreme case of the maths: error beside its tolerance, pass or fail."""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence

import torch

from benchmarks import shared
from benchmarks.stability import (  # noqa: F401  # importing a module registers its cases
    descriptor,
    growth,
    losses,
    pruning,
    regions,
    splats,
    training,
)
from benchmarks.stability.case import CASES, Row, run


def main(arguments: Sequence[str]) -> int:
    parser = shared.parser("stability", __doc__)
    parser.add_argument("--only", default="", help="run cases whose `module: name` holds this text")
    options = parser.parse_args(arguments)
    chosen = [key for key in CASES if options.only in f"{key[0]}: {key[1]}"]
    if not chosen:
        print(f"no case is called {options.only!r}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)  # matrices this small wait longer for threads than they compute
    print(shared.machine())
    rows = []
    for key in chosen:
        row = run(key)
        rows.append(row)
        verdict = "pass" if row.passed else f"FAIL  {row.note}"
        print(f"{row.module:<11} {row.case:<44} {row.error:8.1e} <= {row.tolerance:7.1e}  {verdict}", flush=True)
    path = options.out / "stability.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as handle:
        csv.writer(handle).writerows([Row._fields, *rows])
    failed = sum(not row.passed for row in rows)
    print(f"{len(rows)} cases, {failed} failed, {sum(row.seconds for row in rows):.0f} s; {path}")
    return int(failed > 0)
