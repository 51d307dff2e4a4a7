"""What there is before anything runs: names, settings, versions."""

from __future__ import annotations

import sys
from typing import Any

import click

from chebsplat.errors import ConfigError

WIDEST = 36  # characters of a column of ranges
SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


@click.command()
def scenes() -> None:
    """List the scenes, ablations, sequences and studies that have a name, and scenes whose data must be brought."""
    from chebsplat.pipelines.bases import head_names
    from chebsplat.pipelines.scenes import data_of, names
    from chebsplat.pipelines.tables import show_rows

    needed = {name: found for name in names("scenes") if (found := data_of(name))}
    print(f"scenes: {' '.join(name for name in names('scenes') if name not in needed)}")
    print("scenes of data that is no part of chebsplat:")
    there = {
        name: "there" if path.is_dir() else f"missing; set {variable}" for name, (variable, path) in needed.items()
    }
    show_rows([(f"  {name}", str(path), there[name]) for name, (_, path) in needed.items()])
    for kind in ("ablations", "sequences", "studies"):
        print(f"{kind}: {' '.join(names(kind))}")
    print(f"HEADs: {' '.join(head_names()) or 'none'}")


@click.command()
@click.argument("section", required=False)
def settings(section: str | None) -> None:
    """List every setting (of a SECTION, or one section.key): name, default, range, meaning."""
    from chebsplat.formats.names import suggest
    from chebsplat.pipelines.scenes import shown
    from chebsplat.pipelines.tables import show_rows
    from chebsplat.stages.config import Config, known_keys

    asked = section or ""
    chosen = [key for key in known_keys() if not asked or asked in (key, key.partition(".")[0])]
    if not chosen:
        near = suggest(asked, [*Config.model_fields, *known_keys()])
        raise ConfigError(f"no setting or section is called {shown(asked)}; did you mean "
                          f"{', '.join(near or Config.model_fields)}?")  # fmt: skip
    rows = []
    for key in chosen:
        part, _, name = key.partition(".")
        field: Any = Config.model_fields[part].annotation.model_fields[name]  # type: ignore[union-attr]
        values, meaning = range_of(field), field.description or ""
        if len(values) > WIDEST:
            values, meaning = "see right", f"{meaning}; one of {values}"
        rows.append((key, default_of(field.default), values, meaning))
    show_rows([("setting", "default", "range", "meaning"), *rows])


def default_of(value: Any) -> str:
    """A default as `set=` takes it; `-` where there is none."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    words = {None: "-", True: "true", False: "false"}
    return words[value] if value is None or isinstance(value, bool) else str(value)


def range_of(field: Any) -> str:
    """What values a field takes: its choices, or its type and bounds."""
    from typing import Literal, get_args, get_origin

    if get_origin(field.annotation) is Literal:
        return " | ".join(map(str, get_args(field.annotation)))
    if get_origin(field.annotation) is tuple:
        return "list"
    kinds = [kind for kind in get_args(field.annotation) if kind is not type(None)] or [field.annotation]
    kind = get_args(kinds[0])[0] if hasattr(kinds[0], "__metadata__") else kinds[0]
    bound = {name: f"{getattr(one, name):.15g}" for one in field.metadata for name in SIGNS if hasattr(one, name)}
    words = {int: "integer", float: "number", bool: "true | false"}.get(kind, "text")
    if {"ge", "le"} <= bound.keys():
        return f"{words}, {bound['ge']} to {bound['le']}"
    return ", ".join([words, *(f"{SIGNS[name]} {value}" for name, value in bound.items())])


def version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    """Of chebsplat, of the packages that its kernels are compiled with, and the commit of a checkout."""
    if not wanted or context.resilient_parsing:
        return
    from importlib import metadata

    from chebsplat.pipelines.run import HERE, git_state

    state = git_state(HERE)
    commit = f"commit {state['commit'][:10]}{' with changes' if state['dirty'] else ''}, " if state else ""
    packages = ", ".join(f"{name} {metadata.version(name)}" for name in ("torch", "numba"))
    print(f"chebsplat {metadata.version('chebsplat')}, {commit}{packages}, Python {sys.version.split()[0]}")
    context.exit()


VERSION = click.Option(["--version"], is_flag=True, is_eager=True, expose_value=False, callback=version,
                       help="Versions of chebsplat, torch, numba and Python, and exit.")  # fmt: skip
COMMANDS = (scenes, settings)
