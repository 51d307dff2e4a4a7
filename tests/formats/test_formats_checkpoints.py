"""Checkpoints come back bit for bit, without SH bands that nobody keeps; bad parameters are never
published.
"""

import numpy as np
import pytest
import zarr
from shared import KEY

from chebsplat.formats import artifact
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.gaussians import Gaussians
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


def publish(path, gaussians):
    with artifact.publish(path, Manifest(Gaussians.SCHEMA, KEY, "train")) as tmp:
        gaussians.write(tmp)
    return path


@pytest.mark.parametrize("n", [0, 1, 5])
def test_checkpoint_round_trip_is_exact(tmp_path, n):
    modules = {"gate.w": np.arange(6, dtype=np.float32).reshape(2, 3), "gate.b": np.float32([7])}
    trace = [{"step": 1.0, "seconds": 0.5, "psnr": 20.25}]
    given = Gaussians(example(n), CAMERAS, modules, trace, {"label_names": ["wall"]})
    found = Gaussians.read(publish(tmp_path / "g", given))
    for mine, theirs in ((given.parameters, found.parameters), (modules, found.modules)):
        assert mine.keys() == theirs.keys()
        assert all(np.array_equal(theirs[name], array) for name, array in mine.items())
    assert (found.trace, found.notes) == (trace, given.notes)
    assert found.cameras.names == ["a"] and np.array_equal(found.cameras.Ks, CAMERAS.Ks)


def test_bands_that_nobody_keeps_are_not_in_the_file(tmp_path):
    given = Gaussians(example(50, top=1), CAMERAS)
    path = publish(tmp_path / "g", given)
    assert zarr.open_group(str(path), mode="r")["shN"].shape == (50, 3, 3)
    assert np.array_equal(Gaussians.read(path).parameters["shN"], given.parameters["shN"])


BAD = {
    "a shape": ("quats", np.zeros((5, 3), np.float32), r"quats has shape \(5, 3\)"),
    "a count": ("features", np.zeros((4, 13), np.float32), r"features has shape \(4, 13\)"),
    "a type": ("means", np.zeros((5, 3), complex), "means is complex128, expected float32"),
    "nan": ("means", np.full((5, 3), np.nan, np.float32), "means holds 15 non-finite"),
}


@pytest.mark.parametrize(("name", "values", "words"), BAD.values(), ids=BAD)
def test_bad_parameters_are_never_published(tmp_path, name, values, words):
    with pytest.raises(ValueError, match=words):
        publish(tmp_path / "g", Gaussians(example() | {name: values}, CAMERAS))
    assert not list(tmp_path.iterdir())
