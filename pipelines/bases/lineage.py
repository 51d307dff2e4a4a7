"""What revisions of a basis say of themselves: who added which columns, what changed between two, whether all holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.basis import SCHEMA, Basis, last_report, off_orthonormal, read_basis
from chebsplat.formats.manifest import remedy_of
from chebsplat.pipelines.work import store

Table = list[list[str]]  # header first


def ancestors(path: Path) -> list[Path | None]:
    """Artifacts of all revisions up to this one, the oldest first; None for those that are not in the store."""
    found: list[Path | None] = [path]
    count = read_basis(path).revision
    while len(found) < count:
        key = None if found[0] is None else artifact.read_manifest(found[0]).inputs.get("basis", {}).get("key")
        earlier = store.artifact_path("cks", key) if key else None
        found.insert(0, earlier if earlier is not None and store.is_fresh(earlier) else None)
    return found


def log_table(basis: Basis) -> Table:
    """A row a revision, means over its linear maps; `rank` with the largest."""
    table = [["revision", "scene", "rank", "added", "ρ before", "σ_f", "ρ′", "ρ after", "energy", "gaussians"]]
    for number, entry in enumerate(basis.lineage, start=1):
        reports = list(entry["maps"].values())
        mean = {name: float(np.mean([report[name] for report in reports])) for name in reports[0]}
        rank = f"{mean['rank_after']:.1f} (≤ {max(report['rank_after'] for report in reports)})"
        mean |= {"spread": entry["spread"]}
        figures = [f"{mean[name]:.3f}" for name in ("rho", "spread", "rho_printed", "rho_after", "energy")]
        table.append([str(number), entry["scene"], rank, f"{mean['added']:.1f}", *figures, entry["gaussians"]])
    return table


def columns_by_scene(basis: Basis, name: str) -> str:
    """`1-10 office0, 11-12 office1`: the columns of one map's basis, counted from 1."""
    parts = []
    for entry in basis.lineage:
        report = entry["maps"].get(name, {"rank_before": 0, "rank_after": 0})
        first, last = report["rank_before"] + 1, report["rank_after"]
        if last >= first:
            parts.append(f"{first}-{last} {entry['scene']}" if last > first else f"{first} {entry['scene']}")
    return ", ".join(parts) or "none"


def show_table(basis: Basis) -> Table:
    """A row a linear map of one revision."""
    table = [["map", "r of q", "ρ before", "ρ after", "energy", "|BᵀB − I|", "columns"]]
    for name, columns in basis.bases.items():
        report = last_report(basis.lineage, name)
        figures = [f"{report[key]:.3f}" for key in ("rho", "rho_after", "energy")]
        shape = f"{columns.shape[1]} of {columns.shape[0]}"
        table.append([name, shape, *figures, f"{off_orthonormal(columns):.0e}", columns_by_scene(basis, name)])
    return table


def common(a: Basis, b: Basis) -> int:
    """Number of revisions that two bases share."""
    pairs = zip(a.lineage, b.lineage, strict=False)
    return next((k for k, (one, other) in enumerate(pairs) if one != other), min(a.revision, b.revision))


def diff_table(a: Basis, b: Basis) -> Table:
    """A row a linear map: ranks, columns that are the same, how far each span lies outside the other.

    `outside` is the largest sine of an angle between a vector of the one span and the other span.
    """
    table = [["map", "r", "same columns", "first outside second", "second outside first"]]
    for name in sorted(a.bases.keys() | b.bases.keys()):
        if name not in a.bases or name not in b.bases or len(a.bases[name]) != len(b.bases[name]):
            table.append([name, "of one alone, or of another width", "", "", ""])
            continue
        one, other = (basis.bases[name].astype(np.float64) for basis in (a, b))
        low = min(one.shape[1], other.shape[1])
        same = np.append((one[:, :low] == other[:, :low]).all(0), False).argmin()
        sines = [_outside(one, other), _outside(other, one)]
        ranks = f"{one.shape[1]} → {other.shape[1]}"
        table.append([name, ranks, f"1-{same}" if same else "none", *(f"{sine:.3f}" for sine in sines)])
    return table


def _outside(inner: np.ndarray, outer: np.ndarray) -> float:
    rest = inner - outer @ (outer.T @ inner)
    return float(np.linalg.norm(rest, 2)) if rest.size else 0.0


def change_of_weights(a: Basis, b: Basis) -> str:
    """How far the stored encoders lie apart, relative to the first one's norm."""
    shared = [name for name in a.weights if name in b.weights and a.weights[name].shape == b.weights[name].shape]
    if not shared:
        return "none in common"
    first, second = (np.concatenate([basis.weights[name].ravel() for name in shared]) for basis in (a, b))
    change = float(np.linalg.norm(second - first)) / max(float(np.linalg.norm(first)), 1e-30)
    return f"{len(shared)} arrays of {len(a.weights)} and {len(b.weights)} in common, relative change {change:.3f}"


def verify(path: Path | None, earlier: Path | None) -> str:
    """Check a revision by itself and against the one before; says what was checked.

    Raises: InputError naming the artifact and what does not hold.
    """
    if path is None:
        return "not in this store: nothing to check"
    artifact.verify(path, SCHEMA)
    basis, manifest = read_basis(path), artifact.read_manifest(path)
    share = manifest.config["cks"]["max_rank"]
    for name, columns in basis.bases.items():
        before = last_report(basis.lineage, name)["rank_before"]
        if columns.shape[1] > max(int(share * len(columns)), before):
            raise InputError(f"{path}: {name} has {columns.shape[1]} columns, above its ceiling of {share:g} q")
    error = max(map(off_orthonormal, basis.bases.values()), default=0.0)
    checks = f"digests, |BᵀB − I| ≤ {error:.0e}"
    if earlier is None:
        return checks + ("" if basis.revision == 1 else "; the revision before is not in this store")
    before = read_basis(earlier)
    if before.lineage != basis.lineage[:-1]:
        raise InputError(f"{path}: its lineage does not continue that of {earlier}; delete it and run its stage again")
    for name, columns in before.bases.items():
        if not np.array_equal(basis.bases[name][:, : columns.shape[1]], columns):
            raise InputError(f"{path}: {name} does not begin with the columns of {earlier}; {remedy_of(path)}")
    return checks + f", continues revision {before.revision}"
