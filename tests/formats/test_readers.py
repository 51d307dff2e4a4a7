"""Every exported layout opens in readers that know nothing of chebsplat: counts, positions and tags
agree.

From PyPI gsply, Open3D, plyfile and zarr; from npm splat-transform (PlayCanvas), Spark and zarrita,
installed into build/readers by the first test that wants them. Where there is a browser, Spark
draws them there.
"""

import base64
import csv
import json
import shutil
import subprocess

import numpy as np
import pytest
from box_room import room
from browser import BROWSER
from driven import driven
from served import served
from shared import ROOT, gaussian_parameters

from chebsplat.formats.cameras import Cameras
from chebsplat.formats.scene import Scene
from chebsplat.formats.splats import read_splats, write_splats
from chebsplat.render import SceneRenderer
from chebsplat.stages.tools.page import foreign
from chebsplat.stages.tools.scene import OpenedScene
from chebsplat.synthetic.rays import open3d

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("readers")]

NPM = {
    "@playcanvas/splat-transform": "2.7.1",
    "@sparkjsdev/spark": "2.2.0",
    "three": "0.187.0",
    "zarrita": "0.7.5",
}
NAMES = ["wall", "floor", "round table"]
GRID = 2.0**-12  # of the positions that Spark tells


@pytest.fixture(scope="session")
def packages():
    """node_modules with the packages of NPM."""
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed")
    folder = ROOT / "build/readers"
    wanted = [f"{name}@{version}" for name, version in NPM.items()]
    stamp = folder / "installed"
    if not stamp.is_file() or stamp.read_text() != "\n".join(wanted):
        folder.mkdir(parents=True, exist_ok=True)
        command = [
            "npm",
            "install",
            "--prefix",
            str(folder),
            "--no-save",
            "--ignore-scripts",
            "--no-audit",
            *wanted,
        ]
        subprocess.run(command, check=True, capture_output=True)
        stamp.write_text("\n".join(wanted))
    return folder / "node_modules"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A scene with all four degrees, three labels and none, and what it was made from."""
    path, n = tmp_path_factory.mktemp("readers"), 1000
    p = gaussian_parameters(n)
    rng = np.random.default_rng(1)
    p["features"] = rng.normal(size=(n, 4)).astype(np.float32)
    labels = rng.integers(-1, 3, n).astype(np.int32)
    cameras = Cameras(["a"], np.eye(3)[None], np.eye(4)[None], 5, 4)
    Scene(p, cameras, np.arange(n), labels, NAMES, np.eye(3, 4, dtype=np.float32)).write(path)
    return path, p, labels


@pytest.fixture(scope="module")
def converted(exported, packages):
    """The exported folder with a compressed PLY in it, as docs/usage.md has it, and SOG of ours."""
    transform(packages, exported[0] / "scene.ply", exported[0] / "scene.compressed.ply")
    write_splats(exported[0] / "scene.sog", exported[1])
    return exported[0]


def transform(packages, *arguments):
    cli = packages / "@playcanvas/splat-transform/bin/cli.mjs"
    subprocess.run(
        ["node", cli, "--quiet", "--overwrite", *map(str, arguments)],
        check=True,
        capture_output=True,
    )


def by_splat_transform(path, packages, tmp_path):
    """All columns by name."""
    transform(packages, path, tmp_path / "out.csv")
    with (tmp_path / "out.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def by_spark(path, packages, tmp_path):
    """Positions in the axes of the file."""
    import gsply

    command = [
        "node",
        ROOT / "tests/support/readers.mjs",
        "spark",
        path,
        tmp_path / "out.spz",
        packages,
    ]
    subprocess.run([str(c) for c in command], check=True, capture_output=True)
    return gsply.read_spz(tmp_path / "out.spz").means


def test_ply_opens_in_gsply(exported):
    import gsply

    p = exported[1]
    found = gsply.plyread(exported[0] / "scene.ply")
    n_rest = found.shN.shape[1]
    assert np.array_equal(found.means, p["means"])
    assert np.array_equal(found.quats, p["quats"])
    assert np.array_equal(found.scales, p["log_scales"])
    assert np.array_equal(found.opacities.ravel(), p["logit_opacities"])
    assert np.array_equal(found.sh0.reshape(-1, 1, 3), p["sh0"])
    assert n_rest == 15
    assert np.array_equal(found.shN, p["shN"][:, :n_rest])


def test_ply_opens_in_open3d_tags_included(exported):
    _, p, labels = exported
    found = open3d().t.io.read_point_cloud(str(exported[0] / "scene.ply")).point
    assert np.array_equal(found.positions.numpy(), p["means"])
    assert np.array_equal(found.label.numpy().ravel(), labels)
    assert np.array_equal(found.sh_degree.numpy().ravel(), p["degrees"])


def test_ply_opens_in_splat_transform_tags_included(exported, packages, tmp_path):
    _, p, labels = exported
    found = by_splat_transform(exported[0] / "scene.ply", packages, tmp_path)
    assert np.array_equal(
        np.stack([found[axis] for axis in "xyz"], 1).astype(np.float32), p["means"]
    )
    assert np.array_equal(found["opacity"].astype(np.float32), p["logit_opacities"])
    assert np.array_equal(found["label"], labels)
    assert np.array_equal(found["sh_degree"], p["degrees"])


def test_ply_opens_in_spark(exported, packages, tmp_path):
    p = exported[1]
    found = by_spark(exported[0] / "scene.ply", packages, tmp_path)
    assert found.shape == p["means"].shape
    assert np.abs(found - p["means"]).max() <= 1.01 * GRID


def test_compressed_ply_opens_in_gsply_and_spark(exported, converted, packages, tmp_path):
    import gsply
    from scipy.spatial import cKDTree

    means = exported[1]["means"]
    found = gsply.plyread(converted / "scene.compressed.ply").means
    assert found.shape == means.shape
    # chunks of 256 in Morton order share a box, in which 11, 10 and 11 bits count
    step = np.ptp(means, axis=0).max() / 1023
    distance, match = cKDTree(means).query(found)
    assert distance.max() < step
    assert len(np.unique(match)) > 0.99 * len(means)
    assert (
        np.abs(by_spark(converted / "scene.compressed.ply", packages, tmp_path) - found).max()
        <= 1.01 * GRID
    )


@pytest.mark.parametrize("name", ["scene.spz", "scene.sog"])
def test_small_files_of_ours_are_to_others_what_they_are_to_us(converted, packages, tmp_path, name):
    import gsply

    ours, _, _ = read_splats(converted / name)
    found = by_splat_transform(converted / name, packages, tmp_path)
    columns = {
        "means": [found[axis] for axis in "xyz"],
        "log_scales": [found[f"scale_{k}"] for k in range(3)],
        "quats": [found[f"rot_{k}"] for k in range(4)],
        "sh0": [found[f"f_dc_{k}"] for k in range(3)],
        "shN": [found[f"f_rest_{15 * c + k}"] for k in range(15) for c in range(3)],
    }
    for key, values in columns.items():
        wanted = ours[key].reshape(len(values[0]), -1)
        np.testing.assert_allclose(np.stack(values, 1), wanted, atol=2e-5, err_msg=key)
    shown = 1 / (1 + np.exp(-found["opacity"]))
    np.testing.assert_allclose(shown, 1 / (1 + np.exp(-ours["logit_opacities"])), atol=2e-5)
    turned = ours["means"] * [1, -1, -1]  # SPZ looks along -z, y up
    if name == "scene.spz":
        assert np.abs(gsply.read_spz(converted / name).means - turned).max() < 1e-5
        assert np.abs(by_spark(converted / name, packages, tmp_path) - turned).max() <= 1.01 * GRID


@pytest.mark.skipif(BROWSER is None, reason="neither chromium nor google-chrome is installed")
def test_spark_draws_small_files_of_ours_as_it_draws_the_ply(packages, tmp_path):
    parameters = room(20_000)[0]
    parameters["degrees"] = np.ones(len(parameters["means"]), np.uint8)
    shutil.copy(ROOT / "tests/support/spark.html", tmp_path)
    (tmp_path / "node_modules").symlink_to(packages)
    kinds = ("ply", "spz", "sog")
    for kind in kinds:
        write_splats(tmp_path / f"room.{kind}", dict(parameters))
    seen = OpenedScene(foreign(tmp_path / "room.ply"), tmp_path / "room.ply").cameras[0]
    view = seen.view()
    camera = {"R": view.viewmat[:3, :3].ravel(), "t": view.viewmat[:3, 3], "K": view.K.ravel()}
    camera = {name: values.tolist() for name, values in camera.items()}
    camera |= {"width": view.width, "height": view.height}
    drawn = {}
    with served(tmp_path) as address, driven(tmp_path) as browser:
        browser.open(f"{address}/spark.html", 960, 720)
        loaded = "const wait = () => window.draw ? done() : setTimeout(wait, 50)"
        browser.run(f"new Promise(done => {{ {loaded}; wait(); }})")
        for kind in kinds:
            given = json.dumps(camera | {"turned": kind == "spz"})
            text = browser.run(f"draw('{address}/room.{kind}', {given})")
            picture = np.frombuffer(base64.b64decode(text), np.uint8)
            drawn[kind] = picture.reshape(view.height, view.width, 4)[::-1, :, :3].astype(float)
    truth = SceneRenderer(parameters).render(view)[0]

    def decibels(one, other):
        return 10 * np.log10(255**2 / np.mean((one - other) ** 2))

    # Spark widens small Gaussians more than the renderer does
    assert decibels(drawn["ply"], truth) > 28
    assert decibels(drawn["spz"], drawn["ply"]) > 38
    assert decibels(drawn["sog"], drawn["ply"]) > 38


def test_compressed_files_are_small(exported, converted):
    unpruned = 62 * 4 * len(exported[1]["means"])
    assert (converted / "scene.compressed.ply").stat().st_size < 0.35 * unpruned
    assert (converted / "scene.spz").stat().st_size < 0.35 * unpruned


@pytest.mark.parametrize("name", ["means", "sh2", "sh3", "features"])
def test_ragged_arrays_open_in_zarr_and_zarrita(exported, name, packages, tmp_path):
    import zarr

    path, p, _ = exported
    group = zarr.open_group(str(path), mode="r")
    plain = np.asarray(group[name][:])
    command = [
        "node",
        ROOT / "tests/support/readers.mjs",
        "zarrita",
        path / name,
        tmp_path / "out.bin",
        packages,
    ]
    subprocess.run([str(c) for c in command], check=True, capture_output=True)
    assert np.array_equal(
        np.fromfile(tmp_path / "out.bin", plain.dtype).reshape(plain.shape), plain
    )
    band = int(name[-1]) if name[-1].isdigit() else 0
    if band:
        wanted = p["shN"][p["degrees"] >= band, band**2 - 1 : (band + 1) ** 2 - 1]
        assert np.array_equal(plain.reshape(wanted.shape), wanted)
    elif name == "means":
        assert np.array_equal(plain, p["means"])
    else:
        steps, rows = (np.asarray(group[of][:]) for of in ("steps", "meanings"))
        found = (plain * steps[:, None])[rows]
        assert np.abs(found - p["features"]).max() < 0.51 / 127 * np.abs(p["features"]).max()
