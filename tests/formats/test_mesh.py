"""A scene's mesh lies on its surface, in its frame; what floats goes, holes close, and both files
say the same.
"""

import json
import struct
import sys

import numpy as np
import pytest

from chebsplat.errors import ConfigError
from chebsplat.formats.meshes import Frame, Mesh, clean_mesh, fuse_depth, write_mesh
from chebsplat.stages.tools.mesh import STEP, away, collect_points, drop_edges
from chebsplat.synthetic.rays import intrinsics, look_at, open3d

SIZE = 96, 72
K = intrinsics(*SIZE)


def of_a_ball(radius=0.5):
    """Depth and colour of a ball at the origin from all around, by its equation."""
    u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    for yaw in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        for height in (-1.2, 0.1, 1.2):
            pose = look_at(np.array([1.5 * np.cos(yaw), 1.5 * np.sin(yaw), height]), np.zeros(3))
            center = pose[:3, 3]
            squared, along = (rays**2).sum(-1), rays @ center
            root = along**2 - squared * (center @ center - radius**2)
            depth = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / squared, 0).astype(
                np.float32
            )
            yield Frame(depth, np.full((*depth.shape, 3), (200, 40, 90), np.uint8), K, pose)


@pytest.fixture(scope="module")
def ball():
    return fuse_depth(open3d(), of_a_ball(), 0.02, 5.0)


def test_a_fused_mesh_lies_on_the_surface_in_the_cameras_world_and_bears_its_colour(ball):
    radii = np.linalg.norm(ball.vertices, axis=1)
    assert len(ball.triangles) > 1000
    # a third of a voxel; distances along rays grow at the ball's rim
    assert np.quantile(np.abs(radii - 0.5), 0.9) < 0.006
    assert np.abs(ball.vertices.mean(0)).max() < 0.005
    assert np.abs(ball.colors.astype(int) - (200, 40, 90)).max() <= 1


def test_a_mesh_is_as_far_from_the_depth_of_its_views_as_it_was_moved(ball):
    points = []
    assert len(list(collect_points(of_a_ball(), points))) == 36
    seen = np.concatenate(points)
    assert 36 * 50 < len(seen) < 36 * 150
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 0.5, atol=1e-3)
    assert away(ball, seen) < 0.005  # a quarter of a voxel
    larger = ball._replace(vertices=ball.vertices * np.float32(1.2))
    assert away(larger, seen) == pytest.approx(0.1, abs=0.005)


def test_views_without_depth_make_an_empty_mesh():
    frame = next(of_a_ball())
    empty = fuse_depth(open3d(), [frame._replace(depth=np.zeros_like(frame.depth))], 0.02, 5.0)
    assert [len(part) for part in (empty.vertices, empty.triangles, empty.colors)] == [0, 0, 0]


def test_cleaning_removes_what_floats_closes_holes_and_keeps_to_the_number_of_triangles(ball):
    pytest.importorskip("pymeshlab", reason="the extra mesh is not installed")
    holed = ball.triangles[
        np.linalg.norm(ball.vertices[ball.triangles].mean(1) - (0, 0.5, 0), axis=1) > 0.05
    ]
    speck = np.array([[2, 2, 2], [2.02, 2, 2], [2, 2.02, 2]], np.float32)
    mesh = Mesh(
        np.concatenate([ball.vertices, speck]),
        np.concatenate([holed, len(ball.vertices) + np.arange(3)[None]]).astype(np.int32),
        np.concatenate([ball.colors, np.zeros((3, 3), np.uint8)]),
    )
    whole = clean_mesh(mesh, 10**6, 0.2, 100, 0.02)
    assert np.linalg.norm(whole.vertices, axis=1).max() < 0.6
    edges = np.sort(whole.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    fewer = clean_mesh(mesh, 500, 0.2, 100, 0.02)
    assert len(fewer.triangles) <= 500
    assert np.abs(np.linalg.norm(fewer.vertices, axis=1) - 0.5).max() < 0.04
    assert len(fewer.colors) == len(fewer.vertices)


def test_clustering_leaves_what_is_wanted_and_keeps_the_surface(monkeypatch):
    pytest.importorskip("pymeshlab", reason="the extra mesh is not installed")
    # nothing is left to the collapse but the excess
    monkeypatch.setattr("chebsplat.formats.meshes.EASY", 1)
    fine = fuse_depth(open3d(), of_a_ball(), 0.01, 5.0)
    for wanted in (len(fine.triangles) // 2, len(fine.triangles) // 8):
        found = clean_mesh(fine, wanted, 0.2, 100, 0.01)
        assert 0.6 * wanted < len(found.triangles) <= wanted
        assert np.quantile(np.abs(np.linalg.norm(found.vertices, axis=1) - 0.5), 0.9) < 0.01


def test_a_missing_pymeshlab_is_named_with_what_helps(ball, monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(ConfigError, match=r"the extra `mesh`: .*\[mesh\].*--raw"):
        clean_mesh(ball, 100, 0.1, 10, 0.02)


def test_pixels_at_a_step_of_depth_and_without_depth_are_left_out():
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:, 4:] *= 1 + 2 * STEP
    depth[2, 1] = np.nan
    found = drop_edges(depth)
    assert (found[:, 3:5] == 0).all()
    assert found[2, 1] == 0
    assert (np.delete(found, (3, 4), axis=1) > 0).sum() == 6 * 6 - 1


def test_both_files_hold_the_same_mesh(ball, tmp_path):
    from plyfile import PlyData

    labels = np.where(ball.vertices[:, 2] > 0, 1, -1).astype(np.int32)
    mesh, names = ball._replace(labels=labels), ["table", "café"]
    write_mesh(tmp_path / "a.ply", mesh, names)
    write_mesh(tmp_path / "a.glb", mesh, names)
    read = PlyData.read(tmp_path / "a.ply")
    np.testing.assert_array_equal(
        np.stack([read["vertex"][axis] for axis in "xyz"], 1), mesh.vertices
    )
    np.testing.assert_array_equal(np.stack(read["face"]["vertex_indices"]), mesh.triangles)
    np.testing.assert_array_equal(read["vertex"]["label"], labels)
    assert read.comments == ["label 0 table", r"label 1 caf\xe9"]
    raw = (tmp_path / "a.glb").read_bytes()
    magic, version, length, size = struct.unpack("<4sIII", raw[:16])
    assert (magic, version, length) == (b"glTF", 2, len(raw))
    document = json.loads(raw[20 : 20 + size])
    binary = raw[28 + size :]
    found = []
    for accessor, view in zip(document["accessors"], document["bufferViews"], strict=True):
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor["componentType"]]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        found.append(np.frombuffer(part, kind))
        assert view["byteOffset"] % 4 == 0
    np.testing.assert_array_equal(found[0].reshape(-1, 3), mesh.vertices)
    # outwards, on a ball
    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    normals = found[1].reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)
    assert np.median((normals * outward).sum(1)) > 0.99
    linear = found[2].reshape(-1, 4)[:, :3] / 65535
    display = np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
    np.testing.assert_allclose(255 * display, mesh.colors, atol=0.05)
    np.testing.assert_array_equal(found[3], labels)
    np.testing.assert_array_equal(found[4].reshape(-1, 3), mesh.triangles)
    assert document["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert document["meshes"][0]["extras"]["label_names"] == names


def test_other_files_than_ply_and_glb_are_refused(ball, tmp_path):
    with pytest.raises(ConfigError, match=r"\.ply or \.glb"):
        write_mesh(tmp_path / "a.obj", ball)
