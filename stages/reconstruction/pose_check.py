"""Check of a source's poses against its photos: distances of matches to their epipolar lines."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from chebsplat.formats.capture import Capture
from chebsplat.photos.guided import fundamental, sampson_distance
from chebsplat.stages.reconstruction.matching import match, match_freely, nearest_by_pose
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import SfmSection
from chebsplat.stages.sources.common import file_of

log = logging.getLogger("chebsplat")

MISFIT = 0.5  # pixels that the median match may miss its epipolar line by
# times its distance to that of the pair's own fundamental matrix: features may be coarse
OVER_FREE = 2.0
SHARED = 30  # verified matches of a pair that counts
LEAST = 6  # such pairs, without which there is no verdict
PROBED, FEATURES = 16, 2048  # pairs of the check; features of a view, where it alone needs matches


class Fit(NamedTuple):
    """Median distances of matches to epipolar lines, pixels: by_poses: of the source's poses;
    free: of each pair's own fundamental matrix.
    """

    by_poses: float
    free: float
    n_pairs: int

    @property
    def tells(self) -> bool:
        """True where enough pairs match for a verdict."""
        return self.n_pairs >= LEAST

    @property
    def misses(self) -> bool:
        """True where the poses do not fit."""
        return self.tells and self.by_poses > max(MISFIT, OVER_FREE * self.free)


def wants_adjustment(
    job: Job, capture: Capture, settings: SfmSection, database: Path | None = None
) -> bool:
    """True where `sfm.poses` asks to adjust a capture's poses; auto: where matches miss them.

    Args:    database: with matches of all views; without it some views are matched.
    Choices: generated poses are exact, and those with tracks were made from these photos; both are
      kept, unchecked. Others are kept where too few pairs match for a verdict.
    """
    if settings.poses != "auto" or capture.cam_from_world is None:
        return settings.poses == "adjusted"
    if _exact(capture) or (capture.tracks is not None and len(capture.tracks)):
        return False
    return check_poses(
        job, capture, match_probe(job, capture, settings) if database is None else database
    ).misses


def wants_lines(
    job: Job, capture: Capture, settings: SfmSection, database: Path, pairs: np.ndarray
) -> bool:
    """True where poses fit the photos, so that views are matched along their epipolar lines.

    Args:    database: with features of all views; PROBED of the pairs [P, 2] are matched in it for
      the check.
    Choices: stricter than `wants_adjustment`: false also where too few pairs match, and where
      features are coarse. Generated rooms lost by it at equal seconds, and are matched by a free
      search.
    """
    if (
        capture.cam_from_world is None
        or settings.poses == "adjusted"
        or _exact(capture)
        or len(pairs) < LEAST
    ):
        return False
    match_freely(job, database, _some_of(pairs), settings)
    match_fit = check_poses(job, capture, database)
    return match_fit.tells and match_fit.by_poses <= MISFIT


def _exact(capture: Capture) -> bool:
    return capture.source.get("kind") == "generated" and "disturbed" not in capture.source


def _some_of(pairs: np.ndarray) -> np.ndarray:
    """PROBED of the pairs [P, 2], evenly chosen."""
    return np.asarray(pairs[np.unique(np.linspace(0, len(pairs) - 1, PROBED).round().astype(int))])


def check_poses(job: Job, capture: Capture, database: Path | None) -> Fit:
    """`fit` of the matches of a database, in the facts and the log."""
    pose_fit = Fit(0.0, 0.0, 0) if database is None else fit(database, capture)
    job.facts |= {"epipolar_px": pose_fit.by_poses, "epipolar_free_px": pose_fit.free}
    log.info(
        "given poses %s the photos: matches of %d pairs miss their epipolar lines by %.2f px, %.2f "
        "where each pair is free (medians)%s",
        "do not fit" if pose_fit.misses else "fit",
        pose_fit.n_pairs,
        pose_fit.by_poses,
        pose_fit.free,
        "" if pose_fit.tells else f"; fewer than {LEAST} pairs match, too few to tell",
    )
    return pose_fit


def match_probe(job: Job, capture: Capture, settings: SfmSection) -> Path | None:
    """A database of PROBED pairs of neighbouring views and large features; None without pairs."""
    assert capture.cam_from_world is not None
    pairs = nearest_by_pose(capture.cam_from_world, settings.n_matched)
    if len(pairs) < LEAST:
        return None
    few = settings.model_copy(update={"max_features": min(FEATURES, settings.max_features)})
    return match(job, capture, few, _some_of(pairs))


def fit(database: Path, capture: Capture) -> Fit:
    """Fit of the capture's poses to the verified matches of a database of its views."""
    poses, by_poses, free = capture.cam_from_world, [], []
    assert poses is not None
    with pycolmap.Database.open(database) as opened:
        row = {file_of(view): view for view in range(len(poses))}
        view = {image.image_id: row[image.name] for image in opened.read_all_images()}
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            matches = geometry.inlier_matches
            if len(matches) < SHARED or geometry.F is None:
                continue
            ids = pycolmap.pair_id_to_image_pair(pair)
            first, second = (
                opened.read_keypoints(key)[matches[:, side], :2] for side, key in enumerate(ids)
            )
            a, b = (view[key] for key in ids)
            misses = sampson_distance(
                fundamental(capture.Ks[a], poses[a], capture.Ks[b], poses[b]), first, second
            )
            if np.isfinite(misses).all():
                by_poses.append(misses)
                free.append(sampson_distance(geometry.F, first, second))
    if not by_poses:
        return Fit(0.0, 0.0, 0)
    return Fit(
        float(np.median(np.concatenate(by_poses))),
        float(np.nanmedian(np.concatenate(free))),
        len(by_poses),
    )
