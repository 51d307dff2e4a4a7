"""Alignment of a foreign splat with the cameras of a capture.

It may lie in their frame already, a file beside it may hold the transform, or it was trained in one
of the frames that trainers derive from cameras. A frame is right where renders of training views
resemble their own photos more than others'.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit

from chebsplat.cameras import centers, resized
from chebsplat.errors import InputError
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.dataparser import NAME, beside, read_dataparser
from chebsplat.formats.world import World
from chebsplat.render import SceneRenderer
from chebsplat.splats.similarity import Similarity, fitted
from chebsplat.views import View

log = logging.getLogger("chebsplat")

N_VIEWS, LEAST_VIEWS, WIDTH = 8, 4, 96  # views: compared, needed at least; their width in pixels
# Of the likeness of renders and photos, from -1 to 1. Four scenes of 20,000 points at their places
# have 0.64 to 0.82; turned by a right angle or shifted by a third of the room, at most 0.31. Few or
# faint Gaussians have 0.1 to 0.66 at their places.
AGREES, DOUBTED = 0.4, 0.2
# by which a frame that points refine must be better than the usual ones, which are exact
SAME = 0.01
ONE_COLOR = 1 / 72  # of the coefficient of band 0, which is a step of 255 in colour
BETTER = 0.1  # by which another frame must be better than the splat's own
FIRST, REFINED = 4, 3  # views that all frames are tried on; frames of these that are refined
# of refining (ICP): steps at most, points, and the nearest part of them that counts
STEPS, N_POINTS, NEAREST = 100, 1000, 0.6
FEW_STEPS, FEW_POINTS = 20, 300  # of a rough one, by which starts are compared
LEAST_GAIN = 1e-3  # relative decrease of the distances that a step must bring
SWAPPED = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # nerfstudio's axes of COLMAP's: z up
TURNS = [np.diag(signs) for signs in ((1.0, 1, 1), (1.0, -1, -1), (-1.0, 1, -1), (-1.0, -1, 1))]


class Sights(NamedTuple):
    """V training views: reduced photos u8 [V, h, w, 3], Ks [V, 3, 3] and poses [V, 4, 4]."""

    photos: np.ndarray
    Ks: np.ndarray
    poses: np.ndarray


def in_frame(
    ply: Path,
    parameters: dict[str, np.ndarray],
    capture: Capture,
    cameras: Cameras,
    points: np.ndarray | None,
    theirs: dict[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Raw parameters of a splat in the frame of the cameras; unchanged where it lies in it.

    Args:
      ply:        its file, for messages and the file beside it.
      parameters: in the capture's world; theirs: in the file's, None: the same.
      cameras:    of the capture, by name.
      points:     [P, 3] of the surface in the cameras' frame, to compute and refine normalisations.
    Raises:  InputError naming the splat, and the frames tried, where it resembles the photos in no
      frame.
    Choices: it is transformed only where that is clearly better. One that resembles the photos
      little in any frame is used with a warning: it may be trained little. With fewer than
      LEAST_VIEWS, and of Gaussians of one colour, there is no check.
    """
    sights, light = sights_of(capture, cameras), parameters["sh0"][:, 0]
    if sights is None or np.abs(light - np.median(light, 0)).mean() < ONE_COLOR:
        return parameters
    own = likeness(plain(parameters), sights, Similarity(1.0, np.eye(3), np.zeros(3)))
    if own >= AGREES:
        return parameters
    theirs, world = parameters if theirs is None else theirs, World.read(capture.source)
    renderer, outward = plain(theirs), Similarity(world.scale, np.eye(3), np.array(world.origin))
    ways = [(name, way.after(outward)) for name, way in read_ways(ply)]
    tried = [(name, way) for name, way in ways if likeness(renderer, sights, way) >= AGREES]
    tried = tried or guessed(renderer, sights, theirs, cameras, points)
    score, name, way = max(
        ((likeness(renderer, sights, way), name, way) for name, way in tried), key=lambda x: x[0]
    )
    if score >= max(AGREES, own + BETTER):
        log.warning(
            "%s lies in another frame than the cameras, that of %s: it is scaled by %.4g, turned "
            "and shifted (its renders resemble the photos by %.2f of 1 then, %.2f as it is)",
            ply,
            name,
            1 / way.scale,
            score,
            own,
        )
        return way.inverse().of_gaussians(theirs)
    if own < DOUBTED:
        file = beside(ply)
        raise InputError(
            f"{ply} lies in another frame than the cameras: its renders resemble the photos by "
            f"{own:.2f} of 1, and by {score:.2f} at most by "
            f"{f'{file}, ' if file else ''}nerfstudio's and gsplat's normalisations and by their "
            f"points; put the training's {NAME} beside it, or train and export it without "
            "normalising the scene"
        )
    log.warning(
        "%s resembles the photos by %.2f of 1 only: it is trained little, or lies in another "
        "frame than the cameras",
        ply,
        own,
    )
    return parameters


def sights_of(capture: Capture, cameras: Cameras) -> Sights | None:
    """Up to N_VIEWS training views, evenly spaced; None of too few."""
    row = {name: k for k, name in enumerate(capture.names)}
    used = [
        k for k, name in enumerate(cameras.names) if name in row and not capture.is_test[row[name]]
    ]
    if len(used) < LEAST_VIEWS:
        return None
    views = np.array(used)[np.unique(np.linspace(0, len(used) - 1, N_VIEWS).round().astype(int))]
    width = min(cameras.width, WIDTH)
    size = (width, max(round(cameras.height * width / cameras.width), 1))
    photos = [
        Image.fromarray(capture.images[row[cameras.names[k]]]).resize(size, Image.Resampling.BOX)
        for k in views
    ]
    Ks = resized(cameras.Ks[views], size[0] / cameras.width, size[1] / cameras.height)
    return Sights(
        np.stack([np.asarray(photo) for photo in photos]), Ks, cameras.cam_from_world[views]
    )


def plain(parameters: dict[str, np.ndarray]) -> SceneRenderer:
    """A renderer without SH bands above 0, which a transform would have to rotate."""
    names = ("means", "log_scales", "quats", "logit_opacities", "sh0")
    n = len(parameters["means"])
    none: dict[str, np.ndarray] = {
        "shN": np.zeros((n, 0, 3), np.float32),
        "degrees": np.zeros(n, np.uint8),
    }
    return SceneRenderer({name: parameters[name] for name in names} | none)


def likeness(
    renderer: SceneRenderer, sights: Sights, way: Similarity, n_views: int = N_VIEWS
) -> float:
    """Difference of mean pixel correlations of a splat's renders with their own photos and with
    other views'. way: from the cameras' frame into the splat's.
    """
    rows = np.unique(np.linspace(0, len(sights.photos) - 1, n_views).round().astype(int))
    height, width = sights.photos.shape[1:3]
    renders = []
    for pose, K in zip(way.of_cameras(sights.poses[rows]), sights.Ks[rows], strict=True):
        view = View(torch.from_numpy(K).float(), torch.from_numpy(pose).float(), width, height)
        renders.append(renderer.render(view)[0])
    both = (unit_rows(np.stack(renders)), unit_rows(sights.photos[rows]))
    table, n = both[0] @ both[1].T, len(rows)
    own = np.trace(table)
    return float(own / n - (table.sum() - own) / (n * (n - 1)))


def unit_rows(images: np.ndarray) -> np.ndarray:
    """Images [V, ...] as rows f64 [V, M] of mean 0 and length 1; 0 of a constant one."""
    rows = images.reshape(len(images), -1).astype(np.float64)
    rows -= rows.mean(1, keepdims=True)
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9))


def read_ways(ply: Path) -> Iterator[tuple[str, Similarity]]:
    """Transforms by the file beside a splat: of the cameras as they are, and with swapped axes."""
    if (path := beside(ply)) is not None:
        scale, rotation, shift = read_dataparser(path)
        way = Similarity(scale, rotation, scale * shift)
        for turn in (np.eye(3), SWAPPED, SWAPPED.T):
            yield str(path), way.after(Similarity(1.0, turn, np.zeros(3)))


def guessed(
    renderer: SceneRenderer,
    sights: Sights,
    parameters: dict[str, np.ndarray],
    cameras: Cameras,
    points: np.ndarray | None,
) -> list[tuple[str, Similarity]]:
    """The likeliest of the frames that trainers derive, and these refined by points, if any."""
    tried = [*nerfstudios(cameras.cam_from_world), *gsplats(cameras.cam_from_world, points)]
    first = np.array([likeness(renderer, sights, way, FIRST) for _, way in tried])
    best = [tried[k] for k in np.argsort(-first)[:REFINED]]
    if points is None or len(points) < 16:
        return best
    solid = parameters["means"][expit(parameters["logit_opacities"]) > 0.3].astype(np.float64)
    if len(solid) < 16:
        return best
    tree = KDTree(solid)
    rough = sorted(
        (refined(points, tree, way, FEW_STEPS, FEW_POINTS) for way in principal(points, solid)),
        key=lambda x: x[1],
    )
    best += [("its points", way) for way, _ in rough[:REFINED]]
    finer = [(f"{name}, refined", refined(points, tree, way)[0]) for name, way in best]
    usual = max(likeness(renderer, sights, way) for _, way in best)
    return best + [each for each in finer if likeness(renderer, sights, each[1]) > usual + SAME]


def nerfstudios(cam_from_world: np.ndarray) -> Iterator[tuple[str, Similarity]]:
    """nerfstudio's frames: cameras turned upright or to their principal axes, about their mean, and
    scaled so that the farthest coordinate is 1; of COLMAP's axes and of its own.
    """
    for prior in (np.eye(3), SWAPPED):
        eyes = centers(cam_from_world) @ prior.T
        rights, ups = cam_from_world[:, 0, :3] @ prior.T, -cam_from_world[:, 1, :3] @ prior.T
        for middle in (eyes.mean(0), np.zeros(3)):
            for name, turn in uprights(eyes - eyes.mean(0), rights, ups):
                scale = 1 / max(float(np.abs((eyes - middle) @ turn.T).max()), 1e-30)
                yield (
                    f"nerfstudio's orientation {name}",
                    Similarity(scale, turn @ prior, -scale * turn @ middle),
                )


def uprights(
    spread: np.ndarray, rights: np.ndarray, ups: np.ndarray
) -> Iterator[tuple[str, np.ndarray]]:
    """nerfstudio's rotations, by the cameras' centres about their mean, x axes and up [V, 3]."""
    up = ups.mean(0) / max(float(np.linalg.norm(ups.mean(0))), 1e-30)
    yield "up", onto(up, np.array([0, 0, 1.0]))
    level = np.linalg.svd(rights, full_matrices=False)[2][-1]
    yield "vertical", onto(level if level @ up > 0 else -level, np.array([0, 0, 1.0]))
    axes = np.linalg.eigh(spread.T @ spread)[1][:, ::-1].T
    axes[2] *= np.sign(np.linalg.det(axes))
    for turn in TURNS:
        if (turn @ axes @ up)[2] >= 0:
            yield "pca", turn @ axes
    yield "none", np.eye(3)


def onto(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The least rotation [3, 3] of a unit vector into another; about x where they are opposite."""
    axis, cosine = np.cross(one, other), float(one @ other)
    if cosine < -1 + 1e-8:
        return np.diag([1.0, -1, -1])
    cross = np.cross(np.eye(3), axis)
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))


def gsplats(
    cam_from_world: np.ndarray, points: np.ndarray | None
) -> Iterator[tuple[str, Similarity]]:
    """gsplat's frames: up turned to -y, the median of the cameras' focus points, or of the cameras,
    at 0, their median distance 1; then points to their principal axes.
    """
    ups = -cam_from_world[:, 1, :3].mean(0)
    turn = onto(ups / max(float(np.linalg.norm(ups)), 1e-30), np.array([0, -1.0, 0]))
    eyes, axes = centers(cam_from_world) @ turn.T, cam_from_world[:, 2, :3] @ turn.T
    looked = eyes - (eyes * axes).sum(1, keepdims=True) * axes
    for middle in (np.median(looked, axis=0), np.median(eyes, axis=0)):
        scale = 1 / max(float(np.median(np.linalg.norm(eyes - middle, axis=1))), 1e-30)
        first = Similarity(scale, turn, -scale * middle)
        yield "gsplat's normalisation", first
        if points is not None and len(points) > 3:
            center, frame, _ = principal_axes(first.of_points(points))
            for signs in TURNS:
                rotation = signs @ frame
                yield (
                    "gsplat's normalisation",
                    Similarity(1.0, rotation, -rotation @ center).after(first),
                )


def principal_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Median of points, principal axes as rows of a rotation, longest first, median distance."""
    center = np.median(points, axis=0)
    axes = np.linalg.eigh(np.cov(points, rowvar=False))[1][:, ::-1].T
    axes[0] *= np.sign(np.linalg.det(axes))
    return center, axes, float(np.median(np.linalg.norm(points - center, axis=1)))


def principal(points: np.ndarray, others: np.ndarray) -> Iterator[Similarity]:
    """Similarities that align median, principal axes and size of points with those of others, in
    all 24 orders, as axes of similar length may be swapped.
    """
    center, axes, size = principal_axes(points)
    other, theirs, larger = principal_axes(others)
    for turn in Rotation.create_group("O").as_matrix():
        rotation, scale = theirs.T @ turn @ axes, larger / max(size, 1e-30)
        yield Similarity(scale, rotation, other - scale * rotation @ center)


def refined(
    points: np.ndarray, tree: KDTree, way: Similarity, steps: int = STEPS, n_points: int = N_POINTS
) -> tuple[Similarity, float]:
    """A similarity refined by ICP from points [P, 3] to those of the tree, and the mean distance
    left, in the points' unit.

    Choices: only the NEAREST part counts in each step: where the rest lies the splat may have
      nothing, or floaters.
    """
    sample = points[
        np.random.default_rng(0).choice(len(points), min(len(points), n_points), replace=False)
    ]
    last = np.inf
    for _ in range(steps):
        away, index = tree.query(way.of_points(sample))
        near = away <= np.quantile(away, NEAREST)
        if away[near].mean() > (1 - LEAST_GAIN) * last:
            break
        last = away[near].mean()
        way = fitted(sample[near], tree.data[index[near]])
    return way, float(last / way.scale)
