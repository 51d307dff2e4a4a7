"""Toy artifacts of every stage, made once by the real commands; tests that use them share one
worker.
"""

# before torch: OpenMP threads that spin slow parallel tests down
import chebsplat  # noqa: F401  # isort: skip
import json
import os

import pytest
from shared import INPUTS, KEY, ROOT, TOY, remember, run_stage
from tiny_teachers import color_reference, color_teacher, knowing_rooms

# gsply runs on numba's threads, and open3d brings a TBB that numba refuses with a warning
os.environ["NUMBA_THREADING_LAYER_PRIORITY"] = "omp workqueue tbb"


@pytest.fixture(scope="session")
def code_memo():
    """What `work/.cache/code.json` holds once every stage's code has been read: a planner is then
    quick.
    """
    from chebsplat.pipelines.planning.code import PACKAGE, Code
    from chebsplat.stages.registry import STAGES

    code = Code(PACKAGE, {})
    for stage in STAGES:
        code.stage(stage)
    return json.dumps(code.memo)


@pytest.fixture(scope="session")
def toy(tmp_path_factory):
    """Paths of toy artifacts by stage."""
    root = tmp_path_factory.mktemp("toy")
    model, reference = knowing_rooms(color_teacher(root)), color_reference(root / "reference")
    config = TOY | {"channels": {"model": str(model), "reference": str(reference)}}
    config["teach"] = TOY["teach"] | {"model": str(model)}
    made = {}
    for stage, roles in INPUTS.items():
        made[stage] = root / stage
        assert (
            run_stage(stage, made[stage], {role: made[of] for role, of in roles.items()}, config)
            == 0
        ), stage
    return made


@pytest.fixture(scope="session")
def up_to_teacher(tmp_path_factory):
    """A folder of the toy scene's artifacts that a training reads."""
    root = tmp_path_factory.mktemp("toy")
    for stage in ("ingest", "sfm", "teacher"):
        inputs = {role: root / of for role, of in INPUTS[stage].items()}
        assert run_stage(stage, root / stage, inputs, TOY | {"sfm": {"max_points": 800}}) == 0
    return root


@pytest.fixture(scope="session")
def mixed(toy, tmp_path_factory):
    """The toy checkpoint with every SH degree in use, and its scene."""
    import numpy as np

    from chebsplat.cameras import centers
    from chebsplat.formats import artifact
    from chebsplat.formats.gaussians import Gaussians
    from chebsplat.formats.manifest import Manifest
    from chebsplat.formats.scene import Scene
    from chebsplat.splats.rounded import rounded_light

    checkpoint = Gaussians.read(toy["train"])
    p = checkpoint.parameters
    rng = np.random.default_rng(0)
    p["degrees"] = rng.integers(0, 4, len(p["means"])).astype(np.uint8)
    p["shN"] = rng.normal(0, 0.2, p["shN"].shape).astype(np.float32)
    for degree, n_rest in enumerate((0, 3, 8)):
        p["shN"][p["degrees"] == degree, n_rest:] = 0
    before = Scene.read(toy["export"])
    order = np.argsort(p["degrees"], kind="stable")
    back = np.argsort(before.order)
    before.parameters = {name: values[back][order] for name, values in before.parameters.items()}
    before.parameters |= {name: p[name][order] for name in ("degrees", "shN")}
    before.labels, before.order = before.labels[back][order], order
    path = tmp_path_factory.mktemp("mixed") / "scene"
    with artifact.publish(path, Manifest(Scene.SCHEMA, KEY, "test")) as tmp:
        eyes = centers(before.cameras.cam_from_world)
        before.write(tmp, rounded_light(before.parameters, eyes))
    return checkpoint, path


@pytest.fixture
def quick_plans(tmp_path, monkeypatch):
    """A work folder that is not there yet, beside where the test stands; planning does not read the
    code.
    """
    from chebsplat.pipelines.planning.code import Code

    monkeypatch.setattr(Code, "stage", lambda self, name, *used: {"hash": name})
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "work"


@pytest.fixture
def own_work(tmp_path, monkeypatch, code_memo):
    """A work folder of the test's own, which remembers the hashes of the code."""
    monkeypatch.setenv("CHEBSPLAT_WORK", str(tmp_path / "work"))
    monkeypatch.chdir(ROOT)
    return remember(tmp_path / "work", code_memo)
