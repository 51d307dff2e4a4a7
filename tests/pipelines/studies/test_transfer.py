"""What a study of sequences says of knowledge: gains, returns, pairs, and how soon a variant is as good."""

import pytest
from shared import ROOT

from chebsplat.errors import ConfigError
from chebsplat.pipelines.studies import tables as reaching
from chebsplat.pipelines.studies import transfer
from chebsplat.pipelines.studies.page import write
from chebsplat.pipelines.studies.results import row_of
from chebsplat.pipelines.studies.study import Budgets, expand
from tests.pipelines.studies.test_study import finish, study


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.delenv("REPLICA_ROOT", raising=False)
    monkeypatch.chdir(ROOT)


@pytest.mark.parametrize(
    ("points", "x", "share"),
    [
        ([(10, 0.4), (20, 0.6)], 15, "60 %"),
        ([(20, 0.6), (10, 0.4)], 15, "60 %"),  # whatever their order
        ([(10, 0.5), (20, 0.6)], 10, "≤ 40 %"),
        ([(10, 0.5)], 10, "40 %"),
        ([(10, 0.1), (20, 0.4)], 20, "> 80 %"),
        ([(10, 0.1), (20, 0.6), (30, 0.3)], 18, "72 %"),  # it got there, though it did not stay
    ],
)
def test_a_curve_reaches_a_value_where_its_line_first_does(points, x, share):
    found = reaching.reach(points, 0.5)
    assert (found.x, found.share(25)) == (pytest.approx(x), share)


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
    some = transfer.sections(asked, rows) + reaching.sections(asked, rows)
    found = {section.heading: section for section in some}
    ends = dict(zip(*found["What is gained over scratch"].table, strict=True))
    assert (ends["sequence"], ends["pairs of runs"], ends["worst scene"]) == ("loop", "2", "-2.0 office1")
    assert ends["mIoU"].startswith("+1.0 [")
    # both has office0's 0.5 (0.5 − 0.4) / 0.14 of the way from 30 to 40 s, and office1's 0.6 at once
    _, *lines = found["Seconds to what scratch ends with"].table
    assert [line[:5] for line in lines] == [
        ["office0", "both", "50.0", "40", "37 (93 %)"],
        ["office1", "both", "60.0", "40", "≤30 (≤ 75 %)"],
    ]
    again = found["The first scenes again, with the last basis"].table[1]
    assert again == ["both", "loop", "toy", "1", "70.0", "+40.0", "+40.0"]
    pair = found["Variants against each other"].table[2]
    assert pair[0] == "both − scratch"
    assert pair[2:4] == ["20 steps", "2"]
    page = write(tmp_path / "out", asked, runs, rows, "c", list(found.values())).read_text()
    assert "93 %" in page and "-2.0 office1" in page
    assert "### What is gained over scratch" in (tmp_path / "out/results.md").read_text()


def test_a_variant_that_has_not_finished_leaves_nothing_to_compare(finished, tmp_path):
    asked, _, rows = finished
    for row in rows:
        if row["variant"] == "both":
            row["miou"] = None
    assert transfer.sections(asked, rows) == []
    assert reaching.sections(asked, [row for row in rows if row["variant"] == "both"]) == []
    assert reaching.sections(asked.model_copy(update={"budgets": Budgets(steps=[20])}), rows) == []


def test_pairs_name_variants():
    with pytest.raises(ConfigError, match="'nothing' is none of its variants"):
        study(pairs=[("full", "nothing")])
