"""teach: train the shipped encoder of shape on generated rooms, and sum these rooms' lessons.

See docs/method.md, section 14.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
import torch

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats.channels import ChannelMap
from chebsplat.formats.knowledge import Knowledge, write_knowledge
from chebsplat.formats.teacher_model import EMBEDDED, TeacherModel, read_label_table, read_teacher
from chebsplat.kernels.threads import n_threads, set_n_threads
from chebsplat.labels.decode import decode_labels
from chebsplat.settings import DescribeSection
from chebsplat.shape import point_encoder
from chebsplat.shape.lessons import (
    LEAST_VIEWS,
    Sums,
    basis,
    class_means,
    combined,
    mapped,
    mean_of,
    novelty,
    odds,
    scale_of,
    scaled_novelty,
    summed,
)
from chebsplat.shape.point_encoder import Example, PointEncoder, cloud_of
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.settings import TeachSection
from chebsplat.stages.shape_models.answers import SEEN, units
from chebsplat.stages.shape_models.teaching_rooms import (
    Room,
    catalogue,
    load_room,
    prepare,
    room_path,
)
from chebsplat.stages.teacher_models.text_encoder import match_names, text_embeddings
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import KNOWLEDGE, MODELLED

log = logging.getLogger("chebsplat")
KINDS = ("held_out", "held_out_worn", "held_out_few", "held_out_swept")
N_DRAWN = 3000  # points of a room that its lesson is of
PARTS = 2  # into which the rooms' sums are split


def run(job: Job) -> None:
    """Knowledge for scenes of one teacher (docs/method.md, section 14).

    Reads `channels`. Writes `knowledge`. Rooms that are finished survive a kill.
    """
    settings, channels = job.config.teach, ChannelMap.read(job.inputs["channels"])
    teacher = read_teacher(Path(settings.model) if settings.model else EMBEDDED)
    if teacher.output != "features":
        raise ConfigError(
            f"{teacher.settings}: output is {teacher.output}; knowledge is taught in features"
        )
    if channels.notes.get("digest") != teacher.digest():
        raise InputError(
            f"{job.inputs['channels']} is of another teacher than {teacher.path}; pass its own"
        )
    rooms = prepare_rooms(job, settings, channels.matrix)
    lessons, tested = rooms[: -settings.n_held_out], rooms[-settings.n_held_out :]
    words, embeddings = vocabulary(teacher, list(CLASS_NAMES), channels.matrix)
    named = match_names(list(CLASS_NAMES), words)
    if -1 in named:
        job.left_out(
            "figures on rooms held out",
            f"the teacher has no word for {CLASS_NAMES[named.index(-1)]}",
        )
    classes = embeddings if -1 in named else embeddings[named]
    examples = [example_of(room, classes) for kinds in zip(*lessons, strict=True) for room in kinds]
    if bare := sum(bool((example.n_views < LEAST_VIEWS).all()) for example in examples):
        raise DataFailure(
            f"{bare} rooms have no point that {LEAST_VIEWS} photos see; raise teach.n_views"
        )
    encoder = train_encoder(job, settings, examples)
    weights = {
        name: value.numpy()
        for name, value in encoder.state_dict().items()
        if not name.startswith("head.")
    }
    of_rooms = [
        mean_lesson(job, encoder, lessons[part::PARTS], classes)
        for part in range(min(PARTS, len(lessons)))
    ]
    shape_map = mapped(of_rooms, [], []).astype(np.float32)
    whole = mean_of(of_rooms)
    scale = scale_of(whole)
    shape_basis = basis(whole, scale)
    separable = -1 not in named and np.linalg.matrix_rank(classes) == len(classes)
    means, with_points = class_means(whole, units(classes) if separable else classes[:0])
    card = settings.model_dump(mode="json", exclude={"model", "seed"})
    newest: dict[str, float] = {}
    for name, of in zip(KINDS, zip(*tested, strict=True), strict=True):
        encoded = [encoder.encode(room.inputs) for room in of]
        sums = [lesson_of(z, room, classes) for z, room in zip(encoded, of, strict=True)]
        newest[name] = max(
            scaled_novelty(novelty(one, scale, shape_basis), one.spread()) for one in sums
        )
        if -1 not in named:
            card[name] = measure_accuracy([z @ shape_map for z in encoded], of, classes)
    card["novelty"] = newest
    job.facts |= card
    describe = {
        name: value
        for name, value in DescribeSection().model_dump(mode="json").items()
        if name in SEEN
    }
    write_knowledge(
        job.out,
        Knowledge(
            teacher.name,
            teacher.digest(),
            encoder.settings,
            weights,
            channels.matrix,
            describe,
            words,
            embeddings.astype(np.float16),
            shape_map,
            shape_basis.astype(np.float32),
            scale.astype(np.float32),
            [CLASS_NAMES[k] for k in with_points],
            means.astype(np.float32),
            card,
            shipped=list(of_rooms),
        ),
    )


def mean_lesson(
    job: Job, encoder: PointEncoder, rooms: Sequence[Sequence[Room]], embeddings: np.ndarray
) -> Sums:
    """Mean lesson of rooms, each in all its versions."""
    flat = [room for kinds in rooms for room in kinds]
    parts = (
        drawn_lesson(encoder, room, embeddings)
        for room, _ in job.progress.track(flat, len(flat), "lessons")
    )
    total = combined([next(parts)], [1 / len(flat)])
    for one in parts:
        total = combined([total, one], [1.0, 1 / len(flat)])
    return total


def drawn_lesson(encoder: PointEncoder, room: Room, embeddings: np.ndarray) -> Sums:
    """Lesson of N_DRAWN points of a room, drawn by weight: over many rooms as good as all."""
    meanings, chances = make_targets(room, embeddings)
    rows = np.random.default_rng(0).choice(len(chances), N_DRAWN, p=chances)
    return summed(encoder.encode(room.inputs, rows), meanings[rows], np.ones(N_DRAWN))


def lesson_of(z: np.ndarray, room: Room, embeddings: np.ndarray) -> Sums:
    """Lesson of all points of a room, by the features z [N, p] of its shape."""
    meanings, weights = make_targets(room, embeddings)
    return summed(z, meanings, weights)


def make_targets(room: Room, embeddings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Targets [N, d] of a room's points, unit embeddings of the teacher's labels, and the points'
    weights [N], sum 1.

    Args: embeddings [L, d]: of the labels.
    """
    labels = decode_labels(room.features, embeddings)
    return units(embeddings)[labels], odds(room.n_views, labels)


def vocabulary(
    teacher: TeacherModel, names: list[str], matrix: np.ndarray
) -> tuple[list[str], np.ndarray]:
    """Words of the teacher's table, or else these names; their embeddings f32 [W, d]."""
    words = names if teacher.labels is None else read_label_table(teacher.labels)[0]
    return words, text_embeddings(words, teacher) @ matrix


def prepare_rooms(job: Job, settings: TeachSection, matrix: np.ndarray) -> list[list[Room]]:
    """Rooms to train on, then rooms held out: clean, worn, half seen, swept; a process a thread."""
    seeds = [
        *KNOWLEDGE[: settings.n_rooms],
        *MODELLED[: settings.n_modelled],
        *KNOWLEDGE[-settings.n_held_out :],
    ]
    if settings.n_modelled:
        catalogue()  # what is missing stops it now, not after the other rooms
    folder = job.scratch / "rooms"
    folder.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not room_path(folder, seed).is_file()]
    if len(missing) < len(seeds):
        job.watch.go_on(job.scratch)
    if missing:
        context = multiprocessing.get_context("spawn")
        set_n_threads(n_threads())  # of this process; the others have one each
        os.environ["OMP_NUM_THREADS"] = "1"
        with ProcessPoolExecutor(n_threads(), mp_context=context) as pool:
            jobs = [pool.submit(prepare, folder, seed, settings, matrix) for seed in missing]
            for finished, _ in job.progress.track(
                as_completed(jobs), len(seeds), "rooms", len(seeds) - len(missing)
            ):
                finished.result()
                job.watch.keep(job.scratch)
    return [load_room(folder, seed) for seed in seeds]


def example_of(room: Room, embeddings: np.ndarray) -> Example:
    """Training example of a room, with the teacher's labels."""
    labels = decode_labels(room.features, embeddings)
    return Example(cloud_of(room.inputs), torch.from_numpy(room.features), room.n_views, labels)


def train_encoder(job: Job, settings: TeachSection, examples: list[Example]) -> PointEncoder:
    """The encoder after all steps of training."""
    torch.set_num_threads(n_threads())
    torch.manual_seed(settings.seed)
    clouds = [example.cloud for example in examples]
    n_descriptors = 0 if settings.without == "descriptor" else clouds[0].descriptors.shape[1]
    attends = settings.without != "transformer"
    encoder = PointEncoder(examples[0].features.shape[1], n_descriptors, attends=attends)
    encoder.set_inputs(clouds)
    course = point_encoder.Course(steps=settings.steps, seed=settings.seed)
    losses: deque[float] = deque(maxlen=100)
    steps = point_encoder.train_encoder(encoder, examples, course)
    for loss, status in job.progress.track(steps, settings.steps, "teach"):
        losses.append(loss)
        status["mean loss"] = f"{sum(losses) / len(losses):.4f}"
    return encoder.eval()


def measure_accuracy(
    answers: Sequence[np.ndarray], rooms: Sequence[Room], embeddings: np.ndarray
) -> dict[str, float]:
    """Accuracy of labels on rooms held out: by the teacher's averages, by shape, and by both."""
    right: dict[str, list[float]] = {"teacher": [], "shape": [], "both": []}
    for shape, room in zip(answers, rooms, strict=True):
        has_truth = (room.labels >= 0) & (room.n_views > 0)
        for name, features in (
            ("teacher", room.features),
            ("shape", shape),
            ("both", room.features + shape),
        ):
            right[name].append(
                float((decode_labels(features, embeddings) == room.labels)[has_truth].mean())
            )
    return {name: float(np.mean(values)) for name, values in right.items()}
