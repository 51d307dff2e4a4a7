"""What there is: names, digests, and what nothing names any more."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("folders", nargs=-1, required=True, type=click.Path(path_type=Path))
def verify(folders: tuple[Path, ...]) -> None:
    """Recompute every digest of artifacts."""
    from chebsplat.formats.artifact import verify as check

    for folder in folders:
        manifest = check(folder)
        print(f"{folder}: {manifest.schema}, {len(manifest.files)} files, whole")


@click.command("clean-stale")
@click.option("--yes", is_flag=True, help="remove what is listed")
def clean_stale(yes: bool) -> None:
    """List the artifacts that no scene names any more, and leftovers of killed runs."""
    from chebsplat.pipelines import store

    found = store.unnamed()
    for path, size in found:
        print(f"{size / 2**20:9.1f} MB  {path}")
    total = sum(size for _, size in found) / 2**20
    print(f"{total:9.1f} MB  in {len(found)} folders" + ("" if yes or not found else "; yes=1 (--yes) removes them"))
    if yes:
        for path, _ in found:
            store.remove(path)


@click.command()
def scenes() -> None:
    """List the scenes, ablations, sequences and studies that have a name."""
    from chebsplat.pipelines.bases import head_names
    from chebsplat.pipelines.plan import names

    for kind in ("scenes", "ablations", "sequences", "studies"):
        print(f"{kind}: {' '.join(names(kind))}")
    print(f"HEADs: {' '.join(head_names()) or 'none'}")


COMMANDS = (scenes, verify, clean_stale)
