"""sfm: cameras, and points with normals and local anisotropic covariances."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np

from chebsplat.cameras import centers, unproject
from chebsplat.errors import DataFailure
from chebsplat.formats.capture import Capture
from chebsplat.formats.points import Points
from chebsplat.labels.agreement import project
from chebsplat.photos.colors import tell_of
from chebsplat.settings import default_gaussians
from chebsplat.splats.gaussians import local_shape
from chebsplat.stages.reconstruction.dense import MOST, backdrop, covered, swept, wants_more
from chebsplat.stages.reconstruction.enclosure import enclosed
from chebsplat.stages.reconstruction.pose_check import wants_adjustment
from chebsplat.stages.reconstruction.thinning import by_color, edge_of, thin
from chebsplat.stages.reconstruction.triangulation import reconstruct
from chebsplat.stages.runtime.command import Job

log = logging.getLogger("chebsplat")
# the fields of `Points` but the local shape, and seen_from [N]: the view that a point is from
Cloud = dict[str, Any]
N_NEIGHBORS = 16  # that give a point its normal and covariance
POINTS_SHARE = 0.9  # of the Gaussians that a training of measured points may grow to
CANDIDATES = 16  # pixels with depth that are drawn for each point at most
TRIED = 2000  # points that are compared with depth
EVEN = 0.55  # of the points: spaced evenly whatever the colours, for shape


def run(job: Job) -> None:
    """Cameras, and points with normals and local covariances (docs/method.md, section 1).

    Reads `capture`. Writes `points`. Poses, points and depth of the capture are used as they are;
    what it lacks is computed by feature matching and triangulation, as is everything where
    `sfm.matching` is not `auto`.
    """
    settings, capture = job.config.sfm, Capture.read(job.inputs["capture"])
    most = settings.max_points or default_points(capture)
    spares = capture.points is not None or capture.depth is not None
    use_poses = capture.cam_from_world is not None and settings.matching == "auto" and spares
    adjusted = wants_adjustment(job, capture, settings) if use_poses else None
    use_poses = use_poses and not adjusted
    if use_poses and capture.points is not None:
        job.left_out("feature matching", "poses are given, and points by the source")
        cloud = from_source(capture, most)
    elif use_poses:
        job.left_out("feature matching", "poses and depth are given: points come from depth")
        _, cloud = reduced(from_depth(job, capture, most), most, settings.spacing)
    else:
        cloud = reconstruct(job, capture, settings, most, adjusted)
        if "poses_kept" in cloud["notes"] and capture.depth is not None:
            measured = from_depth(job, capture, most, cloud["cam_from_world"])
            cloud = filled(cloud, measured, most, settings.spacing)
    depths = None
    if len(cloud["means"]) >= 16 and wants_more(job, capture, cloud, settings):
        more = swept(job, capture, cloud)
        depths = more.pop("depths")
        cloud = filled(cloud, more, min(MOST, most), name="n_swept")
    if (n := len(cloud["means"])) < 16:
        raise DataFailure(
            f"only {n} points were found, at least 16 are needed; add views with more overlap"
        )
    off = {} if "reprojection_error_px" in cloud["notes"] else check_points(capture, cloud)
    cloud = with_sides(job, capture, cloud, use_poses or "poses_kept" in cloud["notes"])
    if depths is not None:
        behind = backdrop(capture, cloud)
        cloud = joined(cloud, behind) | {
            "notes": cloud["notes"] | {"n_behind": len(behind["means"])}
        }
    means = cloud["means"]
    covariances, normals = local_shape(means, N_NEIGHBORS)
    eye = centers(cloud["cam_from_world"])[cloud["seen_from"]]
    away = np.einsum("ni,ni->n", normals, eye - means) < 0
    normals[away] *= -1
    job.facts |= {"n_points": len(means), "n_views": len(cloud["names"])} | cloud["notes"] | off
    Points(
        cloud["names"],
        cloud["Ks"],
        cloud["cam_from_world"],
        means,
        cloud["colors"],
        normals,
        covariances,
        cloud["tracks"],
        cloud["notes"],
        depths,
    ).write(job.out)


def default_points(capture: Capture) -> int:
    """Points of a scene, at most, by the pixels of its training photos.

    Choices: with matched points as with measured ones, whose Gaussians may be fewer.
    """
    n_pixels = int((~capture.is_test).sum()) * math.prod(capture.size)
    return round(POINTS_SHARE * default_gaussians(n_pixels, measured=True))


def with_sides(job: Job, capture: Capture, cloud: Cloud, in_unit: bool) -> Cloud:
    """A cloud with points on the sides of its room where no training photo shows them.

    Args: in_unit: the capture's depth, if any, is in the unit of the cloud.
    """
    row = {name: k for k, name in enumerate(capture.names)}
    rows, depth, mask = [row[name] for name in cloud["names"]], capture.depth, capture.loss_mask
    if job.config.sfm.enclosure == "off":
        reason = "sfm.enclosure is off"
    elif depth is None or not in_unit:
        reason = "no depth in the unit of the scene tells what photos show"
    else:

        def depth_of(k: int) -> np.ndarray:
            """Depth of a view of the cloud, 0 where it is masked."""
            return depth[rows[k]] if mask is None else np.where(mask[rows[k]], depth[rows[k]], 0)

        views = np.flatnonzero(~capture.is_test[rows])
        sides, reason = enclosed(cloud, views, depth_of, capture.size)
        if not reason:
            n = len(sides["means"])
            return joined(cloud, sides) | {"notes": cloud["notes"] | {"n_on_sides": n}}
    job.left_out("sides of the room where no photo looks", reason)
    return cloud


def check_points(capture: Capture, cloud: Cloud) -> dict[str, float]:
    """Error of points that come from no matches: `depth_error`, the median of their distance from
    the depth of training views, as a share of it; without depth `covered`, the share of the photos'
    cells that hold a point.

    Choices: TRIED points, in 8 views; more than a tenth off, a point is hidden by another surface.
    """
    if capture.depth is None:
        return {
            "covered": covered(cloud["Ks"], cloud["cam_from_world"], cloud["means"], capture.size)
        }
    row = {name: k for k, name in enumerate(capture.names)}
    views = [
        (k, row[name]) for k, name in enumerate(cloud["names"]) if not capture.is_test[row[name]]
    ]
    means, errors = cloud["means"][:: -(-len(cloud["means"]) // TRIED)], [np.zeros(0)]
    for place, view in views[:: -(-len(views) // 8)]:
        image = project(means, cloud["Ks"][place], cloud["cam_from_world"][place], capture.size)
        u, v, z = image[np.isfinite(image[:, 0])].T
        surface = capture.depth[view][v.astype(int), u.astype(int)]
        apart = np.abs(z - surface) / np.where(surface > 0, surface, np.nan)
        errors.append(apart[apart < 0.1])
    relative = np.concatenate(errors)
    return {"depth_error": float(np.median(relative))} if len(relative) else {}


def filled(
    cloud: Cloud, more: Cloud, count: int, spacing: str = "even", name: str = "n_from_depth"
) -> Cloud:
    """Union of two clouds of the same views, thinned to one point a cube, at most `count`.

    Args:    name: of the note that counts the points of `more`.
    Choices: triangulated points lie where the photos have texture, those of depth in between; a
      cube with both keeps the triangulated one.
    """
    rows, union = reduced(joined(cloud, more), count, spacing)
    union["notes"] |= {name: int((rows >= len(cloud["means"])).sum())}
    return union


def joined(cloud: Cloud, more: Cloud) -> Cloud:
    """A cloud with the points of another one of the same views after its own."""
    return cloud | {
        key: np.concatenate([cloud[key], more[key]]) for key in ("means", "colors", "seen_from")
    }


def reduced(cloud: Cloud, count: int, spacing: str) -> tuple[np.ndarray, Cloud]:
    """Rows of at most `count` points of a cloud, one a cube, and the cloud of these.

    Args: spacing: even: cubes of one size; color: cubes that are the smaller the more the colours
      within differ, and the mean of these colours.
    """
    colors, tracks, notes = cloud["colors"], cloud["tracks"], dict(cloud["notes"])
    if spacing == "color" and len(cloud["means"]) > count:
        edge = edge_of(cloud["means"], int(EVEN * count))
        rows, cube = by_color(cloud["means"], colors, count, edge)
        sums = np.stack([np.bincount(cube, colors[:, k]) for k in range(3)], 1)
        colors = (sums / np.bincount(cube)[:, None]).round().astype(np.uint8)
        notes |= {"largest": edge, "from": cloud["means"].min(0).tolist()}
    else:
        rows = thin(cloud["means"], count)
        colors = colors[rows]
    row = np.full(len(cloud["means"]), -1)
    row[rows] = np.arange(len(rows))
    tracks = tracks[row[tracks[:, 0]] >= 0]
    tracks = np.stack([row[tracks[:, 0]], tracks[:, 1]], 1)
    same = {key: cloud[key][rows] for key in ("means", "seen_from")}
    return rows, cloud | same | {"colors": colors, "tracks": tracks, "notes": notes}


def from_depth(job: Job, capture: Capture, most: int, poses: np.ndarray | None = None) -> Cloud:
    """Points from depth of training views, CANDIDATES times `most`, in random order.

    Args: poses [V, 4, 4]: of the capture's views where they were adjusted.
    Choices: test views give no points; pixels are drawn evenly over views.
    """
    assert capture.cam_from_world is not None and capture.depth is not None
    rng = np.random.default_rng(job.config.sfm.seed)
    poses = capture.cam_from_world if poses is None else poses
    used = np.flatnonzero(~capture.is_test)
    per_view = max(CANDIDATES * most // max(len(used), 1), 16)
    means, colors, view_of = [], [], []
    for view, status in job.progress.track(used, len(used), "depth"):
        depth, image = capture.depth[view], capture.images[view]
        valid = np.isfinite(depth) & (depth > 0)
        if capture.loss_mask is not None:
            valid &= capture.loss_mask[view]
        pixels = np.argwhere(valid)
        pixels = pixels[rng.choice(len(pixels), min(per_view, len(pixels)), replace=False)]
        means.append(unproject(depth, capture.Ks[view], poses[view], pixels))
        colors.append(image[pixels[:, 0], pixels[:, 1]])
        view_of.append(np.full(len(pixels), view))
        status["points"] = sum(map(len, means))
    points = np.concatenate(means)
    if len(points) == 0:
        raise DataFailure(
            "no training view has a pixel with depth; ingest the source without depth instead"
        )
    order = rng.permutation(len(points))
    return {
        "names": list(capture.names),
        "Ks": capture.Ks,
        "cam_from_world": poses,
        "means": points[order],
        "colors": np.concatenate(colors)[order],
        "seen_from": np.concatenate(view_of)[order],
        "tracks": np.zeros((0, 2), np.int32),
        "notes": {"how": "depth", "n_candidates": len(points)},
    }


def from_source(capture: Capture, most: int) -> Cloud:
    """The source's own points that project into a training view, at most `most`, one a voxel.

    Choices: a point is visible from the nearest such view, which orients its normal; occlusion is
      not tested. Points without colours, or with colours unlike the photos' (`tell_of`), take the
      pixels there.
    """
    assert capture.cam_from_world is not None and capture.points is not None
    rows = thin(capture.points, most)
    points, (width, height) = capture.points[rows].astype(np.float64), capture.size
    distance, view_of = np.full(len(points), np.inf), np.full(len(points), -1)
    pixels, colors = np.zeros((len(points), 3), np.uint8), capture.point_colors
    tracks = tracks_of(capture, rows)
    for view in np.flatnonzero(~capture.is_test):
        pose = capture.cam_from_world[view]
        camera = points @ pose[:3, :3].T + pose[:3, 3]
        u, v = ((camera / np.maximum(camera[:, 2:], 1e-6)) @ capture.Ks[view].T)[:, :2].T
        away = np.linalg.norm(points - centers(pose[None])[0], axis=1)
        if len(tracks):
            away = np.where(
                np.isin(np.arange(len(points)), tracks[tracks[:, 1] == view, 0]), away, np.inf
            )
        nearer = (
            (camera[:, 2] > 0.01)
            & (u >= 0)
            & (u < width)
            & (v >= 0)
            & (v < height)
            & (away < distance)
        )
        distance[nearer], view_of[nearer] = away[nearer], view
        pixels[nearer] = capture.images[view][v[nearer].astype(int), u[nearer].astype(int)]
    inside = view_of >= 0
    if colors is not None and not tell_of(colors[rows][inside], pixels[inside]):
        log.warning(
            "the source's colours of points tell nothing of the photos; the photos' own are taken"
        )
        colors = None
    colors = pixels if colors is None else colors[rows]
    tracks = tracks_of(capture, rows[inside])
    log.info(
        "%d of the source's %d points are used; nothing is matched",
        inside.sum(),
        len(capture.points),
    )
    return {
        "names": list(capture.names),
        "Ks": capture.Ks,
        "cam_from_world": capture.cam_from_world,
        "means": capture.points[rows][inside],
        "colors": colors[inside],
        "seen_from": view_of[inside],
        "tracks": tracks,
        "notes": {
            "how": "source",
            "n_candidates": len(capture.points),
            "n_unseen": int((~inside).sum()),
        },
    }


def tracks_of(capture: Capture, rows: np.ndarray) -> np.ndarray:
    """The source's tracks i32 [T, 2] (point, view) of these rows of its points, renumbered."""
    if capture.points is None or capture.tracks is None:
        return np.zeros((0, 2), np.int32)
    place = np.full(len(capture.points), -1)
    place[rows] = np.arange(len(rows))
    tracks = np.stack([place[capture.tracks[:, 0]], capture.tracks[:, 1]], 1)
    return tracks[tracks[:, 0] >= 0].astype(np.int32)
