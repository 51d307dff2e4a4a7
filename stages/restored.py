"""Modules of a checkpoint with its weights, if they fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from chebsplat.errors import InputError
from chebsplat.formats.manifest import remedy_of

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from chebsplat.formats.gaussians import Gaussians
    from chebsplat.shape.encoder import RegionEncoder

T = TypeVar("T")


def trained_with(path: Path) -> dict[str, Any]:
    """The sections `describe` and `train` that the checkpoint was made with. Raises InputError if it names none."""
    from chebsplat.formats.artifact import read_manifest
    from chebsplat.settings import DescribeSection, TrainSection
    from chebsplat.stages.config import checked

    config, file = read_manifest(path).config, path / "artifact.json"
    if not {"describe", "train"} <= set(config):
        raise InputError(f"{file} does not say how the scene was trained; train it again")
    return {
        "describe": checked(DescribeSection, config["describe"], f"{file}: describe", InputError).model_dump(),
        "train": checked(TrainSection, config["train"], f"{file}: train", InputError).model_dump(),
    }


def restored_encoder(path: Path, gaussians: Gaussians) -> RegionEncoder:
    """Raises: InputError if the checkpoint at `path` has no encoder, or weights of another one."""
    from chebsplat.shape.encoder import RegionEncoder

    settings, weights = gaussians.encoder()
    return fitting(path, lambda: RegionEncoder.restored(settings, weights))


def fitting(path: Path, build: Callable[[], T]) -> T:
    """What `build` makes of the weights of the checkpoint at `path`. Raises InputError if they do not fit."""
    try:
        return build()
    except (RuntimeError, ValueError, TypeError) as error:  # torch's, of names, shapes and dtypes
        line = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path / 'modules.safetensors'} does not fit notes.json ({line}); {remedy_of(path)}"
        ) from None


def without_basis(maps: dict[str, Tensor], bases: dict[str, np.ndarray]) -> tuple[list[str], list[str]]:
    """Names of linear maps [q, p] that have no basis of q rows: of those that read what a scene brings, and of others.

    The width of a token's inputs follows teacher and settings; all other widths are the encoder's own.
    """
    unfit = [name for name, W in maps.items() if name not in bases or len(bases[name]) != len(W)]
    return [n for n in unfit if n.startswith("embed_")], [n for n in unfit if not n.startswith("embed_")]
