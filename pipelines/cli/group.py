"""How a command leaves: what it returns is its exit code, and typed errors become a line on stderr and theirs."""

from __future__ import annotations

import sys
from typing import NoReturn

import click

from chebsplat.errors import ChebsplatError


class Guarded(click.Group):
    """A group whose commands return an exit code (nothing: 0) and may raise typed errors."""

    def invoke(self, context: click.Context) -> NoReturn:
        try:
            code = super().invoke(context)
        except ChebsplatError as error:
            print(f"chebsplat: {error}", file=sys.stderr)
            code = error.exit_code
        context.exit(code or 0)

    def list_commands(self, context: click.Context) -> list[str]:
        """In the order in which they were added."""
        return list(self.commands)
