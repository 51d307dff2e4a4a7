"""Values of options that several commands take."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from chebsplat.errors import ConfigError


class NewPath(click.ParamType):
    """A file, of one of these suffixes where there are any, or a folder: made, never written over."""

    name = "path"

    def __init__(self, *suffixes: str):
        self.suffixes = suffixes

    def convert(self, value: Any, param: Any, context: click.Context | None) -> Path:
        path = Path(value)
        if self.suffixes and path.suffix.lower() not in self.suffixes:
            raise ConfigError(f"{path}: the result is a {' or '.join(self.suffixes)}; name it so")
        if os.path.lexists(path):
            raise ConfigError(f"{path} exists; remove it, or choose another --out")
        return path


class Phrases(click.ParamType):
    """Words with commas between them, as a list."""

    name = "phrases"

    def convert(self, value: Any, param: Any, context: click.Context | None) -> list[str]:
        return [word.strip() for word in value.split(",") if word.strip()]


AGAINST = click.option(
    "--against",
    type=Phrases(),
    default="",
    help="phrases it is weighed against; default: object,things,stuff,texture",
)
