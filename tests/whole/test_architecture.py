"""Imports run one way: {pipelines, teachers} -> stages -> {chebsplat, formats}."""

import ast
import json
import os
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LAYERS = ("chebsplat", "formats", "stages", "pipelines", "teachers")
MAY_IMPORT = {
    "chebsplat": {"chebsplat"},
    "formats": {"formats"},
    "stages": {"stages", "chebsplat", "formats"},
    "pipelines": {"pipelines", "stages", "chebsplat", "formats"},
    "teachers": {"teachers", "stages", "chebsplat", "formats"},
}
# Packages of chebsplat/ in their order: each may import those before it that it names, and errors.
PACKAGES = {
    "kernels": set(),
    "cameras": set(),
    "settings": set(),
    "synthetic": {"cameras"},
    "labels": set(),
    "photos": {"cameras", "kernels"},
    "splats": {"kernels"},
    "printed": set(),  # the paper in plain torch: nothing of ours
    "views": set(),
    "rasterize": {"kernels", "splats"},
    "render": {"kernels", "rasterize", "splats", "views"},
    "shape": {"cameras", "kernels", "settings", "splats"},
    "lifting": {"cameras", "kernels", "labels", "rasterize", "render", "splats", "views"},
    "evaluation": {"labels", "splats"},
    "training": {
        "cameras",
        "evaluation",
        "kernels",
        "printed",
        "rasterize",
        "settings",
        "shape",
        "splats",
        "views",
    },
}
SOURCES = [p for layer in LAYERS for p in sorted((ROOT / layer).rglob("*.py"))]


def imported_modules(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_imports_run_one_way(path):
    layer = path.relative_to(ROOT).parts[0]
    for name in imported_modules(path):
        first, _, rest = name.partition(".")
        assert first not in LAYERS[1:], f"{path}: bare import of {name}"
        if first == "chebsplat" and not rest.startswith("errors"):
            target = rest.split(".")[0]
            target = target if target in LAYERS[1:] else "chebsplat"
            assert target in MAY_IMPORT[layer], f"{path}: {layer} must not import {name}"


def test_packages_of_the_maths_import_one_another_one_way():
    order = list(PACKAGES)
    assert all(
        order.index(below) < order.index(name)
        for name, allowed in PACKAGES.items()
        for below in allowed
    )
    folder = ROOT / "chebsplat"
    assert len(list(folder.glob("*.py"))) <= 6
    found = {}
    for path in folder.rglob("*.py"):
        own = path.relative_to(folder).with_suffix("").parts[0]
        names = [
            name.split(".") for name in imported_modules(path) if name.startswith("chebsplat.")
        ]
        found.setdefault(own, set()).update(
            parts[1] for parts in names if parts[1] not in (own, "errors")
        )
    found = {own: imported for own, imported in found.items() if own not in ("__init__", "errors")}
    assert found == PACKAGES


def test_the_printed_method_stays_short_enough_to_be_read_beside_the_paper():
    assert (
        sum(
            len(path.read_text().splitlines()) for path in (ROOT / "chebsplat/printed").glob("*.py")
        )
        <= 1100
    )


# Rooms of stages/ and pipelines/: each imports those before it that it names. A single module is
# named by its file; stages import any but tools.
ROOMS = {
    "stages": {
        "registry": set(),
        "settings": set(),
        "runtime": {"registry", "settings"},
        "measuring": set(),
        "pages": set(),
        "sources": {"runtime", "settings"},
        "reconstruction": {"runtime", "settings", "sources"},
        "training": {"runtime", "settings"},
        "teacher_models": set(),
        "shape_models": {"reconstruction", "settings", "sources", "teacher_models"},
        "tools": {
            "pages",
            "runtime",
            "settings",
            "shape_models",
            "sources",
            "teacher_models",
            "training",
        },
    },
    "pipelines": {
        "work": set(),
        "planning": {"work"},
        "running": {"planning", "work"},
        "studies": {"planning", "running", "work"},
        "selection": {"planning", "work"},
        "api": {"running", "selection", "work"},
        "cli": {"api", "planning", "running", "selection", "studies", "work"},
    },
}
STAGE_MODULES = {path.stem for path in (ROOT / "stages").glob("*.py")} - {
    "__init__",
    *ROOMS["stages"],
}
ALSO_STAGES = {"tools"}  # commands on finished scenes run stages


def module_of(path):
    """Dotted name of a module of ours."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[:-1] if parts[-1] == "__init__" else parts
    return ".".join(parts if parts[0] == "chebsplat" else ("chebsplat", *parts))


MODULES = {module_of(path): path for path in SOURCES}


def imported_by(path):
    """Modules of ours that a module imports, at its top or inside a function."""
    names = set(imported_modules(path))
    found = {
        name if name in MODULES else name.rpartition(".")[0]
        for name in names
        if name.startswith("chebsplat.")
    }
    return (found & MODULES.keys()) - {module_of(path)}


@pytest.mark.parametrize("layer", ROOMS)
def test_rooms_import_exactly_the_earlier_ones_that_they_name(layer):
    rooms, order = ROOMS[layer], list(ROOMS[layer])
    assert all(order.index(below) < order.index(name) for name in rooms for below in rooms[name])
    stages = STAGE_MODULES if layer == "stages" else set()
    found = {}
    for module, path in MODULES.items():
        if module.startswith(f"chebsplat.{layer}."):
            here = module.split(".")[2]
            theirs = {
                name.split(".")[2]
                for name in imported_by(path)
                if name.startswith(f"chebsplat.{layer}.")
            }
            found.setdefault(here, set()).update(theirs - {here})
    assert all(found.pop(stage) <= rooms.keys() - {"tools"} for stage in stages)
    found = {
        here: theirs - (stages if here in ALSO_STAGES else set()) for here, theirs in found.items()
    }
    assert found == rooms


def test_no_imports_run_in_a_circle():
    graph = {module: imported_by(path) for module, path in MODULES.items()}
    # or CycleError, which names it; `cli.runs` loads its group at run time
    TopologicalSorter(graph).prepare()


def test_formats_know_no_torch():
    for path in (ROOT / "formats").rglob("*.py"):
        assert not any(name.split(".")[0] == "torch" for name in imported_modules(path)), path


def test_a_stage_is_known_by_every_kernel_it_runs_and_every_package_it_loads():
    from chebsplat.pipelines.planning.code import PACKAGE, Code

    found: dict[str, list] = {}
    code = Code(PACKAGE, found)
    for stage in ("sfm", "describe", "train", "lift", "refine"):
        code.stage(stage)
    kernels = [
        path for path in PACKAGE.rglob("*.py") if "chebsplat.kernels.jit import" in path.read_text()
    ]
    assert len(kernels) > 8
    assert not [path for path in kernels if str(path) not in found]
    assert {"onnx", "onnxruntime", "torch"} <= set(code.stage("onnx")["packages"])


def test_tools_that_walk_the_links_see_each_file_once(tmp_path):
    from mypy.modulefinder import FindModuleCache, SearchPaths
    from mypy.options import Options

    listed = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--show-files", *LAYERS],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    shown = [Path(line) for line in listed.stdout.splitlines()]
    assert sorted(path for path in shown if path.suffix == ".py") == sorted(SOURCES)
    finder = FindModuleCache(SearchPaths((str(ROOT),), (), (), ()), None, Options())
    typed = [
        Path(module.path).resolve()
        for module in finder.find_modules_recursive("chebsplat")
        if module.path
    ]
    # for the package's own names mypy reads the stub beside them
    seen = [path.with_suffix(".py") for path in typed if path.suffix in (".py", ".pyi")]
    assert sorted(seen) == sorted(SOURCES)
    command = [sys.executable, "-P", "-m", "coverage"]
    traced = os.environ | {"COVERAGE_FILE": str(tmp_path / "data")}
    for words in (
        ["run", "-m", "chebsplat.pipelines.cli", "settings"],
        ["json", "-q", "-o", str(tmp_path / "json")],
    ):
        subprocess.run([*command, *words], cwd=ROOT, env=traced, check=True, capture_output=True)
    covered = [
        (ROOT / name).resolve() for name in json.loads((tmp_path / "json").read_text())["files"]
    ]
    assert sorted(covered) == sorted(SOURCES)
