"""Every extreme case of the maths passes; one that does not is named, and fails the suite."""

import csv

import numpy as np
import pytest

from benchmarks.stability import case, main
from benchmarks.stability.case import CASES, Outcome, beside, run


@pytest.fixture(autouse=True)
def one_thread():
    """Matrices this small wait longer for threads than they compute."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("key", CASES, ids=": ".join)
def test_an_extreme_case_is_within_its_tolerance(key):
    row = run(key)
    assert row.passed, row


def raises():
    raise ValueError("broken")


def warns():
    return Outcome(float(1 / (np.float32(1e30) * np.float32(1e30))), 1e9)  # 0, by way of inf


@pytest.mark.parametrize(
    "broken",
    [lambda: Outcome(2e-6, 1e-6), lambda: Outcome(float("nan"), 1e-6), raises, warns],
    ids=range(4),
)
def test_a_case_that_fails_gives_a_non_zero_exit_and_is_named(
    tmp_path, capsys, monkeypatch, broken
):
    monkeypatch.setitem(CASES, ("none", "meant to fail"), broken)
    assert main.main(["--only", "meant to fail", "--out", str(tmp_path)]) == 1
    with (tmp_path / "stability.csv").open() as handle:
        assert [row["passed"] for row in csv.DictReader(handle)] == ["False"]
    assert "meant to fail" in capsys.readouterr().out


def test_a_plain_way_is_measured_beside_ours_and_fails_no_case(tmp_path, capsys, monkeypatch):
    one = np.float32(1)
    for name, naive in (
        ("raises", raises),
        ("warns", lambda: one / np.float32(0)),
        ("misses", lambda: 3 * one),
    ):
        monkeypatch.setitem(
            CASES, ("none", name), lambda naive=naive: beside(one, naive, 1.0, 1e-6)
        )
    assert main.main(["--only", "none: ", "--out", str(tmp_path)]) == 0
    with (tmp_path / "stability.csv").open() as handle:
        assert [float(row["naive"]) for row in csv.DictReader(handle)] == [np.inf, np.inf, 2.0]
    assert "misses 3 of the 3" in capsys.readouterr().out


def test_an_unknown_case_is_a_usage_error(tmp_path):
    assert main.main(["--only", "no such case", "--out", str(tmp_path)]) == 2


def test_two_cases_of_one_name_are_refused(monkeypatch):
    monkeypatch.setattr(case, "CASES", {})
    case.case("twice")(lambda: None)
    with pytest.raises(ValueError, match="twice"):
        case.case("twice")(lambda: None)
