"""A splat of another frame than the cameras comes into theirs where anything tells the way; else it
is refused.
"""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shared import INPUTS, TOY, run_stage

from chebsplat.cameras import centers, unproject
from chebsplat.errors import InputError
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.lifted import Lifted
from chebsplat.formats.ply import write_ply
from chebsplat.splats.gaussians import initial_gaussians, local_shape
from chebsplat.splats.similarity import Similarity
from chebsplat.stages.sources import generated
from chebsplat.stages.tools.lift_ply import lift_ply
from chebsplat.stages.training.placing import in_frame

ANY = Similarity(
    0.31, Rotation.from_rotvec([1.0, 2.0, 0.3]).as_matrix(), np.array([4.0, 0.2, -3.0])
)
# to nerfstudio's axes, as its COLMAP reader has them
COLMAPS = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def view_of(capture):
    return Cameras(capture.names, capture.Ks, capture.cam_from_world, *capture.size)


def splat_of(capture, rng):
    """A splat of 21,000 points of a capture's depth, and 3,000 other points within 1 cm of it."""
    means, colors = [], []
    for k, depth in enumerate(capture.depth[:]):
        pixels = np.argwhere(depth > 0)
        pixels = pixels[rng.choice(len(pixels), 24_000 // len(capture.names))]
        means.append(unproject(depth, capture.Ks[k], capture.cam_from_world[k], pixels))
        colors.append(capture.images[k][pixels[:, 0], pixels[:, 1]])
    means, colors = np.concatenate(means), np.concatenate(colors)
    order = rng.permutation(len(means))
    splat, rest = order[3000:], order[:3000]
    raw = initial_gaussians(means[splat], colors[splat], local_shape(means[splat], 16)[0], 0.7)
    parameters = {name: value.detach().numpy() for name, value in raw.items()}
    parameters["sh0"] = parameters["sh0"].reshape(-1, 1, 3)
    parameters["shN"] = rng.normal(0, 0.02, (len(splat), 15, 3)).astype(np.float32)
    return parameters, means[rest] + rng.normal(0, 0.01, (3000, 3))


@pytest.fixture(scope="module")
def room():
    """A capture of a toy room, a splat of it, and points."""
    fields = generated.capture("toy", 1, "toy")
    names = "names", "images", "Ks", "cam_from_world"
    is_test = np.arange(len(fields["names"])) % 8 == 0
    capture = Capture(*(fields[name] for name in names), is_test, fields["depth"])
    return capture, *splat_of(capture, np.random.default_rng(0))


def nerfstudios(capture, points, prior=None):
    """`orientation up`, `center poses`, `auto scale`."""
    prior = np.eye(3) if prior is None else prior
    eyes, up = (
        centers(capture.cam_from_world) @ prior.T,
        -capture.cam_from_world[:, 1, :3].mean(0) @ prior.T,
    )
    turn = Rotation.align_vectors([[0, 0, 1.0]], [up])[0]
    placed = turn.apply(eyes - eyes.mean(0))
    return moved(lambda x: turn.apply(x @ prior.T - eyes.mean(0)) / np.abs(placed).max())


def gsplats(capture, points):
    """`normalize_world_space`: upright, what is looked at to 0, median distance 1, then axes of the
    points.
    """
    turn = Rotation.align_vectors([[0, -1.0, 0]], [-capture.cam_from_world[:, 1, :3].mean(0)])[0]
    eyes, axes = (
        turn.apply(centers(capture.cam_from_world)),
        turn.apply(capture.cam_from_world[:, 2, :3]),
    )
    middle = np.median(
        [eye - axis * (eye @ axis) for eye, axis in zip(eyes, axes, strict=True)], axis=0
    )
    scale = np.median(np.linalg.norm(eyes - middle, axis=1))
    cloud = (turn.apply(points) - middle) / scale
    frame = np.linalg.svd(cloud - cloud.mean(0), full_matrices=False)[2]
    frame *= np.linalg.det(frame)
    return moved(lambda x: ((turn.apply(x) - middle) / scale - np.median(cloud, axis=0)) @ frame.T)


def moved(change):
    """The similarity that a function of points is."""
    shift = change(np.zeros((1, 3)))[0]
    matrix = (change(np.eye(3)) - shift).T
    scale = np.linalg.norm(matrix[:, 0])
    return Similarity(scale, matrix / scale, shift)


WAYS = {
    "nerfstudio of transforms.json": (nerfstudios, True),
    "nerfstudio of COLMAP": (lambda *given: nerfstudios(*given, COLMAPS), True),
    "nerfstudio without points": (nerfstudios, False),
    "gsplat": (gsplats, True),
    "any, told by points": (lambda *_: ANY, True),
    "larger": (lambda *_: Similarity(1.5, np.eye(3), np.zeros(3)), True),
}


@pytest.mark.parametrize("name", WAYS)
def test_a_frame_that_trainers_make_of_the_cameras_is_found_and_told(room, tmp_path, caplog, name):
    capture, parameters, points = room
    make, with_points = WAYS[name]
    way = make(capture, points)
    with caplog.at_level(logging.WARNING, "chebsplat"):
        given = way.of_gaussians(parameters)
        found = in_frame(
            tmp_path / "a.ply", given, capture, view_of(capture), points if with_points else None
        )
    extent = np.ptp(parameters["means"], axis=0).max()
    off = np.linalg.norm(found["means"] - parameters["means"], axis=1) / extent
    assert np.median(off) < 0.002  # of the room's extent; points lie 1 cm off
    assert "lies in another frame than the cameras" in caplog.text


@pytest.mark.parametrize(
    "axes", [np.eye(3), COLMAPS, COLMAPS.T], ids=["as they are", "swapped", "swapped back"]
)
@pytest.mark.parametrize("place", [".", "run/exports/splat"])
def test_a_file_of_nerfstudio_tells_the_way_exactly(room, tmp_path, place, axes):
    capture, parameters, _ = room
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    matrix = np.c_[ANY.rotation, ANY.shift / ANY.scale].tolist()
    (tmp_path / "dataparser_transforms.json").write_text(
        json.dumps({"transform": matrix, "scale": ANY.scale})
    )
    given = ANY.after(Similarity(1.0, axes, np.zeros(3))).of_gaussians(parameters)
    found = in_frame(tmp_path / place / "a.ply", given, capture, view_of(capture), None)
    for part in ("means", "log_scales", "shN"):
        np.testing.assert_allclose(found[part], parameters[part], atol=2e-5)


@pytest.mark.parametrize(
    "text", ["{}", '{"transform": [[1, 0], [0, 1]], "scale": 1}', '{"transform": 3, "scale": "x"}']
)
def test_a_file_of_nerfstudio_that_says_nothing_is_named(room, tmp_path, text):
    capture, parameters, _ = room
    (tmp_path / "dataparser_transforms.json").write_text(text)
    with pytest.raises(InputError, match=r"dataparser_transforms\.json holds no"):
        in_frame(tmp_path / "a.ply", ANY.of_gaussians(parameters), capture, view_of(capture), None)


def test_a_splat_in_the_cameras_frame_stays_bit_for_bit_whatever_lies_beside(room, tmp_path):
    capture, parameters, points = room
    (tmp_path / "dataparser_transforms.json").write_text("{}")
    assert in_frame(tmp_path / "a.ply", parameters, capture, view_of(capture), points) is parameters


@pytest.mark.parametrize("what", ["any frame, without points", "of another scene"])
def test_what_nothing_tells_the_way_of_is_refused_with_what_was_tried(room, tmp_path, what):
    capture, parameters, points = room
    given = ANY.of_gaussians(parameters)
    if what == "of another scene":
        rng = np.random.default_rng(1)
        given["means"] = rng.normal(0, 1, given["means"].shape).astype(np.float32)
        given["log_scales"] = np.full_like(given["log_scales"], -4)
    with pytest.raises(
        InputError, match=r"another frame.*nerfstudio's and gsplat's.*dataparser_transforms\.json"
    ) as no:
        in_frame(
            tmp_path / "a.ply",
            given,
            capture,
            view_of(capture),
            points if "scene" in what else None,
        )
    assert str(tmp_path / "a.ply") in str(no.value)


def test_a_splat_trained_little_is_taken_with_a_warning_and_few_views_or_one_colour_say_nothing(
    room, tmp_path, caplog
):
    capture, parameters, _ = room
    rng = np.random.default_rng(0)
    few = parameters | {
        "means": parameters["means"]
        + rng.normal(0, 0.4, (len(parameters["means"]), 3)).astype("f4")
    }
    with caplog.at_level(logging.WARNING, "chebsplat"):
        assert in_frame(tmp_path / "a.ply", few, capture, view_of(capture), None) is few
    assert "trained little" in caplog.text
    three = Capture(*(values[:3] for values in (capture.names, capture.images, capture.Ks,
                                                capture.cam_from_world)),
                    np.zeros(3, bool))  # fmt: skip
    far = ANY.of_gaussians(parameters)
    assert in_frame(tmp_path / "a.ply", far, three, view_of(three), None) is far
    plain = far | {"sh0": np.ones_like(far["sh0"])}
    assert in_frame(tmp_path / "a.ply", plain, capture, view_of(capture), None) is plain


@pytest.mark.xdist_group("toy")
def test_lift_and_train_take_a_splat_of_nerfstudios_frame_as_if_it_lay_in_theirs(
    up_to_teacher, tmp_path
):
    capture = Capture.read(up_to_teacher / "ingest")
    parameters, _ = splat_of(capture, np.random.default_rng(0))
    way = nerfstudios(capture, None)
    features, psnr = [], []
    for name, given in (("ours", parameters), ("theirs", way.of_gaussians(parameters))):
        write_ply(tmp_path / f"{name}.ply", given, 3)
        figures = lift_ply(tmp_path / f"{name}.ply", up_to_teacher / "ingest",
                           up_to_teacher / "sfm",
                           up_to_teacher / "teacher", None, tmp_path / name)  # fmt: skip
        assert figures["gaussians"] == len(parameters["means"])
        features.append(Lifted.read(tmp_path / name / "lift").features)
        train = TOY["train"] | {
            "start": str(tmp_path / f"{name}.ply"),
            "max_gaussians": 30_000,
            "steps": 4,
            "report_every": 1,
        }
        inputs = {role: up_to_teacher / of for role, of in INPUTS["train"].items()}
        assert run_stage("train", tmp_path / f"{name}-train", inputs, TOY | {"train": train}) == 0
        psnr.append(Gaussians.read(tmp_path / f"{name}-train").trace[0]["psnr"])
    alike = (features[0] * features[1]).sum(1) / np.maximum(
        np.linalg.norm(features[0], axis=1) ** 2, 1e-9
    )
    assert np.median(alike[features[0].any(1)]) > 0.999
    assert abs(psnr[0] - psnr[1]) < 0.1


@pytest.mark.parametrize("told", ["in its source's", "by cameras", "by a file"])
def test_in_a_scene_that_is_normalised_inside_the_way_is_found_from_the_source_world(
    room, tmp_path, told
):
    capture, parameters, _ = room
    outward = Similarity(1000.0, np.eye(3), np.array([5000.0, -2000.0, 100.0]))
    capture = replace(
        capture, source={"world": {"origin": outward.shift.tolist(), "scale": 1000.0}}
    )
    way = {"in its source's": outward, "by cameras": nerfstudios(capture, None), "by a file": ANY}[
        told
    ]
    if told == "by a file":
        from_source = ANY.after(outward.inverse())
        matrix = np.c_[from_source.rotation, from_source.shift / from_source.scale].tolist()
        text = json.dumps({"transform": matrix, "scale": from_source.scale})
        (tmp_path / "dataparser_transforms.json").write_text(text)
    theirs = way.of_gaussians(parameters)
    inside = outward.inverse().of_gaussians(theirs)
    found = in_frame(tmp_path / "a.ply", inside, capture, view_of(capture), None, theirs)
    np.testing.assert_allclose(found["means"], parameters["means"], atol=1e-5)
