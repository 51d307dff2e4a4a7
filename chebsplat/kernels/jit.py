"""The door to numba: its on-disk cache is keyed by our kernels' source, so an edited helper is never served stale."""

from __future__ import annotations

import hashlib
import logging
import os
from pathlib import Path
from typing import Any

import numba

log = logging.getLogger("chebsplat")


def _cache_folder() -> Path:
    root = Path(__file__).parents[1]
    sources = [path.read_bytes() for path in sorted(root.rglob("*.py"))]
    text = b"".join(source for source in sources if b"numba" in source or b"chebsplat.kernels.jit" in source)
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "chebsplat" / f"numba-{hashlib.sha256(text).hexdigest()[:16]}"


# A folder that the user has chosen is left alone.
FOLDER = Path(os.environ.get("NUMBA_CACHE_DIR") or _cache_folder())
if not FOLDER.exists():
    log.info("compiling kernels, about 60 s, once")
settings: Any = numba.config
settings.CACHE_DIR = str(FOLDER)
# open3d brings a TBB that numba refuses with a warning: OpenMP comes first.
settings.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]

# No fast-math but contraction: NaN and infinity keep their meaning. Not reassociation either, for kernels just compiled
# then differ in the last bit from the same ones read from the cache.
kernel: Any = numba.njit(cache=True, parallel=True, error_model="numpy", fastmath={"contract", "nsz"})
inline: Any = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"}, inline="always")
# Of explicit vectors and their scalars.
lanes: Any = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
serial: Any = numba.njit(cache=True, error_model="numpy")
prange = numba.prange
