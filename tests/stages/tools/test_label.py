"""`chebsplat label` names the Gaussians of a splat by shape alone, and says what it cannot work
with.
"""

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation
from shared import data

from chebsplat.formats.ply import read_ply, write_ply
from chebsplat.pipelines.cli.uses import label

pytestmark = pytest.mark.xdist_group("toy")


@pytest.fixture
def box(tmp_path):
    """A PLY of a closed room of 3 x 3 x 2.4 m, tiled with flat Gaussians."""
    rng = np.random.default_rng(0)
    sides = [(axis, at) for axis, ends in enumerate(((0, 3), (0, 3), (0, 2.4))) for at in ends]
    means, quats = [], []
    for axis, at in sides:
        points = rng.uniform(0, (3, 3, 2.4), (500, 3))
        points[:, axis] = at
        means.append(points)
        axes = np.roll(np.eye(3), axis + 1, axis=1)  # the last column is the side's normal
        quats.append(np.tile(Rotation.from_matrix(axes).as_quat(scalar_first=True), (500, 1)))
    n = 500 * len(sides)
    raw = {"means": np.concatenate(means), "quats": np.concatenate(quats)}
    raw |= {
        "log_scales": np.tile(np.log([0.1, 0.1, 0.002]), (n, 1)),
        "logit_opacities": np.full(n, 3.0),
    }
    raw |= {"sh0": np.zeros((n, 1, 3)), "shN": np.zeros((n, 15, 3))}
    path = tmp_path / "box.ply"
    write_ply(path, {name: values.astype(np.float32) for name, values in raw.items()}, 0)
    return path


def run(*arguments):
    return CliRunner().invoke(label, [str(a) for a in arguments])


def test_walls_floor_and_ceiling_of_a_splat_alone_are_named_with_a_confidence(box, tmp_path):
    out = tmp_path / "named.ply"
    done = run(box, "--words", "wall, floor,ceiling", "--up", "0,0,1", "--out", out)
    assert done.exit_code == 0, done.output
    assert str(out) in done.output
    parameters, _, labels = read_ply(out)
    given = read_ply(box)[0]
    with np.load(tmp_path / "named.npz") as stored:
        assert stored["names"].tolist() == ["wall", "floor", "ceiling"]
        np.testing.assert_array_equal(stored["labels"], labels)
        assert stored["confidence"].shape == labels.shape
        assert ((stored["confidence"] >= 0) & (stored["confidence"] <= 1)).all()
    right = labels.reshape(6, 500) == np.array([0, 0, 0, 0, 1, 2])[:, None]  # as the box has them
    assert right.mean(1).min() > 0.8  # but for corners
    for name in ("means", "quats", "log_scales", "logit_opacities"):
        np.testing.assert_array_equal(parameters[name], given[name])


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--words", "wall,flor"), 2, "no word flor; near: floor"),
        (("--up", "0,1"), 2, "three numbers"),
        (("--up", "0,0,0"), 2, "three numbers"),
        (("--knowledge", "nowhere"), 3, "nowhere"),
    ],
)
def test_what_cannot_be_asked_is_refused(toy, box, tmp_path, arguments, code, message):
    given = arguments if "--knowledge" in arguments else (*arguments, "--knowledge", toy["teach"])
    done = run(box, *given, "--out", tmp_path / "named.ply")
    assert done.exit_code == 1
    assert done.exception.exit_code == code
    assert message in str(done.exception)
    assert not (tmp_path / "named.ply").exists()


def test_a_splat_that_shows_no_surface_is_exit_4_and_nothing_is_overwritten(toy, box, tmp_path):
    parameters, degree, _ = read_ply(box)
    few = tmp_path / "few.ply"
    write_ply(few, {name: values[:1] for name, values in parameters.items()}, degree)
    done = run(few, "--words", "wall", "--knowledge", toy["teach"], "--out", tmp_path / "named.ply")
    assert done.exception.exit_code == 4
    done = run(box, "--words", "wall", "--knowledge", toy["teach"], "--out", box)
    assert done.exception.exit_code == 2
    assert "exists" in str(done.exception)


def test_labels_of_what_is_no_room_come_with_a_warning(tmp_path, caplog):
    guitar = data("gs_ply") / "guitar_decoded_sh0.ply"
    done = run(guitar, "--words", "wall,floor,chair", "--out", tmp_path / "named.ply")
    assert done.exit_code == 0, done.output
    assert "not sure which way is up" in caplog.text
    assert "do not rely on its labels" in caplog.text
