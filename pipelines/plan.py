"""Config to keys to steps: what a scene runs, what is fresh, and what it leaves out and why."""

from __future__ import annotations

import difflib
import hashlib
import os
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.names import unprintable
from chebsplat.formats.teacher_model import TeacherModel, read_teacher
from chebsplat.pipelines import store
from chebsplat.pipelines.code import Code, installed
from chebsplat.pipelines.keys import PLACES, content_hash, step_key
from chebsplat.pipelines.needs import (
    left_out_knowledge,
    left_out_projection,
    left_out_stages,
    source_sentence,
    teacher_kind,
)
from chebsplat.stages.projection import reference_files
from chebsplat.stages.registry import STAGES, Stage
from chebsplat.teachers import EMBEDDED

if TYPE_CHECKING:
    from chebsplat.stages.config import Config

CONFIGS = Path(__file__).parent / "configs"


@dataclass
class Step:
    """One stage to run: its command's arguments are all here."""

    stage: str
    key: str
    path: Path
    inputs: dict[str, Path]
    sections: dict[str, Any]  # what the stage reads of the config
    code: dict[str, Any]

    @property
    def fresh(self) -> bool:
        return store.is_fresh(self.path)


@dataclass
class Plan:
    """Steps in order, with what is left out and why. `title` names the links: scene[@ablation].

    `asked` is false of a scene that is only made as far as another one needs it.
    """

    title: str
    source: str
    steps: list[Step]
    left_out: dict[str, str] = field(default_factory=dict)
    asked: bool = True

    @property
    def targets(self) -> dict[str, Path]:
        return {step.stage: step.path for step in self.steps}


def names(kind: str) -> list[str]:
    return sorted(path.stem for path in (CONFIGS / kind).glob("*.toml"))


def read_toml(kind: str, name: str) -> dict[str, Any]:
    """A config of ours. Raises ConfigError with the nearest names."""
    path = CONFIGS / kind / f"{name}.toml"
    if not path.is_file():
        near = difflib.get_close_matches(name, names(kind), 3) or names(kind)
        raise ConfigError(f"no {kind[:-1]} is called {name}; did you mean {', '.join(near)}?")
    return tomllib.loads(path.read_text())


def scene_values(scene: str) -> tuple[str, dict[str, Any]]:
    """(name, config values) of a named scene, or of a folder of photos, a COLMAP model or a transforms.json."""
    folder = Path(os.path.expanduser(scene))
    if "/" in scene or scene in (".", "..") or (scene not in names("scenes") and folder.is_dir()):
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder; correct scene=")
        from chebsplat.stages.sources.common import detect

        parts = folder.resolve().parts[1:]
        words = next((k for k in range(1, len(parts)) if re.search(r"[a-zA-Z]", parts[-k])), 1)  # "dense/0" is no "0"
        name = re.sub(r"[^\w.-]+", "-", "-".join(parts[-words:])).lstrip(".") or "scene"
        name += "-scene" if name == "store" else ""  # links lie beside the store
        return name, {"scene": {"name": name}, "source": {"kind": detect(folder), "path": str(folder)}}
    values = read_toml("scenes", scene)
    values.setdefault("scene", {})["name"] = scene
    return scene, values


def placed(config: Config) -> Config:
    """A config whose paths are absolute: stages run in another folder than the one that the user means."""
    for section, key in PLACES:
        held = getattr(config, section)
        path = getattr(held, key)
        if path is not None:
            place = os.path.realpath(os.path.expanduser(expanded(path)))
            config = config.model_copy(update={section: held.model_copy(update={key: place})})
    return config


def expanded(text: str) -> str:
    """`${NAME:-default}` by the environment."""
    return re.sub(r"\$\{(\w+):-([^}]*)\}", lambda m: os.environ.get(m[1]) or m[2], text)


def suffix(settings: str) -> str:
    """`set=` as part of a folder's name: as it is where it fits, otherwise cut and told apart by a digest."""
    text = re.sub(r"[^\w.=+-]+", "_", settings)
    return text if len(text) <= 80 else f"{text[:71]}-{hashlib.sha256(settings.encode()).hexdigest()[:8]}"


def merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    return base | {s: base.get(s, {}) | v if isinstance(v, dict) else v for s, v in over.items()}


def overrides(text: str) -> dict[str, Any]:
    """`a.b=c,d.e=f` as nested values, spaces about them or not. Raises ConfigError on anything else."""
    values: dict[str, Any] = {}
    for item in filter(None, map(str.strip, re.split(r",(?=\s*[\w.]+\s*=)", text))):
        key, _, value = (part.strip() for part in item.partition("="))
        section, _, name = key.partition(".")
        if unprintable(item) or not (section and name and value) or "." in name:
            raise ConfigError(f"set={item[:60]!a}: section.key=value is needed, such as train.steps=500")
        if name in values.setdefault(section, {}):
            raise ConfigError(f"set={item[:60]}: {key} is given twice; leave one")
        values[section][name] = parsed(key, value)
    return values


def parsed(key: str, value: str) -> Any:
    """A value as TOML reads it, text where it does not; `on` and `off` are switches, where `off` is no choice."""
    if value == "off" and key in ("train.encoder", "train.densify"):
        return value
    try:
        return tomllib.loads(f"v = {value}")["v"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return {"on": True, "off": False}.get(value, value)


class Planner:
    """Plans scenes; remembers hashes of code and raw files between runs."""

    def __init__(self, folders: dict[str, Path] | None = None):
        self.code_memo, self.file_memo = store.Memo("code"), store.Memo("files")
        self.code = Code(folders or installed(), self.code_memo.values)

    def save(self) -> None:
        self.code_memo.save()
        self.file_memo.save()

    def plan(
        self,
        scene: str,
        settings: str = "",
        ablation: str = "",
        basis: Path | None = None,
        keep_knowledge: bool = False,
        values: dict[str, Any] | None = None,
    ) -> Plan:
        """The steps of one scene.

        Args: settings: `set=`; basis: an earlier scene's basis to train on; keep_knowledge: end with a cks step;
              values: config sections that replace the scene's own, before ablation and settings (a study's).
        Raises: ConfigError, InputError.
        """
        from chebsplat.stages import config as configs
        from chebsplat.stages import ingest

        name, own = scene_values(scene)
        values = merged(own, values or {})
        title = name
        if ablation:
            values = merged(values, read_toml("ablations", ablation))
            title += f"@{ablation}"
        if settings:
            values = merged(values, overrides(settings))
            title += ("+" if ablation else "@") + suffix(settings)
        config = placed(configs.build(values, f"scene {scene}"))
        asked = config.source
        source = ingest.resolve(name, asked)
        if source.path:  # REPLICA_ROOT may be relative
            source = source.model_copy(update={"path": str(Path(source.path).expanduser().resolve())})
        probe, files = self._probe(source)
        kind, why = teacher_kind(config, probe)
        teacher = config.teacher.model_copy(update={"kind": kind})
        if kind == "onnx" and teacher.model is None:
            teacher = teacher.model_copy(update={"model": str(EMBEDDED)})
        projection = config.projection.model_copy(update={"model": teacher.model})
        config = config.model_copy(update={"source": source, "teacher": teacher, "projection": projection})
        model = read_teacher(Path(teacher.model)) if kind == "onnx" and teacher.model else None
        left_out = left_out_stages(config, kind, why, probe) | left_out_projection(kind, model)
        left_out |= left_out_knowledge(config, kind, why, basis, keep_knowledge)
        steps: dict[str, Step] = {}
        root = Path(source.path) if source.path else None
        raw = {"ingest": content_hash(files, root, self.file_memo.values)}
        if model is not None:
            raw["teacher"] = self._hash_teacher(model, teacher)
            raw["projection"] = self._hash_projection(model, projection)
        if config.evaluate.lpips_weights:
            raw["evaluate"] = self._hash_files([Path(config.evaluate.lpips_weights)], "evaluate.lpips_weights")
        for stage in STAGES.values():
            if stage.name in left_out:
                continue
            inputs = {role: steps[of].path for role, of in stage.roles.items() if of in steps}
            if basis is not None and "basis" not in left_out and stage.name in ("train", "cks"):
                inputs["basis"] = basis
            keys = {role: path.name for role, path in inputs.items()}
            steps[stage.name] = self.step(stage, config, inputs, keys, raw.get(stage.name))
        return Plan(title, source_sentence(name, asked, source), list(steps.values()), left_out)

    def step(
        self, stage: Stage, config: Any, inputs: dict[str, Path], keys: dict[str, str], raw: str | None = None
    ) -> Step:
        """A stage's step; keys: of its inputs, by role."""
        sections, code = config.sections(stage.sections), self.code.stage(stage.name)
        key = step_key(stage, sections, keys, code, raw)
        return Step(stage.name, key, store.artifact_path(stage.name, key), inputs, sections, code)

    def _probe(self, source: Any) -> tuple[dict[str, bool], list[Path]]:
        """What the source has, and the raw files its capture depends on."""
        if source.kind == "generated":
            return {"poses": True, "depth": True, "labels": True}, []
        from importlib import import_module

        folder = Path(source.path)
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder; correct source.path")
        module = import_module(f"chebsplat.stages.sources.{source.kind}")
        return module.probe(folder), module.files(folder)

    def _hash_projection(self, model: TeacherModel, projection: Any) -> str:
        """Of the model's files, and of the reference images; of no scene's."""
        files = model.files()
        if projection.reference:
            files += reference_files(Path(projection.reference))
        return content_hash(files, None, self.file_memo.values)

    def _hash_teacher(self, model: TeacherModel, teacher: Any) -> str:
        """Of the model's files, and of the file of labels."""
        named = [Path(teacher.labels)] if teacher.labels else []
        return self._hash_files([*model.files(), *named], "teacher.labels")

    def _hash_files(self, files: list[Path], setting: str) -> str:
        for file in files:
            if not file.is_file():
                raise InputError(f"{file} is missing; correct {setting}")
        return content_hash(files, None, self.file_memo.values)
