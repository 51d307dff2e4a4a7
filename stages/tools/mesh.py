"""mesh: the surface of a finished scene as triangles with colours and labels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from chebsplat.cameras import unproject, upright
from chebsplat.errors import ConfigError, DataFailure
from chebsplat.evaluation.metrics import features_at
from chebsplat.formats.meshes import Frame, Mesh, cleaned, fused
from chebsplat.labels.decode import decode_labels
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.tools.scene import OpenedScene
from chebsplat.synthetic.rays import open3d

N_VOXELS = 250  # along the longest side of the room, where no voxel is asked for
OPAQUE = 0.6  # least coverage of a pixel whose depth counts
# of its depth, by which a neighbouring pixel may lie deeper: beyond, a pixel is on an edge
STEP = 0.05
LONGEST_HOLE = 60  # edges
N_TRIED = 100  # points of a view, at most, whose distance from the mesh is measured
LEAST_PART = 12.0  # voxels across a connected part that stays


def mesh_of(
    scene: OpenedScene, voxel: float | None, n_triangles: int, raw: bool, progress: Progress
) -> tuple[Mesh, dict[str, Any]]:
    """The mesh of a scene in its source's frame and units, and facts: voxel, how many triangles
    before and after, and how far the surface that the views see is from it.

    Args: voxel: edge, scene units; None: the 250th part of the room; n_triangles: at most; raw:
      nothing is cleaned.
    Raises: ConfigError on a scene without cameras; DataFailure where its Gaussians show no surface.
    Choices: depth is that of `render_depth`, from every view of the capture; a pixel on an edge of
      depth has none. A vertex means what the Gaussians around it mean
      (`evaluation.metrics.features_at`).
    """
    if not scene.cameras:
        raise ConfigError(
            f"{scene.source} has no cameras to see its surface from; open a scene that was trained"
        )
    extent = room_extent(scene)
    edge = extent / N_VOXELS if voxel is None else voxel / scene.world.scale
    shown = f"{edge * scene.world.scale:.3g}"
    seen: list[np.ndarray] = []
    made = fused(open3d(), noted(frames(scene, progress), seen), edge, 2 * extent)
    if not len(made.triangles):
        raise DataFailure(
            f"{scene.source} shows no surface of voxels of {shown}; choose larger ones: --voxel"
        )
    facts = {"voxel": float(shown), "triangles fused": len(made.triangles)}
    if not raw:
        made = cleaned(made, n_triangles, LEAST_PART * edge, LONGEST_HOLE, edge)
    if not len(made.triangles):
        raise DataFailure(
            f"nothing of the surface is larger than {LEAST_PART:g} voxels of {shown}; take --raw"
        )
    off = away(made, np.concatenate(seen)) * scene.world.scale
    facts |= {"off the depth, median": float(f"{off:.2g}")}
    if scene.features is not None and scene.label_embeddings is not None:
        made = made._replace(labels=labels_at(scene, made.vertices))
    made = made._replace(vertices=scene.world.outward(made.vertices).astype(np.float32))
    return made, facts | {"written": len(made.triangles), "vertices": len(made.vertices)}


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


def noted(frames: Iterable[Frame], points: list[np.ndarray]) -> Iterator[Frame]:
    """The frames; some of the points [M, 3] that each shows are added to `points`."""
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
        yield Frame(without_edges(depth), color, camera.K, camera.cam_from_world)


def without_edges(depth: np.ndarray) -> np.ndarray:
    """Depth [H, W], 0 or nan where unknown, as f32 with 0 there, and where a neighbour is deeper or
    nearer by STEP.
    """
    logarithm = np.log(np.where(depth > 0, depth, np.nan))
    on_edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        far = np.abs(np.diff(logarithm, axis=axis, append=np.nan)) > STEP  # nan is no edge
        on_edge |= far | np.roll(far, 1, axis)
    return np.where(on_edge | np.isnan(logarithm), 0, depth).astype(np.float32)


def room_extent(scene: OpenedScene) -> float:
    """The longest side of the box that holds 98 % of the opaque Gaussians along each axis,
    inside.
    """
    means, logits = scene.parameters["means"], scene.parameters["logit_opacities"]
    solid = means[logits > 0] if (logits > 0).any() else means
    low, high = np.quantile(solid, (0.01, 0.99), axis=0)
    return max(float((high - low).max()), 1e-9)


def labels_at(scene: OpenedScene, points: np.ndarray) -> np.ndarray:
    """The label of each of points [M, 3], i32 [M], of what the Gaussians around it mean; -1 where
    there is none.

    Args: scene: with semantics.
    """
    assert scene.label_embeddings is not None
    held = scene.renderer
    gaussians = held.means, held.quats, held.scales, held.opacities, held.raw["features"]
    features, weights = features_at(points, *(part.numpy() for part in gaussians))
    return np.where(weights > 0, decode_labels(features, scene.label_embeddings), -1).astype(
        np.int32
    )
