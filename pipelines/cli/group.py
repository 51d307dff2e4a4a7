"""How a command leaves: its return is the exit code; a typed error or a stop becomes a line on stderr and a code."""

from __future__ import annotations

import sys
from contextlib import suppress
from functools import partial
from typing import NoReturn

import click

from chebsplat.pipelines import store
from chebsplat.stages.stopping import exit_code


def say(text: str) -> None:
    """Print a line of ours to stderr, where that is possible."""
    with suppress(OSError):  # the terminal may be gone, and the disk of a log full
        print(f"chebsplat: {text}", file=sys.stderr)


class Guarded(click.Group):
    """A group whose commands return an exit code (nothing: 0) and may raise typed errors."""

    def invoke(self, context: click.Context) -> NoReturn:
        context.exit(exit_code(partial(super().invoke, context), store.work(), say))

    def list_commands(self, context: click.Context) -> list[str]:
        """In the order in which they were added."""
        return list(self.commands)
