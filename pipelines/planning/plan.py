"""From config to keyed steps: the steps of a scene, and those left out by reason."""

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
from chebsplat.evaluation import protocols
from chebsplat.formats.names import unprintable
from chebsplat.formats.teacher_model import EMBEDDED, read_teacher
from chebsplat.pipelines.planning.code import PACKAGE, PLACES, Code, step_key
from chebsplat.pipelines.planning.needs import (
    Start,
    choose_start,
    colours_alone,
    left_out_channels,
    left_out_stages,
    media_packages,
    source_sentence,
    teacher_kind,
    text_packages,
    unread_inputs,
)
from chebsplat.pipelines.planning.raw import Hashes, content_hash, hashes, raw_files
from chebsplat.pipelines.work import folders, heads, store
from chebsplat.pipelines.work.scenes import (
    escape_text,
    expand_variables,
    folder_of,
    is_source,
    missing_source,
    read_toml,
    scene_values,
)
from chebsplat.stages.registry import OF_KNOWLEDGE, STAGES, Stage, lesson_paths
from chebsplat.stages.runtime import config as configs
from chebsplat.stages.settings import SourceSection
from chebsplat.stages.sources.common import resolve_source

if TYPE_CHECKING:
    from chebsplat.stages.runtime.config import Config


Overrides = str | Mapping[str, Any]  # `section.key=value,...`, or sections by name
OFF_IS_CHOICE = (
    "ingest.depth",
    "sfm.dense",
    "sfm.enclosure",
    "train.densify",
    "train.exposure",
    "refine.smooth",
)


@dataclass
class Step:
    """One stage to run: its command's arguments are all here."""

    stage: str
    key: str
    path: Path
    inputs: dict[str, Path]
    sections: dict[str, Any]  # the part of the config that the stage reads
    code: dict[str, Any]
    raw: Hashes = field(default_factory=dict)  # of the raw files that it reads
    # artifacts that are made first, although it does not read them
    after: list[Path] = field(default_factory=list)
    expected: float | None = None  # s that it is expected to take, where that was forecast

    @property
    def fresh(self) -> bool:
        return store.is_fresh(self.path)


@dataclass
class PlannedLesson:
    """The lesson that a scene's run will make: its set (None: no set), path, the identity of the
    photos, the key of the encoder, and the scene's name.
    """

    lessons: str | None
    path: Path
    capture: str
    start: str
    scene: str


@dataclass
class Plan:
    """Steps in order; left-out stages by reason; `title`: scene[@quality+ablation+settings]."""

    title: str
    source: str
    steps: list[Step]
    left_out: dict[str, str] = field(default_factory=dict)
    lesson: PlannedLesson | None = None

    @property
    def targets(self) -> dict[str, Path]:
        return {step.stage: step.path for step in self.steps}


def identity_of(source: SourceSection, ingest: Step) -> str:
    """Identity of a capture: the content of its photos, or a generated scene's preset and seed."""
    if source.kind == "generated":
        return f"{source.preset} {source.seed}"
    return content_hash(ingest.raw, None)


def resolve_paths(config: Config) -> Config:
    """A config whose paths are absolute, as stages run in another folder than the user."""
    for section, key in PLACES:
        values = getattr(config, section)
        path = getattr(values, key)
        if path is not None:
            absolute = os.path.realpath(os.path.expanduser(expand_variables(path)))
            config = config.model_copy(update={section: values.model_copy(update={key: absolute})})
    return config


def resolve_path(source: SourceSection) -> SourceSection:
    """A source with an absolute path, if it has one: REPLICA_ROOT may be relative."""
    if not source.path:
        return source
    return source.model_copy(update={"path": str(Path(source.path).expanduser().resolve())})


def suffix(settings: Overrides) -> str:
    """Settings as part of a folder's name; long ones are cut and end in a digest."""
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
    """A value as TOML reads it, or text; `on`, `off` are booleans but where `off` is a choice."""
    if value in ("on", "off") and key in OFF_IS_CHOICE:
        return value
    try:
        return tomllib.loads(f"v = {value}")["v"]
    # no TOML, thousands of digits, deep nesting
    except (ValueError, RecursionError):
        return {"on": True, "off": False}.get(value, value)


class Planner:
    """Plans scenes; remembers hashes of code and raw files between runs.

    Args: code: the folder of `chebsplat`; running: plans will run, so that the work folder is made
      and names of folders are reserved; device: of steps that can use a GPU; newer: pin scenes to
      the present lessons; quality: a named set of settings, before ablation and settings.
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
        lessons: Sequence[PlannedLesson] = (),
    ) -> Plan:
        """The steps of one scene.

        Args: settings: over the scene's own; earlier: the training of the scene before, in a
          printed sequence; values: config sections that replace the scene's own, before ablation
          and settings (a study's); place: begins the plan's title, in a sequence; lessons: of
          scenes before it.
        Raises: ConfigError, InputError.
        """
        name, own = scene_values(scene)
        values = merged(own, values or {})
        for folder, name_of in (("qualities", self.quality), ("ablations", ablation)):
            if name_of:
                values = merged(values, read_toml(folder, name_of))
        if settings:
            values = merged(values, overrides(settings))
        config = resolve_paths(configs.build(values, f"scene {escape_text(scene)}"))
        source_setting = config.source
        source = resolve_path(resolve_source(name, source_setting))
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
        variant = "+".join(filter(None, (self.quality, ablation, suffix(settings))))
        title = place + self._named(scene) + (f"@{variant}" if variant else "")
        start = (
            Start(why=left_out["refine"])
            if "refine" in left_out
            else choose_start(config, kind, self.running)
        )
        left_out |= dict.fromkeys(OF_KNOWLEDGE, start.why) if start.path is None else {}
        if start.path is not None and start.lessons is None:
            left_out["learn"] = start.why
        steps: dict[str, Step] = {}
        extra_packages = {"teacher": text_packages(model, teacher.labels)}
        store_inputs = {} if start.path is None else {"start": start.path}
        lesson, identity = None, ""
        for stage in STAGES.values():
            if stage.name in left_out or not stage.of_scene:
                continue
            unread = unread_inputs(config, stage.name)
            inputs = {role: store_inputs[role] for role in stage.roles if role in store_inputs}
            inputs |= {
                role: steps[of].path
                for role, of in stage.roles.items()
                if of in steps and role not in unread
            }
            if stage.name == "train" and earlier is not None:
                inputs["earlier"] = earlier
            if stage.name == "recall":
                inputs.pop("lesson", None)  # its own lesson, which is for later scenes
                inputs |= lesson_paths(self._lessons(place, scene, start, identity, lessons))
                if inputs.keys() == {"start"}:
                    store_inputs["knowledge"] = inputs["start"]
                    left_out["recall"] = "no lesson to add to what ships"
                    continue
            if lacking := [of for role, of in stage.inputs if role not in inputs]:
                left_out[stage.name] = f"{lacking[0]} is left out"
                continue
            keys = {role: path.name for role, path in inputs.items()}
            without = stage.name == "train" and "features" not in inputs
            step = steps[stage.name] = self.step(
                stage,
                colours_alone(config) if without else config,
                inputs,
                keys,
                extra_packages.get(stage.name, ()),
            )
            step.after = [steps[before].path for before in stage.after if before in steps]
            if stage.name == "ingest":
                identity = identity_of(source, step)
            if stage.name == "learn" and start.path is not None:
                lesson = PlannedLesson(
                    start.lessons, step.path, identity, start.path.name, self._named(scene)
                )
        return Plan(
            title,
            source_sentence(name, source_setting, source),
            list(steps.values()),
            left_out,
            lesson,
        )

    def _lessons(
        self, place: str, scene: str, start: Start, capture: str, earlier: Sequence[PlannedLesson]
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
        own = {one.path.name: one.path for one in earlier if one.capture != capture}
        if earlier:
            records, replaced = heads.members(start.lessons), {one.capture for one in earlier}
            keys = [
                key for key in keys if key not in records or records[key]["capture"] not in replaced
            ]
        return {key: heads.fetch(title, start.lessons, key, self.running) for key in keys} | own

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
        """A stage's step; keys: of its inputs by role; used: packages of extras that it needs."""
        sections = config.sections(stage.sections)
        root, files = raw_files(stage.name, sections)
        raw = hashes(files, self.file_memo.values)
        device = stage.device(self.device, sections)
        computing = stage.device_packages if device == "cuda" else ()
        protocol = (protocols.module_of(config.ingest.protocol),) if stage.of_protocol else ()
        code = self.code.stage(stage.name, (*used, *computing, *media_packages(files)), protocol)
        content = content_hash(raw, root) if raw or stage.name in ("pose", "ingest") else None
        key = step_key(stage, sections, keys, code, content, device)
        return Step(
            stage.name, key, store.artifact_path(stage.name, key), inputs, sections, code, raw
        )

    def _probe(self, source: Any, scene: str) -> dict[str, bool]:
        """Truths that the source brings: poses, depth, labels, pseudo labels."""
        if source.kind == "generated":
            return {"poses": True, "depth": True, "labels": True}
        folder = Path(source.path)
        if not is_source(folder):
            raise missing_source(scene, folder)
        module = import_module(f"chebsplat.stages.sources.{source.kind}")
        return module.probe(folder)  # type: ignore[no-any-return]
