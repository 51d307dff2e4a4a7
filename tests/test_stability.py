"""The stability suite runs its cases, writes them down, and fails when one does."""

import csv

import pytest
from shared import ROOT


@pytest.fixture
def suite(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    import benchmarks.stability.main as module
    from benchmarks.stability import case

    monkeypatch.setattr(case, "CASES", dict(case.CASES))
    monkeypatch.setattr(module, "CASES", case.CASES)
    return module, case


def table(path):
    with path.open() as handle:
        return list(csv.DictReader(handle))


@pytest.mark.parametrize(
    "only",
    [
        "needles 1e6",
        "coincident and round",
        "n = 3",
        "fusion: ",
        "a residual of 1e-06",
        "histogram, constant",
        "zero quat",
    ],
)
def test_cases_pass_and_are_written_down(suite, tmp_path, capsys, only):
    module, _ = suite
    assert module.main(["--only", only, "--csv", str(tmp_path / "s.csv")]) == 0
    rows = table(tmp_path / "s.csv")
    assert rows
    assert all(row["passed"] == "True" and float(row["error"]) <= float(row["tolerance"]) for row in rows)
    assert all(only in f"{row['module']}: {row['case']}" for row in rows)
    assert f"{len(rows)} cases, 0 failed" in capsys.readouterr().out


def off(case):
    return case.Outcome("none", "error 1", 2e-6, 1e-6)


def nan(case):
    return case.Outcome("none", "error 1", float("nan"), 1e-6)


def raises(case):
    raise ValueError("broken")


def warns(case):
    import numpy as np

    return case.Outcome("none", "error 1", float(np.float32(1e30) * np.float32(1e30) * 0 + 1), 1e9)


@pytest.mark.parametrize("broken", [off, nan, raises, warns])
def test_a_case_that_fails_gives_a_non_zero_exit_and_is_named(suite, tmp_path, capsys, broken):
    module, case = suite
    case.case("meant to fail")(lambda: broken(case))
    assert module.main(["--only", "meant to fail", "--csv", str(tmp_path / "s.csv")]) == 1
    assert [row["passed"] for row in table(tmp_path / "s.csv")] == ["False"]
    assert "FAIL" in capsys.readouterr().out


def test_a_wrong_descriptor_fails(suite, tmp_path, monkeypatch):
    module, _ = suite
    from benchmarks.stability import descriptor

    correct = descriptor.describe

    def wrong(*regions, **options):
        described = correct(*regions, **options)
        return described._replace(values=described.values * (1 + 1e-5))

    monkeypatch.setattr(descriptor, "describe", wrong)
    assert module.main(["--only", "descriptor: needles 1e6", "--csv", str(tmp_path / "s.csv")]) == 1


def test_an_unknown_case_is_a_usage_error(suite, tmp_path):
    assert suite[0].main(["--only", "no such case", "--csv", str(tmp_path / "s.csv")]) == 2


def test_two_cases_of_one_name_are_refused(suite):
    _, case = suite
    case.case("twice")(lambda: None)
    with pytest.raises(ValueError, match="twice"):
        case.case("twice")(lambda: None)


def test_every_training_that_ought_to_break_ends_whole_or_names_its_step(suite):
    from benchmarks.stability import training

    ends = {name: training.ended(build()) for name, build in training.SCENES.items()}
    assert {name: how for name, (how, error) in ends.items() if error > 0} == {}
    assert any(how.startswith("stopped") for how, _ in ends.values())
