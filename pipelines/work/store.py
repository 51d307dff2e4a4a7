"""The work folder: artifacts by key, links by scene, cached hashes, and garbage collection."""

from __future__ import annotations

import json
import os
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Container, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats import artifact
from chebsplat.formats.files import atomic_write
from chebsplat.formats.manifest import parse_manifest
from chebsplat.pipelines.work import leases


def work() -> Path:
    """Path of the work folder: CHEBSPLAT_WORK, otherwise `work` in the current folder."""
    return Path(os.environ.get("CHEBSPLAT_WORK") or "work").absolute()


def make_work() -> None:
    """Create the work folder. Raises ConfigError where that cannot be."""
    try:
        work().mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError, FileNotFoundError):
        raise ConfigError(
            f"{work()} is no folder and cannot become one; set CHEBSPLAT_WORK to a folder"
        ) from None


def lease(base: Path, name: str) -> Path:
    """Path of the lease in a work folder with a name: an artifact's stage and key, or a run."""
    return base / ".held" / name


def run_lease(plans: Path) -> Path:
    """Path of the lease that a run holds while the folder of its plan is needed."""
    return lease(plans.parents[1], f"run-{plans.name}")


def artifact_path(stage: str, key: str) -> Path:
    """Path of the artifact of a stage and key, finished or not."""
    return work() / "store" / stage / key


def say(text: str) -> None:
    """Print a line to stderr at once."""
    print(text, file=sys.stderr, flush=True)


def is_fresh(path: Path) -> bool:
    """Finished, every file there with its size; `verify` and readers check digests."""
    return artifact.is_whole(path)


def is_name(text: str) -> bool:
    """True for a valid name of an entry in a folder, which cannot lead elsewhere."""
    return text != "" and not text.startswith(".") and not set(text) & set("/\0")


class Memo:
    """A small JSON file of remembered results; losing it costs time, never correctness."""

    def __init__(self, name: str):
        self.path = work() / ".cache" / f"{name}.json"
        try:
            values = json.loads(self.path.read_text())
        except (OSError, ValueError, RecursionError):
            values = {}
        self.values: dict[str, Any] = values if isinstance(values, dict) else {}
        self._before = json.dumps(self.values, sort_keys=True)

    def save(self) -> None:
        """Nothing where there is no work folder: a run makes one, planning does not."""
        text = json.dumps(self.values, sort_keys=True)
        if text != self._before and work().is_dir():
            try:
                atomic_write(self.path, text)
            except OSError as error:
                say(
                    f"{self.path} cannot be written ({error.strerror}): what it would spare is "
                    "done again next time"
                )


def link(scene: str, targets: dict[str, Path]) -> Path:
    """Point `work/<scene>/<stage>` at the finished of `targets`. Stages that the scene leaves out
    lose their link; those that are still to run keep it, and with it the artifact that it names.

    Raises: ConfigError on a name that would lead out of the work folder.
    """
    if not is_name(scene):
        raise ConfigError(
            f"{scene!r} cannot name a folder of links: no / in it, and no . at its beginning"
        )
    folder = work() / scene
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        if old.is_symlink() and old.name not in targets:
            old.unlink(missing_ok=True)
    for stage, target in targets.items():
        if not is_fresh(target):
            continue
        relative = os.path.relpath(target, folder)
        current = folder / stage
        if current.is_symlink() and os.readlink(current) == relative:
            continue
        fresh = folder / f".{stage}-{os.getpid()}"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(relative)
        os.replace(fresh, current)
    return folder


def list_unreferenced(without: Container[Path] = ()) -> list[tuple[Path, int]]:
    """Artifacts that no link and no running plan reaches, neither directly nor as an input, and
    leftovers of runs that failed or were killed; with bytes. Raises InputError if a manifest is
    damaged.

    Args: without: folders whose links count for nothing.
    """
    base = work()
    if not (base / "store").is_dir():
        return []
    waiting = [_real(p) for p in base.glob("*/*") if p.is_symlink() and p.parent not in without]
    running = _running(base)
    waiting += map(_real, running)
    by_key = {p.name: _real(p) for p in base.glob("store/*/*") if not p.name.startswith(".")}
    named: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path in named or not artifact.is_published(path):
            continue
        named.add(path)
        keys = [entry["key"] for entry in parse_manifest(path).inputs.values()]
        waiting += [by_key[key] for key in keys if key in by_key]
    leftovers = [
        p
        for p in sorted(base.glob("store/*/*"))
        if _real(p) not in named and not _in_use(p, running)
    ]
    leftovers += [p for p in sorted(base.glob(".plans/*")) if not is_under_way(p)]
    return [(p, sum(f.stat().st_size for f in p.rglob("*") if f.is_file())) for p in leftovers]


def age(path: Path) -> float:
    """Seconds since an artifact was finished, or a leftover changed, by the file system's clock."""
    manifest = path / "artifact.json"
    changed = (manifest if manifest.is_file() else path).lstat().st_mtime
    with tempfile.TemporaryFile(dir=work()) as clock:
        return os.fstat(clock.fileno()).st_mtime - changed


def sweep() -> None:
    """Remove leases of dead holders, and Snakemake's records where no run is under way."""
    for path in work().glob(".held/*"):
        with suppress(FileNotFoundError):
            if age(path) > leases.EXPIRES and holder(path) is None:
                path.unlink()
    if not any(map(is_under_way, work().glob(".plans/*"))):
        for name in (".snakemake", ".leases", ".names"):  # earlier versions had the last two
            shutil.rmtree(work() / name, ignore_errors=True)


def _real(path: Path) -> Path:
    """Path with links resolved; unlike `Path.resolve`, circular links raise nothing."""
    return Path(os.path.realpath(path))


def _running(base: Path) -> set[Path]:
    """Artifacts that a run under way makes or reads. Raises InputError if its plan is damaged."""
    paths: set[Path] = set()
    for plan in base.glob(".plans/*/plan.json"):
        try:
            if is_under_way(plan.parent):
                for step in json.loads(plan.read_text())["steps"]:
                    paths |= {Path(step["path"]), *map(Path, step["inputs"].values())}
        except FileNotFoundError:  # the run has just ended
            continue
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            advice = f"remove {plan.parent} if no run is under way"
            raise InputError(
                f"{plan} is damaged: what that run needs is not known; {advice}"
            ) from None
    return paths


def is_under_way(plans: Path) -> bool:
    """True while the run of a folder of `.plans` goes on, here or on another machine."""
    return _owner_lives(plans) or holder(run_lease(plans)) is not None


def holder(path: Path) -> str | None:
    """The machine that holds a lease; None: nobody, or one elsewhere that has expired."""
    machine = leases.holder(path)
    with suppress(FileNotFoundError):  # it has just been released
        if machine == socket.gethostname() or (machine and age(path) < leases.EXPIRES):
            return machine
    return None


def _in_use(path: Path, running: set[Path]) -> bool:
    """A hidden folder of a running process or of a run under way, or younger than an hour."""
    if not path.name.startswith("."):
        return False
    # .tmp-<key>-<process>, of this machine or of a node of a run's
    if path.name.startswith(".tmp-"):
        return _owner_lives(path) or path.with_name(path.name.split("-")[1]) in running
    if not path.name.startswith(".part-"):
        return False
    return (
        path.with_name(path.name[len(".part-") :]) in running
        or time.time() - path.lstat().st_mtime < 3600
    )


def remove_half(path: Path) -> None:
    """Remove the partial artifacts of killed processes; the artifact's lease must be held."""
    for half in path.parent.glob(f".tmp-{path.name}-*"):
        if not _owner_lives(half):
            shutil.rmtree(half, ignore_errors=True)


def remove_halves(paths: Iterable[Path]) -> None:
    """Remove partial artifacts of killed jobs, but for those that another run makes."""
    for path in paths:
        if holder(lease(path.parents[2], f"{path.parent.name}-{path.name}")) is None:
            remove_half(path)


def _owner_lives(path: Path) -> bool:
    """True while the process of this machine whose number ends the folder's name runs."""
    owner = path.name.rsplit("-", 1)[-1]
    if not owner.isdecimal():
        return False
    try:
        os.kill(int(owner), 0)
    except PermissionError:  # another user's
        return True
    except (ProcessLookupError, OverflowError):
        return False
    return True


def remove(path: Path) -> None:
    """Remove a path that `list_unreferenced` listed; of a link, the link alone."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
        return
    (path / "artifact.json").unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)


def import_artifact(folder: Path, stage: str, schema: str, running: bool) -> Path:
    """Path in the store of a stage's artifact from elsewhere; verified, and copied there to run.

    Raises: InputError on a damaged artifact, or one of another schema.
    """
    manifest = artifact.verify(folder, schema)
    path = artifact_path(stage, manifest.key)
    if running and not is_fresh(path):
        artifact.copy(folder, path, manifest)
    return path
