"""Modules of a checkpoint with its weights, if they fit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from chebsplat.formats.gaussians import Gaussians
    from chebsplat.shape.encoder import RegionEncoder


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


def restored_encoder(gaussians: Gaussians) -> RegionEncoder:
    """The local encoder of a checkpoint. Raises InputError if the scene was trained without one."""
    from chebsplat.shape.encoder import RegionEncoder

    return RegionEncoder.restored(*gaussians.encoder())


def without_basis(maps: dict[str, Tensor], bases: dict[str, np.ndarray]) -> tuple[list[str], list[str]]:
    """Names of linear maps [q, p] that have no basis of q rows: of those that read what a scene brings, and of others.

    The width of a token's inputs follows teacher and settings; all other widths are the encoder's own.
    """
    unfit = [name for name, W in maps.items() if name not in bases or len(bases[name]) != len(W)]
    return [n for n in unfit if n.startswith("embed_")], [n for n in unfit if not n.startswith("embed_")]
