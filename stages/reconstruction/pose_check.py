"""Whether the poses that a source brings fit its photos: matches against the epipolar lines that
the poses make.
"""

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
# times what it misses that of the pair's own fundamental matrix by: features may be coarse
OVER_FREE = 2.0
SHARED = 30  # verified matches of a pair that counts
LEAST = 6  # such pairs, without which nothing is said
PROBED, FEATURES = 16, 2048  # pairs that tell; features of a view, where nothing else needs matches


class Fit(NamedTuple):
    """given, free: median distances in pixels to the epipolar lines of the poses, and of each
    pair's matches alone.
    """

    given: float
    free: float
    n_pairs: int

    @property
    def tells(self) -> bool:
        """Whether so many pairs match that anything can be said."""
        return self.n_pairs >= LEAST

    @property
    def misses(self) -> bool:
        """Whether the poses do not fit."""
        return self.tells and self.given > max(MISFIT, OVER_FREE * self.free)


def wants_adjustment(
    job: Job, capture: Capture, settings: SfmSection, database: Path | None = None
) -> bool:
    """Whether the poses of a capture are to be adjusted to its photos, as `sfm.poses` says.

    Args:    database: with matches of all views; without it some views are matched.
    Choices: generated poses are exact, and those that came with tracks were made from these photos;
      both are kept, untested. Others are kept where too few pairs match to tell.
    """
    if settings.poses != "auto" or capture.cam_from_world is None:
        return settings.poses == "adjusted"
    if _exact(capture) or (capture.tracks is not None and len(capture.tracks)):
        return False
    return measured(
        job, capture, probed(job, capture, settings) if database is None else database
    ).misses


def wants_lines(
    job: Job, capture: Capture, settings: SfmSection, database: Path, pairs: np.ndarray
) -> bool:
    """Whether views are matched along the epipolar lines of their poses: where these are known to
    fit the photos.

    Args:    database: with features of all views; PROBED of the pairs [P, 2] are matched in it to
      find that out.
    Choices: stricter than what asks for adjustment, for it also says no where too few pairs match,
      and where features are coarse. Generated rooms lost by it (docs/results/photographs.md, "At
      equal seconds"), and are matched by a free search.
    """
    if (
        capture.cam_from_world is None
        or settings.poses == "adjusted"
        or _exact(capture)
        or len(pairs) < LEAST
    ):
        return False
    match_freely(job, database, _some_of(pairs), settings)
    found = measured(job, capture, database)
    return found.tells and found.given <= MISFIT


def _exact(capture: Capture) -> bool:
    return capture.source.get("kind") == "generated" and "disturbed" not in capture.source


def _some_of(pairs: np.ndarray) -> np.ndarray:
    """PROBED of the pairs [P, 2], evenly chosen."""
    return np.asarray(pairs[np.unique(np.linspace(0, len(pairs) - 1, PROBED).round().astype(int))])


def measured(job: Job, capture: Capture, database: Path | None) -> Fit:
    """How well the poses fit, by the matches of a database; in the facts and the log."""
    found = Fit(0.0, 0.0, 0) if database is None else fit(database, capture)
    job.facts |= {"epipolar_px": found.given, "epipolar_free_px": found.free}
    log.info(
        "given poses %s the photos: matches of %d pairs miss their epipolar lines by %.2f px, "
        "%.2f where each pair is "
        "free (medians)%s",
        "do not fit" if found.misses else "fit", found.n_pairs, found.given, found.free,
        "" if found.tells else f"; fewer than {LEAST} pairs match, too few to tell",
    )  # fmt: skip
    return found


def probed(job: Job, capture: Capture, settings: SfmSection) -> Path | None:
    """A database of PROBED pairs of neighbouring views, evenly chosen, and large features; None
    without pairs.
    """
    assert capture.cam_from_world is not None
    pairs = nearest_by_pose(capture.cam_from_world, settings.n_matched)
    if len(pairs) < LEAST:
        return None
    few = settings.model_copy(update={"max_features": min(FEATURES, settings.max_features)})
    return match(job, capture, few, _some_of(pairs))


def fit(database: Path, capture: Capture) -> Fit:
    """How well the capture's poses agree with the verified matches of a database of its views."""
    poses, given, free = capture.cam_from_world, [], []
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
                given.append(misses)
                free.append(sampson_distance(geometry.F, first, second))
    if not given:
        return Fit(0.0, 0.0, 0)
    return Fit(
        float(np.median(np.concatenate(given))),
        float(np.nanmedian(np.concatenate(free))),
        len(given),
    )
