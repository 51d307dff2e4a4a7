"""Studies: scenes × conditions × variants × budgets × seeds, planned, run and reported."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from chebsplat.errors import ChebsplatError, ConfigError
from chebsplat.pipelines.planning.code import PACKAGE
from chebsplat.pipelines.planning.plan import Plan, Planner, Step, merged, suffix
from chebsplat.pipelines.running.cluster import LOCAL
from chebsplat.pipelines.running.run import Outcome, needed_steps, say, snakemake
from chebsplat.pipelines.work import store
from chebsplat.pipelines.work.scenes import read_named, read_toml, scene_values
from chebsplat.stages.runtime.config import checked
from chebsplat.stages.settings import Section, Text, printable
from chebsplat.stages.sources.common import spellings

LAST = "evaluate"  # the last stage of a run: a study needs no page and no ONNX file of each


Sections = dict[str, dict[str, Any]]  # of a config; their values are checked where a run is planned
Name = Annotated[str, Field(max_length=200), AfterValidator(printable)]
EVERY = 1.0  # seconds between polls for finished runs
REFRESH = 300.0  # least seconds between two writings of the page during a study


class Budgets(Section):
    """Budgets of a run. Each is a whole training with its own schedule, never a longer one cut."""

    steps: list[Annotated[int, Field(ge=1, le=1_000_000)]] = Field([], max_length=100)
    seconds: list[Annotated[float, Field(ge=0.1, le=604_800)]] = Field([], max_length=100)

    def settings(self) -> dict[str, dict[str, Any]]:
        """train settings by budget name; without budgets the scene's own, unnamed."""
        settings: dict[str, dict[str, Any]] = {f"{n} steps": {"steps": n} for n in self.steps}
        settings |= {f"{s:g} s": {"seconds": s} for s in self.seconds}
        return settings or {"": {}}


class Table(Section):
    """A condition that stands for a table of a paper, with scenes and variants of its own.

    Scenes lie in the folder that the environment variable `root` names, or one folder below it, and
    hold `holds`. `teacher`: the variable that names the 2D teacher's model, scored by the label set
      `labels`. `variants` are some of the study's, each with the row of `published` that it stands
      for, "" for none. `published`: figures by row, in the units that a study shows.
    """

    root: Text
    holds: str = ""
    teacher: str = ""
    labels: str = ""
    scenes: list[Text] = Field(min_length=1, max_length=1000)
    variants: dict[Name, str] = Field(min_length=1, max_length=1000)
    published: dict[Name, dict[str, float]]

    def folder(self, scene: str) -> str:
        """A scene's folder, ending in "/"; "" where there is none."""
        root = Path(os.environ.get(self.root) or os.devnull)
        candidates = [
            top / name for top in (root, *sorted(root.glob("*/"))) for name in spellings(scene)
        ]
        return next(
            (f"{path.absolute()}/" for path in candidates if (path / self.holds).exists()), ""
        )

    def lacks(self, scene: str, semantic: bool) -> str:
        """Why a scene cannot run, "" where it can. semantic: its variant needs a teacher."""
        if not os.environ.get(self.root):
            return f"{self.root} is not set"
        if not self.folder(scene):
            return f"not in {self.root}" + (f" with {self.holds}/" if self.holds else "")
        return (
            f"{self.teacher} is not set"
            if semantic and self.teacher and not os.environ.get(self.teacher)
            else ""
        )

    def teacher_settings(self, semantic: bool) -> Sections:
        """The settings of the 2D teacher."""
        if not (semantic and self.teacher):
            return {}
        labels = (
            {"labels": str(PACKAGE / f"teachers/labels/{self.labels}.txt")} if self.labels else {}
        )
        return {"teacher": {"kind": "onnx", "model": os.environ[self.teacher]} | labels}


class Study(Section):
    """A file of `configs/studies`, alone or over another that it `extends` (`extend_study`).
    `settings`, conditions and variants hold config sections.

    Conditions are what results are averaged within (a teacher, a noise level); variants are
    compared, each with `baseline`, under the same condition, budget, scene and seed. A variant may
    also name an `ablation`. `tables` holds a `Table` for each condition, in the place of `scenes`;
    what is not there of them does not run.
    """

    title: str
    about: str
    scenes: list[Text] = Field([], max_length=1000)
    seeds: list[Annotated[int, Field(ge=0, lt=2**31)]] = Field([0], min_length=1, max_length=1000)
    budgets: Budgets = Budgets()
    baseline: str
    settings: Sections = Field({})
    conditions: dict[Name, Sections] = Field({"": {}}, max_length=1000)
    variants: dict[Name, dict[str, Any]] = Field(min_length=1, max_length=1000)
    tables: dict[Name, Table] = Field({}, max_length=1000)
    # each scene starts from the lessons of those before it, too, where its variant takes lessons
    grows: bool = False
    # section.key whose value is the figure's horizontal axis, instead of run time
    against: str = ""

    @model_validator(mode="after")
    def _fits_together(self) -> Study:
        if self.baseline not in self.variants:
            raise ValueError(
                f"{self.baseline[:60]!r} is none of its variants: {', '.join(self.variants)}"
            )
        if self.tables.keys() != (set() if self.scenes else self.conditions.keys()):
            raise ValueError("it needs either scenes or tables, one for each of its conditions")
        for name, table in self.tables.items():
            for of, row in table.variants.items():
                if of not in self.variants:
                    raise ValueError(f"tables.{name}: {of!r:.60} is none of the study's variants")
                if row and row not in table.published:
                    raise ValueError(
                        f"tables.{name}: {row!r:.60} is no row of its published figures"
                    )
        for name, variant in self.variants.items():
            for key, value in variant.items():
                kind = str if key == "ablation" else dict
                if not isinstance(value, kind):
                    raise ValueError(f"variants.{name}.{key}: a {kind.__name__} is needed")
        return self

    def points(self) -> Iterator[tuple[str, int, str, list[str]]]:
        """(scene, seed, condition, variants) of all runs."""
        for scene, seed, condition in itertools.product(self.scenes, self.seeds, self.conditions):
            yield scene, seed, condition, list(self.variants)
        for condition, table in self.tables.items():
            for scene, seed in itertools.product(table.scenes, self.seeds):
                yield scene, seed, condition, list(table.variants)


@dataclass(frozen=True)
class Run:
    """One point of a study."""

    condition: str
    variant: str
    budget: str
    scene: str
    seed: int
    plan: Plan = field(compare=False)
    # plans of the scenes whose lessons it starts from
    before: tuple[Plan, ...] = field(default=(), compare=False)

    @property
    def steps(self) -> list[Step]:
        return needed_steps(self.plan, LAST, self.before)

    @property
    def protocol(self) -> str:
        return next(
            step.sections["ingest"]["protocol"]
            for step in self.plan.steps
            if step.stage == "ingest"
        )

    @property
    def name(self) -> str:
        """The name of its link, which a reader can tell the run by."""
        parts = (self.condition, self.variant, self.budget, self.scene)
        return suffix("-".join(str(p) for p in parts if p).replace(" ", "")) + f"-seed{self.seed}"


def read_study(name: str) -> Study:
    """A study of ours by name, or a file of the user's that ends in .toml.

    Raises ConfigError naming the first bad key, or the nearest study's name.
    """
    return checked_study(read_named("studies", name), f"study {name}")


def checked_study(values: dict[str, Any], origin: str) -> Study:
    """The study that a .toml's values describe. Raises ConfigError naming `origin` and the key."""
    return checked(Study, extend_study(values, origin) if "extends" in values else values, origin)


def extend_study(values: dict[str, Any], origin: str) -> dict[str, Any]:
    """A study's values over those of the study of ours that it `extends`, which extends none.

    Its `variants` and `conditions` may be lists, of names of the other's.
    Raises: ConfigError naming `origin` and what is wrong.
    """
    name = str(values["extends"])
    other = read_toml("studies", name)
    if "extends" in other:
        raise ConfigError(f"{origin}: {name} itself extends {other['extends']}; extend that")
    values = {key: value for key, value in values.items() if key != "extends"}
    for key in ("variants", "conditions"):
        if isinstance(names := values.get(key), list):
            of_other = other.get(key, {})
            if wrong := [name for name in names if name not in list(of_other)]:
                choices = ", ".join(of_other)
                raise ConfigError(f"{origin}: {key}: {wrong[0]!r:.60} is none of {choices}")
            values[key] = {name: of_other[name] for name in names}
    return other | values


def expand(study: Study, running: bool = False, device: str = "cpu") -> list[Run]:
    """Every run, planned; variants vary fastest, so that a study cut short has full comparisons.

    Args: running, device: of `Planner`. A missing scene of a table has no run (`list_missing`).
    Raises: ConfigError, InputError.
    Choices: all runs of a condition are measured under one protocol, since figures of two do not
      average.
    """
    planner = Planner(running=running, device=device)
    runs: list[Run] = []
    before: dict[tuple[Any, ...], list[Plan]] = defaultdict(list)
    try:
        for named, seed, condition, variants in study.points():
            for budget, budget_settings in study.budgets.settings().items():
                for variant in variants:
                    values = merged(_values(study, condition, variant), {"train": budget_settings})
                    scene, table = named, study.tables.get(condition)
                    if table is not None:
                        if table.lacks(named, is_semantic(values)):
                            continue
                        scene = table.folder(named)
                        values = merged(values, table.teacher_settings(is_semantic(values)))
                    earlier = before[seed, condition, budget, variant]
                    lessons = [
                        one.lesson
                        for one in earlier
                        if one.lesson is not None and one.lesson.lessons
                    ]
                    knowledge = {"start": "shipped"} | scene_values(scene)[1].get("knowledge", {})
                    values = merged(
                        {"knowledge": knowledge}, merged(values, seed_settings(scene, values, seed))
                    )
                    place = suffix(f"study-{variant}-seed{seed}-") if study.grows else ""
                    plan = planner.plan(scene, values=values, place=place, lessons=lessons)
                    title = named if table else plan.title.removeprefix(place)
                    runs.append(Run(condition, variant, budget, title, seed, plan, tuple(earlier)))
                    earlier += [plan] * study.grows
    finally:
        planner.save()
    for condition in study.conditions:
        protocols = sorted({run.protocol for run in runs if run.condition == condition})
        if len(protocols) > 1:
            raise ConfigError(
                f"scenes measured as {' and as '.join(protocols)} do not compare; "
                "set ingest.protocol"
            )
    return runs


def list_missing(study: Study, condition: str, variant: str) -> dict[str, list[str]]:
    """Scenes of a table that a variant cannot run on, by why it cannot."""
    table, reasons = study.tables[condition], defaultdict(list)
    semantic = is_semantic(_values(study, condition, variant))
    for scene in table.scenes:
        reasons[table.lacks(scene, semantic)].append(scene)
    return {why: scenes for why, scenes in reasons.items() if why}


def is_semantic(values: Sections) -> bool:
    """True where settings ask for features, so that a teacher is needed."""
    return bool(values.get("train", {}).get("semantics", True))


def _values(study: Study, condition: str, variant: str) -> Sections:
    """The settings of a variant under a condition, its ablation's among them."""
    own = dict(study.variants[variant])
    ablation = own.pop("ablation", None)
    values = merged(study.settings, study.conditions[condition])
    return merged(merged(values, read_toml("ablations", ablation) if ablation else {}), own)


def seed_settings(scene: str, values: dict[str, Any], seed: int) -> dict[str, Any]:
    """A seed's settings: of training, and of a label teacher's noise; other teachers run once."""
    kind = merged(scene_values(scene)[1], values).get("teacher", {}).get("kind")
    return {"train": {"seed": seed}} | ({"teacher": {"seed": seed}} if kind == "labels" else {})


def outstanding(runs: list[Run]) -> list[Step]:
    """Steps that are not there yet, each once."""
    steps = {step.key: step for run in runs for step in run.steps}
    return [step for step in steps.values() if not step.fresh]


def execute(
    name: str,
    runs: list[Run],
    cores: int,
    threads: int,
    device: str = "cpu",
    on: str = LOCAL,
    refresh: Callable[[], object] = lambda: None,
) -> Outcome:
    """Compute what is outstanding, cores // threads jobs at once; links in `work/study-NAME` keep
    its artifacts, and `refresh` shows now and then what there is.

    A scene and seed is finished, and measured, before the next begins: a study cut short has
    compared something. A step that fails costs the runs that need it, and no other. On a cluster
    all are in the queue at once.
    """
    outcome = Outcome()
    parts: dict[str, list[Run]] = {}
    for run in runs:
        title = f"{run.scene}, seed {run.seed}" if on == LOCAL else name
        parts.setdefault(title, []).append(run)
    links = {run.name: run.plan.targets[LAST] for run in runs}
    at_once = f"{cores // threads} at once, {threads} threads each"
    with report_progress(runs, say, refresh):
        for title, part in parts.items():
            if waiting := outstanding(part):
                try:
                    say(f"  {title}: {describe(waiting)}; {at_once}")
                    ended = snakemake(waiting, cores, threads, device, on)
                    outcome = Outcome(max(outcome.code, ended.code), outcome.failed | ended.failed)
                finally:  # a stopped study links its finished runs
                    store.link(f"study-{name}", links)
    store.link(f"study-{name}", links)
    return outcome


def describe(steps: list[Step]) -> str:
    """The number of steps to run of each stage."""
    counts: dict[str, int] = {}
    for step in steps:
        counts[step.stage] = counts.get(step.stage, 0) + 1
    return (
        "to run: " + ", ".join(f"{n} {stage}" for stage, n in counts.items())
        if counts
        else ("nothing to run")
    )


@contextmanager
def report_progress(
    runs: Sequence[Run], say: Callable[[str], None], refresh: Callable[[], object] = lambda: None
) -> Iterator[None]:
    """Report `n of m done` as runs finish during the block, and call `refresh` now and then."""
    waiting = {run.name: run.steps[-1] for run in runs if not run.steps[-1].fresh}
    over = threading.Event()

    def look() -> bool:
        finished = [name for name, last in waiting.items() if last.fresh]
        for name in finished:
            del waiting[name]
            say(f"  {len(runs) - len(waiting)} of {len(runs)} done: {name}")
        return bool(finished)

    def watch() -> None:
        written_at, is_new = time.monotonic(), False
        while not over.wait(EVERY):
            is_new |= look()
            if is_new and time.monotonic() - written_at >= REFRESH:
                try:
                    refresh()
                except (ChebsplatError, OSError) as error:
                    say(f"  the page could not be written: {error}")
                written_at, is_new = time.monotonic(), False

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        look()
