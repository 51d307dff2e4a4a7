"""mesh: the surface of a finished scene as triangles with colours and labels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from chebsplat.cameras import unproject, upright
from chebsplat.errors import ConfigError, DataFailure
from chebsplat.evaluation.metrics import features_at
from chebsplat.formats.meshes import Frame, Mesh, clean_mesh, fuse_depth
from chebsplat.labels.decode import decode_labels
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.tools.scene import OpenedScene
from chebsplat.synthetic.rays import open3d

N_VOXELS = 250  # along the longest side of the room, by default
OPAQUE = 0.6  # least coverage of a pixel with depth
# relative depth difference of neighbouring pixels beyond which they are on an edge
STEP = 0.05
LONGEST_HOLE = 60  # edges
N_TRIED = 100  # most points of a view for the distance from the mesh
LEAST_PART = 12.0  # least diagonal of a connected part, voxels


def mesh_of(
    scene: OpenedScene, voxel: float | None, n_triangles: int, raw: bool, progress: Progress
) -> tuple[Mesh, dict[str, Any]]:
    """The mesh of a scene in its source's frame and units, and facts: voxel, numbers of triangles,
    and the median distance of the rendered depth from it.

    Args: voxel: edge, scene units; None: the 250th part of the room; n_triangles: at most; raw:
      nothing is cleaned.
    Raises: ConfigError on a scene without cameras; DataFailure where its Gaussians show no surface.
    Choices: depth is that of `render_depth`, from every view of the capture; a pixel on an edge of
      depth has none. A vertex has the features of the Gaussians around it
      (`evaluation.metrics.features_at`).
    """
    if not scene.cameras:
        raise ConfigError(
            f"{scene.source} has no cameras to see its surface from; open a scene that was trained"
        )
    extent = room_extent(scene)
    edge = extent / N_VOXELS if voxel is None else voxel / scene.world.scale
    size = f"{edge * scene.world.scale:.3g}"
    depth_points: list[np.ndarray] = []
    surface = fuse_depth(
        open3d(), collect_points(frames(scene, progress), depth_points), edge, 2 * extent
    )
    if not len(surface.triangles):
        raise DataFailure(
            f"{scene.source} shows no surface of voxels of {size}; choose larger ones: --voxel"
        )
    facts = {"voxel": float(size), "triangles fused": len(surface.triangles)}
    if not raw:
        surface = clean_mesh(surface, n_triangles, LEAST_PART * edge, LONGEST_HOLE, edge)
    if not len(surface.triangles):
        raise DataFailure(
            f"nothing of the surface is larger than {LEAST_PART:g} voxels of {size}; take --raw"
        )
    distance = away(surface, np.concatenate(depth_points)) * scene.world.scale
    facts |= {"off the depth, median": float(f"{distance:.2g}")}
    if scene.features is not None and scene.label_embeddings is not None:
        surface = surface._replace(labels=labels_at(scene, surface.vertices))
    surface = surface._replace(vertices=scene.world.outward(surface.vertices).astype(np.float32))
    return surface, facts | {"written": len(surface.triangles), "vertices": len(surface.vertices)}


def turned(mesh: Mesh, up: np.ndarray, suffix: str) -> Mesh:
    """The mesh with `up`, unit [3], along z, or of a .glb along y, as glTF has it."""
    turn = upright(up)
    if suffix.lower() == ".glb":
        turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ turn
    return mesh._replace(vertices=(mesh.vertices @ turn.T).astype(np.float32))


def away(mesh: Mesh, points: np.ndarray) -> float:
    """The median distance from points [M, 3] to a mesh, scene units."""
    core, caster = open3d().core, open3d().t.geometry.RaycastingScene()
    caster.add_triangles(
        *map(core.Tensor, (mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32)))
    )
    return float(np.median(caster.compute_distance(core.Tensor(points.astype(np.float32))).numpy()))


def collect_points(frames: Iterable[Frame], points: list[np.ndarray]) -> Iterator[Frame]:
    """The frames, while some of the points [M, 3] of each are appended to `points`."""
    for frame in frames:
        pixels = np.argwhere(frame.depth > 0)
        points.append(
            unproject(frame.depth, frame.K, frame.pose, pixels[:: len(pixels) // N_TRIED + 1])
        )
        yield frame


def frames(scene: OpenedScene, progress: Progress) -> Iterator[Frame]:
    """Depth of the surface and colour from each camera."""
    inside = [scene.inside(camera) for camera in scene.cameras]
    for camera, _ in progress.track(inside, len(inside), "views"):
        view = camera.view()
        depth, covered = scene.renderer.render_depth(view)
        depth[covered < OPAQUE] = 0
        color, _ = scene.renderer.render(view)
        yield Frame(drop_edges(depth), color, camera.K, camera.cam_from_world)


def drop_edges(depth: np.ndarray) -> np.ndarray:
    """Depth [H, W] as f32, 0 where unknown (0 or nan) or where a neighbour differs by STEP."""
    logarithm = np.log(np.where(depth > 0, depth, np.nan))
    on_edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        far = np.abs(np.diff(logarithm, axis=axis, append=np.nan)) > STEP  # nan is no edge
        on_edge |= far | np.roll(far, 1, axis)
    return np.where(on_edge | np.isnan(logarithm), 0, depth).astype(np.float32)


def room_extent(scene: OpenedScene) -> float:
    """Longest side of the box with 98 % of the opaque Gaussians along each axis, scene units."""
    means, logits = scene.parameters["means"], scene.parameters["logit_opacities"]
    solid = means[logits > 0] if (logits > 0).any() else means
    low, high = np.quantile(solid, (0.01, 0.99), axis=0)
    return max(float((high - low).max()), 1e-9)


def labels_at(scene: OpenedScene, points: np.ndarray) -> np.ndarray:
    """Labels i32 [M] of points [M, 3], by the features of the Gaussians around them; -1 none.

    Args: scene: with semantics.
    """
    assert scene.label_embeddings is not None
    renderer = scene.renderer
    gaussians = (
        renderer.means,
        renderer.quats,
        renderer.scales,
        renderer.opacities,
        renderer.raw["features"],
    )
    features, weights = features_at(points, *(part.numpy() for part in gaussians))
    return np.where(weights > 0, decode_labels(features, scene.label_embeddings), -1).astype(
        np.int32
    )
