"""The door to numba: its on-disk cache is keyed by our kernels' source, so an edited helper is never served stale."""

from __future__ import annotations

import hashlib
import logging
import os
from pathlib import Path
from typing import Any

import numba

log = logging.getLogger("chebsplat")

_RASTERIZER = ("binning.py", "ellipses.py", "lanes.py", "tiles.py")
_SOURCES = (*(f"rasterize/{name}" for name in _RASTERIZER), "ssim.py", "simd.py", "region_frame.py", "albo_kernel.py",
            "descriptor_kernel.py")  # fmt: skip


def _cache_folder() -> Path:
    root = Path(__file__).parent
    text = b"".join((root / name).read_bytes() for name in _SOURCES)
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "chebsplat" / f"numba-{hashlib.sha256(text).hexdigest()[:16]}"


# A folder that the user has chosen is left alone.
FOLDER = Path(os.environ.get("NUMBA_CACHE_DIR") or _cache_folder())
if not FOLDER.exists():
    log.info("compiling kernels, about 45 s, once")
settings: Any = numba.config
settings.CACHE_DIR = str(FOLDER)
# open3d brings a TBB that numba refuses with a warning: OpenMP comes first.
settings.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]

# No fast-math beyond reassociation and contraction: NaN and infinity keep their meaning.
kernel: Any = numba.njit(cache=True, parallel=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
inline: Any = numba.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"}, inline="always")
# Short loops, compiled by themselves: inside a large kernel the vectoriser gives up on them.
lanes: Any = numba.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
serial: Any = numba.njit(cache=True, error_model="numpy")
prange = numba.prange
