"""Keys, names, HEADs, places to write and --force, as nobody should give them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from malformed.case import Asked, Case, stage
from malformed.manifests import DAMAGES, KEY, fake

NAMES = {  # option: names that lead elsewhere, or nowhere
    "--ablation": ["../../x", "/etc/passwd", "../scenes/toy", "..", "no-tle/../no-tle", "x" * 5000, "a\nb"],
    "--set": ["train.steps", "=", "a=1", "../x.y=1", "train.steps=", ".=1"],
    "--stage": ["../train", "/", "x" * 5000],
    "--basis": ["../../x", "../../x@1", "/x@1", ".@1", "@", "x@0", "x@-1", "x@²", "x@" + "9" * 5000, "nothing"],
    "--device": ["cuda", "gpu", "cpu/../x"],
}


def _ingest(folder: Path, *more: str | Path, named: str, out: Path | None = None) -> Asked:
    asked = stage("ingest", folder, {"source": {"kind": "generated", "preset": "toy", "seed": 1}}, named)
    arguments = [*asked.arguments, *more]
    if out is not None:
        arguments[arguments.index("--out") + 1] = out
    return Asked(arguments, named)


def _option(option: str, value: str) -> Callable[[Path], Asked]:
    named = {"--set": "set=", "--basis": "basis", "--stage": "stage", "--device": "--device"}.get(option, "ablation")

    def build(folder: Path) -> Asked:
        return Asked(["run", "--scene", "toy", "--stage", "ingest", option, value], named)

    return build


def _command(*arguments: str, named: str = "") -> Callable[[Path], Asked]:
    return lambda folder: Asked(arguments, named or arguments[-1])


# Where nothing can be written, or what must stay: what stands at `place` before, and more arguments.


def _file(place: Path) -> None:
    place.write_text("years")


def _below_a_file(place: Path) -> None:
    place.parent.write_text("years")


def _folder(place: Path) -> None:
    place.mkdir()
    (place / "thesis.tex").write_text("years")


def _folder_with_a_manifest(place: Path) -> None:
    _folder(place)
    (place / "artifact.json").write_text('{"title": "a list of my artifacts"}')


def _other_stage(place: Path) -> None:
    fake(place, "train")


def _with_a_note(place: Path) -> None:
    fake(place, "ingest")
    (place / "thesis.tex").write_text("years")


def _link(place: Path) -> None:
    place.symlink_to(fake(place.with_name("another"), "ingest"))


def _dangling(place: Path) -> None:
    place.symlink_to("nothing")


def _loop(place: Path) -> None:
    place.symlink_to(place.name)


def _nothing(place: Path) -> None:
    pass


def _damaged(name: str) -> Callable[[Path], None]:
    return lambda place: DAMAGES[name](fake(place, "ingest"))


PLACES: dict[str, tuple[Callable[[Path], None], str, bool]] = {  # what stands there, the place, asked with --force?
    "a file": (_file, "mine", False),
    "below a file": (_below_a_file, "mine/x", False),
    "far below a file": (lambda place: _file(place.parents[1]), "mine/x/y", False),
    "a name too long": (_nothing, "x" * 250, False),
    "a name far too long": (_nothing, "x" * 5000, False),
    "a folder of the system's": (_nothing, "/proc/nothing/x", False),
    "a folder of the user's": (_folder, "mine", False),
    "a folder of the user's with an artifact.json": (_folder_with_a_manifest, "mine", False),
    "another stage's artifact": (_other_stage, "mine", False),
    "a link that leads nowhere": (_dangling, "mine", False),
    "a link that leads to itself": (_loop, "mine", False),
    "an artifact with a member gone": (_damaged("a member that is gone"), "mine", False),
    "an artifact with a manifest cut off": (_damaged("a manifest cut off"), "mine", False),
    "--force on a file": (_file, "mine", True),
    "--force on a folder of the user's": (_folder, "mine", True),
    "--force on a folder with an artifact.json": (_folder_with_a_manifest, "mine", True),
    "--force on another stage's artifact": (_other_stage, "mine", True),
    "--force on an artifact with a note in it": (_with_a_note, "mine", True),
    "--force on a link to an artifact": (_link, "mine", True),
    "--force on a link that leads nowhere": (_dangling, "mine", True),
    "--force on a link that leads to itself": (_loop, "mine", True),
}


def _out(stands: Callable[[Path], None], place: str, force: bool) -> Callable[[Path], Asked]:
    def build(folder: Path) -> Asked:
        stands(folder / place)
        return _ingest(folder, *(["--force"] if force else []), named=str(folder / place), out=folder / place)

    return build


# HEADs and bases, in a work folder of their own.


def _head(links: dict[str, str], *arguments: str, named: str) -> Callable[[Path], Asked]:
    """links: name -> target, relative to the HEAD's folder."""

    def build(folder: Path) -> Asked:
        work = folder / "mine"
        (work / "basis-shared").mkdir(parents=True)
        fake(work / "store/cks" / KEY, "cks")
        fake(work / "store/cks/another", "cks")
        for name, target in links.items():
            os.symlink(target, work / "basis-shared" / name)
        return Asked(arguments, named, {"CHEBSPLAT_WORK": str(work)})

    return build


GOOD = f"../store/cks/{KEY}"
HEADS = {
    "numbered 100000000": ({"100000000": GOOD}, "basis-shared/100000000"),
    "numbered 9 without those before": ({"1": GOOD, "9": GOOD}, "basis-shared/9"),
    "that leads nowhere": ({"1": "../store/cks/nothing"}, "basis-shared/1"),
    "that leads to itself": ({"1": "1"}, "basis-shared/1"),
    "that leads out of the store": ({"1": "../.."}, "basis-shared/1"),
    "that leads to a folder of another name": ({"1": "../store/cks/another"}, "basis-shared/1"),
}


def _exported(damage: str) -> Callable[[Path], Asked]:
    def build(folder: Path) -> Asked:
        DAMAGES[damage](fake(folder / "knowledge", "cks"))
        return Asked(["plan", "--scene", "toy", "--basis", f"{folder / 'knowledge'}/"], str(folder / "knowledge"))

    return build


def _without_a_rank(folder: Path) -> Asked:
    """Right in every file but the settings that its manifest says."""
    from chebsplat.formats import artifact
    from chebsplat.formats.basis import SCHEMA, Basis, write_basis
    from chebsplat.formats.manifest import Manifest

    with artifact.publish(folder / "knowledge", Manifest(SCHEMA, KEY, "cks")) as tmp:
        write_basis(tmp, Basis({}, {}, [{"scene": "toy", "gaussians": KEY, "spread": 0.0, "maps": {}}]))
    return Asked(["basis", "verify", f"{folder / 'knowledge'}/"], "config.cks.max_rank")


def cases() -> Iterator[Case]:
    yield Case("argument", "basis verify FOLDER/, settings gone", _without_a_rank, (3,))
    for option, values in NAMES.items():
        for value in values:
            yield Case("argument", f"{option} {value[:40]!r}", _option(option, value), (2,))
    for name, (stands, place, force) in PLACES.items():
        yield Case("argument", f"--out: {name}", _out(stands, place, force), (2, 3))
    for name, (links, named) in HEADS.items():
        yield Case("argument", f"a revision {name}", _head(links, "basis", "log", "shared", named=named), (3,))
    for damage in ("an absolute key", "a key that climbs", "an empty key", "a file that climbs", "a member cut off"):
        yield Case("argument", f"--basis FOLDER/ with {damage}", _exported(damage), (3,))
    yield Case("argument", "clean-stale, a manifest cut off", _cleaned, (3,))
    for name in ("../../x", "..toml", "...toml", "/etc", "nothing.toml", "x" * 300 + ".toml"):
        yield Case("argument", f"study {name[:40]!r}", _command("study", name, "--plan", named=name[:80]), (2,))
        yield Case("argument", f"--sequence {name[:40]!r}", _command("plan", "--sequence", name, named=name[:80]), (2,))
    for name in ("../scenes/toy", "/nowhere/", "./nowhere", "toy/../toy", "x" * 5000):
        yield Case("argument", f"--scene {name[:40]!r}", _command("plan", "--scene", name, named=name[:80]), (2, 3))


def _cleaned(folder: Path) -> Asked:
    work = folder / "mine"
    DAMAGES["a manifest cut off"](fake(work / "store/ingest" / KEY, "ingest"))
    (work / "toy").mkdir()
    os.symlink(f"../store/ingest/{KEY}", work / "toy/ingest")
    return Asked(["clean-stale", "--yes"], f"{KEY}/artifact.json", {"CHEBSPLAT_WORK": str(work)})
