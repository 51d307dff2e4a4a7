"""The `chebsplat` command: runs, plans, studies, upkeep, uses of a finished scene, every stage."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any, NoReturn

import click

from chebsplat.formats.splats import is_splat
from chebsplat.pipelines.cli import about, knowledge, renders, runs, upkeep, uses
from chebsplat.pipelines.cli.group import VERBOSELY, Guarded, log_to_stderr, say
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.stopping import streams

SECTIONS = {  # of the list of commands; the stages follow
    "Run": ("run", "plan", "study", "status", "scenes", "settings"),
    "Look": ("view", "page", "render"),
    "Ask": ("query", "calibrate"),
    "Take": ("export", "extract", "mesh", "cameras", "label", "lift"),
    "Teach": ("get-teacher", "check-teacher", "teach", "knowledge"),
    "Keep": ("ls", "verify", "rm", "clean-stale"),
}


class Commands(Guarded):
    """Lists stages from their table and imports one when it is called: --help stays instant."""

    def main(self, *arguments: Any, **options: Any) -> Any:
        with streams(say):
            return super().main(*arguments, **options)

    def invoke(self, context: click.Context) -> NoReturn:
        with log_to_stderr(context):
            super().invoke(context)

    def list_commands(self, context: click.Context) -> list[str]:
        return [*(name for name in super().list_commands(context) if name not in STAGES), *STAGES]

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """The list of commands, by what a user wants."""
        stages = {"Stages": tuple(name for name in STAGES if name not in self.commands)}
        for title, names in (SECTIONS | stages).items():
            commands = [(name, self.get_command(context, name)) for name in names]
            width = formatter.width - 20
            rows = [(name, of.get_short_help_str(width)) for name, of in commands if of]
            with formatter.section(title):
                formatter.write_dl(rows, col_max=18)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        # for the listing, which shows a name and a line
        if name in STAGES and name not in self.commands:
            return click.Command(name, help=STAGES[name].help)
        return super().get_command(context, name)

    def resolve_command(self, context: click.Context, args: list[str]) -> Any:
        of_a_file = any(
            word.startswith(("--capture", "--as")) or is_splat(word) for word in args[1:]
        ) or (len(args) > 1 and not args[1].startswith("-"))
        # `lift` is also a command on files, `export` on a finished scene
        if args[0] in STAGES and not (of_a_file and args[0] in self.commands):
            from chebsplat.stages.runtime.command import command

            return args[0], command(args[0], partial(run_stage, args[0])), args[1:]
        return super().resolve_command(context, args)


def run_stage(name: str, job: Any) -> None:
    """Import a stage's module, which brings torch, and run it."""
    import_module(f"chebsplat.stages.{name}").run(job)


@click.group(cls=Commands, params=[about.VERSION, VERBOSELY])
def main() -> None:
    """Semantic 3D Gaussian Splatting that understands shape."""


for _command in (
    *runs.COMMANDS,
    *about.COMMANDS,
    *upkeep.COMMANDS,
    *uses.COMMANDS,
    *renders.COMMANDS,
    *knowledge.COMMANDS,
):
    main.add_command(_command)
