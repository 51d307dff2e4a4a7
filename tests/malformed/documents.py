"""Documents that no reader could use, whoever reads them: configs, studies, sequences, ablations, tables of labels."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from malformed.case import Asked, Case, stage

DEEP = 50_000
STUDY = 'title = "M"\nabout = ""\nbaseline = "a"\nscenes = ["toy"]\n'
CONTENTS: dict[str, tuple[bytes, bytes]] = {  # what is wrong: as TOML, as JSON
    "empty object": (b"= 1", b""),
    "binary": (b"\x93NUMPY\x01\x00\xff\xfe", b"\x93NUMPY\x01\x00\xff\xfe"),
    "UTF-16": ("steps = 1".encode("utf-16"), '{"a": 1}'.encode("utf-16")),
    "cut short": (b"[train", b'{"train": {"steps": 5'),
    "a key twice": (b"[train]\nsteps = 1\nsteps = 2\n", b'{"train": {"steps": 1, "steps": 2}}'),
    "deep lists": (b"a = " + b"[" * DEEP, b"[" * DEEP),
    "deep tables": (b"a = " + b"{a=" * DEEP, b'{"a":' * DEEP),
    "a long key": (b"a." * DEEP + b"a = 1", b'{"' + b"a" * DEEP + b'": 1}'),
    "a huge number": (b"[train]\nsteps = " + b"9" * 5000, b'{"train": {"steps": ' + b"9" * 5000 + b"}}"),
    "half a character": (b'[scene]\nname = "\\ud800"\n', b'{"scene": {"name": "\\ud800"}}'),
    "another format": (b'{"train": {"steps": 5}}', b"[train]\nsteps = 5\n"),
    "sections that are no tables": (b"train = 5\n", b'{"train": [5]}'),
}
PLACES = ("missing", "a folder", "a pipe", "/dev/zero", "a looping link", "gigabytes")
ROOTS = {"a list": b"[]", "a number": b"7", "text": b'"train"', "null": b"null", "no UTF-8": b'{"a": "\xff"}'}
STUDIES = {  # what is wrong, and what stderr names
    "no title": (STUDY.partition("\n")[2] + "[variants.a]\n", "title"),
    "no variants": (STUDY, "variants"),
    "no scenes": (STUDY.rpartition("scenes")[0] + "[variants.a]\n", "scenes"),
    "scenes are numbers": (STUDY.replace('["toy"]', "[5]") + "[variants.a]\n", "scenes"),
    "scenes is text": (STUDY.replace('["toy"]', '"toy"') + "[variants.a]\n", "scenes"),
    "an unknown key": (STUDY + "sceens = []\n[variants.a]\n", "sceens"),
    "another baseline": (STUDY.replace('"a"', '"b"') + "[variants.a]\n", "variants"),
    "a negative seed": (STUDY + "seeds = [-1]\n[variants.a]\n", "seeds"),
    "a huge seed": (STUDY + "seeds = [18446744073709551616]\n[variants.a]\n", "seeds"),
    "seeds that are truths": (STUDY + "seeds = [true]\n[variants.a]\n", "seeds"),
    "no seeds": (STUDY + "seeds = []\n[variants.a]\n", "seeds"),
    "infinite seconds": (STUDY + "budgets.seconds = [inf]\n[variants.a]\n", "budgets.seconds"),
    "no steps": (STUDY + "budgets.steps = [0]\n[variants.a]\n", "budgets.steps"),
    "settings are a number": (STUDY + "settings = 5\n[variants.a]\n", "settings"),
    "a section is a number": (STUDY + "settings = { train = 5 }\n[variants.a.train]\nsteps = 5\n", "settings.train"),
    "a variant is a number": (STUDY + "[variants]\na = 5\n", "variants.a"),
    "a variant's section is": (STUDY + "[variants.a]\nteacher = 5\n", "variants.a.teacher"),
    "an ablation is a number": (STUDY + "[variants.a]\nablation = 5\n", "variants.a.ablation"),
    "knowledge is text": (STUDY + '[variants.a]\nknowledge = "no"\n', "variants.a.knowledge"),
    "a condition is a number": (STUDY + "conditions = { x = 5 }\n[variants.a]\n", "conditions.x"),
    "pairs are no pairs": (STUDY + 'pairs = [["a"]]\n[variants.a]\n', "pairs"),
    "a pair of strangers": (STUDY + 'pairs = [["a", "b"]]\n[variants.a]\n', "variants"),
    "a setting out of range": (STUDY + "[variants.a.train]\nwidth = 100000\n", "train.width"),
    "an unknown setting": (STUDY + "[variants.a.train]\nwitdh = 32\n", "train.witdh"),
    "an unknown ablation": (STUDY + '[variants.a]\nablation = "no-tel"\n', "no-tel"),
    "an unknown scene": (STUDY.replace("toy", "tyo") + "[variants.a]\n", "tyo"),
}
SEQUENCES = {
    "no scenes": "",
    "an empty list": "scenes = []\n",
    "a number": "scenes = 5\n",
    "text": 'scenes = "toy"\n',
    "a table": "[scenes]\na = 1\n",
    "numbers": "scenes = [1, 2]\n",
    "an empty name": 'scenes = ["toy", ""]\n',
    "a line end": 'scenes = ["to\\ny"]\n',
    "another key": 'scenes = ["toy"]\nsteps = 5\n',
    "too many": "scenes = [" + '"toy",' * 2000 + "]\n",
}


def _placed(path: Path, place: str) -> None:
    if place == "a folder":
        path.mkdir()
    elif place == "a pipe":
        os.mkfifo(path)
    elif place in ("/dev/zero", "a looping link"):
        path.symlink_to(place if place == "/dev/zero" else path)
    elif place == "gigabytes":
        path.touch()
        os.truncate(path, 1 << 40)


def _ingest(file: Path) -> Asked:
    return Asked(["ingest", "--config", file, "--out", file.parent / "out"], file.name)


READERS: dict[str, tuple[str, Callable[[Path], Asked]]] = {  # the file's name, and the command that reads it
    "config": ("a.toml", _ingest),
    "json config": ("a.json", _ingest),
    "study": ("a.toml", lambda file: Asked(["study", str(file), "--plan"], file.name)),
    "sequence": ("a.toml", lambda file: Asked(["plan", "--sequence", str(file)], file.name)),
}


def _case(kind: str, name: str, content: bytes | None, codes: tuple[int, ...] = (2,)) -> Case:
    file, ask = READERS[kind]

    def build(folder: Path) -> Asked:
        if content is None:
            _placed(folder / file, name)
        else:
            (folder / file).write_bytes(content)
        return ask(folder / file)

    return Case(kind, name, build, codes)


def _named(kind: str, name: str, text: str, named: str) -> Case:
    file, ask = READERS[kind]

    def build(folder: Path) -> Asked:
        (folder / file).write_text(text)
        return Asked(ask(folder / file).arguments, named)

    return Case(kind, name, build, (2,))


def cases() -> Iterator[Case]:
    for kind, (file, _) in READERS.items():
        for place in PLACES:
            yield _case(kind, place, None)
        for name, (toml, json_) in CONTENTS.items():
            yield _case(kind, name, json_ if file.endswith(".json") else toml)
    for name, content in ROOTS.items():
        yield _case("json config", name, content)
    for name, (text, named) in STUDIES.items():
        yield _named("study", name, text, named)
    for name, text in SEQUENCES.items():
        yield _named("sequence", name, text, "a.toml")
    for kind in ("ablation", "study", "sequence", "scene"):
        for name in ("nosuch", "../scenes/toy", "a\nb", "x" * 300):
            yield Case(f"{kind} by name", f"{name[:20]!r}", lambda folder, kind=kind, name=name: _by_name(kind, name))
    yield Case("config", "none", lambda folder: stage("ingest", folder, "", "config.json"), (2,))


def _by_name(kind: str, name: str) -> Asked:
    if kind == "ablation":
        return Asked(["plan", "--scene", "toy", "--ablation", name], name[:10].strip("a\nb"))
    if kind == "study":
        return Asked(["study", name, "--plan"], name[:10].strip("a\nb"))
    return Asked(["plan", f"--{kind}", name], name[:10].strip("a\nb"))
