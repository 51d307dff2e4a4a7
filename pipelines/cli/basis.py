"""`chebsplat basis`: the knowledge that scenes leave behind, by NAME[@REVISION] of a sequence or HEAD, or FOLDER/."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from chebsplat.pipelines.cli.group import Guarded, NewPath
from chebsplat.pipelines.work.summary import show_rows

if TYPE_CHECKING:
    from chebsplat.formats.basis import Basis


@click.group(cls=Guarded)
def basis() -> None:
    """Knowledge bases: NAME[@REVISION] of a sequence or of a HEAD, or FOLDER/ of an artifact."""


def newest(name: str) -> tuple[Path, Basis]:
    """Path and content of a basis' newest revision. Raises ConfigError on an unknown name."""
    from chebsplat.formats.basis import read_basis
    from chebsplat.pipelines.bases.revisions import revisions

    path = revisions(name)[-1]
    return path, read_basis(path)


@basis.command()
@click.argument("name")
def log(name: str) -> None:
    """Revisions: the scene, ranks, ρ before and after, σ_f and ρ′, energy; means over linear maps."""
    from chebsplat.pipelines.bases import lineage

    show_rows(lineage.log_table(newest(name)[1]))


@basis.command()
@click.argument("name")
def show(name: str) -> None:
    """One revision: each linear map, and which scene added which of its columns."""
    from chebsplat.pipelines.bases import lineage

    path, one = newest(name)
    print(f"{path}: revision {one.revision}, {len(one.weights)} arrays of weights")
    show_rows(lineage.show_table(one))


@basis.command()
@click.argument("first")
@click.argument("second")
def diff(first: str, second: str) -> None:
    """What two revisions share, and how far their spans and weights lie apart."""
    from chebsplat.pipelines.bases import lineage

    (_, one), (_, other) = newest(first), newest(second)
    count = lineage.common(one, other)
    print(f"{count} revisions in common")
    for name, which in ((first, one), (second, other)):
        own = [entry["scene"] for entry in which.lineage[count:]]
        print(f"{name} alone: {', '.join(own) or 'none'}")
    show_rows(lineage.diff_table(one, other))
    print(f"weights: {lineage.change_of_weights(one, other)}")


@basis.command()
@click.argument("name")
def verify(name: str) -> None:
    """Every revision: digests, BᵀB = I, ranks below their ceiling, each the continuation of the one before."""
    from chebsplat.pipelines.bases import lineage

    path, one = newest(name)
    chain = lineage.ancestors(path)
    for number, (revision, earlier) in enumerate(zip(chain, [None, *chain], strict=False), start=1):
        print(f"{number} {one.lineage[number - 1]['scene']}: {lineage.verify(revision, earlier)}")


@basis.command()
@click.argument("name")
@click.option("--out", type=NewPath(), required=True, help="folder to make; later: basis=FOLDER/")
def export(name: str, out: Path) -> None:
    """Copy a revision, to start scenes from it elsewhere (basis=FOLDER/)."""
    from chebsplat.formats import artifact

    path, _ = newest(name)
    artifact.copy(path, out, artifact.verify(path))
    print(out.absolute())


@basis.command()
@click.argument("name")
@click.argument("scene")
def extend(name: str, scene: str) -> None:
    """Add a finished SCENE (its links' name or folder, or a gaussians artifact) to the HEAD called NAME.

    Any number of processes may do so at once, and one that was killed may be repeated.
    """
    from chebsplat.pipelines.bases import revisions
    from chebsplat.pipelines.work import finished

    gaussians = finished.artifact_of(scene, "train")
    known = finished.holder(gaussians) or gaussians
    made = revisions.extend(name, gaussians.resolve(), known.name.partition("@")[0])
    print(f"{name}@{len(made)}", file=sys.stderr)
    print(made[-1])
