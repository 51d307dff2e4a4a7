"""What a study of sequences says of knowledge: steps to reach, ends, returns, and pairs."""

import pytest
from shared import ROOT
from test_study import finish, study

from chebsplat.errors import ConfigError
from chebsplat.pipelines.studies import transfer
from chebsplat.pipelines.studies.page import write
from chebsplat.pipelines.studies.results import row_of
from chebsplat.pipelines.studies.study import expand
from chebsplat.pipelines.studies.transfer import Reach, reach


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.delenv("REPLICA_ROOT", raising=False)
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize(
    ("points", "found"),
    [
        ([(10, 0.4), (20, 0.6)], Reach(15)),
        ([(20, 0.6), (10, 0.4)], Reach(15)),  # whatever their order
        ([(10, 0.5), (20, 0.6)], Reach(10, "≤")),
        ([(10, 0.5)], Reach(10)),
        ([(10, 0.1), (20, 0.4)], Reach(20, ">")),
        ([(10, 0.1), (20, 0.6), (30, 0.3)], Reach(18)),  # it got there, though it did not stay
    ],
)
def test_a_curve_reaches_a_value_where_its_line_first_does(points, found):
    answer = reach(points, 0.5)
    assert (answer.x, answer.bound) == (pytest.approx(found.x), found.bound)


BUDGETS = {"steps": [10, 20]}
MIOU = {  # by variant, scene, budget
    "scratch": {"office0": (0.30, 0.50), "office1": (0.40, 0.60)},
    "both": {"office0": (0.40, 0.54), "office1": (0.60, 0.58)},
}


@pytest.fixture
def finished(tmp_path):
    """Study and rows of toy, office0, office1, toy, whose figures are made up."""
    (tmp_path / "loop.toml").write_text('scenes = ["toy", "office0", "office1", "toy"]')
    variants = {"scratch": {"knowledge": False}, "both": {}}
    asked = study(scenes=[], sequences=[str(tmp_path / "loop.toml")], seeds=[0], baseline="scratch", variants=variants,
                  budgets=BUDGETS, pairs=[("both", "scratch")])  # fmt: skip
    runs = expand(asked)
    for run in runs:
        miou = MIOU[run.variant].get(run.scene, ((0.2, 0.3), (0.5, 0.7))[run.variant == "both" and run.visit == 2])
        last = run.budget == "20 steps"
        finish(run, miou=miou[last], steps=20 if last else 10, seconds=40.0 if last else 30.0)
    return asked, runs, [row_of(run, {}) for run in runs]


def test_the_sections_say_what_a_hand_works_out(finished, tmp_path):
    asked, runs, rows = finished
    found = {section.heading: section for section in transfer.sections(tmp_path / "out", asked, rows)}
    # scratch ends with 0.55; both has 0.50 after 10 steps (30 s), 0.56 after 20 (40 s), so 0.55 after 18.3 (38.3 s)
    steps = dict(zip(*found["Steps to reach what scratch ends with"].table, strict=True))
    assert (steps["steps"], steps["seconds"], steps["runs"]) == ("92 %", "96 %", "2")
    assert steps["runs that reach it"] == "2 of 2"
    assert steps["median"] == "68 %"  # office0 (0.5 − 0.4) / 0.14 of the way from 10 to 20: 17.1; office1 at once: 10
    assert steps["mIoU at the end"].startswith("+1.0 [")
    assert steps["worst scene"] == "-2.0 office1"
    again = found["The first scenes again, with the last basis"].table[1]
    assert again == ["both", "loop", "toy", "1", "70.0", "+40.0", "+40.0"]
    pair = found["Variants against each other"].table[2]
    assert pair[0] == "both − scratch"
    assert pair[2:4] == ["20 steps", "2"]
    page = write(tmp_path / "out", asked, runs, rows, "c", list(found.values())).read_text()
    assert "92 %" in page and "-2.0 office1" in page and page.count("data:image/png") == 2
    assert "![Steps to reach what scratch ends with](transfer.png)" in (tmp_path / "out/results.md").read_text()


def test_a_variant_that_has_not_finished_leaves_nothing_to_compare(finished, tmp_path):
    asked, _, rows = finished
    for row in rows:
        if row["variant"] == "both" and row["budget"] == "10 steps":
            row["miou"] = None
    assert transfer.sections(tmp_path, asked, rows) == []


def test_pairs_name_variants():
    with pytest.raises(ConfigError, match="'nothing' is none of its variants"):
        study(pairs=[("full", "nothing")])
