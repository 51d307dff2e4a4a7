"""mesh: the surface of a finished scene as triangles with colours and labels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.errors import ConfigError, DataFailure
from chebsplat.stages.command import Job, command

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from chebsplat.formats.cameras import Cameras
    from chebsplat.formats.meshes import Frame, Mesh
    from chebsplat.formats.scene import Scene
    from chebsplat.render import SceneRenderer
    from chebsplat.stages.progress import Progress

N_VOXELS = 250  # along the longest side of the room, where no voxel is asked for
OPAQUE = 0.6  # least coverage of a pixel whose depth counts
STEP = 0.05  # of its depth, by which a neighbouring pixel may lie deeper: beyond, a pixel is on an edge
LONGEST_HOLE = 60  # edges
LEAST_PART = 12.0  # voxels across a connected part that stays
FILES = ("mesh.ply", "mesh.glb")


def run(job: Job) -> None:
    """The surface of an exported scene, as triangles with colours and labels, in its frame and units.

    Reads `scene`. Writes `mesh`.
    """
    from chebsplat.formats.meshes import write_mesh
    from chebsplat.formats.scene import read_scene

    settings, source = job.config.mesh, job.inputs["scene"]
    scene = read_scene(source)
    mesh, facts = mesh_of(scene, source, settings.voxel, settings.n_triangles, job.progress, settings.raw)
    if mesh.labels is None:
        job.left_out("labels", "the scene has no semantics")
    for name in FILES:
        write_mesh(job.out / name, mesh, scene.label_names)
    job.facts |= facts


def mesh_of(
    scene: Scene, source: Path, voxel: float | None, n_triangles: int, progress: Progress, raw: bool = False
) -> tuple[Mesh, dict[str, Any]]:
    """The mesh of a scene in its own frame and units, and facts: voxel, and how many triangles before and after.

    Args: source: where the scene is, for a message; voxel: edge, scene units; None: the 250th part of the room;
      n_triangles: at most; raw: nothing is cleaned.
    Raises: ConfigError on a scene without cameras; DataFailure where its Gaussians show no surface.
    Choices: depth is that of `render_depth`, from every view of the capture; a pixel on an edge of depth has none. A
      vertex means what the Gaussians around it mean (`evaluation.surface.features_at`).
    """
    from chebsplat.formats.meshes import cleaned, fused
    from chebsplat.render import SceneRenderer

    if not scene.cameras.names:
        raise ConfigError(f"{source} has no cameras to see its surface from; open a scene that was trained")
    extent, renderer = room_extent(scene), SceneRenderer(scene.parameters)
    edge = extent / N_VOXELS if voxel is None else voxel
    made = fused(frames(renderer, scene.cameras, progress), edge, 2 * extent)
    if not len(made.triangles):
        raise DataFailure(f"{source} shows no surface of voxels of {edge:.3g}; choose larger ones: --voxel, mesh.voxel")
    facts = {"voxel": edge, "n_fused": len(made.triangles)}
    if not raw:
        made = cleaned(made, n_triangles, LEAST_PART * edge, LONGEST_HOLE, edge)
    if not len(made.triangles):
        why = f"nothing of the surface is larger than {LEAST_PART:g} voxels of {edge:.3g}"
        raise DataFailure(f"{why}; take --raw, mesh.raw")
    if "features" in scene.parameters and scene.label_embeddings is not None:
        made = made._replace(labels=labels_at(renderer, scene.label_embeddings, made.vertices))
    return made, facts | {"n_triangles": len(made.triangles), "n_vertices": len(made.vertices)}


def frames(renderer: SceneRenderer, cameras: Cameras, progress: Progress) -> Iterator[Frame]:
    """Depth of the surface and colour from each camera."""
    import torch

    from chebsplat.formats.meshes import Frame
    from chebsplat.views import View

    pairs = list(zip(cameras.Ks, cameras.cam_from_world, strict=True))
    for (K, pose), _ in progress.track(pairs, len(pairs), "views"):
        intrinsic, extrinsic = (torch.from_numpy(matrix).float() for matrix in (K, pose))
        view = View(intrinsic, extrinsic, cameras.width, cameras.height)
        depth, covered = renderer.render_depth(view)
        depth[covered < OPAQUE] = 0
        color, _ = renderer.render(view)
        yield Frame(without_edges(depth), color, K, pose)


def without_edges(depth: np.ndarray) -> np.ndarray:
    """Depth [H, W], 0 or nan where unknown, as f32 with 0 there, and where a neighbour is deeper or nearer by STEP."""
    import numpy as np

    logarithm = np.log(np.where(depth > 0, depth, np.nan))
    on_edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        far = np.abs(np.diff(logarithm, axis=axis, append=np.nan)) > STEP  # nan is no edge
        on_edge |= far | np.roll(far, 1, axis)
    return np.where(on_edge | np.isnan(logarithm), 0, depth).astype(np.float32)


def room_extent(scene: Scene) -> float:
    """The longest side of the box that holds 98 % of the opaque Gaussians along each axis, scene units."""
    import numpy as np

    means, logits = scene.parameters["means"], scene.parameters["logit_opacities"]
    solid = means[logits > 0] if (logits > 0).any() else means
    low, high = np.quantile(solid, (0.01, 0.99), axis=0)
    return max(float((high - low).max()), 1e-9)


def labels_at(renderer: SceneRenderer, embeddings: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The label of each point i32 [M], of what the Gaussians around it mean; -1 where there is none.

    Args: renderer: of a scene with features; embeddings [L, C] of its labels; points [M, 3].
    """
    import numpy as np

    from chebsplat.evaluation.surface import features_at
    from chebsplat.labels.decode import decode_labels

    gaussians = renderer.means, renderer.quats, renderer.scales, renderer.opacities, renderer.raw["features"]
    features, weights = features_at(points, *(part.numpy() for part in gaussians))
    return np.where(weights > 0, decode_labels(features, embeddings), -1).astype(np.int32)


def write(scene: Scene, source: Path, out: Path, voxel: float | None, n_triangles: int, raw: bool) -> dict[str, Any]:
    """Make and write the mesh of a scene; returns the facts. Raises ConfigError where `out` exists."""
    from chebsplat.formats.meshes import write_mesh
    from chebsplat.stages.progress import Progress

    if out.suffix.lower() not in (".ply", ".glb"):
        raise ConfigError(f"--out {out}: a mesh is written as .ply or .glb")
    if out.exists():
        raise ConfigError(f"{out} exists; remove it, or choose another --out")
    mesh, facts = mesh_of(scene, source, voxel, n_triangles, Progress(), raw)
    write_mesh(out, mesh, scene.label_names)
    return facts


main = command("mesh", run)
