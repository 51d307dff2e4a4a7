"""What is exported renders as the checkpoint does, and a part of a scene is chosen as asked."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from plyfile import PlyData
from shared import data

from chebsplat.cameras import upright
from chebsplat.formats.ply import read_ply, write_ply
from chebsplat.formats.scene import Scene
from chebsplat.formats.splats import read_splats
from chebsplat.pipelines.api import load
from chebsplat.pipelines.cli import main
from chebsplat.rasterize import rasterize
from chebsplat.render import SceneRenderer
from chebsplat.splats.gaussians import activated
from chebsplat.splats.sh import eval_sh
from chebsplat.stages.evaluate import camera
from chebsplat.stages.tools.up import up_of

pytestmark = pytest.mark.xdist_group("toy")


def rendered(parameters, cameras, index):
    """Float image of raw parameters, every band of every Gaussian evaluated."""
    raw = {
        name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in parameters.items()
    }
    means, quats, scales, opacities = activated(raw)
    viewmat = torch.from_numpy(cameras.cam_from_world[index]).float()
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    colors = eval_sh(raw["sh0"], raw["shN"], means - eye, 3)
    K = torch.from_numpy(cameras.Ks[index]).float()
    return rasterize(
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmat[None],
        K[None],
        cameras.width,
        cameras.height,
    )[0]


def test_the_exported_scene_renders_as_the_checkpoint_does(mixed):
    checkpoint, path = mixed
    for index in range(0, len(checkpoint.cameras.names), 3):
        wanted = rendered(checkpoint.parameters, checkpoint.cameras, index)
        assert wanted.max() > 0.3
        for found in (Scene.read(path).parameters, read_ply(path / "scene.ply")[0]):
            image = rendered(found, checkpoint.cameras, index)
            assert (image - wanted).abs().max() < 1e-4  # only the order of equal depths may differ


def test_the_renderer_that_evaluates_by_degree_agrees(mixed):
    checkpoint, path = mixed
    scene = Scene.read(path)
    image = SceneRenderer(scene.parameters).render(camera(scene, 0))[0].astype(np.float32) / 255
    wanted = rendered(checkpoint.parameters, scene.cameras, 0)[0].clamp(0, 1).numpy()
    assert np.abs(image - wanted).max() <= 0.5 / 255 + 1e-4


def test_what_is_shared_is_small(mixed):
    sizes, n = Scene.read(mixed[1]).summary["bytes"], len(Scene.read(mixed[1]).order)
    files = {name: mixed[1] / f"scene.{name}" for name in ("ply", "spz")}
    assert {name: sizes[name] for name in files} == {
        name: file.stat().st_size for name, file in files.items()
    }
    assert sizes["unpruned_ply"] == n * 62 * 4 > 8 * sizes["spz"]


def run(*arguments):
    return CliRunner().invoke(main, ["extract", *map(str, arguments)])


def test_filters_keep_what_they_name_and_nothing_else(mixed, tmp_path):
    scene = Scene.read(mixed[1])
    p, names = scene.parameters, scene.label_names
    wanted = names[np.bincount(scene.labels[scene.labels >= 0]).argmax()]
    low, high = np.quantile(p["means"], [0.1, 0.9], axis=0).round(3)
    box = ",".join(map(str, [*low, *high]))
    opacities = 1 / (1 + np.exp(-p["logit_opacities"].astype(float)))
    least = np.median(opacities[scene.labels == names.index(wanted)]).round(3)
    filters = ["--keep-label", f" {wanted.upper()}", "--min-opacity", least, f"--box={box}"]
    done = run(mixed[1], "--out", tmp_path / "a.ply", *filters)
    assert done.exit_code == 0, done.stderr
    assert done.stdout == f"{tmp_path / 'a.ply'}\n"
    keep = scene.labels == names.index(wanted)
    inside = ((p["means"] >= low) & (p["means"] <= high)).all(1)
    n_of_any_opacity, keep = (keep & inside).sum(), keep & inside & (opacities >= least)
    assert n_of_any_opacity > keep.sum() > 0
    found, degree, labels = read_ply(tmp_path / "a.ply")
    assert f"kept {keep.sum():,}, of {len(keep):,}, left out by label" in done.stderr
    assert all(np.array_equal(found[name], p[name][keep]) for name in found)
    assert np.array_equal(labels, scene.labels[keep])
    assert degree == p["degrees"][keep].max()


def test_an_extract_is_trimmed_to_the_degrees_it_holds(mixed, tmp_path):
    scene = Scene.read(mixed[1])
    keep = scene.parameters["degrees"] == 1
    corner = scene.parameters["means"][keep][0]
    box = ",".join(map(str, [*(corner - 1e-4), *(corner + 1e-4)]))
    assert run(mixed[1], "--out", tmp_path / "a.ply", f"--box={box}").exit_code == 0
    assert read_ply(tmp_path / "a.ply")[1] == 1


def test_without_filters_everything_is_kept(mixed, tmp_path):
    assert run(mixed[1], "--out", tmp_path / "a.ply").exit_code == 0
    assert (tmp_path / "a.ply").read_bytes() == (mixed[1] / "scene.ply").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--keep-label", "flor"], 2, "did you mean floor?"),
        (["--box", "0,0,0,1,1"], 2, "six numbers"),
        (["--box", "0,0,0,1,0,1"], 2, "x0 < x1"),
        (["--box", "0,0,0,1,nan,1"], 2, "six numbers"),
        (["--box", "500,500,500,501,501,501"], 4, "centres lie from"),
        (["--min-opacity", "2"], 2, "range"),
        (["--min-opacity", "nan"], 2, "from 0 to 1"),
        (["--min-opacity", "1"], 4, "opacity leaves out"),
        (["--box", "a,0,0,1,1,1"], 2, "six numbers"),
    ],
)
def test_a_filter_that_makes_no_sense_is_an_error(mixed, tmp_path, arguments, code, message):
    done = run(mixed[1], "--out", tmp_path / "a.ply", *arguments)
    assert (done.exit_code, list(tmp_path.iterdir())) == (code, [])
    assert message in done.stderr


def test_nothing_of_the_user_s_is_overwritten_and_other_formats_are_refused(mixed, tmp_path):
    (tmp_path / "a.ply").write_text("mine")
    assert run(mixed[1], "--out", tmp_path / "a.ply").exit_code == 2
    assert (tmp_path / "a.ply").read_text() == "mine"
    for name in ("a.ksplat", "a.compressed.ply"):
        done = run(mixed[1], "--out", tmp_path / name)
        assert done.exit_code == 2
        assert "name it so" in done.stderr


@pytest.mark.parametrize("kind", ["ply", "spz", "sog", "glb"])
def test_a_scene_leaves_as_one_file_that_stands_upright_where_asked(
    mixed, tmp_path, kind, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    scene = load(mixed[1])
    done = CliRunner().invoke(main, ["export", str(mixed[1]), "--as", kind])
    path = tmp_path / f"{mixed[1].name}.{kind}"
    assert done.exit_code == 0, done.stderr
    assert f"bytes {path.stat().st_size:,}" in done.stderr
    assert CliRunner().invoke(main, ["export", str(mixed[1]), "--as", kind]).exit_code == 2
    flat = [
        "export",
        "--as",
        kind,
        str(mixed[1]),
        "--up",
        "x",
        "--out",
        str(tmp_path / f"b.{kind}"),
    ]
    assert CliRunner().invoke(main, flat).exit_code == 0
    if kind == "glb":
        plain, turned = (positions(tmp_path / name) for name in (path.name, "b.glb"))
        up = up_of("auto", scene.parameters, scene.exported.cameras.cam_from_world)
        heights = scene.parameters["means"] @ up, scene.parameters["means"][:, 0]
        for found, height in zip((plain[:, 1], turned[:, 1]), heights, strict=True):
            np.testing.assert_allclose(np.sort(found), np.sort(height), atol=1e-4)
        return
    plain, turned = (read_splats(tmp_path / name)[0] for name in (path.name, f"b.{kind}"))
    cameras = scene.exported.cameras
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ upright(np.array([1.0, 0, 0]))
    np.testing.assert_allclose(turn[1], [-1, 0, 0], atol=1e-12)
    moved = replace(cameras, cam_from_world=cameras.cam_from_world.copy())
    moved.cam_from_world[:, :3, :3] @= turn.T
    wanted = rendered(scene.parameters, cameras, 0).clamp(0, 1)
    for found, seen_by in ((plain, cameras), (turned, moved)):
        image = rendered(found, seen_by, 0).clamp(0, 1)
        assert (image - wanted).square().mean() < (1e-8 if kind == "ply" else 10**-3.5)


def positions(path):
    raw = path.read_bytes()
    start = 28 + struct.unpack("<I", raw[12:16])[0]
    n = json.loads(raw[20 : start - 8])["accessors"][0]["count"]
    return np.frombuffer(raw[start : start + 12 * n], "<f4").reshape(n, 3)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "of"), [("graphdeco_sh3_100.ply", 3), ("guitar_decoded_sh0.ply", 0)]
)
def test_files_of_others_come_back_unchanged(tmp_path, name, of):
    p, degree, labels = read_ply(data("gs_ply") / name)
    assert (degree, labels) == (of, None)
    write_ply(tmp_path / "a.ply", p, degree)
    theirs, ours = (
        PlyData.read(str(f))["vertex"].data for f in (data("gs_ply") / name, tmp_path / "a.ply")
    )
    for field in set(theirs.dtype.names) - {"nx", "ny", "nz"}:
        assert np.array_equal(theirs[field], ours[field]), field


def test_what_was_left_out_is_listed(toy):
    summary = Scene.read(toy["export"]).summary
    assert summary["left_out"]["lifted start of features"]
    assert set(summary["bytes"]) == {"unpruned_ply", "ply", "spz", "ragged", "semantic"}
