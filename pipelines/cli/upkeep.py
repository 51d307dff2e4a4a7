"""Commands on the work folder: list, verify and remove scenes, and what no scene names."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import click

from chebsplat.errors import ChebsplatError
from chebsplat.pipelines.cli.group import Known

SCENES = click.argument("scenes", nargs=-1, required=True, type=Known("finished"))
UNITS = {"m": 60, "h": 3600, "d": 86400, "w": 604800}


class Age(click.ParamType):
    """A length of time, in seconds."""

    name = "age"

    def convert(
        self, value: Any, param: click.Parameter | None, context: click.Context | None
    ) -> float:
        if isinstance(value, float):
            return value
        if not (match := re.fullmatch(r"(\d{1,6})([mhdw])", value)):
            self.fail(f"{value!r} is no age such as 30m, 12h, 7d or 4w", param, context)
        return float(match[1]) * UNITS[match[2]]


@click.command("ls")
def list_scenes() -> None:
    """List scenes, studies and sequences in work: source, stages, bytes, date and figures."""
    from chebsplat.pipelines.work import inventory, store
    from chebsplat.pipelines.work.summary import show_rows

    scenes = inventory.scenes()
    if not scenes:
        print(f"no scene in {store.work()}", file=sys.stderr)
        return
    show_rows([inventory.COLUMNS, *scenes])
    print(f"{store.work()}: what several share counts in each, and in none alone", file=sys.stderr)


@click.command()
@SCENES
@click.option("--yes", is_flag=True, help="remove what is listed")
def rm(scenes: tuple[str, ...], yes: bool) -> None:
    """Remove SCENES: their links and pages, and the artifacts that nothing else names."""
    from chebsplat.pipelines.work import inventory

    folders = list(dict.fromkeys(inventory.in_work(scene) for scene in scenes))
    artifacts = inventory.list_exclusive(folders)
    for folder in folders:
        foreign = inventory.others(folder)
        print(
            f"           {folder}"
            + (f" (stays, for what is not ours: {', '.join(foreign)})" if foreign else "")
        )
    show_sizes(artifacts, yes, "--yes removes them")
    if yes:
        remove(folders, artifacts)


def remove(folders: list[Path], artifacts: list[tuple[Path, int]]) -> None:
    """Remove the links of these folders, and these artifacts and leftovers."""
    from chebsplat.pipelines.work import inventory, store

    for folder in folders:
        inventory.unlink(folder)
    for path, _ in artifacts:
        store.remove(path)


def show_sizes(sizes: list, removed: bool, advice: str) -> None:
    """Print folders with their sizes in MB, and the total; `advice` follows unless they go now."""
    for path, size in sizes:
        print(f"{size / 2**20:9.1f} MB  {path}")
    total = sum(size for _, size in sizes) / 2**20
    print(f"{total:9.1f} MB  in {len(sizes)} folders" + ("" if removed else f"; {advice}"))


@click.command()
@SCENES
def verify(scenes: tuple[str, ...]) -> int:
    """Recompute every digest of SCENES' artifacts, or of artifacts."""
    from chebsplat.formats.artifact import verify as check
    from chebsplat.pipelines.work.finished import artifacts

    codes = [0]
    for path in [path for scene in scenes for path in artifacts(scene)]:
        try:
            manifest = check(path)
            print(f"{path}: {manifest.schema}, {len(manifest.files)} files, whole")
        except ChebsplatError as error:
            print(f"chebsplat: {error}", file=sys.stderr)
            codes.append(error.exit_code)
    return max(codes)


@click.command("clean-stale")
@click.option("--yes", is_flag=True, help="remove what is listed")
@click.option(
    "--keep-newer", type=Age(), default=0.0, help="keep what is younger: 30m, 12h, 7d, 4w"
)
@click.option(
    "--older-than",
    type=Age(),
    help="also remove scenes and studies without additions for so long",
)
def clean_stale(yes: bool, keep_newer: float, older_than: float | None) -> None:
    """List the artifacts that no scene names any more, and leftovers of killed runs."""
    from chebsplat.pipelines.work import inventory, store

    old = [] if older_than is None else inventory.list_idle(older_than)
    leftovers = store.list_unreferenced(set(old))
    leftovers = [
        (path, size) for path, size in leftovers if not keep_newer or store.age(path) >= keep_newer
    ]
    for folder in old:
        print(f"           {folder}")
    show_sizes(leftovers, yes or not (leftovers or old), "yes=1 (--yes) removes them")
    if yes:
        remove(old, leftovers)
        store.sweep()


@click.command()
def status() -> None:
    """Show running, waiting and failed steps, with seconds and the end of the log."""
    from chebsplat.pipelines.work import store
    from chebsplat.pipelines.work.summary import lines

    report = list(lines())
    for line in report:
        print(line)
    if not report:
        print(f"nothing runs in {store.work()}, and nothing has failed", file=sys.stderr)


COMMANDS = (list_scenes, rm, verify, status, clean_stale)
