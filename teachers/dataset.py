"""Rendered training rooms, kept in a folder so that they are rendered once."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import numpy as np

from chebsplat.formats.files import atomic_path
from chebsplat.stages.runtime.progress import Progress
from chebsplat.teachers.rooms import generator_digest, training_views


def rendered(folder: Path, seeds: range, n_views: int, workers: int) -> tuple[np.ndarray, np.ndarray]:
    """Images u8 [N, H, W, 3] and labels i8 [N, H, W] of the rooms of `seeds`, from the folder where they are there.

    Choices: a folder of its own for each version of the code that draws rooms, so that none is stale.
    """
    place = folder / f"{generator_digest()}-{n_views}"
    place.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not (place / f"{seed}.npz").is_file()]
    with ProcessPoolExecutor(workers) as pool:
        jobs = [pool.submit(partial(_render, place, seed, n_views)) for seed in missing]
        for job, _ in Progress().track(as_completed(jobs), len(jobs), "rooms"):
            job.result()
    images, labels = zip(*(_load(place / f"{seed}.npz") for seed in seeds), strict=True)
    return np.concatenate(images), np.concatenate(labels)


def _render(place: Path, seed: int, n_views: int) -> None:
    images, labels = training_views(seed, n_views)
    with atomic_path(place / f"{seed}.npz") as temporary:
        np.savez(temporary, images=images, labels=labels)


def _load(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with np.load(path) as stored:
        return stored["images"], stored["labels"]
