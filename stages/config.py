"""A config: the settings of every stage together, read from a file or from values, and checked."""

from __future__ import annotations

import difflib
import json
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from chebsplat.errors import ConfigError
from chebsplat.stages.settings import (
    CksSection,
    DescribeSection,
    EvaluateSection,
    ExportSection,
    IngestSection,
    OnnxSection,
    ProjectionSection,
    ReportSection,
    SceneSection,
    Section,
    SfmSection,
    SourceSection,
    TeacherSection,
    TrainSection,
)


class Config(Section):
    scene: SceneSection = SceneSection()
    source: SourceSection = SourceSection()
    ingest: IngestSection = IngestSection()
    sfm: SfmSection = SfmSection()
    projection: ProjectionSection = ProjectionSection()
    teacher: TeacherSection = TeacherSection()
    describe: DescribeSection = DescribeSection()
    train: TrainSection = TrainSection()
    export: ExportSection = ExportSection()
    onnx: OnnxSection = OnnxSection()
    cks: CksSection = CksSection()
    evaluate: EvaluateSection = EvaluateSection()
    report: ReportSection = ReportSection()

    def sections(self, names: tuple[str, ...]) -> dict[str, Any]:
        """The named sections as plain JSON-able values."""
        return {name: getattr(self, name).model_dump(mode="json") for name in names}


def load(path: Path) -> Config:
    """A config from a TOML or JSON file; sections that are not given keep their defaults."""
    try:
        text = Path(path).read_text()
        values = json.loads(text) if Path(path).suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; pass --config with a TOML file") from None
    except ValueError as error:
        raise ConfigError(f"{path} does not parse: {error}") from None
    return build(values, str(path))


def build(values: dict[str, Any], origin: str) -> Config:
    """A checked config. Raises ConfigError naming the first bad key, with the nearest known name."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{origin}: {where}: {_advice(first)}") from None


def known_keys() -> list[str]:
    return [f"{s}.{k}" for s, f in Config.model_fields.items() for k in f.annotation.model_fields]  # type: ignore[union-attr]


def _advice(error: Any) -> str:
    if error["type"] != "extra_forbidden":
        return f"{error['msg']} (got {error['input']!r})"
    loc = [str(part) for part in error["loc"]]
    if len(loc) == 1:
        near = difflib.get_close_matches(loc[0], list(Config.model_fields), 1)
    else:
        elsewhere = [key for key in known_keys() if key.endswith("." + loc[-1])]
        own = [key.split(".")[1] for key in known_keys() if key.startswith(loc[0] + ".")]
        near = elsewhere or [f"{loc[0]}.{key}" for key in difflib.get_close_matches(loc[-1], own, 1)]
    return "no such key" + (f"; did you mean {near[0]}?" if near else "")
