"""A config: the settings of every stage together, read from a file or from values, and checked."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError

from chebsplat.errors import ChebsplatError, ConfigError
from chebsplat.formats.files import parse_json, parse_toml
from chebsplat.formats.names import suggest
from chebsplat.settings import DescribeSection, Section, TrainSection
from chebsplat.stages import settings as parts

Model = TypeVar("Model", bound=BaseModel)
WORDS = {  # pydantic's kinds of error, in a user's words
    "int_type": "a whole number is needed",
    "float_type": "a number is needed",
    "finite_number": "a finite number is needed",
    "bool_type": "true or false is needed",
    "string_type": "text is needed",
    "model_type": "a table of settings is needed",
    "dict_type": "a table is needed",
    "list_type": "a list is needed",
    "tuple_type": "a list is needed",
    "too_short": "at least one is needed",
}


class Config(Section):
    scene: parts.SceneSection = parts.SceneSection()
    source: parts.SourceSection = parts.SourceSection()
    # made when a config is: its default reads a protocol
    ingest: parts.IngestSection = Field(default_factory=parts.IngestSection)
    pose: parts.PoseSection = parts.PoseSection()
    sfm: parts.SfmSection = parts.SfmSection()
    channels: parts.ChannelsSection = parts.ChannelsSection()
    teacher: parts.TeacherSection = parts.TeacherSection()
    describe: DescribeSection = DescribeSection()
    train: TrainSection = TrainSection()
    agree: parts.AgreeSection = parts.AgreeSection()
    lift: parts.LiftSection = parts.LiftSection()
    refine: parts.RefineSection = parts.RefineSection()
    knowledge: parts.KnowledgeSection = parts.KnowledgeSection()
    learn: parts.LearnSection = parts.LearnSection()
    teach: parts.TeachSection = parts.TeachSection()
    evaluate: parts.EvaluateSection = parts.EvaluateSection()

    def sections(self, names: tuple[str, ...]) -> dict[str, Any]:
        """The named sections as plain JSON-able values."""
        return {name: getattr(self, name).model_dump(mode="json") for name in names}


def load(path: Path) -> Config:
    """A config from a TOML or JSON file; absent sections have defaults. Raises ConfigError."""
    parse = parse_json if Path(path).suffix == ".json" else parse_toml
    return build(parse(path, "correct it, or pass another --config", ConfigError), str(path))


def build(values: dict[str, Any], origin: str) -> Config:
    """A checked config. Raises ConfigError naming the first bad key and the nearest valid one."""
    return checked(Config, values, origin)


def checked(
    model: type[Model], values: Any, origin: str, error: type[ChebsplatError] = ConfigError
) -> Model:
    """A pydantic model of these values. Raises `error`: one line about the first bad key."""
    try:
        return model.model_validate(values)
    except ValidationError as faults:
        fault = faults.errors()[0]
        where = ".".join(_printable(part) for part in fault["loc"])
        raise error(
            f"{origin}: {where}{': ' if where else ''}{_advice(fault, list(model.model_fields))}"
        ) from None


def known_keys() -> list[str]:
    """Every setting as `section.key`."""
    return [
        f"{name}.{key}"
        for name, section in Config.model_fields.items()
        for key in section.annotation.model_fields  # type: ignore[union-attr]
    ]


def _printable(part: Any) -> str:
    """Part of a key, quoted and cut where a message of one line needs it."""
    return str(part) if re.fullmatch(r"[\w.-]{1,60}", str(part)) else repr(str(part)[:60])


def _advice(error: Any, first: list[str]) -> str:
    if error["type"] == "value_error":
        return str(error["ctx"]["error"])
    if error["type"] != "extra_forbidden":
        needed = WORDS.get(error["type"]) or error["msg"].replace("Input should be", "it must be")
        value = error["input"]
        got = (
            f"a {type(value).__name__}"
            if isinstance(value, (dict, list, tuple))
            else f"{value!r:.60}"
        )
        return f"{needed} (got {got})"
    loc = [str(part) for part in error["loc"]]
    if len(loc) == 1:
        near = suggest(loc[0], first, 1)
        # a section of another name, perhaps an earlier one
        if not near and isinstance(error["input"], dict):
            near = [
                key for child in error["input"] for key in known_keys() if key.endswith(f".{child}")
            ]
    else:
        elsewhere = [key for key in known_keys() if key.endswith("." + loc[-1])]
        own = [key.split(".")[1] for key in known_keys() if key.startswith(loc[0] + ".")]
        near = elsewhere or [f"{loc[0]}.{key}" for key in suggest(loc[-1], own, 1)]
    return "no such key" + (f"; did you mean {near[0]}?" if near else "")
