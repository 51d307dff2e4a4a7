"""Every export lies in the frame and units of the poses that were given, however large, far off and
tilted they are.
"""

from copy import deepcopy

import numpy as np
import pytest
from click.testing import CliRunner
from plyfile import PlyData
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from shared import published

import chebsplat
from chebsplat.formats.packed import Packed, unpack
from chebsplat.formats.ply import read_ply
from chebsplat.formats.scene import Scene
from chebsplat.formats.splats import read_splats
from chebsplat.pipelines.cli import main
from chebsplat.stages.sources.colmap_model import read_model
from tests.stages.tools.test_page import held_in

SCALE, SHIFT = 3.7, np.array([120.0, -45.0, 18.0])
TURN = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
TURN *= np.linalg.det(TURN)  # a rotation


@pytest.fixture(scope="module")
def moved(mixed, tmp_path_factory):
    """A checkpoint with every SH degree whose poses are of another model of COLMAP's; means [N, 3];
    its export.
    """
    root, checkpoint = tmp_path_factory.mktemp("frames"), deepcopy(mixed[0])
    checkpoint.parameters.pop("features", None)
    means = SCALE * checkpoint.parameters["means"].astype(np.float64) @ TURN.T + SHIFT
    checkpoint.parameters["means"] = means.astype(np.float32)
    checkpoint.parameters["log_scales"] = checkpoint.parameters["log_scales"] + np.float32(
        np.log(SCALE)
    )
    turned = Rotation.from_matrix(TURN) * Rotation.from_quat(
        checkpoint.parameters["quats"], scalar_first=True
    )
    checkpoint.parameters["quats"] = turned.as_quat(scalar_first=True).astype(np.float32)
    checkpoint.modules, checkpoint.optimizer = {}, {}
    poses = checkpoint.cameras.cam_from_world
    poses[:, :3, 3] = SCALE * poses[:, :3, 3] - poses[:, :3, :3] @ TURN.T @ SHIFT
    poses[:, :3, :3] = poses[:, :3, :3] @ TURN.T
    gaussians = published(root / "gaussians", checkpoint)
    return checkpoint, chebsplat.run_stage(
        "export", root / "scene/export", {"gaussians": gaussians}
    )


def run(*arguments):
    """A command that succeeds."""
    done = CliRunner().invoke(main, list(map(str, arguments)))
    assert done.exit_code == 0, done.output


def refused(code, said, *arguments):
    done = CliRunner().invoke(main, list(map(str, arguments)))
    assert (done.exit_code, said in done.output) == (code, True)


def close(found, wanted, within):
    """Whether two sets of points are one, by nearest neighbours both ways."""
    assert len(found) == len(wanted)
    for a, b in ((found, wanted), (wanted, found)):
        assert cKDTree(b).query(a)[0].max() <= within


def test_layouts_lie_where_the_checkpoint_does(moved):
    checkpoint, export = moved
    wanted = checkpoint.parameters["means"]
    scene = Scene.read(export)
    close(scene.parameters["means"], wanted, 0)  # ragged arrays
    close(read_ply(export / "scene.ply")[0]["means"], wanted, 0)
    close(read_splats(export / "scene.spz")[0]["means"], wanted, 0.06)
    np.testing.assert_array_equal(scene.cameras.cam_from_world, checkpoint.cameras.cam_from_world)
    sizes = np.exp(scene.parameters["log_scales"][np.argsort(scene.order)])
    np.testing.assert_allclose(sizes, np.exp(checkpoint.parameters["log_scales"]), rtol=1e-6)


def test_parts_pages_and_cameras_lie_there_too(moved, tmp_path):
    checkpoint, export = moved
    wanted = checkpoint.parameters["means"]
    scene = chebsplat.load(export)
    close(read_ply(scene.export(tmp_path / "python.ply"))[0]["means"], wanted, 0)
    for command, out in (("extract", "part.ply"), ("page", "page.html"), ("cameras", "cameras")):
        run(command, export, "--out", tmp_path / out)
    close(read_ply(tmp_path / "part.ply")[0]["means"], wanted, 0)
    for kind, within in (("spz", 0.06), ("sog", 0.001)):
        run("export", export, "--as", kind, "--out", tmp_path / f"a.{kind}")
        close(read_splats(tmp_path / f"a.{kind}")[0]["means"], wanted, within)
    about, arrays = held_in(tmp_path / "page.html")
    held = unpack(
        Packed({name: arrays[name] for name in arrays if name != "views"}, about["ranges"])
    )
    # of extents of about 20: 24 bits a coordinate, then float32 at 120
    close(held["means"], wanted, 1e-5)
    pose = read_model(tmp_path / "cameras/sparse/0").images[0].pose
    np.testing.assert_allclose(pose[:3, 3], checkpoint.cameras.cam_from_world[0, :3, 3], rtol=1e-12)


def test_an_imported_splat_stays_where_it_was(moved, tmp_path):
    checkpoint, export = moved
    theirs = tmp_path / "theirs"
    run("lift", export / "scene.ply", "--out", theirs)
    scene = chebsplat.load(theirs)
    close(scene.parameters["means"], checkpoint.parameters["means"], 0)
    assert scene.features is None
    shown = scene.render(scene.cameras[0])
    assert (shown.alpha > 0.5).mean() > 0.05
    run("verify", theirs)
    run("extract", theirs, "--min-opacity", "0.1", "--out", tmp_path / "part.ply")
    run("page", theirs, "--out", tmp_path / "page.html")
    run("lift", "--out", tmp_path / "again", export / "scene.ply")
    refused(2, "exists", "lift", export / "scene.ply", "--out", theirs)
    refused(
        2,
        "add --capture",
        "lift",
        export / "scene.ply",
        "--teacher",
        "x.onnx",
        "--out",
        tmp_path / "x",
    )


def test_a_mesh_lies_there_too(mixed, moved, tmp_path):
    """That of the moved scene, moved back, is that of the scene: voxels lie elsewhere, surfaces
    where they were.
    """
    voxel, found = 0.04, []
    for scene, edge in ((mixed[1], voxel), (moved[1], SCALE * voxel)):
        out = tmp_path / f"{len(found)}.ply"
        run("mesh", scene, "--out", out, "--voxel", edge, "--raw")
        vertex = PlyData.read(out)["vertex"]
        found.append(np.stack([vertex[axis] for axis in "xyz"], 1).astype(np.float64))
    refused(
        4,
        "shows no surface",
        "mesh",
        mixed[1],
        "--out",
        tmp_path / "a.glb",
        "--voxel",
        1e6,
        "--raw",
    )
    refused(2, ".ply or .glb", "mesh", mixed[1], "--out", tmp_path / "a.obj")
    refused(2, "exists", "mesh", mixed[1], "--out", out)
    back = (found[1] - SHIFT) @ TURN / SCALE
    for a, b in ((found[0], back), (back, found[0])):
        assert len(a) > 500
        # vertices of either are about a voxel apart
        assert np.median(cKDTree(b).query(a)[0]) < 0.75 * voxel
