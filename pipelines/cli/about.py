"""Commands that need no run: names, settings, versions."""

from __future__ import annotations

import json
import sys
from importlib import metadata
from typing import Any

import click

from chebsplat.errors import ConfigError

WIDEST = 36  # characters of the column of ranges


@click.command()
def scenes() -> None:
    """List named scenes, ablations, sequences and studies, and scenes whose data is missing."""
    from chebsplat.pipelines.work.scenes import data_of, names
    from chebsplat.pipelines.work.summary import show_rows

    needed = {name: location for name in names("scenes") if (location := data_of(name))}
    print(f"scenes: {' '.join(name for name in names('scenes') if name not in needed)}")
    print("scenes of data that is no part of chebsplat:")
    there = {
        name: "there" if path.is_dir() else f"missing; set {variable}"
        for name, (variable, path) in needed.items()
    }
    show_rows([(f"  {name}", str(path), there[name]) for name, (_, path) in needed.items()])
    for kind in ("ablations", "sequences", "studies"):
        print(f"{kind}: {' '.join(names(kind))}")


@click.command()
@click.argument("section", required=False)
def settings(section: str | None) -> None:
    """List every setting (of a SECTION, or one section.key): name, default, range, meaning."""
    from chebsplat.formats.names import suggest
    from chebsplat.pipelines.work.scenes import escape_text
    from chebsplat.pipelines.work.summary import show_rows
    from chebsplat.stages.runtime.config import Config, known_keys

    query = section or ""
    keys = [key for key in known_keys() if not query or query in (key, key.partition(".")[0])]
    if not keys:
        near = suggest(query, [*Config.model_fields, *known_keys()])
        raise ConfigError(f"no setting or section is called {escape_text(query)}; did you mean "
                          f"{', '.join(near or Config.model_fields)}?")  # fmt: skip
    rows, schema = [], Config.model_json_schema()
    for key in keys:
        part, _, name = key.partition(".")
        section_of: Any = Config.model_fields[part].annotation
        field = schema["$defs"][section_of.__name__]["properties"][name]
        values, meaning, default = range_of(field), field["description"], field.get("default")
        if len(values) > WIDEST:
            values, meaning = "see right", f"{meaning}; one of {values}"
        default_text = (
            "-" if default is None else default if isinstance(default, str) else json.dumps(default)
        )
        rows.append((key, default_text, values, meaning))
    show_rows([("setting", "default", "range", "meaning"), *rows])


def range_of(field: dict[str, Any]) -> str:
    """Values that a field takes, by its JSON schema: its choices, or its type and bounds."""
    kind = field.get("anyOf", [field])[0]
    if "enum" in kind:
        return " | ".join(kind["enum"])
    called = {"boolean": "true | false", "array": "list", "object": "table", "string": "text"}
    words: str = called.get(kind["type"], kind["type"])
    return words + (
        f", {kind['minimum']:.15g} to {kind['maximum']:.15g}" if "minimum" in kind else ""
    )


def version(context: click.Context, _: click.Parameter, flag: bool) -> None:
    """Print versions of chebsplat and of its compilers' packages, and the commit of a checkout."""
    if not flag or context.resilient_parsing:
        return

    from chebsplat.pipelines.running.run import HERE, git_state

    state = git_state(HERE)
    commit = (
        f"commit {state['commit'][:10]}{' with changes' if state['dirty'] else ''}, "
        if state
        else ""
    )
    packages = ", ".join(f"{name} {metadata.version(name)}" for name in ("torch", "numba"))
    print(
        f"chebsplat {metadata.version('chebsplat')}, {commit}{packages}, Python "
        f"{sys.version.split()[0]}"
    )
    context.exit()


VERSION = click.Option(
    ["--version"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=version,
    help="Versions of chebsplat, torch, numba and Python, and exit.",
)
COMMANDS = (scenes, settings)
