"""What the pages name exists: files, what they define, other pages, settings, equations and
artifacts.
"""

import ast
import os
import re
from importlib import import_module

import pytest
from shared import ROOT

from chebsplat.formats.capture import Capture
from chebsplat.formats.channels import ChannelMap
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.encoding import Encoding
from chebsplat.formats.evaluation import Pictures, ViewAgreement
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Checkpoint
from chebsplat.formats.lifted import Lifted, Refined
from chebsplat.formats.ply import read_ply
from chebsplat.formats.points import Points
from chebsplat.formats.record import layout_of
from chebsplat.formats.scene import RaggedScene, Scene
from chebsplat.settings import TrainSection
from chebsplat.stages.registry import STAGES
from chebsplat.stages.runtime.config import known_keys
from chebsplat.stages.training.defaults import DEFAULTS, OPEN

PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md")] + sorted(
    (ROOT / "docs").rglob("*.md")
)
CODE = re.compile(
    r"`([\w/]+\.py)(?::([\w.]+))?`|\b((?:chebsplat|formats|stages|pipelines)/[\w/]+\.py):(\w+)"
)
LINK = re.compile(r"\]\(([^)#:]+)\)")
RECORDS = (
    Capture, Points, ChannelMap, Features, ViewAgreement, Descriptors, Encoding, Checkpoint, Lifted,
    Refined,
    RaggedScene, Pictures,
)  # fmt: skip


def defined(path):
    """Top-level names of a module."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_file_function_and_page_that_is_named_exists(page):
    text = page.read_text()
    for match in CODE.finditer(text):
        file, name = match[1] or match[3], match[2] or match[4]
        # a file of the reader's, or one of the folder that the sentence is about
        if "/" not in file:
            continue
        assert (ROOT / file).is_file(), match[0]
        assert name is None or name in defined(ROOT / file), match[0]
    for target in LINK.findall(text):
        assert (page.parent / target).exists(), target


def test_the_method_names_where_each_equation_is_computed():
    text = (ROOT / "docs/method.md").read_text()
    named = set()
    for first, printed, ours, worth in re.findall(
        r"^\| (.+?) \| (.+?) \| (.+?) \| (.+?) \|$", text, re.MULTILINE
    ):
        if numbers := re.match(r"Eqs? (\d+)(?:-(\d+))?, |pruning$|SH masks$|losses$", first):
            from_, to = numbers[1], numbers[2] or numbers[1]
            named |= set(range(int(from_), int(to) + 1)) if from_ else {first}
            assert "chebsplat/printed/" in printed and CODE.search(printed), first
            assert CODE.search(ours) and worth, first
    assert named == {*range(1, 16), "pruning", "SH masks", "losses"}
    settings = set(re.findall(r"`((?:describe|train)\.\w+)", text))
    assert len(settings) > 15
    assert settings <= set(known_keys())


def test_the_architecture_names_code_of_the_schema_of_each_artifact():
    text = (ROOT / "docs/architecture.md").read_text()
    for stage in STAGES.values():
        if stage.name == "report":  # a page for people
            continue
        schema = stage.schema.removeprefix("chebsplat.")
        row = re.search(rf"^\| `{schema}` \|.*\|$", text, re.MULTILINE)
        assert row, schema
        named = CODE.findall(row[0])
        assert named, schema
        for module, name, *_ in named:
            code = import_module(f"chebsplat.{module.removesuffix('.py').replace('/', '.')}")
            schema_of = getattr(getattr(code, name), "SCHEMA", getattr(code, "SCHEMA", None))
            of_stage = (module, name) == (f"stages/{stage.name}.py", "run")
            assert of_stage or schema_of == stage.schema, row[0]


def rows_of(record, prefix=""):
    """Rows of the table of layouts: a record's arrays, those of records within, and its
    attributes.
    """
    layout = layout_of(record)
    for name, spec in layout.arrays.items():
        shape = ", ".join(map(str, spec.axes))
        remarks = "; ".join(
            filter(None, (spec.units, "optional" if name in layout.optional else ""))
        )
        yield f"| `{prefix}{name}` | {spec.dtype} | {shape} | {remarks} |"
    for name, within in layout.records.items():
        yield from rows_of(within, f"{prefix}{name}/")
    if layout.attributes:
        names = ", ".join(f"`{name}`" for name in layout.attributes)
        yield f"| {prefix}attributes | | | {names} |"


def test_the_architecture_lists_the_arrays_of_each_record():
    """CHEBSPLAT_WRITE_DOCS=1 writes the table anew."""
    page = ROOT / "docs/architecture.md"
    begin, end = (
        "<!-- layouts: written by tests/whole/test_docs.py -->\n",
        ("<!-- end of layouts -->"),
    )
    lines = ["", "| array | dtype | axes | units |", "|---|---|---|---|"]
    for record in RECORDS:
        lines += [f"| **{record.SCHEMA.removeprefix('chebsplat.')}** | | | |", *rows_of(record)]
    before, rest = page.read_text().split(begin)
    wanted = before + begin + "\n".join(lines) + "\n\n" + end + rest.split(end)[1]
    if os.environ.get("CHEBSPLAT_WRITE_DOCS"):
        page.write_text(wanted)
    assert page.read_text() == wanted
    stored = {stage.schema for stage in STAGES.values()}
    assert stored >= {record.SCHEMA for record in RECORDS}


def test_usage_lists_each_setting_that_a_scene_decides():
    """CHEBSPLAT_WRITE_DOCS=1 writes the table anew."""
    page = ROOT / "docs/usage.md"
    begin, end = (
        "<!-- decided: written by tests/whole/test_docs.py -->\n",
        ("<!-- end of decided -->"),
    )
    lines = ["", "| setting | decided by |", "|---|---|"]
    lines += [f"| `train.{name}` | {default.by} |" for name, default in DEFAULTS.items()]
    before, rest = page.read_text().split(begin)
    wanted = before + begin + "\n".join(lines) + "\n\n" + end + rest.split(end)[1]
    if os.environ.get("CHEBSPLAT_WRITE_DOCS"):
        page.write_text(wanted)
    assert page.read_text() == wanted
    open_settings = {name for name, value in TrainSection() if value in OPEN}
    assert open_settings - {"seconds", "start"} == set(DEFAULTS)


def test_citations_of_the_method_lead_to_a_section():
    sections = set(re.findall(r"^## (\d+)\. ", (ROOT / "docs/method.md").read_text(), re.MULTILINE))
    cited = set()
    for layer in ("chebsplat", "formats", "stages", "pipelines", "tests", "benchmarks"):
        for path in (ROOT / layer).rglob("*.py"):
            cited |= set(re.findall(r"docs/method\.md, section (\d+)", path.read_text()))
    assert cited
    assert cited <= sections


@pytest.mark.xdist_group("toy")
def test_the_python_of_the_readme_renders_and_asks_a_scene(toy, tmp_path):
    text = (ROOT / "README.md").read_text()
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    for stage in ("export", "teacher"):
        (tmp_path / stage).symlink_to(toy[stage])
    name = Scene.read(toy["export"]).label_names[0]
    for written, here in (
        ("work/office0", tmp_path),
        ('"sofa"', f'"{name}", against=["{name}"]'),
        ("> 0.5", ">= 0"),
    ):
        assert written in code
        code = code.replace(written, str(here))
    found = {}
    exec(code.replace("sofa.ply", str(tmp_path / "part.ply")), found)
    assert found["shown"].color.shape[2] == 3 and found["shown"].color.std() > 0
    assert found["shown"].features.shape[:2] == found["shown"].labels.shape
    assert len(read_ply(tmp_path / "part.ply")[0]["means"]) == len(found["scene"])


def test_the_readme_is_short_and_answers_a_newcomer():
    text = (ROOT / "README.md").read_text()
    assert len(text.split()) <= 900
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert {"Install", "Your own photos", "Look at the result", "Use it from Python", "GPU"} <= set(
        headings
    )
