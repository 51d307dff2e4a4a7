"""Identity of a step: one digest of all that its result depends on, its code included.

The hash of the code behind a stage covers the syntax trees, without comments and docstrings, of the
stage's module and of every module of ours it imports, however deep, the templates of pages beside
them, and the versions of the packages these import. Runtime code that cannot change a result is
left out, so that a better progress bar makes nothing stale.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import chebsplat
from chebsplat.stages.registry import Stage

PACKAGE = Path(chebsplat.__file__).parent
PLUMBING = tuple(
    f"chebsplat.{name}."
    for name in ("settings", "stages.settings", "stages.registry", "stages.runtime")
)
TEMPLATES = {".html", ".css", ".js"}  # templates that a package's modules fill
# of extras: part of the key where a scene uses them
OPTIONAL = {"av", "gsplat", "pillow_heif", "tokenizers", "transformers"}
# Settings that are paths of raw files: their content is hashed in place of the path.
PLACES = (
    ("source", "path"),
    ("ingest", "volumes"),
    ("channels", "model"),
    ("channels", "reference"),
    ("teacher", "model"),
    ("teacher", "labels"),
    ("train", "start"),
    ("learn", "points"),
    ("teach", "model"),
    ("evaluate", "lpips_weights"),
)


class Code:
    """Hashes the modules of ours below `package`, the folder of `chebsplat`. `memo` maps a path to
    the digest and imports of its file at a (mtime, size); the caller saves it, so that an unchanged
    file is not parsed again.
    """

    def __init__(self, package: Path, memo: dict[str, list]):
        self.package, self.memo = package, memo
        self.read_now = 0  # files parsed in this process
        self._versions: dict[str, str | None] = {}
        self._stages: dict[tuple[str, ...], dict[str, Any]] = {}

    def stage(
        self, name: str, used: tuple[str, ...] = (), modules_used: tuple[str, ...] = ()
    ) -> dict[str, Any]:
        """{"hash": ..., "packages": {name: version}} of stage `name`; computed once by this object.

        Args: used: packages of extras that the configuration uses; others of OPTIONAL are no part
          of the identity. modules_used: those of ours that the configuration chooses, which no
          import names.
        """
        modules = (f"chebsplat.stages.{name}", *modules_used)
        if modules not in self._stages:
            self._stages[modules] = self._identity(modules)
        identity = self._stages[modules]
        return identity | {"packages": identity["packages"] | self._versions_of(used)}

    def _identity(self, modules: tuple[str, ...]) -> dict[str, Any]:
        digests: dict[str, str] = {}
        packages: set[str] = set()
        queue = list(modules)
        while queue:
            module = queue.pop()
            path = self._path(module)
            if module in digests or f"{module}.".startswith(PLUMBING) or path is None:
                continue
            digest, imports = self._read(path)
            digests[module] = digest
            if path.name == "__init__.py":
                templates = (
                    file for file in sorted(path.parent.iterdir()) if file.suffix in TEMPLATES
                )
                digests |= {f"{module}/{file.name}": self._read(file)[0] for file in templates}
            for imported in imports:
                first = imported.partition(".")[0]
                if first == "chebsplat":
                    queue += self._modules(imported)
                elif first not in sys.stdlib_module_names:
                    packages.add(first)
        text = "\n".join(f"{module} {digest}" for module, digest in sorted(digests.items()))
        versions = self._versions_of(packages - OPTIONAL)
        return {"hash": hashlib.sha256(text.encode()).hexdigest()[:16], "packages": versions}

    def _versions_of(self, packages: Iterable[str]) -> dict[str, str]:
        return {name: version for name in sorted(packages) if (version := self._version(name))}

    def _modules(self, dotted: str) -> list[str]:
        """Modules that `import <dotted>` runs: the packages on the way, and the module itself."""
        parts = dotted.split(".")
        modules = (".".join(parts[:n]) for n in range(1, len(parts) + 1))
        return [module for module in modules if self._path(module) is not None]

    def _path(self, module: str) -> Path | None:
        path = self.package.joinpath(*module.split(".")[1:])
        for candidate in (path.with_name(path.name + ".py"), path / "__init__.py"):
            if candidate.is_file():
                return candidate
        return None

    def _read(self, path: Path) -> tuple[str, list[str]]:
        state, key = path.stat(), str(path)
        stamp = [state.st_mtime_ns, state.st_size]
        entry = self.memo.get(key)
        if entry is None or not _remembers(entry, stamp):
            self.read_now += 1
            entry = self.memo[key] = [stamp, *parsed(path.read_text(encoding="utf-8"), key)]
        return entry[1], entry[2]

    def _version(self, package: str) -> str | None:
        if package not in self._versions:
            try:
                name = {"PIL": "pillow", "open3d": "open3d-cpu"}.get(package, package)
                self._versions[package] = metadata.version(name)
            except metadata.PackageNotFoundError:
                self._versions[package] = None
        return self._versions[package]


def _remembers(entry: Any, stamp: list[int]) -> bool:
    """True for a well-formed entry of the memo, a file that may be damaged, with this stamp."""
    if not (
        isinstance(entry, list)
        and len(entry) == 3
        and entry[0] == stamp
        and isinstance(entry[1], str)
    ):
        return False
    return isinstance(entry[2], list) and all(isinstance(name, str) for name in entry[2])


def parsed(text: str, name: str) -> tuple[str, list[str]]:
    """Digest of a module's syntax tree without docstrings, and its imports; or of a template."""
    if not name.endswith(".py"):
        return hashlib.sha256(text.encode()).hexdigest()[:16], []
    tree = ast.parse(text, name)
    imports: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            imports |= {f"{node.module}.{alias.name}" for alias in node.names}
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                node.body = node.body[1:] or [ast.Pass()]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:16], sorted(imports)


def step_key(
    stage: Stage,
    sections: dict[str, Any],
    inputs: dict[str, str],
    code: dict[str, Any],
    raw: str | None = None,
    device: str = "cpu",
) -> str:
    """Key of a stage's artifact, 16 hex digits.

    Args: sections: the config that the stage reads; inputs: keys of artifacts by role; code: of
      `Code.stage`; raw: `raw.content_hash` of the files outside the store that the stage reads;
      device: that computes it. The CPU's keys do not name it.
    """
    identity = {
        "stage": stage.name,
        "schema": stage.schema,
        "config": without_paths(sections),
        "inputs": inputs,
        "code": code,
    } | ({} if raw is None else {"raw": raw})
    if device != "cpu":
        identity["device"] = device
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def without_paths(sections: dict[str, Any]) -> dict[str, Any]:
    """Sections that name raw files by their last part only."""
    named = {name: dict(section) for name, section in sections.items()}
    for section, key in PLACES:
        if named.get(section, {}).get(key):
            named[section][key] = Path(named[section][key]).name
    return named
