"""Toy artifacts of every stage, made once by the real commands; tests that use them share one worker."""

import chebsplat  # noqa: F401  # isort: skip  # before torch: OpenMP threads that spin slow parallel tests down
import pytest
from shared import INPUTS, run_stage


@pytest.fixture(scope="session")
def toy(tmp_path_factory):
    """Paths of toy artifacts by stage."""
    root = tmp_path_factory.mktemp("toy")
    made = {}
    for stage, roles in INPUTS.items():
        made[stage] = root / stage
        assert run_stage(stage, made[stage], {role: made[of] for role, of in roles.items()}) == 0, stage
    return made
