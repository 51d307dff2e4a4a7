"""One scene written in many ways: each trains to what the scene is worth, or a line names what was
in the way.
"""

import json
import logging
import re
from functools import partial

import layouts
import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from shared import TOY, run_stage
from source_folders import save

from chebsplat.cameras import unproject
from chebsplat.errors import ChebsplatError
from chebsplat.formats.gaussians import Gaussians
from chebsplat.render import SceneRenderer
from chebsplat.stages.sources import common, generated
from chebsplat.views import View

DECIBELS = 1.0  # that a way to write a scene may cost without a word
CONFIG = TOY | {
    "ingest": {"min_views": 2},
    "sfm": {"max_points": 3000, "dense": "off"},
    "train": {
        "steps": 80,
        "semantics": False,
        "max_gaussians": 3500,
        "n_densify": 1,
        "report_every": 80,
    },
}
FLIP = np.array([1.0, -1.0, -1.0, 1.0])
AS_IT_IS = 1.0, np.eye(3), np.zeros(3)
TURNED = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()


@pytest.fixture(scope="module")
def scene():
    """A toy room of 16 views of 96 x 72, and 3,000 points of its surface with colours and who sees
    them [T, 2].
    """
    fields, rng = generated.capture("toy", 1, "toy"), np.random.default_rng(0)
    poses, Ks, depth = fields["cam_from_world"], fields["Ks"], fields["depth"]
    points, colors = [], []
    for k in range(16):
        pixels = np.stack([rng.integers(0, side, 190) for side in depth.shape[1:]], 1)
        points.append(unproject(depth[k], Ks[k], poses[k], pixels))
        colors.append(fields["images"][k][pixels[:, 0], pixels[:, 1]])
    points, tracks = np.concatenate(points), []
    for k in range(16):
        at = points @ poses[k, :3, :3].T + poses[k, :3, 3]
        with np.errstate(divide="ignore"):
            u, v = (at @ Ks[k].T / at[:, 2:])[:, :2].T
        inside = (at[:, 2] > 0) & (u >= 0) & (u < 96) & (v >= 0) & (v < 72)
        seen = np.flatnonzero(inside)
        met = depth[k][v[seen].astype(int), u[seen].astype(int)]
        tracks += [(point, k) for point in seen[np.abs(met / at[seen, 2] - 1) < 0.03]]
    held = {name: fields[name] for name in ("names", "images", "labels", "class_names")}
    return held | {
        "cam_from_world": poses, "Ks": Ks, "depth": depth, "points": points,
        "colors": np.concatenate(colors),
        "tracks": np.array(sorted(tracks)),
    }  # fmt: skip


def psnr_of(scene, folder, source):
    """Test PSNR of a training on a source, its views rendered as the true cameras see them, against
    the true photos.
    """
    config = CONFIG | {"source": {"kind": common.detect(source), "path": str(source)}}
    inputs = {}
    for stage, roles in (("ingest", ()), ("sfm", ("capture",)), ("train", ("capture", "points"))):
        given = {role: folder / {"capture": "ingest", "points": "sfm"}[role] for role in roles}
        if run_stage(stage, folder / stage, given, config):
            return None
        inputs[stage] = folder / stage
    trained = Gaussians.read(inputs["train"])
    renderer, errors = SceneRenderer(sorted_by_degree(trained.parameters)), []
    row = {name.rpartition("/")[2]: k for k, name in enumerate(scene["names"])}
    for name, pose in zip(trained.cameras.names, trained.cameras.cam_from_world, strict=True):
        k = row[name.rpartition("/")[2]]
        if k % 8 == 0:
            K, image = scene["Ks"][k], scene["images"][k]
            view = View(
                torch.from_numpy(K).float(), torch.from_numpy(pose).float(), *image.shape[1::-1]
            )
            errors.append(((renderer.render(view)[0].astype(float) - image) ** 2).mean())
    return float(-10 * np.log10(np.mean(errors) / 255**2))


def sorted_by_degree(parameters):
    order = np.argsort(parameters["degrees"], kind="stable")
    return {name: values[order] for name, values in parameters.items()}


# writers


def colmap(folder, scene, *, model="PINHOLE", more="", name="{}.png", place="sparse/0",
           images="images", keypoints=None,
           way=AS_IT_IS, colors=None, tracks=True, size=1, views=range(16), camera="{w} {h}",
           errors=0.5, depth=None, binary=False, file=None, separate=False):  # fmt: skip
    """A model as COLMAP writes one, but for what is asked for.

    way: scale, rotation and shift of the world; name: of a photo in the model, file: on disk (None:
      the same); size: of
    photos on disk, parts; more: parameters of the camera behind its pinhole; depth: stored values
    of the true ones.
    """
    scale, turn, shift = way
    K, (height, width) = scene["Ks"][0], scene["images"].shape[1:3]
    assert np.ptp(scene["Ks"], axis=0).max() == 0 and K[0, 0] == K[1, 1]
    focals = (
        [K[0, 0]] if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else [K[0, 0], K[1, 1]]
    )
    camera = camera.format(w=width, h=height)
    line = (
        f"{model} {camera} {' '.join(repr(float(v)) for v in (*focals, K[0, 2], K[1, 2]))} {more}"
    )
    sparse = folder / place
    layouts.write_text(
        sparse / "cameras.txt", "".join(f"{k} {line}\n" for k in range(1, 17 if separate else 2))
    )
    points = scale * scene["points"] @ turn.T + shift
    seen = scene["tracks"] if tracks else np.zeros((0, 2), int)
    at, rows = {}, []
    for k in views:
        pose = scene["cam_from_world"][k]
        R, own = pose[:3, :3] @ turn.T, np.flatnonzero(seen[:, 1] == k)
        t = scale * pose[:3, 3] - R @ shift
        quaternion = Rotation.from_matrix(R).as_quat(scalar_first=True)
        written = name.format(scene["names"][k])
        rows.append(
            f"{k + 1} {' '.join(repr(float(v)) for v in (*quaternion, *t))} "
            f"{k + 1 if separate else 1} {written}\n"
        )
        for place_in, row in enumerate(own):
            at[int(row)] = place_in
        listed = " ".join(f"1.5 2.5 {seen[row, 0] + 1}" for row in own)
        rows.append(f"{listed}\n" if keypoints is None else keypoints)
        stored = folder / images / (file or name).format(scene["names"][k])
        photo = Image.fromarray(scene["images"][k])
        stored.parent.mkdir(parents=True, exist_ok=True)
        photo.resize((width // size, height // size), Image.Resampling.BOX).save(
            stored, format="PNG"
        )
        if depth is not None:
            values = (
                depth(scene["depth"].astype(float))[k].round().clip(0, 65_535).astype(np.uint16)
            )
            save(folder / f"depth/{scene['names'][k]}.png", values)
    layouts.write_text(sparse / "images.txt", "".join(rows))
    starts = (
        np.searchsorted(seen[:, 0], np.arange(len(points) + 1))
        if len(seen)
        else np.zeros(len(points) + 1, int)
    )
    colored = (
        scene["colors"]
        if colors is None
        else np.broadcast_to(np.uint8(colors), scene["colors"].shape)
    )
    listed = []
    for k, (xyz, rgb) in enumerate(zip(points, colored, strict=True)):
        own = [row for row in range(starts[k], starts[k + 1]) if row in at]
        track = " ".join(f"{seen[row, 1] + 1} {at[row]}" for row in own)
        listed.append(
            f"{k + 1} {' '.join(repr(float(v)) for v in xyz)} {' '.join(map(str, rgb))} "
            f"{errors} {track}\n"
        )
    layouts.write_text(sparse / "points3D.txt", "".join(listed))
    if binary:
        pycolmap.Reconstruction(str(sparse)).write_binary(str(sparse))
        for path in sparse.glob("*.txt"):
            path.unlink()


def transforms(folder, scene, *, shared=None, frame=None, rows=4, path="images/{}.png", scale=1.0,
               shift=0.0,
               depth=1000.0, document="transforms.json", drop=(), split=False):  # fmt: skip
    """A transforms.json as nerfstudio writes one, with depth, but for what is asked for."""
    K, (height, width) = scene["Ks"][0], scene["images"].shape[1:3]
    whole = {
        "w": width,
        "h": height,
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
    }
    whole = {key: value for key, value in (whole | (shared or {})).items() if key not in drop}
    frames = []
    for name, image, z, pose in zip(scene["names"], scene["images"], scene["depth"],
                                    layouts.world_from_cam(scene),
                                    strict=True):  # fmt: skip
        save(folder / "images" / f"{name}.png", image)
        matrix = pose * FLIP
        matrix[:3, 3] = scale * matrix[:3, 3] + shift
        save(folder / f"depth/{name}.png", (z * depth).round().astype(np.uint16))
        entry = {"file_path": path.format(name), "transform_matrix": matrix[:rows].tolist()}
        entry |= {"depth_file_path": f"depth/{name}.png"} | (frame or {})
        frames.append(entry)
    if not split:
        layouts.write_text(folder / document, json.dumps(whole | {"frames": frames}))
        return
    for part, chosen in (("train", [k for k in range(16) if k % 8]), ("test", [0, 8])):
        listed = [frames[k] for k in chosen]
        layouts.write_text(
            folder / f"transforms_{part}.json", json.dumps(whole | {"frames": listed})
        )


def after(write, change):
    """A writer, and what is changed in its folder."""

    def both(folder, scene):
        write(folder, scene)
        change(folder)

    return both


def every(path, change):
    """Text files of a folder of which `change` makes others."""

    def apply(folder):
        for file in folder.glob(path):
            file.write_text(change(file.read_text()))

    return apply


def small_model_first(folder, scene):
    colmap(folder, scene, place="sparse/1")
    colmap(folder, scene, place="sparse/0", views=range(5))


def rgba(folder):
    for path in (folder / "images").iterdir():
        Image.open(path).convert("RGBA").save(path)


def white_masks(folder):
    for path in (folder / "images").iterdir():
        save(folder / "masks" / path.name, np.full((72, 96), 255, np.uint8))


def absolute(folder):
    every("transforms.json", lambda text: text.replace('"images/', f'"{folder}/images/'))(folder)


def trailing(folder):
    with (folder / "sparse/0/points3D.bin").open("ab") as stream:
        stream.write(b"\0" * 7)


def half_depth(folder):
    for path in (folder / "depth").iterdir():
        save(path, np.asarray(Image.open(path))[::2, ::2])


C, T = colmap, transforms
MM = {"depth": lambda z: 1000 * z}


def holes(z, codes=(65_535,)):
    """Millimetres with a corner, and an edge, of unknown depth in every view."""
    stored = 1000 * z
    for k, code in enumerate(codes):
        stored[:, 20 * k : 20 * k + 16, :20] = code
    return stored


# (what, how it is written, a word of the line that names the cause where it costs more, or is
# refused)
POINTS = {
    "text": (C, ""),
    "binary": (partial(C, binary=True), ""),
    "SIMPLE_PINHOLE": (partial(C, model="SIMPLE_PINHOLE"), ""),
    "SIMPLE_RADIAL without distortion": (partial(C, model="SIMPLE_RADIAL", more="0"), ""),
    "RADIAL without distortion": (partial(C, model="RADIAL", more="0 0"), ""),
    "OPENCV without distortion": (partial(C, model="OPENCV", more="0 0 0 0"), ""),
    "FULL_OPENCV without distortion": (
        partial(C, model="FULL_OPENCV", more="0 0 0 0 0 0 0 0"),
        "FULL_OPENCV",
    ),
    "a camera a view": (partial(C, separate=True), ""),
    "black points": (partial(C, colors=0), "colou?r"),
    "white points": (partial(C, colors=255), "colou?r"),
    "grey points": (partial(C, colors=128), "colou?r"),
    "points without tracks": (partial(C, tracks=False), ""),
    "points whose error is unknown": (partial(C, errors="nan"), "error"),
    "points whose error is -1": (partial(C, errors=-1), ""),
    "no lines of keypoints": (partial(C, keypoints="", tracks=False), ""),
    "remarks for keypoints": (partial(C, keypoints="# none\n", tracks=False), "images.txt"),
    "spaces before remarks": (
        after(C, every("sparse/0/*.txt", lambda text: "  # made by hand\n" + text)),
        r"\.txt",
    ),
    "lines as Windows ends them": (
        after(C, every("sparse/0/*.txt", lambda text: text.replace("\n", "\r\n"))),
        "",
    ),
    "empty lines at the end": (after(C, every("sparse/0/*.txt", lambda text: text + "\n\n")), ""),
    "a size with decimals": (partial(C, camera="{w}.0 {h}.0"), "cameras.txt"),
    "a thousandth": (partial(C, way=(1e-3, np.eye(3), np.zeros(3))), ""),
    "thousandfold": (partial(C, way=(1e3, np.eye(3), np.zeros(3))), ""),
    "turned": (partial(C, way=(1.0, TURNED, np.zeros(3))), ""),
    "far away": (partial(C, way=(1.0, np.eye(3), np.array([5e5, -3e5, 100.0]))), ""),
    "very far away": (partial(C, way=(1.0, np.eye(3), np.array([5e6, 4e6, 0.0]))), "far"),
    "small, turned and far away": (
        partial(C, way=(0.01, TURNED, np.array([900.0, 4.0, -7.0]))),
        "",
    ),
    "a small model first": (small_model_first, ""),
    "a model in sparse/": (partial(C, place="sparse"), ""),
    "a model in colmap/sparse/0": (partial(C, place="colmap/sparse/0"), "colmap|is no source"),
    "photos in input/": (partial(C, images="input"), "input|images is missing"),
    "endings in capitals": (partial(C, name="{}.PNG"), ""),
    "endings in capitals on disk": (partial(C, file="{}.PNG"), "absent on disk|usable frames"),
    "other endings on disk": (
        partial(C, name="{}.jpg", file="{}.png"),
        "absent on disk|usable frames",
    ),
    "folders before names": (
        partial(C, name="images/{}.png", file="{}.png"),
        "absent on disk|usable frames",
    ),
    "folders within images/": (partial(C, name="left/{}.png"), ""),
    "backslashes": (
        partial(C, name="left\\{}.png", file="left/{}.png"),
        "absent on disk|usable frames",
    ),
    "photos half as large": (partial(C, size=2), "48x36"),
    "images_2 alone": (partial(C, size=2, images="images_2"), "images_2|images is missing"),
    "bytes behind the last point": (after(partial(C, binary=True), trailing), "points3D"),
    "photos with alpha": (after(C, rgba), ""),
    "masks that hide nothing": (after(C, white_masks), ""),
}
DEPTH = {
    "millimetres": (partial(C, **MM), ""),
    "millimetres beside another unit": (partial(C, way=(0.3, TURNED, np.ones(3)), **MM), ""),
    "five thousandths": (partial(C, depth=lambda z: 5000 * z), ""),
    "inverse depth": (partial(C, depth=lambda z: 25_000 / z - 2000), ""),
    "65535 for unknown": (partial(C, depth=holes), ""),
    "several codes for unknown": (partial(C, depth=partial(holes, codes=(65_535, 50_000, 1))), ""),
    "depth of other views": (partial(C, depth=lambda z: 1000 * np.roll(z, 5, 0)),
                             r"in no unit.*ingest\.depth=off"),
    "depth half as large": (after(partial(C, **MM), half_depth), "48x36"),
    "transforms.json": (T, ""),
    "distortion of zero": (partial(T,
                                   shared={"camera_model": "OPENCV", "k1": 0, "k2": 0, "p1": 0,
                                           "p2": 0}), ""),
    "a list of distortion": (partial(T, shared={"distortion_params": [0, 0, 0, 0, 0, 0]}),
                             "distortion_params"),
    "an angle of view": (lambda folder,
                         scene: transforms(folder, scene, drop=("fl_x", "fl_y", "cx", "cy"),
                                           shared={
        "camera_angle_x": 2 * np.arctan(48 / scene["Ks"][0, 0, 0])}), ""),
    "names without endings": (partial(T, path="images/{}"), ""),
    "names with ./": (partial(T, path="./images/{}.png"), ""),
    "whole paths": (after(T, absolute), ""),
    "matrices of three rows": (partial(T, rows=3), "3, 4|3x4"),
    "a file for training, one for tests": (partial(T, split=True), r"transforms"),
    "another unit than the depth's": (partial(T, scale=0.3), ""),
    "five thousandths beside transforms.json": (partial(T, depth=5000.0), ""),
    "transforms.json far away": (partial(T, shift=np.array([5e5, 2e5, 10.0])), ""),
    "intrinsics of each frame": (lambda folder,
                                 scene: transforms(folder, scene,
                                                   shared={"fl_x": 30.0, "fl_y": 30.0},
        frame={"fl_x": scene["Ks"][0, 0, 0], "fl_y": scene["Ks"][0, 1, 1]}), ""),
}  # fmt: skip
WAYS = [
    (family, name) for family, table in (("points", POINTS), ("depth", DEPTH)) for name in table
]


@pytest.fixture(scope="module")
def worth(scene, tmp_path_factory):
    """What the scene is worth by points and by depth, dB."""
    folder, found = tmp_path_factory.mktemp("truth"), {}
    for family, (write, _) in (("points", POINTS["text"]), ("depth", DEPTH["millimetres"])):
        write(folder / family / "scene", scene)
        found[family] = psnr_of(scene, folder / family, folder / family / "scene")
        assert found[family] > 15, family
    return found


@pytest.mark.slow
@pytest.mark.xdist_group("ways")
@pytest.mark.parametrize(
    ("family", "name"), WAYS, ids=[f"{family}: {name}" for family, name in WAYS]
)
def test_a_way_to_write_a_scene_costs_no_decibel_without_a_word(
    scene, worth, tmp_path, caplog, capfd, family, name
):
    write, word = (POINTS if family == "points" else DEPTH)[name]
    write(tmp_path / "scene", scene)
    with caplog.at_level(logging.INFO, "chebsplat"):
        try:
            found, said = psnr_of(scene, tmp_path, tmp_path / "scene"), ""
        except ChebsplatError as refused:
            found, said = None, str(refused)
    said += caplog.text + capfd.readouterr().err
    print(f"{family}: {name}: {found} of {worth[family]} dB")
    if found is None or found < worth[family] - DECIBELS:
        assert word and re.search(word, said, re.IGNORECASE), (
            f"{found} dB of {worth[family]}: {said[-2000:]}"
        )
