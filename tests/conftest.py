"""Toy artifacts of every stage, made once by the real commands; tests that use them share one worker."""

import chebsplat  # noqa: F401  # isort: skip  # before torch: OpenMP threads that spin slow parallel tests down
import pytest
from shared import INPUTS, TOY, run_stage
from tiny_teachers import color_reference, color_teacher


@pytest.fixture(scope="session")
def toy(tmp_path_factory):
    """Paths of toy artifacts by stage."""
    root = tmp_path_factory.mktemp("toy")
    model, reference = color_teacher(root), color_reference(root / "reference")
    config = TOY | {"projection": {"model": str(model), "reference": str(reference)}}
    made = {}
    for stage, roles in INPUTS.items():
        made[stage] = root / stage
        assert run_stage(stage, made[stage], {role: made[of] for role, of in roles.items()}, config) == 0, stage
    return made
