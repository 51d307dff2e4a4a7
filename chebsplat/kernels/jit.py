"""Compilation of kernels by numba: its options, the folder of the cache, and memory to work in.

The folder is named for our kernels' source, so that an edited helper is never served stale. It lies
in the user's cache; CHEBSPLAT_CACHE moves it.
"""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import logging
import os
import pickle
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numba.extending
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

log = logging.getLogger("chebsplat")
EVERY = 10.0  # seconds between two lines on what is being compiled
ROOT = Path(__file__).parents[1]  # of the package
MALLOC_BYTES = {-3: 32 << 20, -1: 64 << 20}  # by malloc.h's M_MMAP_THRESHOLD, M_TRIM_THRESHOLD


def _keep_freed_memory() -> None:
    """Let a step's arrays take the memory that the last step's freed: memory given back to the
    system comes page by page, a third of a small step's time. Of glibc alone; the user's own
    settings stay.
    """
    if any(name in os.environ for name in ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")):
        return
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        for option, size in MALLOC_BYTES.items():
            library.mallopt(option, size)


def _digest() -> str:
    """Of our kernels' source."""
    sources = [path.read_bytes() for path in sorted(ROOT.rglob("*.py"))]
    text = b"".join(
        source for source in sources if b"numba" in source or b"chebsplat.kernels.jit" in source
    )
    return hashlib.sha256(text).hexdigest()[:16]


def _folders() -> list[Path]:
    """Folders for compiled kernels, the best first."""
    name = f"numba-{DIGEST}"
    configured, cache, work = (
        os.environ.get(key) for key in ("CHEBSPLAT_CACHE", "XDG_CACHE_HOME", "CHEBSPLAT_WORK")
    )
    user = Path(cache or Path(os.path.expanduser("~")) / ".cache")
    defaults = [Path(configured or user / "chebsplat") / name] + (
        [Path(work) / ".cache" / name] if work else []
    )
    # numba's own setting: a user's value is left alone
    own = os.environ.get("NUMBA_CACHE_DIR")
    return [
        folder for folder in ([Path(own)] if own else []) + defaults if own or folder.is_absolute()
    ]


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        log.warning(
            "no kernels can be kept in %s (%s); CHEBSPLAT_CACHE names another folder",
            folder,
            error.strerror,
        )
        return False
    return True


_keep_freed_memory()
DIGEST = _digest()
FOLDER = next(filter(_writable, _folders()), None)
settings: Any = numba.config
if FOLDER is None:
    log.warning("kernels are compiled, and not kept")
else:
    settings.CACHE_DIR = str(FOLDER)


class _ByModule(_CacheLocator):
    """Place of a kernel by its module and source, where numba takes the file's path and time:
    another clone of the same source, or one that was moved or checked out again, finds it compiled.
    """

    def __init__(self, module: Path, line: int):
        self.module, self.line = module, line

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _ByModule | None:
        """None for a kernel of another package, which our source's digest does not cover."""
        if FOLDER is None or not Path(file).is_relative_to(ROOT):
            return None
        return cls(Path(file).relative_to(ROOT), function.__code__.co_firstlineno)

    def get_cache_path(self) -> str:
        return str(FOLDER / self.module.parent) if FOLDER is not None else ""

    def get_source_stamp(self) -> str:
        return DIGEST

    def get_disambiguator(self) -> str:
        return str(self.line)


class _KernelFiles(CompileResultCacheImpl):
    _locator_classes = [_ByModule, *CompileResultCacheImpl._locator_classes]  # noqa: RUF012


class _KernelCache(FunctionCache):
    """A kernel's files on disk. A full disk leaves it unsaved; a damaged file is compiled anew."""

    _impl_class = _KernelFiles

    def load_overload(self, signature: Any, context: Any) -> Any:
        try:
            return super().load_overload(signature, context)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            log.warning(
                "a compiled kernel in %s is damaged (%s) and compiled anew", self.cache_path, error
            )
            return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        try:
            # numba numbers files by an index that it reads first: two processes at once would mix
            # their kernels up.
            Path(self.cache_path).mkdir(parents=True, exist_ok=True)
            with open(Path(self.cache_path) / ".lock", "w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                super().save_overload(signature, compiled)
        except OSError as error:
            log.warning("a kernel cannot be kept in %s (%s): it is compiled again next time; "
                        "CHEBSPLAT_CACHE names another folder", self.cache_path,
                        error.strerror)  # fmt: skip


class _CompilationLog(event.Listener):
    """Logs now and then which kernel is compiled: it takes a minute or two for each new version."""

    def __init__(self) -> None:
        self.kernels, self.depth = 0, 0
        self.seconds, self.began, self.last = 0.0, 0.0, -EVERY

    def on_start(self, started: event.Event) -> None:
        now = time.monotonic()
        if self.depth == 0:
            self.began = now
        self.depth += 1
        function = started.data["dispatcher"].py_func
        if function.__module__.startswith("chebsplat") and now - self.last >= EVERY:
            progress = (
                f"{self.kernels} done in {self.spent(now):.0f} s"
                if self.kernels
                else (f"kept in {FOLDER}")
            )
            log.info(
                "compiling kernels: %s of %s (%s)", function.__name__, function.__module__, progress
            )
            self.last = now

    def on_end(self, ended: event.Event) -> None:
        self.depth -= 1
        self.kernels += 1
        if self.depth == 0:
            self.seconds += time.monotonic() - self.began

    def spent(self, now: float) -> float:
        return self.seconds + (now - self.began if self.depth else 0)


compilation = _CompilationLog()
event.register("numba:compile", compilation)


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(error_model="numpy", **options)(function)
        if FOLDER is not None:
            dispatcher._cache = _KernelCache(function)  # as `cache=True` does with numba's own
        return dispatcher

    return decorate


# No fast-math but contraction: NaN and infinity keep their meaning. Not reassociation either, for
# kernels just compiled then differ in the last bit from the same ones read from the cache.
kernel: Any = _compiled(fastmath={"contract", "nsz"}, nogil=True)  # may run in threads
body: Any = _compiled(fastmath={"contract", "nsz"})  # part of a kernel
lanes: Any = _compiled(fastmath={"contract"})  # of explicit vectors and their scalars
serial: Any = _compiled()
plain: Any = numba.extending.register_jitable  # a small function that Python calls, too
