"""Imports run one way: {pipelines, teachers} -> stages -> {chebsplat, formats}."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = ("chebsplat", "formats", "stages", "pipelines", "teachers")
MAY_IMPORT = {
    "chebsplat": {"chebsplat"},
    "formats": {"formats"},
    "stages": {"stages", "chebsplat", "formats"},
    "pipelines": {"pipelines", "stages", "chebsplat", "formats"},
    "teachers": {"teachers", "stages", "chebsplat", "formats"},
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
            if rest == "teachers.EMBEDDED" and layer in ("stages", "pipelines"):
                continue  # the shipped model's path: all that the product knows of how it was made
            target = rest.split(".")[0]
            target = target if target in LAYERS[1:] else "chebsplat"
            assert target in MAY_IMPORT[layer], f"{path}: {layer} must not import {name}"


def test_formats_know_no_torch():
    for path in (ROOT / "formats").rglob("*.py"):
        assert not any(name.split(".")[0] == "torch" for name in imported_modules(path)), path


def test_a_stage_is_known_by_every_kernel_it_runs_and_every_package_it_loads():
    from chebsplat.pipelines.code import Code, installed

    found: dict[str, list] = {}
    code = Code(installed(), found)
    code.stage("train")
    kernels = [path for path in installed()["chebsplat"].rglob("*.py") if "chebsplat.jit import" in path.read_text()]
    assert len(kernels) > 8
    assert not [path for path in kernels if str(path) not in found]
    assert {"onnx", "onnxruntime", "torch"} <= set(code.stage("onnx")["packages"])
