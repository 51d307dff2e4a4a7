"""Config to keys to steps: what a scene runs, what is fresh, and what it leaves out and why."""

from __future__ import annotations

import hashlib
import json
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import ConfigError
from chebsplat.formats.names import unprintable
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.pipelines.planning.code import PACKAGE, PLACES, Code, step_key
from chebsplat.pipelines.planning.needs import (
    Start,
    left_out_channels,
    left_out_stages,
    media_packages,
    source_sentence,
    start_given,
    teacher_kind,
    text_packages,
    unread_inputs,
)
from chebsplat.pipelines.planning.raw import Hashes, content_hash, hashes, raw_files
from chebsplat.pipelines.work import folders, heads, store
from chebsplat.pipelines.work.scenes import (
    absent,
    expanded,
    folder_of,
    is_source,
    read_toml,
    scene_values,
    shown,
)
from chebsplat.stages.registry import OF_KNOWLEDGE, STAGES, Stage, lesson_paths
from chebsplat.stages.runtime import config as configs
from chebsplat.stages.settings import SourceSection
from chebsplat.stages.sources.common import resolve_source

if TYPE_CHECKING:
    from chebsplat.stages.runtime.config import Config


Overrides = str | Mapping[str, Any]  # `section.key=value,...`, or sections by name
OFF_IS_CHOICE = ("ingest.depth", "sfm.dense", "train.densify", "train.exposure", "refine.smooth")


@dataclass
class Step:
    """One stage to run: its command's arguments are all here."""

    stage: str
    key: str
    path: Path
    inputs: dict[str, Path]
    sections: dict[str, Any]  # what the stage reads of the config
    code: dict[str, Any]
    raw: Hashes = field(default_factory=dict)  # of the files outside the store that it reads
    # artifacts that are made first, although it reads nothing of them
    after: list[Path] = field(default_factory=list)
    expected: float | None = None  # s that it is expected to take, where that was forecast

    @property
    def fresh(self) -> bool:
        return store.is_fresh(self.path)


@dataclass
class Learned:
    """The lesson that a scene's run makes: the set that it is added to (None: to none), where it
    will lie, the identity of the photos, the key of the encoder, and the scene's name.
    """

    lessons: str | None
    path: Path
    capture: str
    start: str
    scene: str


@dataclass
class Plan:
    """Steps in order, with what is left out and why. `title` names the links:
    scene[@quality+ablation+settings].
    """

    title: str
    source: str
    steps: list[Step]
    left_out: dict[str, str] = field(default_factory=dict)
    lesson: Learned | None = None

    @property
    def targets(self) -> dict[str, Path]:
        return {step.stage: step.path for step in self.steps}


def identity_of(source: SourceSection, ingest: Step) -> str:
    """What tells photos from others: their content; of a generated scene what it is made from."""
    if source.kind == "generated":
        return f"{source.preset} {source.seed}"
    return content_hash(ingest.raw, None)


def placed(config: Config) -> Config:
    """A config whose paths are absolute: stages run in another folder than the one that the user
    means.
    """
    for section, key in PLACES:
        values = getattr(config, section)
        path = getattr(values, key)
        if path is not None:
            absolute = os.path.realpath(os.path.expanduser(expanded(path)))
            config = config.model_copy(update={section: values.model_copy(update={key: absolute})})
    return config


def located(source: SourceSection) -> SourceSection:
    """A source with an absolute path, if it has one: REPLICA_ROOT may be relative."""
    if not source.path:
        return source
    return source.model_copy(update={"path": str(Path(source.path).expanduser().resolve())})


def suffix(settings: Overrides) -> str:
    """Settings as part of a folder's name: as they are where they fit, otherwise cut and told apart
    by a digest.
    """
    if not isinstance(settings, str):
        values = [
            (section, key, value)
            for section, of in overrides(settings).items()
            for key, value in of.items()
        ]
        words = (value if isinstance(value, str) else json.dumps(value) for _, _, value in values)
        settings = ",".join(
            f"{section}.{key}={word}" for (section, key, _), word in zip(values, words, strict=True)
        )
    text = re.sub(r"[^\w.=+-]+", "_", settings)
    return (
        text
        if len(text) <= 80
        else f"{text[:71]}-{hashlib.sha256(settings.encode()).hexdigest()[:8]}"
    )


def merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Settings by section, `over` winning key by key."""
    return base | {s: base.get(s, {}) | v if isinstance(v, dict) else v for s, v in over.items()}


def overrides(settings: Overrides) -> dict[str, Any]:
    """`a.b=c,d.e=f` as nested values, spaces about them or not; nested values as they are.

    Raises: ConfigError on anything else.
    """
    values: dict[str, Any] = {}
    if not isinstance(settings, str):
        for section, of in settings.items():
            if not isinstance(of, Mapping):
                raise ConfigError(
                    f"{section} is a section: give a dict, as {section}={{'key': value}}"
                )
            values[section] = dict(of)
        return values
    for item in filter(None, map(str.strip, re.split(r",(?=\s*[\w.]+\s*=)", settings))):
        key, _, value = (part.strip() for part in item.partition("="))
        section, _, name = key.partition(".")
        if unprintable(item) or not (section and name and value) or "." in name:
            raise ConfigError(
                f"set={item[:60]!a}: section.key=value is needed, such as train.steps=500"
            )
        if name in values.setdefault(section, {}):
            raise ConfigError(f"set={item[:60]}: {key} is given twice; leave one")
        values[section][name] = parsed(key, value)
    return values


def parsed(key: str, value: str) -> Any:
    """A value as TOML reads it, text where it does not; `on` and `off` are switches, where `off` is
    no choice.
    """
    if value in ("on", "off") and key in OFF_IS_CHOICE:
        return value
    try:
        return tomllib.loads(f"v = {value}")["v"]
    # no TOML, a number of thousands of digits, nested a thousand times
    except (ValueError, RecursionError):
        return {"on": True, "off": False}.get(value, value)


class Planner:
    """Plans scenes; remembers hashes of code and raw files between runs.

    Args: code: the folder of `chebsplat`; running: what is planned will run, so that the work
      folder is made, and a
          folder gets its name for good; device: that steps which can use a GPU run on; newer:
          scenes are pinned to the lessons that there are now; quality: a named set of settings,
          before ablation and settings.
    """

    def __init__(
        self,
        code: Path = PACKAGE,
        running: bool = False,
        device: str = "cpu",
        newer: bool = False,
        quality: str = "",
    ):
        self.code_memo, self.file_memo = store.Memo("code"), store.Memo("files")
        self.code, self.running = Code(code, self.code_memo.values), running
        self.device, self.newer, self.quality = device, newer, quality

    def save(self) -> None:
        self.code_memo.save()
        self.file_memo.save()

    def plan(
        self,
        scene: str,
        settings: Overrides = "",
        ablation: str = "",
        earlier: Path | None = None,
        values: dict[str, Any] | None = None,
        place: str = "",
        lessons: Sequence[Learned] = (),
    ) -> Plan:
        """The steps of one scene.

        Args: settings: over the scene's own; earlier: the training of the scene before, in a
          printed sequence; values:
              config sections that replace the scene's own, before ablation and settings (a
              study's); place: begins the plan's title, in a sequence; lessons: of scenes before it.
        Raises: ConfigError, InputError.
        """
        name, own = scene_values(scene)
        values = merged(own, values or {})
        for folder, name_of in (("qualities", self.quality), ("ablations", ablation)):
            if name_of:
                values = merged(values, read_toml(folder, name_of))
        if settings:
            values = merged(values, overrides(settings))
        config = placed(configs.build(values, f"scene {shown(scene)}"))
        asked = config.source
        source = located(resolve_source(name, asked))
        probe = self._probe(source, scene) | ({"labels": True} if config.ingest.volumes else {})
        kind, why = teacher_kind(config, source.kind, probe)
        teacher = config.teacher.model_copy(update={"kind": kind})
        if kind == "onnx" and teacher.model is None:
            teacher = teacher.model_copy(update={"model": str(EMBEDDED)})
        channels = config.channels.model_copy(update={"model": teacher.model})
        config = config.model_copy(
            update={"source": source, "teacher": teacher, "channels": channels}
        )
        model = read_teacher(Path(teacher.model)) if kind == "onnx" and teacher.model else None
        left_out = left_out_stages(config, kind, why, probe) | left_out_channels(kind, model)
        chosen = "+".join(filter(None, (self.quality, ablation, suffix(settings))))
        title = place + self._named(scene) + (f"@{chosen}" if chosen else "")
        start = (
            Start(why=left_out["refine"])
            if "refine" in left_out
            else start_given(config, kind, self.running)
        )
        left_out |= dict.fromkeys(OF_KNOWLEDGE, start.why) if start.path is None else {}
        if start.path is not None and start.lessons is None:
            left_out["learn"] = start.why
        steps: dict[str, Step] = {}
        used = {"teacher": text_packages(model, teacher.labels)}
        given = {} if start.path is None else {"start": start.path}
        lesson, identity = None, ""
        for stage in STAGES.values():
            if stage.name in left_out or not stage.of_scene:
                continue
            unread = unread_inputs(config, stage.name)
            inputs = {role: given[role] for role in stage.roles if role in given}
            inputs |= {
                role: steps[of].path
                for role, of in stage.roles.items()
                if of in steps and role not in unread
            }
            if stage.name == "train" and earlier is not None:
                inputs["earlier"] = earlier
            if stage.name == "recall":
                inputs.pop("lesson", None)  # its own, which is for the scenes after it
                inputs |= lesson_paths(self._lessons(place, scene, start, identity, lessons))
                if inputs.keys() == {"start"}:
                    given["knowledge"], left_out["recall"] = (
                        inputs["start"],
                        ("no lesson to add to what ships"),
                    )
                    continue
            keys = {role: path.name for role, path in inputs.items()}
            step = steps[stage.name] = self.step(
                stage, config, inputs, keys, used.get(stage.name, ())
            )
            step.after = [steps[before].path for before in stage.after if before in steps]
            if stage.name == "ingest":
                identity = identity_of(source, step)
            if stage.name == "learn" and start.path is not None:
                lesson = Learned(
                    start.lessons, step.path, identity, start.path.name, self._named(scene)
                )
        return Plan(
            title, source_sentence(name, asked, source), list(steps.values()), left_out, lesson
        )

    def _lessons(
        self, place: str, scene: str, start: Start, capture: str, earlier: Sequence[Learned]
    ) -> dict[str, Path]:
        """Lessons of a scene by key: those that it is pinned to, and those of the scenes before it
        in a sequence, which stand in for pinned ones of the same photos; none of its own photos.

        Args: place: begins the plan's title, in a sequence; capture: identity of the photos;
              earlier: of the scenes before it.
        """
        if start.path is None or start.lessons is None:
            return {}
        named = self._named(scene)
        title, of = place + named, (start.lessons, start.path.name, capture, named)
        keys = heads.pinned(title, *of, running=self.running, newer=self.newer)
        found = {one.path.name: one.path for one in earlier if one.capture != capture}
        if earlier:
            held, seen = heads.members(start.lessons), {one.capture for one in earlier}
            keys = [key for key in keys if key not in held or held[key]["capture"] not in seen]
        return {key: heads.taken(title, start.lessons, key, self.running) for key in keys} | found

    def _named(self, scene: str) -> str:
        """The name of a scene's links."""
        folder = folder_of(scene)
        if self.running:
            store.make_work()
        if folder is None:
            return scene
        return folders.claim(folder) if self.running else folders.name_of(folder)

    def step(
        self,
        stage: Stage,
        config: Any,
        inputs: dict[str, Path],
        keys: dict[str, str],
        used: tuple[str, ...] = (),
    ) -> Step:
        """A stage's step; keys: of its inputs, by role; used: packages of extras that this
        configuration uses.
        """
        sections = config.sections(stage.sections)
        root, files = raw_files(stage.name, sections)
        raw = hashes(files, self.file_memo.values)
        device = stage.device(self.device, sections)
        computing = stage.device_packages if device == "cuda" else ()
        code = self.code.stage(stage.name, (*used, *computing, *media_packages(files)))
        content = content_hash(raw, root) if raw or stage.name in ("pose", "ingest") else None
        key = step_key(stage, sections, keys, code, content, device)
        return Step(
            stage.name, key, store.artifact_path(stage.name, key), inputs, sections, code, raw
        )

    def _probe(self, source: Any, scene: str) -> dict[str, bool]:
        """What the source has."""
        if source.kind == "generated":
            return {"poses": True, "depth": True, "labels": True}
        folder = Path(source.path)
        if not is_source(folder):
            raise absent(scene, folder)
        return import_module(f"chebsplat.stages.sources.{source.kind}").probe(folder)  # type: ignore[no-any-return]
