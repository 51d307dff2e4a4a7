"""`chebsplat render` and `chebsplat cameras`: frames are those that are evaluated, kept, and of the
asked cameras.
"""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from box_room import room
from click.testing import CliRunner
from PIL import Image
from scipy.spatial.transform import Rotation

import chebsplat
from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import Evaluation
from chebsplat.formats.ply import write_ply
from chebsplat.formats.points import Points
from chebsplat.formats.world import World
from chebsplat.labels.agreement import project
from chebsplat.pipelines.cli import main
from chebsplat.render import SceneRenderer
from chebsplat.stages.settings import IngestSection
from chebsplat.stages.sources import colmap
from chebsplat.stages.sources.colmap_model import read_model
from chebsplat.stages.tools import camera_files, camera_paths
from chebsplat.stages.tools.frames import kinds_of
from chebsplat.stages.tools.scene import Camera

TOLERANCE = 1e-12  # of text with all of a double's digits, through an inverse


@pytest.fixture(scope="module")
def folder(toy, tmp_path_factory):
    """A scene's folder of links."""
    made = tmp_path_factory.mktemp("scene")
    for stage in ("ingest", "sfm", "export", "teacher"):
        (made / stage).symlink_to(toy[stage])
    return made


@pytest.fixture(scope="module")
def scene(folder):
    return chebsplat.load(folder)


def run(*arguments, code=0):
    done = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert done.exit_code == code, done.stderr
    return done


def picture(path):
    return np.asarray(Image.open(path))


@pytest.mark.xdist_group("toy")
def test_frames_are_what_is_evaluated_and_what_python_renders(scene, folder, toy, tmp_path):
    word = scene.label_names[0]
    run(
        "render",
        folder,
        "--path",
        "capture",
        "--what",
        "color,labels,depth,relevancy",
        "--query",
        word,
        "--out",
        tmp_path / "frames",
    )
    figures = Evaluation.read(toy["evaluate"])
    for name, render in zip(figures.figures["names"], figures.pictures["renders"], strict=True):
        np.testing.assert_array_equal(picture(tmp_path / f"frames/color/{name}.png"), render)
    camera = scene.cameras[1]
    shown = scene.render(camera)
    np.testing.assert_array_equal(
        np.load(tmp_path / f"frames/depth/{camera.name}.npy"), shown.depth
    )
    np.testing.assert_array_equal(
        picture(tmp_path / f"frames/labels/{camera.name}.png").astype(int) - 1, shown.labels
    )
    assert picture(tmp_path / f"frames/relevancy/{camera.name}.png").shape == shown.color.shape
    assert len(list((tmp_path / "frames/color").iterdir())) == len(scene.cameras)


@pytest.mark.xdist_group("toy")
def test_frames_that_are_there_and_whole_are_kept(folder, tmp_path):
    command = (
        "render",
        folder,
        "--path",
        "orbit",
        "--frames",
        5,
        "--size",
        "40x30",
        "--out",
        tmp_path / "frames",
    )
    run(*command)
    frames = sorted((tmp_path / "frames/color").iterdir())
    before = [(path.read_bytes(), path.stat().st_mtime_ns) for path in frames]
    assert len(frames) == 5
    frames[1].unlink()
    frames[2].write_bytes(before[2][0][:-20])
    run(*command)
    assert [path.read_bytes() for path in frames] == [content for content, _ in before]
    kept = [
        path.stat().st_mtime_ns == stamp for path, (_, stamp) in zip(frames, before, strict=True)
    ]
    assert kept == [True, False, False, True, True]
    refused = run(*command[:3], "capture", *command[4:], code=2)
    assert "frames of another scene, path, size or query" in refused.stderr


def killed_and_resumed(folder, out, cameras, size, after):
    """Files of frames that were begun, killed when `after` of them were there, and finished by the
    same command.
    """
    command = [
        sys.executable,
        "-m",
        "chebsplat.pipelines.cli",
        "render",
        str(folder),
        "--path",
        str(cameras),
    ]
    command += ["--size", size, "--out", str(out)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while process.poll() is None and len(list(out.glob("color/view*"))) < after:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    there = {path: path.stat().st_mtime_ns for path in out.glob("color/view*")}
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"{len(there)} of 100 frames are there and kept" in done.stderr
    assert {path: path.stat().st_mtime_ns for path in there} == there
    return there


def hundred(scene, path):
    """A cameras.json of a hundred views: the capture's, over and over, each moved a little."""
    rows = camera_files.gs_cameras(scene.cameras)
    rows = [rows[k % len(rows)] | {"id": k, "img_name": f"view{k:03d}"} for k in range(100)]
    rows = [
        row | {"position": [p + 0.001 * k for p in row["position"]]} for k, row in enumerate(rows)
    ]
    path.write_text(json.dumps(rows))
    return path


@pytest.mark.xdist_group("toy")
@pytest.mark.parametrize("size", ["96x72", pytest.param("640x480", marks=pytest.mark.slow)])
def test_a_hundred_frames_outlive_a_kill_and_equal_evaluates_renders(scene, folder, tmp_path, size):
    file = hundred(scene, tmp_path / "cameras.json")
    there = killed_and_resumed(folder, tmp_path / "frames", file, size, 7)
    assert 7 <= len(there) < 100
    renderer = SceneRenderer(scene.parameters, Ks=scene.exported.cameras.Ks)
    width, height = map(int, size.split("x"))
    for k, row in enumerate(json.loads(file.read_text())):
        rotation = np.array(row["rotation"]).T
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ row["position"]
        zoom = width / row["width"]
        K = np.array(
            [
                [row["fx"] * zoom, 0, row["cx"] * zoom],
                [0, row["fy"] * zoom, row["cy"] * zoom],
                [0, 0, 1],
            ]
        )
        image, _ = renderer.render(Camera("", K, pose, width, height).view(), with_features=True)
        frame = picture(tmp_path / f"frames/color/view{k:03d}.png")
        # A pose goes through text and an SVD: float32 of it may differ in the last bit, a pixel's
        # rounding then by one.
        differing = np.abs(frame.astype(int) - image)
        assert differing.max() <= 1 and differing.mean() / 255 < 1e-6


@pytest.mark.parametrize("read", ["cameras.json", "transforms.json", "colmap"])
def test_written_cameras_are_read_back(tmp_path, read):
    rng = np.random.default_rng(0)
    cameras = []
    for k in range(5):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, rng.normal(size=3) * 10
        K = np.array([[300.0 + k, 0, 155], [0, 310, 117.5], [0, 0, 1]])
        cameras.append(Camera(f"room/view {k}.a", K, pose, 320, 240))
    camera_files.write_cameras(tmp_path, cameras)
    if read == "colmap":
        model = read_model(tmp_path / "sparse/0")
        for camera, image in zip(cameras, model.images, strict=True):
            np.testing.assert_allclose(image.pose, camera.cam_from_world, atol=TOLERANCE)
            assert model.cameras[image.camera] == (
                "PINHOLE",
                camera_files.intrinsics(camera),
                320,
                240,
            )
            assert image.name == f"{camera.name}.png"
    else:
        for camera, found in zip(cameras, camera_files.read_cameras(tmp_path / read), strict=True):
            np.testing.assert_allclose(
                found.cam_from_world, camera.cam_from_world, atol=TOLERANCE * 10
            )
            np.testing.assert_array_equal(found.K, camera.K)
            assert (found.name, found.width, found.height) == (camera.name, 320, 240)
    with pytest.raises(ConfigError, match="exists"):
        camera_files.write_cameras(tmp_path, cameras)


@pytest.mark.xdist_group("toy")
def test_full_cameras_are_a_data_set_that_colmap_and_our_own_reader_understand(
    folder, toy, tmp_path
):
    """Of the toy scene, with tracks, masks, a far world and names that are no file's added."""
    capture, points = Capture.read(toy["ingest"]), Points.read(toy["sfm"])
    run("cameras", folder, "--full", "--out", tmp_path / "plain")
    plain = pycolmap.Reconstruction(tmp_path / "plain/sparse/0")
    assert plain.num_points3D() == len(points.means) and plain.compute_num_observations() == 0

    rng, world = np.random.default_rng(0), World((900.0, -70, 8), 3.0)
    names = [f"left eye/{name}" for name in capture.names]
    mask = rng.random(capture.images.shape[:3]) < 0.9
    capture = replace(capture, names=names, loss_mask=mask, source=world.notes)
    tracks = [
        (row, view)
        for view, (K, pose) in enumerate(zip(points.Ks, points.cam_from_world, strict=True))
        for row in np.flatnonzero(project(points.means, K, pose, capture.size)[:, 2] > 0)[:8]
    ]
    points = replace(points, names=names[::-1], tracks=np.array(tracks, np.int32))
    camera_files.write_capture(tmp_path / "full", capture, points)
    model = pycolmap.Reconstruction(tmp_path / "full/sparse/0")
    images = sorted(model.images.values(), key=lambda image: image.image_id)
    assert [image.name for image in images] == [
        f"left-eye-{name.rpartition('/')[2]}.png" for name in points.names
    ]
    poses = world.poses_outward(points.cam_from_world)
    for image, K, pose, name in zip(images, points.Ks, poses, points.names, strict=True):
        np.testing.assert_allclose(image.cam_from_world().matrix(), pose[:3], atol=1e-9)
        camera, photo = (
            model.cameras[image.camera_id],
            picture(tmp_path / "full/images" / image.name),
        )
        np.testing.assert_array_equal(camera.calibration_matrix(), K)
        assert (camera.model.name, camera.width, camera.height) == ("PINHOLE", *capture.size)
        np.testing.assert_array_equal(photo, capture.images[names.index(name)])
    assert sorted(model.points3D) == list(range(1, len(points.means) + 1))
    found = [model.points3D[key] for key in sorted(model.points3D)]
    np.testing.assert_allclose([p.xyz for p in found], world.outward(points.means), atol=1e-9)
    np.testing.assert_array_equal([p.color for p in found], points.colors)
    seen = [(row, e.image_id - 1) for row, p in enumerate(found) for e in p.track.elements]
    assert sorted(seen) == sorted(tracks)
    model.update_point_3d_errors()
    assert max(p.error for p in found if p.track.length()) < 1e-9
    again = colmap.read(tmp_path / "full", IngestSection(min_views=2))
    rows = [names.index(f"left eye/{name.removeprefix('left-eye-')}") for name in again["names"]]
    np.testing.assert_array_equal(again["images"][:], capture.images[:][rows])
    np.testing.assert_array_equal(again["loss_mask"][:], mask[rows])
    frames = json.loads((tmp_path / "full/transforms.json").read_text())["frames"]
    for frame in frames:
        assert (tmp_path / "full" / frame["file_path"]).is_file()
        assert (tmp_path / "full" / frame["mask_path"]).is_file()
    refused = run("cameras", folder, "--full", "--size", "8x6", "--out", tmp_path / "no", code=2)
    assert "leave out --path" in refused.stderr
    assert "exists" in run("cameras", folder, "--full", "--out", tmp_path / "plain", code=2).stderr


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "neither a transforms.json"),
        ("[]", "lists no cameras"),
        ('[{"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]', "'position' is missing"),
        (
            '{"frames": [{"file_path": "a.png", "w": 4, "h": 3, "fl_x": 4, "transform_matrix": '
            "[1]}]}",
            "not usable",
        ),
        (
            '[{"rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]], "position": [0, 0, 0], "width": 8, '
            '"height": 8, '
            '"fx": 8, "fy": 8}]',
            "not a rotation",
        ),
    ],
)
def test_a_file_of_no_cameras_is_said(tmp_path, content, message):
    (tmp_path / "path.json").write_text(content)
    with pytest.raises(InputError, match=message):
        camera_files.read_cameras(tmp_path / "path.json")


def ring(n=12, tilt=0.3):
    """Cameras on a circle of radius 3 about (1, 2, 0), which look at its middle from above; z is
    up.
    """
    K = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    for angle in np.arange(n) * 2 * np.pi / n:
        eye = np.array([1 + 3 * np.cos(angle), 2 + 3 * np.sin(angle), 3 * tilt])
        pose = camera_paths.look_at(eye, np.array([1.0, 2, 0]), np.array([0, 0, 1.0]))
        yield Camera(f"{angle:.2f}", K, pose, 100, 80)


def test_an_orbit_goes_round_what_the_cameras_look_at():
    frames = camera_paths.orbit(list(ring()), 8)
    for frame in frames:
        np.testing.assert_allclose(
            frame.cam_from_world @ [1, 2, 0, 1], [0, 0, np.hypot(3, 0.9), 1], atol=1e-9
        )
        assert frame.cam_from_world[1, 2] < 0  # its top points up
    places = np.stack([frame.position for frame in frames])
    np.testing.assert_allclose(places[:, 2], 0.9)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(places, axis=0), axis=1), 6 * np.sin(np.pi / 8), rtol=1e-6
    )
    assert len(camera_paths.orbit([next(ring())] * 2, 3)) == 3  # in one place, looking one way


def test_a_path_flies_through_its_keys_at_their_lenses():
    keys = list(ring())[:3]
    keys[2] = replace(keys[2], K=keys[2].K * [[2.0], [2.0], [1.0]])
    path = camera_paths.between(keys, 5)
    for k, key in ((0, 0), (2, 1), (4, 2)):
        np.testing.assert_allclose(path[k].cam_from_world, keys[key].cam_from_world, atol=1e-9)
        np.testing.assert_allclose(path[k].K, keys[key].K)
    assert np.linalg.norm(path[1].position - path[0].position) > 0.5
    for wrong, n in ((keys[:1], 5), (keys, 1), ([keys[0], keys[1].resized(50, 40)], 5)):
        with pytest.raises(ConfigError, match=r"a path .*needs"):
            camera_paths.between(wrong, n)


def turned_round(camera):
    """The camera where it stands, looking the other way."""
    return replace(camera, cam_from_world=np.diag([-1.0, 1, -1, 1]) @ camera.cam_from_world)


@pytest.mark.parametrize(
    ("cameras", "inwards"),
    [
        (list(ring()), True),
        (list(ring())[:6], False),  # from one side
        ([turned_round(camera) for camera in ring()], False),  # a room, from its middle
    ],
)
def test_cameras_look_inwards_where_they_stand_around_what_they_look_at(cameras, inwards):
    assert camera_paths.look_inwards(cameras, np.array([0, 0, 1.0])) is inwards


def test_a_flight_follows_shaken_cameras_in_any_order_smooth_and_level():
    rng, up = np.random.default_rng(0), np.array([0, 0, 1.0])
    cameras = []
    for camera in map(turned_round, ring(60)):  # outwards, as a room is taken
        shaken = np.eye(4)
        shaken[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()
        cameras.append(replace(camera, cam_from_world=shaken @ camera.cam_from_world))
    flights = [
        camera_paths.fly_along(order, None, up, depth=3.0)
        for order in (cameras, [cameras[0], *(cameras[k] for k in 1 + rng.permutation(59))])
    ]
    for path in flights:
        poses = np.stack([frame.cam_from_world for frame in path])
        assert np.abs(poses[:, 0, :3] @ up).max() < 1e-9 and (poses[:, 1, 2] < 0).all()
        turns = np.arccos((poses[1:, 2, :3] * poses[:-1, 2, :3]).sum(1))
        assert turns.max() < 1.5 * np.radians(354) / len(path)  # shaken by 3 degrees from one on
        away = np.linalg.norm([frame.position - [1, 2, 0.9] for frame in path], axis=1)
        assert away.min() > 2.7 and away.max() < 3.01  # on the ring, but smoother
    assert abs(len(flights[0]) - len(flights[1])) < 0.1 * len(flights[0])


@pytest.mark.parametrize("inside", [True, False])
def test_the_path_of_a_bare_splat_goes_round_within_a_room_or_about_a_thing(tmp_path, inside):
    parameters, _, _ = room()
    if not inside:  # a solid ball
        rng = np.random.default_rng(0)
        parameters["means"] = rng.normal(size=parameters["means"].shape).astype(np.float32)
    ply = tmp_path / "theirs.ply"
    write_ply(ply, {name: v for name, v in parameters.items() if name != "degrees"}, 1)
    run("lift", ply, "--up", "z", "--out", tmp_path / "scene")
    opened = chebsplat.load(tmp_path / "scene")
    for camera in camera_paths.path_of(opened, "auto", 8):
        x, y, z = camera.position
        within = abs(x) < 2.5 and abs(y) < 2 and 0 < z < 2.5
        assert within if inside else np.linalg.norm(camera.position) > 3
        assert (opened.render(camera.resized(64, 48)).alpha >= 0.5).mean() > (
            0.9 if inside else 0.2
        )


@pytest.mark.xdist_group("toy")
def test_frames_of_next_to_nothing_are_warned_of(scene, folder, tmp_path, caplog):
    there = scene.cameras[0]
    away = np.eye(4)
    away[2, 3] = 1e4  # the room is a dot
    rows = camera_files.gs_cameras([there, there, replace(there, cam_from_world=away), there])
    (tmp_path / "path.json").write_text(json.dumps(rows))
    run("render", folder, "--path", tmp_path / "path.json", "--out", tmp_path / "frames")
    assert "25 % of the frames show next to nothing" in caplog.text


def test_another_size_shows_all_of_the_view_in_square_pixels():
    camera = next(ring())
    wide = camera_paths.fitted(camera, (400, 160))
    np.testing.assert_allclose(wide.K, [[200, 0, 200], [0, 200, 80], [0, 0, 1]])
    same = camera_paths.fitted(camera, (200, 160))
    np.testing.assert_allclose(same.K, camera.resized(200, 160).K)
    for wrong in ("12", "0x5", "axb", "99999x9"):
        with pytest.raises(ConfigError, match="--size"):
            camera_paths.size_of(wrong)


@pytest.mark.xdist_group("toy")
def test_what_cannot_be_rendered_is_said(scene, folder, toy, tmp_path):
    for text, asked, message in (
        ("colour", False, "are needed"),
        ("relevancy", False, "needs --query"),
        ("color", True, "add relevancy"),
    ):
        with pytest.raises(ConfigError, match=message):
            kinds_of(text, scene, asked)
    assert (
        "flight, orbit, capture or a .json"
        in run("render", folder, "--path", "walk", "--out", tmp_path, code=2).stderr
    )
    refused = run("render", folder, "--out", tmp_path / "x.avi", code=2)
    assert "ends in .mp4" in refused.stderr and not (tmp_path / "x.avi").exists()
    (tmp_path / "x").mkdir()
    (tmp_path / "x/notes.txt").write_text("mine")
    assert (
        "something else than frames"
        in run("render", folder, "--out", tmp_path / "x", code=2).stderr
    )


@pytest.mark.xdist_group("toy")
def test_a_video_has_a_frame_for_every_camera(folder, tmp_path):
    av = pytest.importorskip("av")
    out = tmp_path / "orbit.mp4"
    run(
        "render",
        folder,
        "--path",
        "orbit",
        "--frames",
        6,
        "--what",
        "depth",
        "--size",
        "64x48",
        "--out",
        out,
    )
    with av.open(str(out)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 6 and frames[0].shape == (48, 64, 3)
    assert os.listdir(tmp_path) == ["orbit.mp4"]  # the frames are gone with the work
    assert "exists" in run("render", folder, "--out", out, code=2).stderr
    assert (
        "even"
        in run("render", folder, "--size", "63x48", "--out", tmp_path / "odd.mp4", code=2).stderr
    )
    both = run("render", folder, "--what", "color,depth", "--out", tmp_path / "two.mp4", code=2)
    assert "a video shows one of color,depth" in both.stderr


@pytest.mark.xdist_group("toy")
def test_a_video_without_its_package_is_one_line(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    for scene in (folder, tmp_path / "no-such-scene"):  # before a scene is opened
        refused = run("render", scene, "--out", tmp_path / "room.mp4", code=2)
        assert refused.stderr.strip().count("\n") == 0
        assert "needs the extra `video`: " in refused.stderr and "[video]" in refused.stderr
