"""Settings, documents, names and places that no command could use, and a work folder that is none
or damaged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from chebsplat.stages.registry import STAGES
from malformed.artifacts import KEY, fake
from malformed.edits import DEEP, Edit, no_file, put, swollen
from malformed.row import Arguments, Row, stage

LONG = "x" * 300
# a setting of a config, its value, a word of the message beside its name
SETTINGS: list[tuple[str, object, str]] = [
    ("scene.name", "a\nb", "scene.name"),
    ("source.kind", "coLmap", "colmap"),
    ("source.seed", 2**64, "source.seed"),
    ("ingest.test_every", 1, "ingest.test_every"),
    ("teacher.scales", [], "teacher.scales"),
    ("teacher.scales", [0.0], "teacher.scales.0"),
    ("teacher.scales", [1.0] * 100, "teacher.scales"),
    ("refine.smooth", ["on"], "refine.smooth"),
    ("train.method", "prnted", "'printed'"),
    ("train.seconds", float("inf"), "a finite number is needed"),
    ("train.semantics", 1, "true or false is needed"),
    ("train.densify_until", 0.9, "densify_until must not lie after"),
    ("train.stpes", 5, "did you mean train.steps"),
    ("train.n_angles", 5, "did you mean describe.n_angles"),
    ("trian.steps", 5, "did you mean train"),
    ("projection.n_channels", 9, "did you mean channels.n_channels"),
]
SET = {  # --set: what stderr names
    "train.steps": "section.key=value",
    "train.steps=": "'train.steps=': section.key=value is needed",
    "=5": "'=5': section.key=value is needed",
    "../x.y=1": "set=",
    "train.steps.more=5": "section.key=value is needed",
    "train.stps=3": "did you mean train.steps",
    "train.steps=5, train.steps=6": "train.steps is given twice",
    "train.lr_means=inf": "train.lr_means: a finite number is needed",
    "train.steps=" + "9" * 5000: "train.steps: a whole number is needed",
    "train.steps=" + DEEP: "train.steps: a whole number is needed",
    "teacher.labels=a\nb": "section.key=value is needed",
    "describe.n_regions=200000,describe.n_angles=64": "descriptors of",
}
TOMLS: list[tuple[str, bytes, str]] = [  # what a config holds, a word of the message
    ("cut short", b"[train", "does not parse"),
    ("a key twice", b"[train]\nsteps = 1\nsteps = 2\n", "does not parse"),
    ("deep lists", b"a = " + DEEP.encode(), "nested too deeply"),
    ("an endless number", b"[train]\nsteps = " + b"9" * 5000, "does not parse"),
    ("a section that is no table", b"train = 5\n", "train"),
]
JSONS: list[tuple[str, bytes, str]] = [
    ("no UTF-8", b'{"a": "\xff"}', "UTF-8"),
    ("deep lists", DEEP.encode(), "nested too deeply"),
    ("a list", b"[]", "a table of settings is needed"),
    ("a section that is no table", b'{"train": [5]}', "train"),
]
STUDY = 'title = "M"\nabout = ""\nbaseline = "a"\nscenes = ["toy"]\n'
STUDIES: list[tuple[str, str, str]] = [  # what is wrong, the text, what stderr names
    ("cut short", "[variants", "does not parse"),
    ("no title", STUDY.partition("\n")[2] + "[variants.a]\n", "title"),
    ("scenes that are numbers", STUDY.replace('["toy"]', "[5]") + "[variants.a]\n", "scenes"),
    ("an unknown key", STUDY + "sceens = []\n[variants.a]\n", "sceens"),
    ("another baseline", STUDY.replace('"a"', '"b"') + "[variants.a]\n", "variants"),
    ("no seeds", STUDY + "seeds = []\n[variants.a]\n", "seeds"),
    ("infinite seconds", STUDY + "budgets.seconds = [inf]\n[variants.a]\n", "budgets.seconds"),
    (
        "a section that is a number",
        STUDY + "settings = { train = 5 }\n[variants.a]\n",
        "settings.train",
    ),
    ("no scenes", STUDY.replace('"toy"', "") + "[variants.a]\n", "scenes"),
    ("an ablation that is a number", STUDY + "[variants.a]\nablation = 5\n", "variants.a.ablation"),
    (
        "a condition that is a number",
        STUDY + "conditions = { x = 5 }\n[variants.a]\n",
        "conditions.x",
    ),
    ("a setting out of range", STUDY + "[variants.a.train]\nwidth = 100000\n", "train.width"),
    ("an unknown setting", STUDY + "[variants.a.train]\nwitdh = 32\n", "train.witdh"),
    ("an unknown ablation", STUDY + '[variants.a]\nablation = "no-tel"\n', "no-tel"),
    ("an unknown scene", STUDY.replace("toy", "tyo") + "[variants.a]\n", "tyo"),
]
SEQUENCES = {  # text: what stderr says
    "[scenes": "does not parse",
    **dict.fromkeys(
        ("", "scenes = []", 'scenes = "toy"', 'scenes = ["toy"]\nsteps = 5',
         "scenes = [" + '"toy",' * 2000 + "]"),
        'it says scenes = ["...", ...]',
    ),
    "scenes = [1, 2]": "1 is no scene's name",
    'scenes = ["toy", ""]': "'' is no scene's name",
    'scenes = ["to\\ny"]': "is no scene's name",
}  # fmt: skip
NAMES: list[tuple[str, str, int]] = [  # a command's words, what it must name, its exit code
    ("run", "scene=", 2),
    ("run --scene ofice0", "office0", 2),
    ("run --scene toy --sequence toys", "sequence=", 2),
    ("run --scene toy --stage trian", "train", 2),
    ("run --scene toy --stage ../train", "no stage is called ../train", 2),
    ("run --scene toy --cores 0", "Invalid value for '--cores'", 2),
    ("run --scene toy --device tpu", "Invalid value for '--device'", 2),
    ("run --scene toy --nonsense", "No such option", 2),
    ("run --scene toy --ablation no-densfy", "no-densify", 2),
    ("run --scene toy --ablation ../scenes/toy", "no ablation is called ../scenes/toy", 2),
    ("run --scene ./nowhere/", "not a folder", 3),
    ("run --scene ./file", "./file is not a folder", 3),
    ("run --scene ../scenes/toy", "../scenes/toy is not a folder", 3),
    (f"run --scene ./{LONG}", f"{LONG[:70]}' is not a folder", 3),
    ("run --scene ~nobody-of-this-name", "no scene is called ~nobody-of-this-name", 2),
    ("run --sequence ofices", "offices", 2),
    ("run --sequence toys --ablation no-tle", "no ablation is called no-tle", 2),
    ("plan --scene toy --set knowledge.start=.rooms", "'.rooms' cannot name a set", 2),
    ("knowledge log --set ../rooms", "'../rooms' cannot name a set", 2),
    ("knowledge forget 0123456789abcdef", "rooms has no lesson 0123456789abcdef", 2),
    ("run --sequence nowhere.toml", "nowhere.toml is missing", 2),
    (f"plan --sequence {LONG}.toml", f"{LONG}.toml: File name too long", 2),
    ("study methd", "did you mean method", 2),
    ("study ../studies/toys", "no study is called ../studies/toys", 2),
    ("study nowhere.toml", "nowhere.toml is missing", 2),
    ("study toys --threads 0", "Invalid value for '--threads'", 2),
    ("settings trian", "train", 2),
    ("settings train.stpes", "train.steps", 2),
    ("verify nowhere", "no finished scene", 2),
    ("verify ./nowhere", "./nowhere is missing", 3),
    ("rm . --yes", " . is no finished scene", 3),
    ("rm .. --yes", " .. is no finished scene", 3),
    ("rm ./file --yes", "./file is neither a scene", 3),
    ("query nowhere sofa", "nowhere is no finished scene", 2),
    ("query ./file sofa", "./file is neither a scene", 3),
    ("extract office0 --out x.ply", "make scene=office0", 2),
    ("extract ./nowhere --out x.ply", "./nowhere is missing", 3),
    ("lift nowhere.ply --capture ./nowhere --out x", "./nowhere is missing", 3),
    ("check-teacher nowhere.onnx", "nowhere.onnx is missing", 3),
    ("nonsense", "No such command 'nonsense'", 2),
    ("sfm --out x", "Missing option '--in-capture'", 2),
]


def words(
    kind: str, arguments: Sequence[str], *named: str, code: int = 2, edit: Edit | None = None
) -> Row:
    """A command met in a folder with a file named `file`, and what `edit` puts there."""

    def build(folder: Path) -> Arguments:
        (folder / "file").write_text("text")
        if edit:
            edit(folder)
        return arguments

    name = " ".join(ascii(word[:40])[1:-1] for word in arguments)
    return Row(kind, name, build, named, code)


def settings() -> Iterator[Row]:
    for setting, value, word in SETTINGS:
        section, key = setting.split(".")

        def build(
            folder: Path, section: str = section, key: str = key, value: object = value
        ) -> Arguments:
            return stage("sfm", folder, {section: {key: value}}, capture=folder / "none")

        yield Row("setting", f"{setting} = {value!r:.30}", build, (word,), 2)
    for text, word in SET.items():
        yield words("set=", ["plan", "--scene", "toy", "--set", text], word)
    for name in STAGES:

        def misspelt(folder: Path, name: str = name) -> Arguments:
            of = STAGES[name]
            given = {role: fake(folder / role, of.roles[role]) for role, _ in of.inputs}
            return stage(name, folder, {"train": {"tets_every": 3}}, **given)

        yield Row("setting", f"of {name}, misspelt", misspelt, ("train.tets_every",), 2)


def documents() -> Iterator[Row]:
    def met(kind: str, what: str, edit: Edit, word: str, alone: bool = False) -> Row:
        name = "a.json" if kind == "json config" else "a.toml"
        asked: Callable[[Path], list[str | Path]] = {
            "study": lambda folder: ["study", folder / name, "--plan"],
            "sequence": lambda folder: ["plan", "--sequence", folder / name],
        }.get(
            kind,
            lambda folder: [
                "sfm",
                "--config",
                folder / name,
                "--out",
                folder / "out",
                "--in-capture",
                folder,
            ],
        )

        def build(folder: Path) -> Arguments:
            edit(folder)
            return asked(folder)

        return Row(kind, what[:40], build, (word,) if kind == "study" else (name, word), 2, alone)

    for what, content, word in TOMLS:
        yield met("config", what, put("a.toml", content), word)
    for what, content, word in JSONS:
        yield met("json config", what, put("a.json", content), word)
    for what, text, word in STUDIES:
        yield met("study", what, put("a.toml", text), word)
    for text, word in SEQUENCES.items():
        yield met("sequence", f"{text!r}", put("a.toml", text), word)
    yield met("config", "missing", lambda folder: None, "is missing")
    yield met("config", "a folder", no_file("a.toml", "folder"), "is a folder")
    for kind in ("config", "study", "sequence"):
        yield met(kind, "a pipe", no_file("a.toml", "pipe"), "a pipe", True)
    yield met("config", "a device", no_file("a.toml", "device"), "a device", True)
    yield met("json config", "a terabyte",
              lambda folder: (put("a.json", "")(folder), swollen("a.json")(folder)),
              "are read", True)  # fmt: skip


def names() -> Iterator[Row]:
    for line, word, code in NAMES:
        yield words("command", line.split(), word, code=code)
    for word in ("a\nb", "\x1b[31mred", "toy\udcff"):
        yield words("command", ["run", "--scene", word], repr(word))
    for command, word in ((["run", "--scene"], "scene="),
                          (["run", "--sequence"], "no sequence can be called"),
                          (["study"], "no study can be called"),
                          (["verify"], "''")):  # fmt: skip
        yield words("command", [*command, ""], word)


# Where nothing can be written, or what must stay: the place of an artifact and its key.


def users(place: Path) -> None:
    place.mkdir()
    (place / "thesis.tex").write_text("years")


def with_a_manifest(place: Path) -> None:
    users(place)
    (place / "artifact.json").write_text('{"title": "a list of my artifacts"}')


def with_a_note(place: Path) -> None:
    fake(place, "ingest")
    (place / "thesis.tex").write_text("years")


# what stands where, and the exit code
PLACES: dict[str, tuple[Callable[[Path], object], str, int]] = {
    "a file": (lambda place: place.write_text("years"), "mine", 3),
    "a folder of the user's": (users, "mine", 3),
    "a folder with an artifact.json": (with_a_manifest, "mine", 3),
    "another stage's artifact": (lambda place: fake(place, "train"), "mine", 3),
    "a link to an artifact": (
        lambda place: place.symlink_to(fake(place.with_name("other"), "ingest")),
        "mine",
        3,
    ),
    "a link that leads nowhere": (lambda place: place.symlink_to("nothing"), "mine", 3),
    "a link that leads to itself": (lambda place: place.symlink_to(place.name), "mine", 3),
    "below a file": (lambda place: place.parents[1].write_text("years"), "mine/x/y", 2),
    "a name too long": (lambda place: None, "x" * 250, 2),
    "a name far too long": (lambda place: None, "x" * 5000, 2),
    "a folder of the system's": (lambda place: None, "/proc/nothing/x", 2),
}


def places() -> Iterator[Row]:
    def ingest(folder: Path) -> list[str | Path]:
        """Of a folder that is not there: what is refused later names that."""
        return stage("ingest", folder, {"source": {"kind": "colmap", "path": "nowhere"}})

    yield Row("setting", "source.path = 'nowhere'", ingest, ("nowhere", "source.path"))
    for what, (stands, place, code) in PLACES.items():
        for force in (False, True) if place == "mine" else (False,):
            if what == "a link to an artifact" and not force:
                continue  # it is whole: there is nothing to do

            def build(
                folder: Path, stands=stands, place: str = place, force: bool = force
            ) -> Arguments:  # type: ignore[no-untyped-def]
                stands(folder / place)
                arguments = ingest(folder)
                arguments[arguments.index("--out") + 1] = folder / place
                return [*arguments, *["--force"] * force]

            word = "mine" if "mine" in place else place[-60:]
            remedy = "choose another --out" if code == 2 else "nothing was replaced"
            yield Row("--out", f"{what}{', --force' * force}", build, (word, remedy), code)

    def noted(folder: Path) -> Arguments:
        with_a_note(folder / "out")
        return [*ingest(folder), "--force"]

    yield Row(
        "--out",
        "an artifact with a note in it, --force",
        noted,
        ("thesis.tex", "no part of the artifact"),
    )


# What lies in work


def linked(work: Path, title: str, of: str, manifest: str = "{}") -> None:
    """A scene's link to an artifact that is a manifest alone."""
    put(f"store/{of}/{KEY}/artifact.json", manifest)(work)
    (work / title).mkdir()
    (work / title / of).symlink_to(work / f"store/{of}/{KEY}")


def plan_under_way(text: str | None) -> Edit:
    """The plan of a run under way (process 1 always is), or a folder in its place."""

    def edit(folder: Path) -> None:
        plan = folder / f"work/.plans/{KEY}-1/plan.json"
        (plan if text is None else plan.parent).mkdir(parents=True)
        (folder / "work/store").mkdir()
        if text is not None:
            plan.write_text(text)

    return edit


def several(folder: Path) -> None:
    for steps in (5, 6):
        linked(folder / "work", f"toy@train.steps={steps}", "train")


def work() -> Iterator[Row]:
    def damaged(folder: Path) -> None:
        linked(folder / "work", "toy", "train", "{")

    def unfinished(folder: Path) -> None:
        linked(folder / "work", "toy", "train")

    for line in ("verify toy", "rm toy", "clean-stale", "clean-stale --yes"):
        yield words(
            "work, a manifest cut short",
            line.split(),
            "artifact.json",
            "does not parse",
            code=3,
            edit=damaged,
        )
    for what, text in (
        ("cut short", "{"),
        ("of another kind", '{"steps": [3]}'),
        ("a folder", None),
    ):
        yield words(
            f"work, a plan {what}",
            ["clean-stale", "--yes"],
            "plan.json",
            code=3,
            edit=plan_under_way(text),
        )
    yield words("work, several settings", ["verify", "toy"], "toy@train.steps=5", edit=several)
    yield words("work, unfinished", ["extract", "toy", "--out", "x.ply"], "export", edit=unfinished)
    yield words("work, unfinished", ["query", "toy", "sofa"], "export", edit=unfinished)
    yield words("work, a file", ["run", "--scene", "toy"], "work", edit=put("work", "a file"))
    photo = put("images/a.jpg", "")
    yield words(
        "work, photos not run yet",
        ["query", "./images", "sofa"],
        "make scene=./images",
        code=3,
        edit=photo,
    )
    yield words(
        "work, photos",
        ["extract", "images", "--out", "x.ply"],
        "images is no finished scene",
        code=3,
        edit=photo,
    )
    yield words("work, links elsewhere", ["rm", "./mine", "--yes"], "mine does not lie in", code=3,
                edit=lambda folder: linked(folder, "mine", "train"))  # fmt: skip


def rows() -> Iterator[Row]:
    for part in (settings, documents, names, places, work):
        yield from part()
