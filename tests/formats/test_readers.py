"""Every exported layout opens in readers that know nothing of chebsplat: counts, positions and tags
agree.

From PyPI gsply, Open3D, plyfile and zarr; from npm splat-transform (PlayCanvas), Spark and zarrita,
installed into build/readers by the first test that wants them.
"""

import csv
import shutil
import subprocess

import numpy as np
import pytest
from shared import ROOT, gaussian_parameters

import chebsplat.kernels.jit  # noqa: F401  # chooses the threading layer before gsply's numba
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.scene import Scene

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("readers")]

NPM = {
    "@playcanvas/splat-transform": "2.7.1",
    "@sparkjsdev/spark": "2.2.0",
    "three": "0.187.0",
    "zarrita": "0.7.5",
}
NAMES = ["wall", "floor", "round table"]
# as the README gives them
CONVERSIONS = {"scene.compressed.ply": [], "scene.spz": ["--spz-version", "3"]}
GRID = 2.0**-12  # of SPZ's positions


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
    """The exported folder with the two compressed files in it."""
    for name, options in CONVERSIONS.items():
        transform(packages, *options, exported[0] / "scene.ply", exported[0] / name)
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


def part_of(p, labels, name):
    if name == "scene.ply":
        return p, labels
    kept = p["degrees"] == int(name[7])
    return {key: values[kept] for key, values in p.items()}, labels[kept]


PLY = ["scene.ply", *(f"scene_d{degree}.ply" for degree in range(4))]


@pytest.mark.parametrize("name", PLY)
def test_ply_opens_in_gsply(exported, name):
    import gsply

    p, _ = part_of(*exported[1:], name)
    found = gsply.plyread(exported[0] / name)
    n_rest = found.shN.shape[1]
    assert np.array_equal(found.means, p["means"])
    assert np.array_equal(found.quats, p["quats"])
    assert np.array_equal(found.scales, p["log_scales"])
    assert np.array_equal(found.opacities.ravel(), p["logit_opacities"])
    assert np.array_equal(found.sh0.reshape(-1, 1, 3), p["sh0"])
    assert n_rest == (15 if name == "scene.ply" else (int(name[7]) + 1) ** 2 - 1)
    assert np.array_equal(found.shN, p["shN"][:, :n_rest])


@pytest.mark.parametrize("name", PLY)
def test_ply_opens_in_open3d_tags_included(exported, name):
    import open3d

    p, labels = part_of(*exported[1:], name)
    found = open3d.t.io.read_point_cloud(str(exported[0] / name)).point
    assert np.array_equal(found.positions.numpy(), p["means"])
    assert np.array_equal(found.label.numpy().ravel(), labels)
    assert np.array_equal(found.sh_degree.numpy().ravel(), p["degrees"])


@pytest.mark.parametrize("name", PLY)
def test_ply_opens_in_splat_transform_tags_included(exported, name, packages, tmp_path):
    p, labels = part_of(*exported[1:], name)
    found = by_splat_transform(exported[0] / name, packages, tmp_path)
    assert np.array_equal(
        np.stack([found[axis] for axis in "xyz"], 1).astype(np.float32), p["means"]
    )
    assert np.array_equal(found["opacity"].astype(np.float32), p["logit_opacities"])
    assert np.array_equal(found["label"], labels)
    assert np.array_equal(found["sh_degree"], p["degrees"])


@pytest.mark.parametrize("name", PLY)
def test_ply_opens_in_spark(exported, name, packages, tmp_path):
    p, _ = part_of(*exported[1:], name)
    found = by_spark(exported[0] / name, packages, tmp_path)
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


def test_spz_opens_in_gsply_and_spark_and_is_version_3(exported, converted, packages, tmp_path):
    import gzip

    import gsply

    p = exported[1]
    header = gzip.decompress((converted / "scene.spz").read_bytes())[:16]
    assert header[:4] == b"NGSP"
    assert np.frombuffer(header[4:12], "<u4").tolist() == [3, len(p["means"])]
    found = gsply.read_spz(converted / "scene.spz")
    turned = p["means"] * [1, -1, -1]  # SPZ looks along -z, y up
    assert np.abs(found.means - turned).max() <= 1.01 * GRID
    # 1/16 of log-scale, cut to [-10, 6); 8 bits of opacity
    assert np.abs(found.scales - p["log_scales"]).max() <= 0.51 / 16
    opacities, wanted = (
        1 / (1 + np.exp(-v.astype(float).ravel())) for v in (found.opacities, p["logit_opacities"])
    )
    assert np.abs(opacities - wanted).max() <= 1.01 / 255
    assert (
        np.abs(by_spark(converted / "scene.spz", packages, tmp_path) - turned).max() <= 2.01 * GRID
    )


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
        assert np.abs(plain * group.attrs["steps"][name] - p["features"]).max() < 1e-4
