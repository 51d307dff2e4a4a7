"""A study of several budgets says how soon a variant is as good as its baseline is at the end."""

import pytest
from test_study import finish, study

from chebsplat.pipelines.studies import reaching
from chebsplat.pipelines.studies.reaching import reach
from chebsplat.pipelines.studies.results import row_of
from chebsplat.pipelines.studies.study import expand


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))


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


def rows_of(budgets, figures):
    variants = {"old": {}, "new": {"train": {"albo": False}}}
    asked = study(scenes=["office0"], seeds=[0, 1], baseline="old", variants=variants, budgets={"steps": budgets})
    runs = expand(asked)
    for run in runs:
        miou, seconds = figures[run.variant][budgets.index(int(run.budget.split()[0]))]
        finish(run, miou=miou + 0.02 * run.seed, steps=10, seconds=seconds)
    return asked, [row_of(run, {}) for run in runs]


def test_seconds_to_the_end_of_the_baseline_are_read_off_the_line_between_budgets():
    asked, rows = rows_of([10, 20], {"old": [(0.2, 30.0), (0.5, 60.0)], "new": [(0.4, 10.0), (0.6, 20.0)]})
    (section,) = reaching.sections(asked, rows)
    header, line = section.table
    assert header[:2] == ["scene", "variant"] and line[:2] == ["office0", "new"]
    assert line[2:5] == ["51.0", "60", "15 (25 %)"]
    assert section.heading == "Seconds to what old ends with"


def test_one_budget_or_no_baseline_has_no_such_section():
    asked, rows = rows_of([10], {"old": [(0.2, 30.0)], "new": [(0.4, 10.0)]})
    assert reaching.sections(asked, rows) == []
    asked, rows = rows_of([10, 20], {"old": [(0.2, 30.0), (0.5, 60.0)], "new": [(0.4, 10.0), (0.6, 20.0)]})
    assert reaching.sections(asked, [row for row in rows if row["variant"] == "new"]) == []
