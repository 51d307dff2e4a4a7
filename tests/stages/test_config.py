"""A configuration is checked whole, and a misspelt key suggests the nearest name."""

import ast
import json
import re
import tomllib
from collections import Counter
from typing import get_args

import pytest
from shared import ROOT

from chebsplat.errors import ConfigError
from chebsplat.pipelines.planning.plan import OFF_IS_CHOICE
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime import config

SETTINGS = {
    f"{section}.{key}": setting
    for section, field in config.Config.model_fields.items()
    for key, setting in field.annotation.model_fields.items()
}


def test_json_and_toml_give_the_same_config(tmp_path):
    (tmp_path / "a.toml").write_text("[train]\nsteps = 7\n")
    (tmp_path / "a.json").write_text(json.dumps({"train": {"steps": 7}}))
    for name in ("a.toml", "a.json"):
        assert config.load(tmp_path / name) == config.build({"train": {"steps": 7}}, name)


def test_every_stage_reads_known_sections_and_known_stages():
    for stage in STAGES.values():
        config.Config().sections(stage.sections)
        assert set(stage.roles.values()) <= set(STAGES)


def test_every_setting_says_what_it_means():
    assert [name for name, setting in SETTINGS.items() if not setting.description] == []


def test_a_setting_has_a_lower_and_an_upper_bound():
    for name, setting in SETTINGS.items():
        if setting.annotation in (int, float, int | None, float | None):
            assert {"Ge", "Le"} <= {type(rule).__name__ for rule in setting.metadata}, name


def settings_of(values):
    """Every `section.key` of nested tables, whatever they lie in."""
    tables = {name: table for name, table in values.items() if isinstance(table, dict)}
    own = {f"{name}.{key}" for name, table in tables.items() for key in table}
    return own.union(*map(settings_of, tables.values()))


def names_in(source):
    """Every `section.key` of tables in tables of Python code; names of keys and keywords alone."""
    whole, alone = set(), set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            alone |= {keyword.arg for keyword in node.keywords}
        elif isinstance(node, ast.Dict):
            for name, value in zip(node.keys, node.values, strict=True):
                if isinstance(name, ast.Constant):
                    alone.add(name.value)
                    tables = [inner for inner in ast.walk(value) if isinstance(inner, ast.Dict)]
                    keys = [key for table in tables for key in table.keys]
                    keys = [key.value for key in keys if isinstance(key, ast.Constant)]
                    whole |= {f"{name.value}.{key}" for key in keys}
    return whole, alone


def test_there_are_at_most_150_settings_and_something_names_each():
    """One that no config, study, doc, test or benchmark names has no use that anyone knows of.

    It is named with its section; by its key alone in code, too, if no other section has that key.
    """
    settings = config.known_keys()
    assert len(settings) <= 150
    pages = [*ROOT.glob("docs/*.md"), ROOT / "README.md"]
    configs = list(ROOT.glob("pipelines/configs/*/*.toml"))
    code = [path for folder in ("tests", "benchmarks") for path in ROOT.glob(f"{folder}/**/*.py")]
    named, alone = set(), set()
    for path in (*pages, *configs, *code):
        named |= set(re.findall(r"\w+\.\w+", path.read_text()))
    for path in configs:
        named |= settings_of(tomllib.loads(path.read_text()))
    for path in code:
        whole, keys = names_in(path.read_text())
        named, alone = named | whole, alone | keys
    times = Counter(setting.split(".")[1] for setting in settings)
    alone = {key for key in alone if times[key] == 1}
    unknown = [name for name in settings if name not in named]
    assert [name for name in unknown if name.split(".")[1] not in alone] == []


@pytest.mark.parametrize("value", [True, 1.0, "5", float("nan"), float("inf"), 10**400, [5]])
def test_types_are_strict_and_no_number_is_infinite(value):
    with pytest.raises(ConfigError, match=r"x\.toml: train\.steps: "):
        config.build({"train": {"steps": value}}, "x.toml")


def test_a_message_is_one_short_line():
    for values in (
        {"train": dict.fromkeys(map(str, range(10_000)), 1)},
        {"train": [0] * 10_000},
        {"a\nb" * 999: 1},
    ):
        with pytest.raises(ConfigError) as error:
            config.build(values, "x.toml")
        assert len(str(error.value)) < 300 and "\n" not in str(error.value)


def test_off_is_text_wherever_it_is_a_choice():
    choices = {name for name, setting in SETTINGS.items() if "off" in get_args(setting.annotation)}
    assert choices == set(OFF_IS_CHOICE)
