"""Logging and exit codes of commands: the log goes to stderr; what a command returns is its exit code; a typed
error or a stop becomes a line on stderr and a code.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import NoReturn

import click

from chebsplat.pipelines.work import store
from chebsplat.stages.runtime.stopping import exit_code


def say(text: str) -> None:
    """Print a line of ours to stderr, where that is possible."""
    with suppress(OSError):  # the terminal may be gone, and the disk of a log full
        print(f"chebsplat: {text}", file=sys.stderr)


class _Lines(logging.Formatter):
    """Each line begins with the command's name."""

    def __init__(self, context: click.Context):
        super().__init__()
        self.context = context

    def format(self, record: logging.LogRecord) -> str:
        return f"{self.context.invoked_subcommand}: {super().format(record)}"


@contextmanager
def logged(context: click.Context) -> Iterator[None]:
    """Send the log to stderr within; a stage that is run there says it in its own way from then on."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Lines(context))
    logging.getLogger("chebsplat").setLevel("INFO")
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)


class Guarded(click.Group):
    """A group whose commands return an exit code (nothing: 0) and may raise typed errors."""

    def invoke(self, context: click.Context) -> NoReturn:
        gone = (BrokenPipeError,)  # whoever read stdout: click ends without a word
        context.exit(exit_code(partial(super().invoke, context), store.work(), say, gone))

    def list_commands(self, context: click.Context) -> list[str]:
        """In the order in which they were added."""
        return list(self.commands)
