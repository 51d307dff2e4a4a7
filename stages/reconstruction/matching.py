"""Features of a capture's views and their matches, by pycolmap, in a database for mapping.

Pairs to match are all, those of near cameras, or those alike. Views are numbered 0...V-1 in the
capture's order, which is that of their names. Pairs are int [P, 2], smaller index first, each once
and sorted.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

from chebsplat.cameras import centers
from chebsplat.formats.capture import Capture
from chebsplat.kernels.threads import n_threads
from chebsplat.photos.guided import along_lines, fundamental
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import PoseSection, SfmSection
from chebsplat.stages.sources.common import file_of

log = logging.getLogger("chebsplat")
Searched = SfmSection | PoseSection  # settings of features and pairs
# a thread's share between two lines of progress; each such block of pairs indexes its views anew
PHOTOS, PAIRS = 8, 64
LEAST = 15  # matches of a pair that has any: pycolmap's own, of a free search
LARGEST = 128  # features of a view, by size, by which the likeness of two views is measured
FEW = 100  # views that are all matched with each other
# degrees between two viewing directions that weigh like the capture's median distance of two
# cameras
TURN = 30.0
# degrees; views that face farther from each other share no feature that SIFT could match
APART = 90.0
IN_A_ROW = 5  # views on either side in the order of names
RATIO = 0.8  # Lowe's, of the distances of the nearest and the second nearest descriptor


def match(job: Job, capture: Capture, settings: SfmSection, pairs: np.ndarray) -> Path:
    """Extract SIFT from the capture's own pixels and match pairs [P, 2] of its views.

    Choices: views that occur in no pair have no features either.
    """
    database = with_features(job, capture, settings, sorted(set(pairs.ravel().tolist())))
    match_freely(job, database, pairs, settings)
    return database


def with_features(job: Job, capture: Capture, settings: SfmSection, views: Sequence[int]) -> Path:
    """A database of views with SIFT from the capture's own pixels."""
    folder = _write_images(job, capture, views)
    database = empty_database(job.scratch / "database.db")
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    if capture.loss_mask is not None:
        reader.mask_path = str(job.scratch / "masks")
    mode = pycolmap.CameraMode.PER_IMAGE if _cameras_differ(capture) else pycolmap.CameraMode.SINGLE
    if not _cameras_differ(capture):
        K = capture.Ks[0]
        reader.camera_params = ",".join(str(float(v)) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    extract(job, database, folder, [file_of(view) for view in views], reader, mode, settings)
    return database


def empty_database(path: Path) -> Path:
    """A new database, in place of an old one."""
    pycolmap.logging.minloglevel = (
        pycolmap.logging.ERROR.value if hasattr(pycolmap.logging, "ERROR") else 2
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    pycolmap.Database.open(path).close()  # creates it
    return path


def extract(
    job: Job,
    database: Path,
    folder: Path,
    files: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    mode: pycolmap.CameraMode,
    settings: Searched,
) -> None:
    """Add images of a folder to a database, with cameras by `reader` and `mode`, and their SIFT."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.peak_threshold = settings.peak_threshold
    extraction.sift.max_num_features = settings.max_features
    extraction.use_gpu, extraction.num_threads = False, n_threads()
    pycolmap.import_images(database, folder, mode, image_names=list(files), options=reader)
    for some in _in_blocks(job, list(files), PHOTOS * n_threads(), "features"):
        pycolmap.extract_features(database, folder, some, mode, reader, extraction)


def match_freely(job: Job, database: Path, pairs: np.ndarray, settings: Searched) -> None:
    """Match pairs of views [P, 2] without poses, verified by RANSAC."""
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.use_gpu, matching.num_threads = False, n_threads()
    verification.ransac.random_seed = settings.seed
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = job.scratch / "pairs.txt"
    for some in _in_blocks(job, pairs.tolist(), PAIRS * n_threads(), "matching"):
        lines = [f"{file_of(first)} {file_of(second)}\n" for first, second in some]
        listed.match_list_path.write_text("".join(lines))
        pycolmap.match_image_pairs(database, matching, listed, verification)


def match_along_lines(job: Job, database: Path, pairs: np.ndarray, capture: Capture) -> None:
    """Match pairs of views [P, 2] along the epipolar lines of poses that fit the photos.

    Choices: a pair of fewer than LEAST matches has none, as in a free search. Features of one
      block's views are in memory at once.
    """
    poses, Ks, n_matches = capture.cam_from_world, capture.Ks, 0
    assert poses is not None
    with pycolmap.Database.open(database) as opened:
        ids = {int(image.name[:-4]): image.image_id for image in opened.read_all_images()}
        opened.clear_two_view_geometries()  # those by which the poses were checked
        for some in _in_blocks(job, pairs.tolist(), PAIRS * n_threads(), "matching"):
            views, rows = np.unique(some, return_inverse=True)
            pixels = [opened.read_keypoints(ids[view])[:, :2] for view in views]
            descriptors = [opened.read_descriptors(ids[view]).data for view in views]
            lines = np.stack([fundamental(Ks[a], poses[a], Ks[b], poses[b]) for a, b in some])
            pair_matches = along_lines(pixels, descriptors, rows.reshape(-1, 2), lines)
            for (a, b), matches in zip(some, pair_matches, strict=True):
                if len(matches) < LEAST:
                    continue
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = matches.astype(np.uint32)
                opened.write_two_view_geometry(ids[a], ids[b], geometry)
                n_matches += len(matches)
    job.facts["n_matches_along_lines"] = n_matches


def chosen_pairs(
    job: Job, database: Path, n: int, settings: Searched, poses: np.ndarray | None = None
) -> np.ndarray:
    """Pairs of `n` views to match, int [P, 2], by the setting `matching`."""
    mode = matching_mode(settings.matching, n, poses is not None)
    if mode == "posed":
        assert poses is not None
        pairs = nearest_by_pose(poses, settings.n_matched)
        why = f"{settings.n_matched} nearest of each by its pose"
    elif mode == "sequential":
        pairs = in_sequence(_largest_descriptors(database, n), settings.n_matched)
        why = f"{IN_A_ROW} before and after each, {settings.n_matched} most alike"
    else:
        pairs, why = all_pairs(n), "all"
    log.info("%s: %d of %d pairs (%s)", mode, len(pairs), n * (n - 1) // 2, why)
    job.facts["n_pairs"] = len(pairs)
    return pairs


def _largest_descriptors(database: Path, n_views: int) -> list[np.ndarray]:
    """f32 [k, 128] of unit length per view, of its LARGEST features."""
    per_view = [np.zeros((0, 128), np.float32)] * n_views
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            shape = opened.read_keypoints(image.image_id)[:, 2:]  # affine [n, 4], rows
            largest = np.argsort(-np.hypot(shape[:, 0], shape[:, 2]), kind="stable")[:LARGEST]
            some = opened.read_descriptors(image.image_id).data[largest].astype(np.float32)
            per_view[int(image.name[:-4])] = some / np.maximum(
                np.linalg.norm(some, axis=1, keepdims=True), 1e-9
            )
    return per_view


def _write_images(job: Job, capture: Capture, views: Iterable[int]) -> Path:
    """Write images of some of the capture's views, and masks where it has any, for pycolmap."""
    folder, masks = job.scratch / "images", job.scratch / "masks"
    folder.mkdir(parents=True, exist_ok=True)
    masks.mkdir(exist_ok=True)
    for view in views:
        Image.fromarray(capture.images[view]).save(folder / file_of(view), compress_level=0)
        if capture.loss_mask is not None:
            mask = np.where(capture.loss_mask[view], 255, 0).astype(np.uint8)
            Image.fromarray(mask).save(masks / f"{file_of(view)}.png")
    return folder


def _in_blocks(job: Job, items: list[Any], size: int, what: str) -> Iterator[list[Any]]:
    """Blocks of so many items, with rate and time left: pycolmap reports no progress."""
    blocks = [items[at : at + size] for at in range(0, len(items), size)]
    count = 0
    for block, status in job.progress.track(blocks, len(blocks), what):
        yield block
        count += len(block)
        status["done"] = f"{count} of {len(items)}"


def _cameras_differ(capture: Capture) -> bool:
    return not np.allclose(capture.Ks, capture.Ks[:1])


def matching_mode(mode: str, n_views: int, posed: bool) -> str:
    """`exhaustive`, `posed` or `sequential`: `mode`, and for `auto` the one that fits.

    Choices: poses, where there are any, select the pairs; without them few views are all matched.
    """
    if mode == "auto":
        return "posed" if posed else "exhaustive" if n_views <= FEW else "sequential"
    return mode


def all_pairs(n_views: int) -> np.ndarray:
    """All pairs of `n_views` views."""
    return np.stack(np.triu_indices(n_views, 1), 1)


def nearest_by_pose(cam_from_world: np.ndarray, n_neighbors: int) -> np.ndarray:
    """Each view with the `n_neighbors` that are nearest by position and viewing direction.

    Args:    cam_from_world: [V, 4, 4].
    Choices: distance over the capture's median distance, plus angle over TURN: no depth of the
      scene is needed. On 50 photos with poses (fox) 10 neighbours are a quarter of the pairs and
      leave 98 % of the points; frusta at guessed depths choose no better.
    """
    return nearest(apart(cam_from_world), n_neighbors)


def apart(cam_from_world: np.ndarray) -> np.ndarray:
    """Distance of views [V, V] in median distances and TURNs; infinite beyond APART and to self."""
    eye, forward = centers(cam_from_world), cam_from_world[:, 2, :3]
    distance = np.linalg.norm(eye[:, None] - eye[None], axis=-1)
    angle = np.degrees(np.arccos(np.clip(forward @ forward.T, -1, 1)))
    usual = float(np.median(distance[np.triu_indices(len(eye), 1)])) or 1.0
    cost = np.where(angle > APART, np.inf, distance / usual + angle / TURN)
    np.fill_diagonal(cost, np.inf)
    return cost


def in_sequence(descriptors: list[np.ndarray], n_neighbors: int) -> np.ndarray:
    """Each view with IN_A_ROW before and after it, and with the `n_neighbors` most alike of all.

    Args:    descriptors: per view [k, 128], of its largest features, visible from far and near.
    Choices: likeness is the number of matches between these few (mutual, by Lowe's ratio). That
      takes milliseconds a pair, needs no vocabulary, closes loops, and finds neighbours where names
      have no order. With 128 features a view it selects as well as poses do: in a quarter of fox's
      pairs both keep 65 % of all inliers.
    """
    n = len(descriptors)
    alike = np.zeros((n, n))
    for i, j in all_pairs(n):
        alike[i, j] = alike[j, i] = n_matches(descriptors[i], descriptors[j])
    row = np.arange(n)
    near = np.abs(row[:, None] - row[None]) <= IN_A_ROW
    in_a_row = np.argwhere(np.triu(near, 1))
    return np.unique(
        np.concatenate([in_a_row, nearest(np.where(alike > 0, -alike, np.inf), n_neighbors)]),
        axis=0,
    )


def nearest(cost: np.ndarray, count: int) -> np.ndarray:
    """Pairs in which either view is among the other's `count` of least finite cost [V, V]."""
    cost = cost.copy()
    np.fill_diagonal(cost, np.inf)
    order = np.argsort(cost, 1, kind="stable")[:, :count]
    adjacent = np.zeros(cost.shape, bool)
    np.put_along_axis(adjacent, order, np.isfinite(np.take_along_axis(cost, order, 1)), 1)
    return np.argwhere(np.triu(adjacent | adjacent.T, 1))


def n_matches(first: np.ndarray, second: np.ndarray) -> int:
    """Mutual nearest neighbours, by Lowe's ratio, among unit descriptors [n, 128] and [m, 128]."""
    if len(first) < 1 or len(second) < 2:
        return 0
    cosine = first @ second.T
    row, best = np.arange(len(first)), cosine.argmax(1)
    mutual = cosine.argmax(0)[best] == row
    top = cosine[row, best]
    cosine[row, best] = -1
    return int((mutual & (1 - top < RATIO**2 * (1 - cosine.max(1)))).sum())
