"""Whether a model that structure from motion made of photos is to be believed, and what to
photograph otherwise.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap
from scipy.sparse.csgraph import connected_components

from chebsplat.errors import DataFailure
from chebsplat.formats.photo_model import PhotoModel

LEAST = 30  # verified matches of a pair that counts
SOUND = 0.6  # of the pairs
DENIED = 0.05  # of a pair's matches: where fewer are, the pair contradicts it
# of a photo's pairs: where more contradict its place, it is left out; of right photos .44 did
CONTRADICTED = 0.5
# of a photo's pairs: where more contradict its place, it speaks for no costlier model
DISPUTED = 0.3
# of a pair's matches: where so many are points of the model, the pair agrees with it
CONFIRMED = 0.3
# of the pairs: of six real captures all that are right have .88 and more, a repetitive board .5
AGREE = 0.8
FLAT = 2.0  # degrees between the rays of the median point: below, depth is a guess
LEVEL = 0.9  # of the pairs: of views of one panorama all, of captures that are right at most 40 %
HOMOGRAPHIES = {
    getattr(pycolmap.TwoViewGeometryConfiguration, name)
    for name in ("PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC")
}
SCARCE = 60  # points of the median photo
LOOSE = 1.5e-3  # of the longer side: a reprojection error of 2.4 pixels in 1,600
REMEDY = (
    "photograph from more places, a step to the side between photos, with two thirds of the "
    "picture in common"
)


class Pairs(NamedTuple):
    """The pairs of a model's photos that have LEAST verified matches.

    images: ids [N] of the photos; rows: [P, 2] into them; confirmed: [P] the share of a pair's
      matches that are points
    of the model; level: the share of the pairs whose matches one homography explains.
    """

    images: list[int]
    rows: np.ndarray
    confirmed: np.ndarray
    level: float = 0.0


def pairs(model: pycolmap.Reconstruction, database: Path) -> Pairs:
    """Pairs of a model's photos, and the share of each one's matches that the model confirms."""
    points = {
        image.image_id: np.array(
            [p.point3D_id if p.has_point3D() else -1 for p in image.points2D], np.int64
        )
        for image in model.images.values()
        if image.has_pose
    }
    images, rows, confirmed, level = sorted(points), [], [], []
    with pycolmap.Database.open(database) as opened:
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            matches = geometry.inlier_matches
            if len(matches) >= LEAST and first in points and second in points:
                a, b = points[first][matches[:, 0]], points[second][matches[:, 1]]
                rows.append([images.index(first), images.index(second)])
                confirmed.append(float(((a == b) & (a >= 0)).mean()))
                level.append(geometry.config in HOMOGRAPHIES)
    return Pairs(
        images,
        np.array(rows, int).reshape(-1, 2),
        np.array(confirmed),
        float(np.mean(level or [False])),
    )


def misplaced(found: Pairs, most: float = CONTRADICTED) -> list[int]:
    """Ids of photos that many of their pairs contradict, for they were put beside something that
    only looks alike.

    Args:    most: of a photo's pairs, that may contradict its place.
    Choices: the photo with the largest share of contradicting pairs goes first, and its pairs no
      longer count. One pair alone tells nothing. Of groups then linked by no agreeing pair the
      largest stays; photos without pairs stay, too. Where less than SOUND of all pairs agree,
      matches are no witnesses, and all stay.
    """
    if not len(found.confirmed) or np.mean(found.confirmed >= CONFIRMED) < SOUND:
        return []
    n = len(found.images)
    agree, deny = np.zeros((n, n)), np.zeros((n, n))
    for matrix, chosen in ((agree, found.confirmed >= CONFIRMED), (deny, found.confirmed < DENIED)):
        i, j = found.rows[chosen].T
        matrix[i, j] = matrix[j, i] = 1
    kept = np.ones(n, bool)
    while True:
        against = deny @ kept
        share = np.where(kept & (against > 1), against / np.maximum(against + agree @ kept, 1), 0)
        worst = np.lexsort((against, share))[-1]
        if share[worst] <= most:
            break
        kept[worst] = False
    held = np.flatnonzero(kept & agree.any(1))
    _, group = connected_components(agree[np.ix_(held, held)], directed=False)
    kept[held[group != np.bincount(group, minlength=1).argmax()]] = False
    return [found.images[k] for k in np.flatnonzero(~kept)]


def judged(
    model: pycolmap.Reconstruction,
    found: Pairs,
    n_photos: int,
    others: list[int],
    n_misplaced: int,
    mapped_error: float,
) -> dict[str, Any]:
    """What tells whether a model is right, and `doubts` in words.

    Args: others: photos in each further model, which share nothing with this one; n_misplaced: left
      out of it;
          mapped_error: pixels, before what strays was left out.
    """
    images = [model.images[key] for key in found.images if model.images[key].has_pose]
    side = max(max(camera.width, camera.height) for camera in model.cameras.values())
    facts: dict[str, Any] = {
        "how": "structure from motion",
        "n_registered": len(images),
        "n_given": n_photos,
        "n_in_others": others,
        "n_misplaced": n_misplaced,
        "n_undisputed": len(images) - len(misplaced(found, DISPUTED)),
        "n_points": model.num_points3D(),
        "points_a_view": float(np.median([image.num_points3D for image in images])),
        "track_length": round(float(model.compute_mean_track_length()), 2),
        "reprojection_error_px": round(float(model.compute_mean_reprojection_error()), 3),
        "reprojection_error": float(model.compute_mean_reprojection_error() / side),
        "mapped_error": float(mapped_error / side),
        "pairs_agree": float(np.mean(found.confirmed >= CONFIRMED))
        if len(found.confirmed)
        else 0.0,
        "pairs_level": found.level,
        "angle_degrees": angle(
            model, {image.image_id: image.projection_center() for image in images}
        ),
    }
    return facts | {"doubts": doubts(facts)}


def angle(model: pycolmap.Reconstruction, eyes: dict[int, np.ndarray]) -> float:
    """The widest angle between two rays of a point, degrees, in the median point."""
    widest = [0.0]
    for point in model.points3D.values():
        rays = point.xyz - np.array([eyes[e.image_id] for e in point.track.elements])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        widest.append(float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))))
    return float(np.median(widest))


def doubts(found: dict[str, Any]) -> list[str]:
    """What speaks against a model, and what to do about it; nothing of a good one."""
    absent, others = (
        found["n_given"] - found["n_registered"] - found["n_misplaced"],
        found["n_in_others"],
    )
    said = []
    if others and absent > 0.1 * found["n_given"]:
        said.append(
            f"The photos fall into {len(others) + 1} groups that hardly meet; the largest is "
            f"used, {absent} photos "
            "are not: photograph what lies between, or make a scene of each."
        )
    elif absent > 0.1 * found["n_given"]:
        said.append(
            f"{absent} of {found['n_given']} photos could not be placed and are left out; {REMEDY}."
        )
    if n := found["n_misplaced"]:
        said.append(
            f"{n} photos are left out that most of their matches contradict: something in "
            "the scene repeats."
        )
    if found["pairs_agree"] < AGREE:
        said.append(
            f"Only {found['pairs_agree']:.0%} of the pairs of photos agree with where the model "
            "puts them: something "
            "repeats, mirrors or moves in the scene, or the lens changed; check the poses, and "
            f"{REMEDY}."
        )
    if found["mapped_error"] > LOOSE:
        said.append(
            f"Points miss their photos by {found['mapped_error']:.1e} of their side: the lens or "
            "what is shown moved "
            "while it was photographed; lock focus and zoom."
        )
    if found["points_a_view"] < SCARCE:
        said.append(
            f"A photo has only {found['points_a_view']:.0f} points (median); {REMEDY}, of "
            "more texture."
        )
    return said


def sentence(found: dict[str, Any]) -> str:
    """The figures of a model in words."""
    return (
        f"{found['n_registered']} of {found['n_given']} photos registered, {found['n_points']} "
        "points in "
        f"{found['track_length']:.1f} photos each, {found['reprojection_error_px']:.2f} px, "
        f"{found['pairs_agree']:.0%} "
        f"of the pairs agree, {found['angle_degrees']:.1f}° between rays."
    )


def check(model: PhotoModel, least: float) -> None:
    """Raise DataFailure on a model that is not to be believed."""
    found, n_photos = model.judged, model.judged["n_given"]
    needed = max(math.ceil(least * n_photos), 3)
    if len(model.names) < needed:
        more = f" {' '.join(found['doubts'])}" if found["doubts"] else ""
        raise DataFailure(
            f"{len(model.names)} of {n_photos} photos registered; at least {needed} are needed "
            f"(pose.min_registered); {REMEDY}.{more}"
        )
    if found["angle_degrees"] < FLAT or found["pairs_level"] > LEVEL:
        raise DataFailure(
            "the photos were taken from one place, or show one plane, which tells no depth: a "
            "homography explains "
            f"{found['pairs_level']:.0%} of the pairs, rays of a point meet at "
            f"{found['angle_degrees']:.1f}°; {REMEDY}"
        )
