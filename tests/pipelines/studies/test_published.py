"""Tables of a paper: planned and run on stand-ins of the paper's data, and what is not there is
named.
"""

import csv
import os
import subprocess
import sys

import layouts
import numpy as np
import pytest
from shared import ROOT
from tiny_teachers import color_teacher, write_table

from chebsplat.cameras import unproject
from chebsplat.errors import ConfigError
from chebsplat.evaluation.protocols import scannet_closed, scannet_open
from chebsplat.formats.teacher_model import read_label_set
from chebsplat.pipelines.studies.page import write
from chebsplat.pipelines.studies.published import published_sections
from chebsplat.pipelines.studies.results import FIGURES
from chebsplat.pipelines.studies.study import checked_study, expand, read_study
from chebsplat.stages.sources import generated

ROOM = {"root": "REPLICA_ROOT", "scenes": ["room0"], "published": {}}
ROOTS = ("REPLICA_ROOT", "SCANNET_ROOT", "DEEP_BLENDING_ROOT", "LSEG_MODEL")


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    for name in ROOTS:
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "work"


def with_classes(scene, names):
    labels = np.where(scene["labels"] < 0, -1, scene["labels"] % len(names)).astype(np.int16)
    return scene | {"labels": labels, "class_names": list(names)}


@pytest.fixture
def stand_ins(tmp_path, monkeypatch):
    """A toy room as one scene of each data set, and a teacher that tells colours and has all
    words.
    """
    scene = generated.capture("toy", 1, "toy")
    pixels = np.argwhere(np.ones(scene["depth"].shape[1:], bool))[::97]
    views = zip(scene["depth"], scene["Ks"], scene["cam_from_world"], strict=True)
    scene["points"] = np.concatenate([unproject(*view, pixels) for view in views]).astype(
        np.float32
    )
    scene["point_colors"] = np.concatenate(
        [image[pixels[:, 0], pixels[:, 1]] for image in scene["images"]]
    )
    layouts.write_nice_slam(tmp_path / "replica/room_0", scene)
    layouts.write_scannet_sg(
        tmp_path / "scannet/open/scene0050_02", with_classes(scene, scannet_open.CLASSES)
    )
    closed = with_classes(scene, scannet_closed.CLASSES)
    closed |= {
        "pseudo_labels": closed["labels"],
        "confidence": np.full(closed["labels"].shape, 0.9),
    }
    layouts.write_scannet_pl(tmp_path / "scannet/closed/scene0144_01", closed)
    layouts.write_colmap(tmp_path / "blending/playroom", scene)
    (tmp_path / "teacher").mkdir()
    model = color_teacher(tmp_path / "teacher")
    sets = [
        read_label_set(ROOT / f"teachers/labels/{name}.txt") for name in ("ade20k", "scannet20")
    ]
    words = list(dict.fromkeys(word for names in sets for of in names.values() for word in of))
    write_table(
        model.with_name("tiny.npz"), words, np.random.default_rng(0).normal(size=(len(words), 3))
    )
    for name, value in zip(
        ROOTS, (*(tmp_path / of for of in ("replica", "scannet", "blending")), model), strict=True
    ):
        monkeypatch.setenv(name, str(value))


def test_without_any_data_the_tables_hold_the_papers_figures_and_name_what_is_lacking(tmp_path):
    asked = read_study("paper-tables")
    assert expand(asked) == []
    sections = published_sections(asked, [])
    assert [section.heading[:7] for section in sections] == [f"Table {k}" for k in range(1, 6)]
    for section, root in zip(
        sections, (ROOTS[0], ROOTS[1], ROOTS[1], ROOTS[2], ROOTS[2]), strict=True
    ):
        assert {row[-1] for row in section.table[1:] if row[1] != "-"} == {
            f"all: {root} is not set"
        }
    assert sections[0].table[4][:5] == ["Ours", "paper", "-", "81.1", "-"]
    given = {
        key
        for table in asked.tables.values()
        for figures in table.published.values()
        for key in figures
    }
    assert given <= {figure.key for figure in FIGURES}
    assert "1600 pixels at most" in sections[3].note and "592 pixels" in sections[2].note
    page = write(tmp_path, asked, [], [], "make study=paper-tables", sections)
    for text in (page.read_text(), (tmp_path / "results.md").read_text().replace("\\", "")):
        assert "REPLICA_ROOT is not set" in text and "Semantic Gaussians" in text


def test_what_is_there_is_planned_each_table_by_its_own_protocol_and_without_a_teacher_colour_alone(
    stand_ins, monkeypatch
):
    asked = read_study("paper-tables")
    found = {}
    for run in expand(asked):
        sections = next(step.sections for step in run.plan.steps if step.stage == "ingest")
        ingest = sections["ingest"]
        found.setdefault(run.condition[:7], set()).add(
            (run.scene, ingest["protocol"], ingest["max_side"])
        )
    assert found == {
        "Table 1": {("room0", "replica-f3", 640)},
        "Table 2": {("scene0050_02", "scannet-open", 648)},
        "Table 3": {("scene0144_01", "scannet-closed", 592)},
        "Table 4": {("playroom", "deep-blending", 1600)},
        "Table 5": {("playroom", "deep-blending", 1600)},
    }
    monkeypatch.delenv("LSEG_MODEL")
    assert {(run.condition[:7], run.variant) for run in expand(asked)} == {
        ("Table 3", "paper"), ("Table 3", "full"), ("Table 4", "plain"),
    }  # fmt: skip
    lacking = published_sections(asked, [])[3].table
    assert [row[-1] for row in lacking if row[1] == "full"] == [
        "drjohnson: not in DEEP_BLENDING_ROOT with sparse/; playroom: LSEG_MODEL is not set"
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenes": ["toy"]}, "either scenes or tables"),
        ({"conditions": {"other": {}}}, "either scenes or tables"),
        ({"variants": {"full": {}}}, "'paper' is none of the study's variants"),
        (
            {"conditions": {"T": {}}, "tables": {"T": ROOM | {"variants": {"full": "Ours"}}}},
            "'Ours' is no row",
        ),
    ],
)
def test_tables_that_do_not_fit_their_study_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        checked_study({"extends": "paper-tables"} | changes, "mine")


@pytest.mark.slow
@pytest.mark.xdist_group("cli")
def test_the_papers_tables_run_on_stand_ins_with_protocol_split_and_resolution_by_each_figure(
    tmp_path, stand_ins
):
    (tmp_path / "mine.toml").write_text("""
extends = "paper-tables"
[settings]
channels = { n_rooms = 1 }
sfm = { max_points = 200 }
describe = { n_regions = 12 }
train = { steps = 12, n_densify = 1, report_every = 6, max_gaussians = 400 }
evaluate = { timing_repeats = 1 }
""")
    command = [
        sys.executable,
        "-m",
        "chebsplat.pipelines.cli",
        "study",
        str(tmp_path / "mine.toml"),
    ]
    command += ["--cores", "2", "--threads", "2", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=os.environ)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "out/results.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    assert {row["state"] for row in rows} == {"done"}
    assert len(rows) == 3 + 3 + 2 + 4 + 7
    assert {(row["protocol"], row["resolution"], row["split"]) for row in rows} == {
        ("replica-f3", "96x72", "view index % 8 == 2 is test"),
        ("scannet-open", "96x72", "no view is held out; all are evaluated"),
        ("scannet-closed", "96x72", "the source's own"),
        ("deep-blending", "96x72", "view index % 8 == 0 is test"),
    }
    assert all(row["psnr"] for row in rows)
    assert {row["variant"] for row in rows if not row["miou"]} == {"plain"}
    text = (tmp_path / "out/results.md").read_text().replace("\\", "")
    assert "Measured at 96x72 (the source's own)" in text
    assert "room1, office3, office4: not in REPLICA_ROOT |" in text
