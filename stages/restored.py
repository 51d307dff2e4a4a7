"""Modules of a checkpoint with its weights, if they fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from chebsplat.errors import InputError
from chebsplat.formats.manifest import remedy_of

if TYPE_CHECKING:
    from chebsplat.formats.gaussians import Gaussians
    from chebsplat.shape.encoder import RegionEncoder

T = TypeVar("T")


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
