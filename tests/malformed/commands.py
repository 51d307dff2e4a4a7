"""Odd uses of the commands: names that are none, paths of another kind, a damaged or occupied work folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from malformed.case import Asked, Case

LONG = "x" * 300
# (the command's arguments, what it must name, its exit code)
NAMES: list[tuple[list[str], str, int]] = [
    (["run"], "scene=", 2),
    (["run", "--scene", "ofice0"], "office0", 2),
    (["run", "--scene", ""], "scene=", 2),
    (["run", "--scene", "a\nb"], r"'a\nb'", 2),
    (["run", "--scene", "\x1b[31mred"], r"'\x1b[31mred'", 2),
    (["run", "--scene", "toy\udcff"], r"'toy\udcff'", 2),
    (["run", "--scene", LONG], LONG[:80], 2),
    (["run", "--scene", f"./{LONG}"], LONG[:70], 3),
    (["run", "--scene", "./nowhere"], "./nowhere", 3),
    (["run", "--scene", "./file"], "./file", 3),
    (["run", "--scene", "file"], "file", 2),
    (["run", "--scene", "~nobody-of-this-name"], "~nobody-of-this-name", 2),
    (["run", "--scene", "toy", "--sequence", "toys"], "sequence=", 2),
    (["run", "--scene", "toy", "--stage", "trian"], "train", 2),
    (["run", "--scene", "toy", "--stage", "cks"], "cks", 2),
    (["run", "--scene", "toy", "--cores", "0"], "--cores", 2),
    (["run", "--scene", "toy", "--device", "tpu"], "--device", 2),
    (["run", "--scene", "toy", "--nonsense"], "--nonsense", 2),
    (["run", "--scene", "toy", "--ablation", "no-tel"], "no-tle", 2),
    (["run", "--scene", "toy", "--ablation", "../scenes/toy"], "../scenes/toy", 2),
    (["run", "--scene", "../scenes/toy"], "../scenes/toy", 3),
    (["run", "--sequence", "ofices"], "offices", 2),
    (["run", "--sequence", ""], "sequence", 2),
    (["run", "--sequence", "nowhere.toml"], "nowhere.toml", 2),
    (["plan", "--scene", "toy", "--basis", "nobody"], "nobody", 2),
    (["plan", "--scene", "toy", "--basis", "offices@99"], "offices@99", 2),
    (["plan", "--scene", "toy", "--basis", "@"], "basis=@", 2),
    (["study", "methd"], "method", 2),
    (["study", ""], "study", 2),
    (["study", "../studies/toys"], "../studies/toys", 2),
    (["study", "nowhere.toml"], "nowhere.toml", 2),
    (["study", "toys", "--threads", "0"], "--threads", 2),
    (["settings", "trian"], "train", 2),
    (["settings", "train.stpes"], "train.steps", 2),
    (["settings", "\x1b[2J"], r"'\x1b[2J'", 2),
    (["verify", "nowhere"], "nowhere", 2),
    (["verify", "./nowhere"], "./nowhere", 3),
    (["verify", ""], "''", 2),
    (["verify", "file"], "file", 2),
    (["verify", "/"], "/", 3),
    (["rm", "nowhere", "--yes"], "nowhere", 2),
    (["rm", ".", "--yes"], ".", 3),
    (["rm", "..", "--yes"], "..", 3),
    (["rm", "./file", "--yes"], "./file", 3),
    (["query", "nowhere", "sofa"], "nowhere", 2),
    (["query", "./file", "sofa"], "./file", 3),
    (["extract", "office0", "--out", "x.ply"], "make scene=office0", 2),
    (["extract", "./nowhere", "--out", "x.ply"], "./nowhere", 3),
    (["encode", "nowhere", "--out", "x.npz"], "nowhere", 2),
    (["encode", "nowhere.ply", "--out", "x.npz"], "--encoder", 2),
    (["encode", "nowhere.ply", "--encoder", "./nowhere", "--out", "x.npz"], "./nowhere", 3),
    (["encode", "nowhere.ply", "--encoder", "nowhere.onnx", "--out", "x.npz"], "nowhere.onnx", 2),
    (["lift", "nowhere.ply", "--capture", "nowhere", "--out", "x"], "nowhere", 2),
    (["lift", "nowhere.ply", "--capture", "./nowhere", "--out", "x"], "./nowhere", 3),
    (["check-teacher", "nowhere.onnx"], "nowhere.onnx", 3),
    (["basis", "show", "ofices"], "offices", 2),
    (["basis", "log", "./nowhere"], "nowhere", 2),
    (["basis", "diff", "offices@0", "offices"], "offices@0", 2),
    (["basis", "extend", "a/b", "nowhere"], "nowhere", 2),
    (["basis", "nonsense"], "nonsense", 2),
    (["nonsense"], "nonsense", 2),
]


def _name(arguments: list[str], named: str, code: int) -> Case:
    def build(folder: Path) -> Asked:
        (folder / "file").write_text("text")
        return Asked(arguments, named)

    return Case("command", " ".join(ascii(word[:40])[1:-1] for word in arguments), build, (code,))


def photos(folder: Path) -> Path:
    from PIL import Image

    folder.mkdir(parents=True)
    for k in range(4):
        Image.new("RGB", (32, 24), (60 * k, 0, 0)).save(folder / f"{k}.jpg")
    return folder


def linked(work: Path, title: str, stage: str, manifest: str) -> None:
    """A scene's link to an artifact that is a manifest alone."""
    artifact = work / f"store/{stage}/0123456789abcdef"
    artifact.mkdir(parents=True, exist_ok=True)
    (artifact / "artifact.json").write_text(manifest)
    (work / title).mkdir()
    (work / title / stage).symlink_to(artifact)


def _damaged(folder: Path, *arguments: str) -> list[str]:
    linked(folder / "lair", "toy", "train", "{")
    return list(arguments)


def _plan(folder: Path, text: str | None) -> list[str]:
    """The plan of a run under way (process 1 always is), or a folder in its place."""
    plan = folder / "lair/.plans/0123456789abcdef-1/plan.json"
    (plan if text is None else plan.parent).mkdir(parents=True)
    (folder / "lair/store").mkdir()
    if text is not None:
        plan.write_text(text)
    return ["clean-stale", "--yes"]


def _several(folder: Path) -> list[str]:
    for steps in (5, 6):
        linked(folder / "lair", f"toy@train.steps={steps}", "train", "{}")
    return ["verify", "toy"]


def _unfinished(folder: Path, *arguments: str) -> list[str]:
    linked(folder / "lair", "toy", "train", "{}")
    return [*arguments, "--out", "x.ply"] if arguments[0] == "extract" else list(arguments)


def _occupied(folder: Path) -> list[str]:
    (folder / "lair").write_text("a file")
    return ["run", "--scene", "toy"]


def _photos(folder: Path, *arguments: str) -> list[str]:
    photos(folder / "images")
    return list(arguments)


def _elsewhere(folder: Path) -> list[str]:
    linked(folder, "mine", "train", "{}")
    return ["rm", "./mine", "--yes"]


# what is in work (here: `lair`), and what is asked: (what it is, its builder, what must be named, the exit code)
WORK: list[tuple[str, Callable[[Path], list[str]], str, int]] = [
    ("verify of a damaged manifest", lambda folder: _damaged(folder, "verify", "toy"), "artifact.json", 3),
    ("rm of a damaged manifest", lambda folder: _damaged(folder, "rm", "toy"), "artifact.json", 3),
    ("clean-stale of a damaged manifest", lambda folder: _damaged(folder, "clean-stale"), "artifact.json", 3),
    ("basis of a damaged scene", lambda folder: _damaged(folder, "basis", "extend", "h", "toy"), "artifact.json", 3),
    ("clean-stale beside a plan cut short", lambda folder: _plan(folder, "{"), "plan.json", 3),
    ("clean-stale beside a plan of another kind", lambda folder: _plan(folder, '{"steps": [3]}'), "plan.json", 3),
    ("clean-stale beside a plan that is a folder", lambda folder: _plan(folder, None), "plan.json", 3),
    ("a scene of several settings", _several, "toy@train.steps=5", 2),
    (
        "extract of an unfinished scene",
        lambda folder: _unfinished(folder, "extract", "toy"),
        "export",
        2,
    ),
    ("query of an unfinished scene", lambda folder: _unfinished(folder, "query", "toy", "sofa"), "export", 2),
    ("work is a file", _occupied, "lair", 2),
    (
        "photos not run yet",
        lambda folder: _photos(folder, "query", "./images", "sofa"),
        "make scene=./images",
        3,
    ),
    ("extract of photos", lambda folder: _photos(folder, "extract", "images", "--out", "x.ply"), "images", 3),
    ("rm of links elsewhere", _elsewhere, "mine", 3),
    ("scene whose data is absent", lambda folder: ["run", "--scene", "fox"], "CHEBSPLAT_TEST_DATA", 3),
]


def _work(what: str, arrange: Callable[[Path], list[str]], named: str, code: int) -> Case:
    def build(folder: Path) -> Asked:
        env = {"CHEBSPLAT_WORK": str(folder / "lair"), "CHEBSPLAT_TEST_DATA": str(folder / "nowhere")}
        return Asked(arrange(folder), named, env)

    return Case("command", what, build, (code,))


def cases() -> Iterator[Case]:
    for row in NAMES:
        yield _name(*row)
    for entry in WORK:
        yield _work(*entry)
