"""channels: from a teacher's channels to the fewer that scenes are trained in, one for all scenes.

See docs/method.md, section 8.

It is computed from the teacher, its words and reference images, and from nothing of a scene, so
that knowledge of shape and meaning carries over from one scene to the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats.artifact import read_manifest
from chebsplat.formats.channels import ChannelMap
from chebsplat.formats.images import images_below, read_rgb
from chebsplat.formats.teacher_model import EMBEDDED, TeacherModel, read_label_table, read_teacher
from chebsplat.kernels.threads import n_threads
from chebsplat.labels import channels as maths
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import ChannelsSection
from chebsplat.stages.sources.generated import SIZES, photograph
from chebsplat.stages.teacher_models.image_encoder import TeacherInference
from chebsplat.synthetic.layout import REFERENCE, build
from chebsplat.synthetic.rays import RayCaster, intrinsics, walk

ENTRY = 4  # pixels of an image that an entry of its map is wide, at least
VIEWS = 4  # of a generated room
CHECKED = 20_000  # pixels whose labels before and after are compared


def run(job: Job) -> None:
    """Directions of a teacher's features to train scenes in (docs/method.md, section 8).

    Reads no artifact: a teacher, its words and reference images. Writes `channels`.
    """
    settings = job.config.channels
    teacher = read_teacher(Path(settings.model) if settings.model else EMBEDDED)
    if teacher.output != "features":
        raise ConfigError(
            f"{teacher.settings}: output is {teacher.output}; only channels of features are reduced"
        )
    if (brought := shipped(teacher, settings)) is not None:
        job.left_out(
            "reference images", f"{brought.name} beside the teacher holds what comes of them"
        )
        job.facts |= {
            name: value
            for name, value in read_manifest(brought, ChannelMap.SCHEMA).facts.items()
            if name != "left_out"
        }
        ChannelMap.read(brought).write(job.out)
        return
    words = vocabulary(job, teacher)
    network = TeacherInference(teacher, n_threads())
    images, count = reference(settings)
    moments, sample = None, []
    for (name, image), status in job.progress.track(images, count, "channels"):
        grid, n_channels = network.grid(image, ENTRY)
        if moments is None:
            moments = maths.Moments(n_channels)
            if words is not None and words.shape[1] != n_channels:
                raise InputError(
                    f"{teacher.path} has {n_channels} channels, {teacher.labels} embeds in "
                    f"{words.shape[1]}; export them from one model"
                )
        features = network.features(image, grid, (1.0,), False, name)
        moments.add(features)
        rows = features.reshape(-1, n_channels)
        sample.append(rows[:: -(-len(rows) * count // CHECKED)])
        status["pixels"] = moments.count
    if moments is None or not np.trace(moments.products) > 0:
        raise DataFailure(
            f"{teacher.path} gives zero features on all {count} reference images; export it again"
        )
    embeddings = np.zeros((0, len(moments.products))) if words is None else words
    matrix, energy = maths.channel_map(moments, embeddings, settings.n_channels)
    notes: dict[str, Any] = {
        "n_pixels": moments.count,
        "n_words": len(embeddings),
        "n_images": count,
    }
    notes |= {"reference": settings.reference or "generated rooms", "digest": teacher.digest()}
    lost = float(np.sqrt(max(1 - energy[matrix.shape[1] - 1], 0)))
    job.facts |= notes | {"n_channels": matrix.shape[1], "of": len(matrix), "relative_error": lost}
    if words is not None:
        job.facts["label_agreement"] = maths.agreement(np.concatenate(sample), words, matrix)
    matrix, energy = matrix.astype(np.float32), energy.astype(np.float32)
    ChannelMap(matrix, matrix.T.copy(), energy, teacher.name, notes).write(job.out)


def shipped(teacher: TeacherModel, settings: ChannelsSection) -> Path | None:
    """The artifact of this stage beside the teacher, if it is of the same files and settings."""
    if not teacher.channels.is_dir():
        return None
    manifest, unnamed = read_manifest(teacher.channels, ChannelMap.SCHEMA), {"model"}
    expected = settings.model_dump(mode="json", exclude=unnamed)
    recorded = {
        name: value for name, value in manifest.config["channels"].items() if name not in unnamed
    }
    return (
        teacher.channels
        if recorded == expected and manifest.facts.get("digest") == teacher.digest()
        else None
    )


def vocabulary(job: Job, teacher: TeacherModel) -> np.ndarray | None:
    """Unit embeddings [L, C] of the teacher's table of words; None where it has none."""
    names, embeddings = read_label_table(teacher.labels) if teacher.labels else ([], None)
    if embeddings is None:
        job.left_out(
            "vocabulary",
            f"{teacher.settings} names no table of embeddings: directions go by energy alone",
        )
        return None
    lengths = np.linalg.norm(embeddings, axis=1)
    if lengths.min() < 1e-6:
        raise InputError(
            f"{teacher.labels}: the embedding of {names[lengths.argmin()]} is zero; write it again"
        )
    return embeddings / lengths[:, None]


def reference(settings: ChannelsSection) -> tuple[Iterator[tuple[str, np.ndarray]], int]:
    """(name, image u8 [H, W, 3]) one by one, and how many."""
    if settings.reference is None:
        return generated(REFERENCE[: settings.n_rooms]), settings.n_rooms * VIEWS
    files = images_below(Path(settings.reference), "correct channels.reference")
    return photos(files), len(files)


def photos(files: list[Path]) -> Iterator[tuple[str, np.ndarray]]:
    """Names and u8 images [H, W, 3] of files. Raises InputError on one that cannot be read."""
    for file in files:
        yield str(file), read_rgb(file, "correct channels.reference")


def generated(seeds: range) -> Iterator[tuple[str, np.ndarray]]:
    """Views of generated rooms, offices and living rooms in turn."""
    for seed in seeds:
        preset = ("office", "room")[seed % 2]
        _, width, height = SIZES[preset]
        room = build(preset, seed)
        caster, K = RayCaster(room.soup.vertices, room.soup.triangles), intrinsics(width, height)
        shoot = partial(photograph, room, caster, K, width=width, height=height)
        with ThreadPoolExecutor(VIEWS) as pool:
            for view, (image, _, _) in enumerate(pool.map(shoot, walk(room.size, VIEWS, seed))):
                yield f"room {seed}, view {view}", image
