"""A source in any unit, about any origin, is the same scene, and what is exported has the source's
own.
"""

import shutil

import layouts
import numpy as np
import pytest
from plyfile import PlyData
from shared import INPUTS, run_stage

from chebsplat.cameras import unproject
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import Evaluation
from chebsplat.formats.ply import read_ply, write_ply
from chebsplat.formats.points import Points
from chebsplat.formats.scene import Scene
from chebsplat.formats.world import HERE, World
from chebsplat.settings import TrainSection
from chebsplat.stages.sources import generated
from chebsplat.stages.tools.page import foreign
from chebsplat.stages.tools.scene import OpenedScene
from chebsplat.stages.training.assembly import read_start

CHANGES = {
    "as it is": (1.0, 0.0),
    "tiny": (1e-4, 0.0),
    "huge": (1e4, 0.0),
    "far": (1.0, 1e6),
    "both": (1e-3, -7e4),
}


def written(folder, scale, offset):
    """The toy room with points as a COLMAP model in other units, x and y moved."""
    fields = generated.capture("toy", 1, "toy")
    pixels = np.argwhere(np.ones((72, 96), bool))[::31]
    seen = range(0, 16, 3)
    parts = [
        unproject(fields["depth"][k], fields["Ks"][k], fields["cam_from_world"][k], pixels)
        for k in seen
    ]
    colors = np.concatenate([fields["images"][k][pixels[:, 0], pixels[:, 1]] for k in seen])
    points, origin = (
        scale * np.concatenate(parts) + [offset, offset, 0],
        np.array([offset, offset, 0]),
    )
    fields["cam_from_world"][:, :3, 3] *= scale
    fields["cam_from_world"][:, :3, 3] -= fields["cam_from_world"][:, :3, :3] @ origin
    layouts.write_colmap(folder, fields)
    for name in ("depth", "semantic"):
        shutil.rmtree(folder / name)
    (folder / "labels.json").unlink()
    rows = [f"{k} {' '.join(map(repr, map(float, p)))} {' '.join(map(str, c))} 0.5" for k, (p, c) in
            enumerate(zip(points, colors, strict=True), 1) if np.isfinite(p).all()]  # fmt: skip
    (folder / "sparse/0/points3D.txt").write_text("\n".join(rows) + "\n")
    return fields["cam_from_world"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """PSNR, opened scene, the poses that were written, and points, of each change."""
    found = {}
    for name, change in CHANGES.items():
        place = tmp_path_factory.mktemp("units")
        poses = written(place / "source", *change)
        config = {
            "source": {"kind": "colmap", "path": str(place / "source")},
            "sfm": {"dense": "off"},
            "train": {"semantics": False, "steps": 60, "report_every": 30, "max_gaussians": 3000}
            # what chance decides differs by .8 dB
            | {"densify": "off", "prune": False, "sh_prune": False},
            "evaluate": {"timing_repeats": 0},
        }
        made = {}
        for stage in ("ingest", "sfm", "train", "export", "evaluate"):
            roles = {role: made[of] for role, of in INPUTS[stage].items() if of in made}
            made[stage] = place / stage
            assert run_stage(stage, made[stage], roles, config) == 0
        opened = OpenedScene(Scene.read(made["export"]), made["export"])
        psnr = Evaluation.read(made["evaluate"]).figures["image"]["psnr"]
        found[name] = psnr, opened, poses, Points.read(made["sfm"])
    return found


def places(ply):
    """Centres f64 [N, 3] of a PLY file."""
    vertex = PlyData.read(ply)["vertex"]
    return np.stack([vertex[axis].astype(float) for axis in "xyz"], 1)


@pytest.mark.parametrize("name", list(CHANGES)[1:])
def test_units_and_origin_change_neither_the_picture_nor_what_is_exported(scenes, name, tmp_path):
    (psnr, plain, _, _), (scale, offset) = scenes["as it is"], CHANGES[name]
    other, opened, poses, points = scenes[name]
    assert abs(other - psnr) < 0.01
    origin, rounding = np.array([offset, offset, 0]), 1e-9 * abs(offset)
    files = [scene.source / "scene.ply" for scene in (plain, opened)]
    ends, moved = (np.quantile(places(ply), (0.05, 0.95), axis=0) for ply in files)
    assert np.abs(moved - origin - scale * ends).max() < 0.02 * scale * (ends[1] - ends[0]).max()
    sizes = [np.median(read_ply(ply)[0]["log_scales"]) for ply in files]
    assert sizes[1] - sizes[0] == pytest.approx(np.log(scale), abs=0.05)
    begun = read_start(
        files[1], points, TrainSection(), Capture.read(opened.source.parent / "ingest")
    )["means"].numpy()
    assert np.allclose(begun, opened.parameters["means"], atol=1e-5)
    for camera, pose in zip(opened.cameras, poses, strict=True):
        assert np.allclose(camera.cam_from_world[:3, :3], pose[:3, :3])
        assert (
            np.abs(camera.position + pose[:3, :3].T @ pose[:3, 3]).max() < 1e-6 * scale + rounding
        )
    pictures = [scene.render(scene.cameras[0]) for scene in (plain, opened)]
    assert np.nanmedian(pictures[1].depth) == pytest.approx(
        scale * np.nanmedian(pictures[0].depth), rel=0.02
    )
    assert np.abs(pictures[1].color.astype(float) - pictures[0].color).mean() < 3
    box = np.array([ends[0], ends.mean(0)])
    parts = plain.select(box=box.ravel()), opened.select(box=(origin + scale * box).ravel())
    assert len(parts[1]) == pytest.approx(len(parts[0]), rel=0.1)
    assert np.allclose(
        places(parts[1].export(tmp_path / "part.ply")), parts[1].points()[0], rtol=1e-6, atol=0
    )


@pytest.mark.parametrize("color", [0.0, 0.4, 1.0])
def test_a_given_splat_of_one_colour_begins_with_the_points_colours_and_another_with_its_own(
    scenes, color, tmp_path
):
    _, opened, _, points = scenes["tiny"]
    given = opened.parameters
    own = read_start(
        opened.source / "scene.ply",
        points,
        TrainSection(),
        Capture.read(opened.source.parent / "ingest"),
    )
    assert np.allclose(own["sh0"], given["sh0"])
    sh0 = np.full_like(given["sh0"], (color - 0.5) / 0.28209479177387814)
    write_ply(tmp_path / "one.ply", given | {"sh0": sh0}, 0, world=opened.world)
    found = read_start(
        tmp_path / "one.ply", points, TrainSection(), Capture.read(opened.source.parent / "ingest")
    )
    nearest = np.linalg.norm(given["means"][:, None] - points.means, axis=-1).argmin(1)
    shown = 255 * (found["sh0"][:, 0].numpy() * 0.28209479177387814 + 0.5)
    assert np.abs(shown - points.colors[nearest]).max() < 0.01


@pytest.mark.parametrize("name", list(CHANGES)[1:])
def test_a_splat_from_elsewhere_is_seen_in_any_unit_and_keeps_its_own(scenes, name, tmp_path):
    _, opened, _, _ = scenes["as it is"]
    scale, offset = CHANGES[name]
    pictures, middles = [], []
    for k, world in enumerate((HERE, World((offset, offset, 0.0), scale))):
        ply = tmp_path / f"{k}.ply"
        write_ply(ply, opened.parameters, 0, world=world)
        scene = OpenedScene(foreign(ply), ply)
        assert np.allclose(scene.points()[0], places(ply), rtol=1e-6, atol=0)
        middles.append(np.median(scene.points()[0], axis=0))
        pictures.append(scene.render(scene.cameras[0]))
    assert np.allclose(middles[1], [offset, offset, 0] + scale * middles[0], rtol=1e-6)
    assert np.abs(pictures[1].color.astype(float) - pictures[0].color).mean() < 1
    assert np.nanmedian(pictures[1].depth) == pytest.approx(
        scale * np.nanmedian(pictures[0].depth), rel=1e-3
    )
