"""The generated scenes are deterministic, exactly labelled, and geometrically true."""

import numpy as np
import pytest

from chebsplat.cameras import centers, unproject
from chebsplat.formats.meshes import RayCaster
from chebsplat.stages.sources import generated
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import build
from chebsplat.synthetic.path import walk


@pytest.fixture(scope="module")
def toy():
    return generated.capture("toy", 1, "toy")


def test_a_seed_gives_the_same_bytes_and_another_seed_does_not(toy):
    again, other = generated.capture("toy", 1, "toy"), generated.capture("toy", 2, "toy")
    for name in ("images", "depth", "labels"):
        assert toy[name].tobytes() == again[name].tobytes()
        assert toy[name].tobytes() != other[name].tobytes()


def test_every_pixel_has_depth_and_label_inside_the_room(toy):
    assert np.isfinite(toy["depth"]).all()
    assert toy["labels"].min() >= 0
    assert toy["images"].std() > 20
    size = build("toy", 1).size
    pixels = np.argwhere(np.ones(toy["depth"][0].shape, bool))
    for view in range(len(toy["names"])):
        points = unproject(toy["depth"][view], toy["Ks"][view], toy["cam_from_world"][view], pixels)
        assert (points > -0.05).all()
        assert (points < np.array(size) + 0.05).all()


def test_depth_of_one_view_predicts_another(toy):
    a, b = 0, 1
    pixels = np.argwhere(np.ones(toy["depth"][a].shape, bool))
    points = unproject(toy["depth"][a], toy["Ks"][a], toy["cam_from_world"][a], pixels)
    pose = toy["cam_from_world"][b]
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    image = camera @ toy["Ks"][b].T
    u, v = np.floor(image[:, :2] / image[:, 2:]).T
    height, width = toy["depth"][b].shape
    inside = (camera[:, 2] > 0.1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    seen = toy["depth"][b][v[inside].astype(int), u[inside].astype(int)]
    relative = np.abs(seen - camera[inside, 2]) / seen
    assert inside.mean() > 0.2
    assert np.median(relative) < 5e-3  # half a pixel of slope on the nearest wall


@pytest.mark.parametrize(("preset", "seed"), [("office", 100), ("office", 103), ("room", 200)])
def test_a_room_holds_every_class_and_no_camera_touches_furniture(preset, seed):
    room = build(preset, seed)
    assert {CLASS_NAMES[label] for label in np.unique(room.soup.labels)} == set(CLASS_NAMES)
    eyes = centers(walk(room.size, 80, seed))
    caster = RayCaster(room.soup.vertices, room.soup.triangles)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for eye in eyes:
        hits = caster.cast(eye[None], directions)
        assert hits.distance.min() > 0.3
        assert (hits.triangle >= 0).all()


def test_glossy_surfaces_change_with_the_eye():
    from chebsplat.synthetic.light import shade

    lights = np.array([[[0.0, 0.0, 2.5], [0.3, 0.3, 0.0]]])
    one, up = np.ones(1, np.float32), np.float32([[0, 0, 1]])
    eyes = [np.float32([[0, 0, 1]]), np.float32([[0.8, 0, 0.6]])]
    free = lambda start, offset: np.zeros(len(start), bool)  # noqa: E731
    a, b = (shade(np.zeros((1, 3), np.float32), up, eye, np.ones((1, 3)), one, 30 * one, lights, free) for eye in eyes)
    assert a.mean() > 1.1 * b.mean()


def test_an_unknown_preset_is_refused():
    with pytest.raises(KeyError):
        build("castle", 0)
