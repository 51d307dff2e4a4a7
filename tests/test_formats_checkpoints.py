"""Checkpoints and bases come back bit for bit, and a damaged or non-finite one is refused by name."""

import numpy as np
import pytest
from safetensors.numpy import load_file
from shared import KEY

from chebsplat.errors import InputError
from chebsplat.formats import artifact
from chebsplat.formats.basis import Basis, read_basis, write_basis
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.gaussians import Gaussians, read_gaussians, write_gaussians
from chebsplat.formats.manifest import Manifest

CAMERAS = Cameras(["a"], np.eye(3)[None], np.eye(4)[None], 5, 4)


def example(n=5, seed=0, top=3):
    rng = np.random.default_rng(seed)
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "logit_opacities": (n,)}
    shapes |= {"sh0": (n, 1, 3), "shN": (n, 15, 3), "features": (n, 13)}
    parameters = {k: rng.normal(size=s).astype(np.float32) for k, s in shapes.items()}
    degrees = rng.integers(0, top + 1, n).astype(np.uint8)
    parameters["shN"][np.arange(1, 16) >= (degrees[:, None] + 1) ** 2] = 0
    return parameters | {"degrees": degrees}


def publish_gaussians(path, gaussians):
    with artifact.publish(path, Manifest("chebsplat.gaussians/1", KEY, "train")) as tmp:
        write_gaussians(tmp, gaussians)
    return path


def publish_basis(path, basis):
    with artifact.publish(path, Manifest("chebsplat.basis/3", KEY, "cks")) as tmp:
        write_basis(tmp, basis)
    return path


@pytest.mark.parametrize("n", [0, 1, 5])
def test_checkpoint_round_trip_is_exact(tmp_path, n):
    given = Gaussians(
        example(n),
        CAMERAS,
        {"encoder.w": np.ones((2, 3), np.float32)},
        {},
        [{"step": 1.0, "seconds": 0.5, "psnr": 20.25}],
    )
    found = read_gaussians(publish_gaussians(tmp_path / "g", given))
    assert found.parameters.keys() == given.parameters.keys()
    for name, array in given.parameters.items():
        np.testing.assert_array_equal(found.parameters[name], array)
    assert found.trace == given.trace
    assert found.optimizer == {}


def test_poses_that_were_given_lie_beside_those_that_were_reached(tmp_path):
    poses = CAMERAS.cam_from_world + 0.0
    poses[:, 0, 3] += 0.25
    found = read_gaussians(publish_gaussians(tmp_path / "g", Gaussians(example(), CAMERAS, given_poses=poses)))
    np.testing.assert_array_equal(found.given_poses, poses)
    np.testing.assert_array_equal(found.cameras.cam_from_world, CAMERAS.cam_from_world)
    assert read_gaussians(publish_gaussians(tmp_path / "h", Gaussians(example(), CAMERAS))).given_poses is None
    poses[:, 0, 0] = 2
    with pytest.raises(InputError, match=r"given.safetensors: the pose of .* is not a rotation"):
        read_gaussians(publish_gaussians(tmp_path / "i", Gaussians(example(), CAMERAS, given_poses=poses)))


def test_bands_that_nobody_keeps_are_not_in_the_file(tmp_path):
    given = Gaussians(example(50, top=1), CAMERAS)
    path = publish_gaussians(tmp_path / "g", given)
    assert load_file(path / "parameters.safetensors")["shN"].shape == (50, 3, 3)
    np.testing.assert_array_equal(read_gaussians(path).parameters["shN"], given.parameters["shN"])


@pytest.mark.parametrize(("name", "shape"), [("quats", (5, 3)), ("means", (4, 3)), ("features", (4, 13))])
def test_disagreeing_shape_is_named(tmp_path, name, shape):
    path = publish_gaussians(tmp_path / "g", Gaussians(example() | {name: np.zeros(shape, np.float32)}, CAMERAS))
    with pytest.raises(InputError, match=r"shape .* expected"):
        read_gaussians(path)


def test_missing_array_is_named(tmp_path):
    parameters = example()
    del parameters["quats"]
    with pytest.raises(InputError, match="no array quats"):
        read_gaussians(publish_gaussians(tmp_path / "g", Gaussians(parameters, CAMERAS)))


def test_non_finite_parameter_is_never_published(tmp_path):
    parameters = example()
    parameters["means"][2, 1] = np.nan
    with pytest.raises(ValueError, match="means holds 1 non-finite"):
        publish_gaussians(tmp_path / "g", Gaussians(parameters, CAMERAS))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("file", ["parameters.safetensors", "trace.csv"])
def test_bit_flip_is_named_with_the_remedy(tmp_path, file):
    path = publish_gaussians(tmp_path / "g", Gaussians(example(), CAMERAS, trace=[{"step": 1.0}]))
    data = bytearray((path / file).read_bytes())
    data[-1] ^= 1
    (path / file).write_bytes(data)
    with pytest.raises(InputError, match=f"{file}.*again"):
        read_gaussians(path)


def test_basis_round_trip_and_refusal_of_what_its_columns_and_lineage_contradict(tmp_path):
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(8, 3)))
    weights = {"layer0.query": np.ones((8, 8), np.float32)}
    report = {
        "rank_before": 0,
        "rank_after": 3,
        "added": 3,
        "rho": 1.0,
        "rho_after": 0.1,
        "energy": 0.99,
        "rho_printed": 2.0,
    }
    entry = {"scene": "toy", "gaussians": "k", "spread": 1.0, "maps": {"layer0.query": report}}
    given = Basis({"layer0.query": q.astype(np.float32)}, weights, [entry])
    found = read_basis(publish_basis(tmp_path / "b", given))
    np.testing.assert_array_equal(found.bases["layer0.query"], given.bases["layer0.query"])
    assert (found.revision, found.lineage) == (1, given.lineage)
    given.bases["layer0.query"] *= 1.01
    with pytest.raises(InputError, match="not orthonormal"):
        read_basis(publish_basis(tmp_path / "skew", given))
    given.bases["layer0.query"] = q[:, :2].astype(np.float32)
    with pytest.raises(InputError, match="2 columns, its lineage 3"):
        read_basis(publish_basis(tmp_path / "short", given))
    given.lineage[0].pop("scene")
    with pytest.raises(InputError, match=r"lineage\.json: 0\.scene: "):
        read_basis(publish_basis(tmp_path / "nameless", given))
