"""Meshes: fused from depth by open3d, cleaned by pymeshlab, written as PLY and GLB."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree

from chebsplat.errors import ConfigError
from chebsplat.formats.extras import extra
from chebsplat.formats.files import atomic_path
from chebsplat.formats.gltf import linear_light, write_glb

BLOCK = 16  # voxels along a block of the grid
N_BLOCKS = 20_000  # initial blocks of the grid, which grows
TRUNCATED = 4.0  # voxels of truncation
LEAST_WEIGHT = 3.0  # a voxel of the surface is in more views than this
TOUCHED = 4  # open3d samples every fourth pixel along each axis for blocks of a frame
EASY = 100_000  # triangles that the quadric collapse handles in about a second
PER_CELL = 0.85  # share of a fused mesh's triangles that clustering by its own voxels keeps


class Mesh(NamedTuple):
    """vertices f32 [V, 3] scene units; triangles i32 [T, 3]; colors u8 [V, 3]; labels i32 [V]."""

    vertices: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray
    labels: np.ndarray | None = None


class Frame(NamedTuple):
    """depth f32 [H, W] scene units, 0 unknown; color u8 [H, W, 3]; K; pose world to camera."""

    depth: np.ndarray
    color: np.ndarray
    K: np.ndarray
    pose: np.ndarray


def fuse_depth(open3d: Any, frames: Iterable[Frame], voxel: float, farthest: float) -> Mesh:
    """The surface of depth images, by a truncated signed distance on voxels of this edge.

    Args: open3d: the module; voxel, farthest: scene units, depth beyond which is ignored.
    Choices: truncated at four voxels; a voxel counts that more than LEAST_WEIGHT views saw. open3d
      takes the pixel that a point falls into, so that the centre of the first one is at 0.5, as
      ours is. A frame that touches no block would be an error to it, and is passed over.
    """
    core, image = open3d.core, open3d.t.geometry.Image
    names, widths = ("tsdf", "weight", "color"), ((1,), (1,), (3,))
    grid = open3d.t.geometry.VoxelBlockGrid(
        names, (core.float32,) * 3, widths, voxel, BLOCK, N_BLOCKS, core.Device("CPU:0")
    )
    n_frames = 0
    for frame in frames:
        touched = frame.depth[::TOUCHED, ::TOUCHED]
        if not ((touched > 0) & (touched < farthest)).any():
            continue
        depth = image(core.Tensor(np.ascontiguousarray(frame.depth, np.float32)))
        color = image(core.Tensor(np.ascontiguousarray(frame.color, np.float32) / 255))
        K, pose = (
            core.Tensor(np.ascontiguousarray(matrix, np.float64))
            for matrix in (frame.K, frame.pose)
        )
        blocks = grid.compute_unique_block_coordinates(depth, K, pose, 1.0, farthest, TRUNCATED)
        grid.integrate(blocks, depth, color, K, pose, 1.0, farthest, TRUNCATED)
        n_frames += 1
    mesh = grid.extract_triangle_mesh(LEAST_WEIGHT) if n_frames else None
    if mesh is None or not len(mesh.vertex.positions):
        empty = np.zeros((0, 3))
        return Mesh(empty.astype(np.float32), empty.astype(np.int32), empty.astype(np.uint8))
    colors = (mesh.vertex.colors.numpy() * 255).round().clip(0, 255).astype(np.uint8)
    return Mesh(
        mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy().astype(np.int32), colors
    )


def meshlab() -> Any:
    """The module that cleans meshes. Raises ConfigError where it, or a library that it is linked
    to, is missing.
    """
    return extra("pymeshlab", "cleaning a mesh", "ask for the mesh as it is: --raw")


def clean_mesh(
    mesh: Mesh, n_triangles: int, least_diagonal: float, longest_hole: int, voxel: float
) -> Mesh:
    """The mesh in at most `n_triangles`, floaters removed, small holes closed, labels dropped.

    Args: least_diagonal: of a connected part that stays, scene units; longest_hole: edges of a hole
      that is closed; voxel: edge of those that it was fused from, scene units.
    Raises: ConfigError as `meshlab`.
    Choices: a vertex takes the colour of the nearest one before. Vertices are first clustered in
      cubic cells, of a size that leaves n_triangles or EASY, and edges collapsed by quadrics from
      there on: the collapse alone takes four times as long, for 0.002 of the F-score at 5 cm.
    """
    pymeshlab = meshlab()
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices.astype(np.float64), mesh.triangles))
    meshes.meshing_remove_connected_component_by_diameter(
        mincomponentdiag=pymeshlab.PureValue(least_diagonal)
    )
    meshes.meshing_repair_non_manifold_edges()
    # otherwise only the selection would be decimated
    meshes.meshing_close_holes(maxholesize=longest_hole, newfaceselected=False)
    count, clustered = meshes.current_mesh().face_number(), max(n_triangles, EASY)
    if count > clustered:
        cell = voxel * (PER_CELL * count / clustered) ** 0.5
        meshes.meshing_decimation_clustering(threshold=pymeshlab.PureValue(cell))
    if meshes.current_mesh().face_number() > n_triangles:
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=n_triangles, preserveboundary=True, preservenormal=True
        )
    meshes.meshing_remove_unreferenced_vertices()
    simplified = meshes.current_mesh()
    vertices, triangles = (
        simplified.vertex_matrix().astype(np.float32),
        simplified.face_matrix().astype(np.int32),
    )
    if not len(vertices):
        return Mesh(vertices.reshape(0, 3), triangles.reshape(0, 3), np.zeros((0, 3), np.uint8))
    return Mesh(vertices, triangles, mesh.colors[cKDTree(mesh.vertices).query(vertices)[1]])


def write_mesh(path: Path, mesh: Mesh, names: list[str] | None = None) -> None:
    """Write the mesh as .ply or .glb, by the file's name, with its labels and their names.

    Raises: ConfigError on another suffix.
    Choices: PLY has an int property `label`, -1 for none, and comments `label ID NAME`. GLB has
      `_LABEL` as a float attribute, 255 values and more without loss, and the names in the mesh's
      extras; its material is rough, its colours in linear light, so that viewers shade it.
    """
    writers = {".ply": _ply, ".glb": _glb}
    if path.suffix.lower() not in writers:
        raise ConfigError(f"{path}: a mesh is written as .ply or .glb")
    with atomic_path(path) as temporary:
        writers[path.suffix.lower()](temporary, mesh, names or [])


def _ply(path: Path, mesh: Mesh, names: list[str]) -> None:
    kinds = [(axis, "f4") for axis in "xyz"] + [
        (channel, "u1") for channel in ("red", "green", "blue")
    ]
    vertices = np.zeros(
        len(mesh.vertices), kinds + ([("label", "i4")] if mesh.labels is not None else [])
    )
    for column, axis in enumerate("xyz"):
        vertices[axis] = mesh.vertices[:, column]
    for column, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = mesh.colors[:, column]
    if mesh.labels is not None:
        vertices["label"] = mesh.labels
    faces = np.zeros(len(mesh.triangles), [("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = mesh.triangles
    comments = [
        f"label {k} {name.encode('ascii', 'backslashreplace').decode()}"
        for k, name in enumerate(names)
    ]
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, byte_order="<", comments=comments).write(str(path))


def _glb(path: Path, mesh: Mesh, names: list[str]) -> None:
    attributes = {
        "POSITION": mesh.vertices.astype(np.float32),
        "NORMAL": normals(mesh),
        "COLOR_0": linear_light(mesh.colors / 255),
    }
    if mesh.labels is not None:
        attributes["_LABEL"] = mesh.labels.astype(np.float32)
    rough = {"pbrMetallicRoughness": {"metallicFactor": 0.0}, "doubleSided": True}
    triangles = mesh.triangles.astype(np.uint32).ravel()
    write_glb(path, attributes, {"material": 0}, triangles, names, materials=[rough])


def normals(mesh: Mesh) -> np.ndarray:
    """Unit normals of the vertices, f32 [V, 3]: area-weighted means of their triangles, or z."""
    a, b, c = mesh.vertices.astype(np.float64)[mesh.triangles.T]
    sums = np.zeros((len(mesh.vertices), 3))
    for corner in mesh.triangles.T:
        np.add.at(sums, corner, np.cross(b - a, c - a))
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    unit = np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), [0.0, 0.0, 1.0])
    return unit.astype(np.float32)
