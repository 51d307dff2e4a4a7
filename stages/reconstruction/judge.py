"""Checks of a model from structure from motion: doubts about it, and what to photograph better."""

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
FEW = 20  # verified matches of a pair that counts between two parts of a model
PART = 10  # photos of a part: what COLMAP calls a model of its own
# of the pairs: of six real captures all that are right have .88 and more, a repetitive board .5
AGREE = 0.8
FLAT = 2.0  # degrees between the rays of the median point: below, depth is a guess
LEVEL = 0.9  # of the pairs: of views of one panorama all, of captures that are right at most 40 %
HOMOGRAPHIES = {
    getattr(pycolmap.TwoViewGeometryConfiguration, name)
    for name in ("PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC")
}
SCARCE = 60  # points of the median photo
# of `focal_spread`: of two lenses .3; of a zoom that goes by a third .24, where own focal lengths
# leave errors of 2 to 4 cm in a room; through one lens they are 1 cm
ZOOMED = 0.1
LOOSE = 1.5e-3  # of the longer side: a reprojection error of 2.4 pixels in 1,600
REMEDY = (
    "photograph from more places, a step to the side between photos, with two thirds of the "
    "picture in common"
)


class Pairs(NamedTuple):
    """The match graph of a model: pairs of its photos with enough verified matches.

    images: ids [N] of the photos; rows: [P, 2] into them; confirmed: [P] share of a pair's matches
    that are points of the model; level: share of the pairs whose matches one homography explains.
    """

    images: list[int]
    rows: np.ndarray
    confirmed: np.ndarray
    level: float = 0.0

    @property
    def n_agree(self) -> int:
        """Pairs that agree with the model."""
        return int((self.confirmed >= CONFIRMED).sum())


def pairs(model: pycolmap.Reconstruction, database: Path, least: int = LEAST) -> Pairs:
    """Pairs of a model's photos with so many matches or more, and the share of each one's matches
    that the model confirms.
    """
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
            if len(matches) >= least and first in points and second in points:
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


def misplaced(graph: Pairs, most: float = CONTRADICTED) -> list[int]:
    """Ids of photos whose place many of their pairs contradict, as where the scene repeats.

    Args:    most: share of a photo's pairs that may contradict its place.
    Choices: the photo with the largest share of contradicting pairs goes first, and its pairs no
      longer count. A single pair is no evidence. Of groups then linked by no agreeing pair the
      largest stays; photos without pairs stay, too. Where less than SOUND of all pairs agree,
      matches are not to be trusted, and all photos stay.
    """
    if not len(graph.confirmed) or np.mean(graph.confirmed >= CONFIRMED) < SOUND:
        return []
    agree, deny = _votes(graph)
    survivors = np.ones(len(agree), bool)
    while True:
        against = deny @ survivors
        share = np.where(
            survivors & (against > 1), against / np.maximum(against + agree @ survivors, 1), 0
        )
        worst = np.lexsort((against, share))[-1]
        if share[worst] <= most:
            break
        survivors[worst] = False
    linked = np.flatnonzero(survivors & agree.any(1))
    survivors[np.setdiff1d(linked, _largest_group(agree, linked))] = False
    return [graph.images[k] for k in np.flatnonzero(~survivors)]


def joint(graph: Pairs) -> list[tuple[int, int]]:
    """Pairs of photos, by their ids, that alone join two parts of a model, most pairs between which
    contradict it; none where most agree.

    Args:    graph: of pairs with FEW or more matches.
    Choices: agreeing pairs attract, contradicting ones repel: the signs of the lowest eigenvector
      of that graph's Laplacian are two sides between which few pairs agree, and one side where no
      pair contradicts. A part is the largest group of a side that agreeing pairs link; one of less
      than PART photos is left to `misplaced`. It is a suspicion alone: between halves of a house
      that were joined wrongly 85 to 95 % contradict, between those of a right room 82 %.
    """
    agree, deny = _votes(graph)
    linked = _largest_group(agree + deny, np.arange(len(agree)))
    votes = (agree - deny)[np.ix_(linked, linked)]
    lowest = np.linalg.eigh(np.diag(np.abs(votes).sum(1)) - votes).eigenvectors[:, 0]
    parts = [_largest_group(agree, linked[side]) for side in (lowest > 0, lowest <= 0)]
    if min(map(len, parts)) < PART or deny[np.ix_(*parts)].sum() <= agree[np.ix_(*parts)].sum():
        return []
    part = np.zeros(len(agree), int)
    part[parts[0]], part[parts[1]] = 1, -1
    joining = (part[graph.rows].prod(1) < 0) & (graph.confirmed >= DENIED)
    return [(graph.images[i], graph.images[j]) for i, j in graph.rows[joining]]


def _votes(graph: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Pairs that agree with a model and pairs that contradict it, each [N, N] of 0 and 1."""
    agree, deny = np.zeros((2, len(graph.images), len(graph.images)))
    for matrix, mask in ((agree, graph.confirmed >= CONFIRMED), (deny, graph.confirmed < DENIED)):
        i, j = graph.rows[mask].T
        matrix[i, j] = matrix[j, i] = 1
    return agree, deny


def _largest_group(links: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Those of `rows` in the largest group that `links` [N, N] between them connect."""
    _, group = connected_components(links[np.ix_(rows, rows)], directed=False)
    return rows[group == np.bincount(group, minlength=1).argmax()]


def judge_model(
    model: pycolmap.Reconstruction,
    graph: Pairs,
    n_photos: int,
    others: list[int],
    n_misplaced: int,
    mapped_error: float,
    focal_spread: float,
    own_focals: bool,
) -> dict[str, Any]:
    """Figures by which to judge a model, and its `doubts` in words.

    Args: others: photos in each further model, which share nothing with this one; n_misplaced: left
      out of it; mapped_error: reprojection error, pixels, before outliers were removed;
      focal_spread: span of the middle 80 % of the photos' own focal lengths, ln; own_focals: the
      model has them.
    """
    images = [model.images[key] for key in graph.images if model.images[key].has_pose]
    side = max(max(camera.width, camera.height) for camera in model.cameras.values())
    facts: dict[str, Any] = {
        "how": "structure from motion",
        "n_registered": len(images),
        "n_given": n_photos,
        "n_in_others": others,
        "n_misplaced": n_misplaced,
        "n_undisputed": len(images) - len(misplaced(graph, DISPUTED)),
        "n_points": model.num_points3D(),
        "points_a_view": float(np.median([image.num_points3D for image in images])),
        "track_length": round(float(model.compute_mean_track_length()), 2),
        "reprojection_error_px": round(float(model.compute_mean_reprojection_error()), 3),
        "reprojection_error": float(model.compute_mean_reprojection_error() / side),
        "mapped_error": float(mapped_error / side),
        "focal_spread": focal_spread,
        "own_focals": own_focals,
        "pairs_agree": graph.n_agree / max(len(graph.rows), 1),
        "pairs_level": graph.level,
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


def doubts(facts: dict[str, Any]) -> list[str]:
    """Doubts about a model, each with its remedy; none about a good one."""
    absent = facts["n_given"] - facts["n_registered"] - facts["n_misplaced"]
    others = facts["n_in_others"]
    messages = []
    if others and absent > 0.1 * facts["n_given"]:
        messages.append(
            f"The photos fall into {len(others) + 1} groups that hardly meet; the largest is used, "
            f"{absent} photos are not: photograph what lies between, or make a scene of each."
        )
    elif absent > 0.1 * facts["n_given"]:
        messages.append(
            f"{absent} of {facts['n_given']} photos could not be placed and are left out; {REMEDY}."
        )
    if n := facts["n_misplaced"]:
        messages.append(
            f"{n} photos are left out that most of their matches contradict: something in "
            "the scene repeats."
        )
    if facts["pairs_agree"] < AGREE:
        messages.append(
            f"Only {facts['pairs_agree']:.0%} of the pairs of photos agree with where the model "
            "puts them: something repeats, mirrors or moves in the scene, or the lens changed; "
            f"check the poses, and {REMEDY}."
        )
    if facts["mapped_error"] > LOOSE:
        messages.append(
            f"Points miss their photos by {facts['mapped_error']:.1e} of their side: the lens or "
            "what is shown moved while it was photographed; lock focus and zoom."
        )
    if facts["focal_spread"] > ZOOMED:
        messages.append(
            f"Focal lengths of the photos differ by {math.expm1(facts['focal_spread']):.0%}, "
            f"{'which makes poses less exact' if facts['own_focals'] else 'where one is assumed'}: "
            "lock focus and zoom, or make a scene of each lens."
        )
    if facts["points_a_view"] < SCARCE:
        messages.append(
            f"A photo has only {facts['points_a_view']:.0f} points (median); {REMEDY}, of "
            "more texture."
        )
    return messages


def sentence(facts: dict[str, Any]) -> str:
    """The figures of a model in words."""
    return (
        f"{facts['n_registered']} of {facts['n_given']} photos registered, {facts['n_points']} "
        f"points in {facts['track_length']:.1f} photos each, {facts['reprojection_error_px']:.2f} "
        f"px, {facts['pairs_agree']:.0%} of the pairs agree, {facts['angle_degrees']:.1f}° "
        "between rays."
    )


def check(model: PhotoModel, least: float) -> None:
    """Raise DataFailure on a model of too few photos, or of photos that show no depth."""
    facts, n_photos = model.judged, model.judged["n_given"]
    needed = max(math.ceil(least * n_photos), 3)
    if len(model.names) < needed:
        more = f" {' '.join(facts['doubts'])}" if facts["doubts"] else ""
        raise DataFailure(
            f"{len(model.names)} of {n_photos} photos registered; at least {needed} are needed "
            f"(pose.min_registered); {REMEDY}.{more}"
        )
    if facts["angle_degrees"] < FLAT or facts["pairs_level"] > LEVEL:
        raise DataFailure(
            "the photos were taken from one place, or show one plane, which tells no depth: a "
            f"homography explains {facts['pairs_level']:.0%} of the pairs, rays of a point meet at "
            f"{facts['angle_degrees']:.1f}°; {REMEDY}"
        )
