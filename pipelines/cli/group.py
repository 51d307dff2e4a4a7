"""Logging, exit codes and shared options of commands: the log goes to stderr; a command's result is
its exit code; a typed error or a stop becomes a line on stderr and a code.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import click
import numpy as np
from click.shell_completion import CompletionItem

from chebsplat.errors import ConfigError
from chebsplat.pipelines.work import store
from chebsplat.stages.runtime.progress import VERBOSE, log_level
from chebsplat.stages.runtime.stopping import exit_code


def say(text: str) -> None:
    """Print a line of ours to stderr, where that is possible."""
    with suppress(OSError):  # the terminal may be closed, or the log's disk full
        print(f"chebsplat: {text}", file=sys.stderr)


def be_verbose(_context: click.Context, _: click.Parameter, flag: bool) -> None:
    """Show details on the console, of this process and of those that it starts."""
    if flag:
        os.environ[VERBOSE] = "1"


class _Lines(logging.Formatter):
    """Each line begins with the command's name."""

    def __init__(self, context: click.Context):
        super().__init__()
        self.context = context

    def format(self, record: logging.LogRecord) -> str:
        return f"{self.context.invoked_subcommand}: {super().format(record)}"


@contextmanager
def log_to_stderr(context: click.Context) -> Iterator[None]:
    """Send the log to stderr within the block; a stage's command formats it in its own way."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Lines(context))
    logging.getLogger("chebsplat").setLevel(log_level())
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)


class Guarded(click.Group):
    """A group whose commands return an exit code (nothing: 0) and may raise typed errors."""

    def invoke(self, context: click.Context) -> NoReturn:
        gone = (BrokenPipeError,)  # stdout's reader has gone: click ends silently
        context.exit(exit_code(partial(super().invoke, context), store.work(), say, gone))

    def list_commands(self, context: click.Context) -> list[str]:
        """In the order in which they were added."""
        return list(self.commands)


class NewPath(click.ParamType):
    """A file (of one of these suffixes, if any) or a folder to make; it must not exist yet."""

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


class Known(click.ParamType):
    """Text that a shell completes by names, or as a path where none fits.

    kinds: of `pipelines.work.scenes.names`, or `finished`: of scenes in the work folder.
    """

    name = "text"

    def __init__(self, *kinds: str):
        self.kinds = kinds

    def shell_complete(
        self, context: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        from chebsplat.pipelines.work import finished, scenes

        lists = [finished.titles() if k == "finished" else scenes.names(k) for k in self.kinds]
        items = [CompletionItem(name) for some in lists for name in some]
        fitting = [item for item in items if item.value.startswith(incomplete)]
        return fitting or [CompletionItem(incomplete, type="file")]


class Upward(click.ParamType):
    """x, y or z with a sign, or three numbers, as a unit vector [3]; `auto` as it is."""

    name = "up"

    def convert(self, value: Any, param: Any, context: click.Context | None) -> Any:
        if not isinstance(value, str) or value == "auto":
            return value
        sign, axis = ("", value) if value[:1] not in ("+", "-") else (value[0], value[1:])
        try:
            vector = np.array([float(part) for part in value.split(",")])
        except ValueError:
            vector = np.eye(3)["xyz".index(axis)] if axis in ("x", "y", "z") else np.zeros(0)
            vector = -vector if sign == "-" else vector
        length = np.linalg.norm(vector)
        if vector.shape != (3,) or not 0 < length < np.inf:
            raise ConfigError(
                f"--up {value}: x, y or z with a sign, three numbers such as 0,0,1, "
                "or auto is needed"
            )
        return vector / length


class Phrases(click.ParamType):
    """Words with commas between them, as a list."""

    name = "phrases"

    def convert(self, value: Any, param: Any, context: click.Context | None) -> list[str]:
        return [word.strip() for word in value.split(",") if word.strip()]


VERBOSELY = click.Option(
    ["-v", "--verbose"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=be_verbose,
    help="Say what a scene leaves out, and other details.",
)
SCENE = click.argument("scene", type=Known("finished"))
UP = click.option(
    "--up",
    type=Upward(),
    help="against gravity: x, -y, three numbers with commas, or auto (by the cameras, else by the "
    "floor)",
)
AGAINST = click.option(
    "--against",
    type=Phrases(),
    default="",
    help="phrases to compare with; default: object,things,stuff,texture",
)
