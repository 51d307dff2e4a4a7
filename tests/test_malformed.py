"""Malformed inputs end in a clear error that names the file; `make malformed` runs the whole corpus."""

import pytest
from malformed.case import run
from malformed.corpus import CASES, sample


@pytest.mark.parametrize("case", sample(40), ids=lambda case: case.id)
def test_a_malformed_input_is_a_clear_error(case, tmp_path):
    outcome = run(case, tmp_path)
    assert not outcome.fault, outcome.stderr


def test_no_case_is_listed_twice():
    ids = [case.id for case in CASES]
    assert len(set(ids)) == len(ids)
