"""`make malformed`: every case of the corpus, two at a time, and the table of outcomes.

Arguments: words that a case's id must contain, all of them.
"""

from __future__ import annotations

import csv
import shutil
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from malformed.case import BYTES, SECONDS, Case, Outcome, run
from malformed.corpus import CASES

AT_ONCE = 2


def outcome(case: Case) -> Outcome:
    folder = Path(tempfile.mkdtemp(prefix="malformed-"))
    try:
        return run(case, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main(words: list[str]) -> int:
    chosen = [case for case in CASES if all(word in case.id for word in words)]
    rows, faults = [], []
    with ThreadPoolExecutor(AT_ONCE) as pool:
        for number, (case, found) in enumerate(zip(chosen, pool.map(outcome, chosen), strict=True), start=1):
            last = found.stderr.strip().splitlines()[-1] if found.stderr.strip() else ""
            rows.append([case.kind, case.name, found.code, f"{found.seconds:.2f}", found.peak >> 20, found.fault, last])
            if found.fault:
                faults.append(case)
                print(f"{case.id}: {found.fault}\n  {last}", file=sys.stderr)
            if number % 50 == 0 or number == len(chosen):
                print(f"malformed {number}/{len(chosen)}, {len(faults)} faults", file=sys.stderr)
    out = Path("build/malformed.csv")
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("w", newline="") as handle:
        csv.writer(handle).writerows([["kind", "name", "code", "seconds", "MiB", "fault", "last line"], *rows])
    table = {kind: Counter("fault" if row[5] else str(row[2]) for row in rows if row[0] == kind)
             for kind in dict.fromkeys(row[0] for row in rows)}  # fmt: skip
    print(f"{'kind':24s}{'cases':>6s}{'exit 2':>8s}{'exit 3':>8s}{'exit 4':>8s}{'faults':>8s}")
    for kind, counts in [*table.items(), ("all", sum(table.values(), Counter()))]:
        cells = "".join(f"{counts[code]:8d}" for code in ("2", "3", "4", "fault"))
        print(f"{kind:24s}{counts.total():6d}{cells}")
    if rows:
        print(f"longest {max(float(row[3]) for row in rows):.1f} s of {SECONDS:g}, "
              f"most memory {max(row[4] for row in rows)} MiB of {BYTES >> 20}; {out}")  # fmt: skip
    return 1 if faults or not rows else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
