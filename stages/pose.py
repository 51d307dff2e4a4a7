"""pose: cameras of photos or frames of a video that come alone, found by structure from motion."""

from __future__ import annotations

import logging
from pathlib import Path
from types import ModuleType

from chebsplat.errors import DataFailure
from chebsplat.formats import artifact
from chebsplat.formats.photo_model import PhotoModel
from chebsplat.stages.reconstruction import judge, posing
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.sources import photos, video

log = logging.getLogger("chebsplat")
SOURCES: dict[str, ModuleType] = {"photos": photos, "video": video}  # those that bring no poses


def run(job: Job) -> None:
    """Cameras, lenses and poses of photos, and points that they share.

    Reads photos or a video. Writes `model`.

    Raises:  DataFailure where few photos register, or their rays fix no depth.
    Choices: all photos take part, also later test views. Of a video twice the frames are tried
      where few of them register.
    """
    try:
        best = _best(job)
    finally:
        artifact.discard(job.scratch)  # also of photos that cannot be posed
    job.facts |= best.judged | {"registered": share(best)}
    for note in best.notes:
        log.info("%s", note)
    for warning in best.judged["doubts"]:
        log.warning("%s", warning)
    best.write(job.out)


def _best(job: Job) -> PhotoModel:
    """The model of a source's photos, or of the frames of a video that give the better one."""
    source, settings = job.config.source, job.config.pose
    folder, of = Path(str(source.path)).expanduser(), SOURCES[source.kind]
    best: PhotoModel | None = None
    for finer in (1, 2) if source.kind == "video" and settings.max_views is None else (1,):
        shots, notes = of.shots(folder, settings, job.progress, finer)
        pictures = job.scratch / f"images-{finer}"
        pictures.mkdir(parents=True, exist_ok=True)
        of.save(shots, folder, pictures, settings.max_side)
        model = posing.map_photos(job, shots, pictures, settings)
        if model is not None and (best is None or share(model) > share(best)):
            best = model
            best.notes[:0] = notes
        if best is not None and share(best) * posing.MORE >= 1:
            break
    if best is None:
        raise DataFailure(
            f"no two photos of {folder} could be registered; {judge.REMEDY}, of more texture"
        )
    judge.check(best, settings.min_registered)
    return best


def share(model: PhotoModel) -> float:
    """The part of the photos that a model has."""
    return len(model.names) / float(model.judged["n_given"])
