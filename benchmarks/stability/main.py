"""Every stiff and extreme case: condition, what the naive formula makes of it, our float32 error, pass or fail."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import chebsplat
from benchmarks.stability import (  # noqa: F401  # importing a module registers its cases
    descriptor,
    fusion,
    gates,
    growth,
    knowledge,
    losses,
    pruning,
    rasterizer,
    regions,
    tokens,
    training,
)
from benchmarks.stability.case import CASES, Row, run

MEDIAN = 5e-7  # of the descriptor's float32 errors, in a whole run


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser("python -m benchmarks stability", description=__doc__)
    parser.add_argument("--only", default="", help="run cases whose `module: name` holds this text")
    parser.add_argument("--csv", type=Path, default=Path("build/bench/stability.csv"))
    options = parser.parse_args(arguments)
    chosen = [key for key in CASES if options.only in f"{key[0]}: {key[1]}"]
    if not chosen:
        print(f"no case is called {options.only!r}", file=sys.stderr)
        return 2
    print(f"chebsplat {chebsplat.__version__}, numpy {np.__version__}, torch {torch.__version__}")
    torch.set_num_threads(1)  # matrices this small wait longer for threads than they compute
    rows = []
    for key in chosen:
        row = run(key)
        rows.append(row)
        print(line(row), flush=True)
    options.csv.parent.mkdir(parents=True, exist_ok=True)
    with options.csv.open("w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(Row._fields)
        writer.writerows(rows)
    failed = [row for row in rows if not row.passed]
    middle = 0.0 if options.only else float(np.median([row.error for row in rows if row.module == "descriptor"]))
    if not options.only:
        print(f"descriptor: median error {middle:.1e} <= {MEDIAN:.0e}  {'pass' if middle <= MEDIAN else 'FAIL'}")
    print(f"{len(rows)} cases, {len(failed)} failed, {sum(row.seconds for row in rows):.0f} s; {options.csv}")
    return 1 if failed or not middle <= MEDIAN else 0


def line(row: Row) -> str:
    what = f"{row.module:<11} {row.case:<44} {row.condition:<24} {row.naive:<31}"
    return f"{what} {row.error:8.1e} <= {row.tolerance:7.1e}  {'pass' if row.passed else 'FAIL'}  {row.note}".rstrip()
