"""How soon a variant of a study is as good as the baseline ends."""

import pytest
from shared import ROOT

from chebsplat.pipelines.studies.results import row_of
from chebsplat.pipelines.studies.study import Budgets, expand
from chebsplat.pipelines.studies.tables import reach, sections
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
    found = reach(points, 0.5)
    assert (found.x, found.share(25)) == (pytest.approx(x), share)


MIOU = {  # by variant, scene, budget
    "less": {"office0": (0.30, 0.50), "office1": (0.40, 0.60)},
    "full": {"office0": (0.40, 0.54), "office1": (0.60, 0.58)},
}


@pytest.fixture
def finished():
    """Study and rows of two scenes whose figures are made up."""
    asked = study(scenes=["office0", "office1"], seeds=[0], budgets={"steps": [10, 20]})
    runs = expand(asked)
    for run in runs:
        last = run.budget == "20 steps"
        miou = MIOU[run.variant][run.scene][last]
        finish(run, miou=miou, steps=20 if last else 10, seconds=40.0 if last else 30.0)
    return asked, [row_of(run, {}) for run in runs]


def test_the_section_says_what_a_hand_works_out(finished):
    (section,) = sections(*finished)
    assert section.heading == "Seconds to what less ends with"
    # full has office0's 0.5 (0.5 − 0.4) / 0.14 of the way from 30 to 40 s, and office1's 0.6 at
    # once
    assert [line[:5] for line in section.table[1:]] == [
        ["office0", "full", "50.0", "40", "37 (93 %)"],
        ["office1", "full", "60.0", "40", "≤30 (≤ 75 %)"],
    ]


def test_a_variant_that_has_not_finished_leaves_nothing_to_compare(finished):
    asked, rows = finished
    assert sections(asked, [row for row in rows if row["variant"] == "full"]) == []
    assert sections(asked.model_copy(update={"budgets": Budgets(steps=[20])}), rows) == []
