"""Features of a capture's views and their matches, by pycolmap, in a database that mapping and triangulation read."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chebsplat.stages.command import Job, n_threads

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    import numpy as np

    from chebsplat.formats.capture import Capture
    from chebsplat.stages.settings import SfmSection

log = logging.getLogger("chebsplat")
PHOTOS, PAIRS = 8, 64  # a thread's share between two lines of progress; each such block of pairs indexes its views anew
LEAST = 15  # matches of a pair that has any: pycolmap's own, of a free search
LARGEST = 128  # features of a view, by size, that say how alike two views are


def file_of(view: int) -> str:
    """The image of a view in the scratch folder: pycolmap's lists of pairs allow no name with a space."""
    return f"{view:06d}.png"


def match(job: Job, capture: Capture, settings: SfmSection, pairs: np.ndarray) -> Path:
    """Extract SIFT from the capture's own pixels and match given pairs [P, 2] of its views.

    Choices: views that occur in no pair have no features either.
    """
    database = with_features(job, capture, settings, sorted(set(pairs.ravel().tolist())))
    match_freely(job, database, pairs, settings)
    return database


def with_features(job: Job, capture: Capture, settings: SfmSection, views: Sequence[int]) -> Path:
    """A database of views with SIFT from the capture's own pixels."""
    import pycolmap

    job.scratch.mkdir(parents=True, exist_ok=True)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value if hasattr(pycolmap.logging, "ERROR") else 2
    folder, database = _write_images(job, capture, views), job.scratch / "database.db"
    database.unlink(missing_ok=True)
    pycolmap.Database.open(database).close()  # creates it
    files = [file_of(view) for view in views]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    if capture.loss_mask is not None:
        reader.mask_path = str(job.scratch / "masks")
    mode = pycolmap.CameraMode.PER_IMAGE if _cameras_differ(capture) else pycolmap.CameraMode.SINGLE
    if not _cameras_differ(capture):
        K = capture.Ks[0]
        reader.camera_params = ",".join(str(float(v)) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    pycolmap.import_images(database, folder, mode, image_names=files, options=reader)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.peak_threshold = settings.peak_threshold
    extraction.sift.max_num_features = settings.max_features
    extraction.use_gpu, extraction.num_threads = False, n_threads()
    for some in _in_blocks(job, files, PHOTOS * n_threads(), "features"):
        pycolmap.extract_features(database, folder, some, mode, reader, extraction)
    return database


def match_freely(job: Job, database: Path, pairs: np.ndarray, settings: SfmSection) -> None:
    """Match pairs of views [P, 2] as if nothing were known of their poses; what RANSAC verifies is kept."""
    import pycolmap

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
    """Match pairs of views [P, 2] along the epipolar lines that their poses make, which fit the photos.

    Choices: a pair of fewer than LEAST matches has none, as in a free search. Features of one block's views are in
      memory at once.
    """
    import numpy as np
    import pycolmap

    from chebsplat.photos.epipolar import fundamental
    from chebsplat.photos.guided import along_lines

    poses, Ks, n_matches = capture.cam_from_world, capture.Ks, 0
    assert poses is not None
    with pycolmap.Database.open(database) as opened:
        ids = {int(image.name[:-4]): image.image_id for image in opened.read_all_images()}
        opened.clear_two_view_geometries()  # those of the pairs that told whether the poses fit
        for some in _in_blocks(job, pairs.tolist(), PAIRS * n_threads(), "matching"):
            views, rows = np.unique(some, return_inverse=True)
            pixels = [opened.read_keypoints(ids[view])[:, :2] for view in views]
            descriptors = [opened.read_descriptors(ids[view]).data for view in views]
            lines = np.stack([fundamental(Ks[a], poses[a], Ks[b], poses[b]) for a, b in some])
            found = along_lines(pixels, descriptors, rows.reshape(-1, 2), lines)
            for (a, b), matches in zip(some, found, strict=True):
                if len(matches) < LEAST:
                    continue
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.inlier_matches = matches.astype(np.uint32)
                opened.write_two_view_geometry(ids[a], ids[b], geometry)
                n_matches += len(matches)
    job.facts["n_matches_along_lines"] = n_matches


def chosen_pairs(job: Job, database: Path, capture: Capture, settings: SfmSection) -> np.ndarray:
    """Pairs of views to match, int [P, 2], as `sfm.matching` says."""
    from chebsplat.stages import view_pairs

    n, poses = len(capture.names), capture.cam_from_world
    mode = view_pairs.mode(settings.matching, n, poses is not None)
    if mode == "posed":
        assert poses is not None
        pairs, why = view_pairs.posed(poses, settings.n_matched), f"{settings.n_matched} nearest of each by its pose"
    elif mode == "sequential":
        pairs = view_pairs.sequential(_largest_descriptors(database, n), settings.n_matched)
        why = f"{view_pairs.IN_A_ROW} before and after each, {settings.n_matched} most alike"
    else:
        pairs, why = view_pairs.exhaustive(n), "all"
    log.info("%s: %d of %d pairs (%s; sfm.matching is %s)", mode, len(pairs), n * (n - 1) // 2, why, settings.matching)
    job.facts["n_pairs"] = len(pairs)
    return pairs


def _largest_descriptors(database: Path, n_views: int) -> list[np.ndarray]:
    """f32 [k, 128] of unit length per view, of its LARGEST features."""
    import numpy as np
    import pycolmap

    found = [np.zeros((0, 128), np.float32)] * n_views
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            shape = opened.read_keypoints(image.image_id)[:, 2:]  # affine [n, 4], rows
            largest = np.argsort(-np.hypot(shape[:, 0], shape[:, 2]), kind="stable")[:LARGEST]
            some = opened.read_descriptors(image.image_id).data[largest].astype(np.float32)
            found[int(image.name[:-4])] = some / np.maximum(np.linalg.norm(some, axis=1, keepdims=True), 1e-9)
    return found


def _write_images(job: Job, capture: Capture, views: Iterable[int]) -> Path:
    """The images of some of the capture's views, and where it has them their masks, as pycolmap reads them."""
    import numpy as np
    from PIL import Image

    folder, masks = job.scratch / "images", job.scratch / "masks"
    folder.mkdir(exist_ok=True)
    masks.mkdir(exist_ok=True)
    for view in views:
        Image.fromarray(capture.images[view]).save(folder / file_of(view), compress_level=0)
        if capture.loss_mask is not None:
            mask = np.where(capture.loss_mask[view], 255, 0).astype(np.uint8)
            Image.fromarray(mask).save(masks / f"{file_of(view)}.png")
    return folder


def _in_blocks(job: Job, items: list[Any], size: int, what: str) -> Iterator[list[Any]]:
    """Blocks of so many items, with rate and time left: pycolmap says nothing while it works."""
    blocks = [items[at : at + size] for at in range(0, len(items), size)]
    done = 0
    for block, status in job.progress.track(blocks, len(blocks), what):
        yield block
        done += len(block)
        status["done"] = f"{done} of {len(items)}"


def _cameras_differ(capture: Capture) -> bool:
    import numpy as np

    return not np.allclose(capture.Ks, capture.Ks[:1])
