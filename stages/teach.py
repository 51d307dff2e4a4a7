"""teach: knowledge that scenes start from: a point encoder, taught over generated rooms what a 2D teacher says of them.

See docs/method.md, section 14.
"""

from __future__ import annotations

import json
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
from chebsplat.formats.knowledge import ENCODER, Knowledge, write_knowledge
from chebsplat.formats.teacher_model import EMBEDDED, TeacherModel, read_label_table, read_teacher
from chebsplat.labels.decode import decode_labels
from chebsplat.settings import DescribeSection
from chebsplat.shape import point_encoder
from chebsplat.shape.point_encoder import LEAST_VIEWS, Lesson, PointEncoder, cloud_of
from chebsplat.shape.point_inputs import PointInputs
from chebsplat.stages.runtime.command import Job, n_threads
from chebsplat.stages.settings import KnowledgeSection
from chebsplat.stages.shape_models.teaching_rooms import Room, held, kept_as, prepare
from chebsplat.stages.teacher_models.text_encoder import found, text_embeddings
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import KNOWLEDGE

log = logging.getLogger("chebsplat")
TOLERANCE = 1e-5  # of the ONNX file: largest difference from torch


def run(job: Job) -> None:
    """Knowledge for scenes of one teacher (docs/method.md, section 14).

    Reads `channels`. Writes `knowledge`. Rooms that are finished survive a kill.
    """
    settings, channels = job.config.knowledge, ChannelMap.read(job.inputs["channels"])
    teacher = read_teacher(Path(settings.model) if settings.model else EMBEDDED)
    if teacher.output != "features":
        raise ConfigError(f"{teacher.settings}: output is {teacher.output}; knowledge is taught in features")
    if channels.notes.get("digest") != teacher.digest():
        raise InputError(f"{job.inputs['channels']} is of another teacher than {teacher.path}; pass its own")
    clean, worn, few, swept = zip(*prepared(job, settings, channels.matrix), strict=True)
    taught_on, tested_on = slice(settings.n_rooms), slice(settings.n_rooms, None)
    words, embeddings = vocabulary(teacher, list(CLASS_NAMES), channels.matrix)
    named = found(list(CLASS_NAMES), words)
    if -1 in named:
        job.left_out("figures on rooms held out", f"the teacher has no word for {CLASS_NAMES[named.index(-1)]}")
    classes = embeddings if -1 in named else embeddings[named]
    kinds = (clean, worn, few, swept)
    lessons = [lesson_of(room, classes) for rooms in kinds for room in rooms[taught_on]]
    if bare := sum(bool((lesson.n_views < LEAST_VIEWS).all()) for lesson in lessons):
        raise DataFailure(f"{bare} rooms have no point that {LEAST_VIEWS} photos see; raise knowledge.n_views")
    encoder = taught(job, settings, lessons)
    card = settings.model_dump(mode="json", exclude={"model", "seed"})
    if -1 not in named:
        names = ("held_out", "held_out_worn", "held_out_few", "held_out_swept")
        card |= {of: measured(encoder, rooms[tested_on], classes) for of, rooms in zip(names, kinds, strict=True)}
    job.facts |= card
    weights = {name: value.numpy() for name, value in encoder.state_dict().items()}
    describe = DescribeSection().model_dump(mode="json")
    job.facts["largest_difference"] = exported(job, encoder, clean[0].inputs)
    of = teacher.name, teacher.digest(), encoder.settings, weights
    write_knowledge(job.out, Knowledge(*of, channels.matrix, describe, words, embeddings.astype(np.float16), card))


def exported(job: Job, encoder: PointEncoder, inputs: PointInputs) -> float:
    """Write the encoder in ONNX; its largest difference from torch on a room's points.

    Raises: DataFailure where that is more than TOLERANCE.
    """
    import onnx
    import onnxruntime

    from chebsplat.stages.shape_models.point_graph import point_contract, point_model

    path, model = job.out / ENCODER, point_model(encoder)
    onnx.helper.set_model_props(model, {"chebsplat.contract": json.dumps(point_contract(encoder))})
    onnx.save(model, path)
    runner = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    answers = runner.run(None, {name: value.numpy() for name, value in cloud_of(inputs)._asdict().items()})[0]
    difference = float(np.abs(answers - encoder.predict(inputs)).max())
    if not difference <= TOLERANCE:
        raise DataFailure(f"{ENCODER} differs from torch by {difference:.1e}, more than {TOLERANCE:.1e}; report this")
    return difference


def vocabulary(teacher: TeacherModel, names: list[str], matrix: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Words that the teacher knows, of its table, otherwise these names; and their embeddings f32 [W, d]."""
    words = names if teacher.labels is None else read_label_table(teacher.labels)[0]
    return words, text_embeddings(words, teacher) @ matrix


def prepared(job: Job, settings: KnowledgeSection, matrix: np.ndarray) -> list[list[Room]]:
    """The rooms to teach on, then those held out: clean, worn, half seen, swept; a process for each thread."""
    seeds = [*KNOWLEDGE[: settings.n_rooms], *KNOWLEDGE[-settings.n_held_out :]]
    folder = job.scratch / "rooms"
    folder.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not kept_as(folder, seed).is_file()]
    if missing:
        os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the processes below
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(n_threads(), mp_context=context) as pool:
            jobs = [pool.submit(prepare, folder, seed, settings, matrix) for seed in missing]
            done = as_completed(jobs)
            for finished, _ in job.progress.track(done, len(seeds), "rooms", len(seeds) - len(missing)):
                finished.result()
    return [held(folder, seed) for seed in seeds]


def lesson_of(room: Room, embeddings: np.ndarray) -> Lesson:
    """A room as it is taught: labels are the teacher's."""
    labels = decode_labels(room.features, embeddings)
    return Lesson(cloud_of(room.inputs), torch.from_numpy(room.features), room.n_views, labels)


def taught(job: Job, settings: KnowledgeSection, lessons: list[Lesson]) -> PointEncoder:
    """The encoder after the whole course."""
    torch.set_num_threads(n_threads())
    torch.manual_seed(settings.seed)
    clouds = [lesson.cloud for lesson in lessons]
    encoder = PointEncoder(lessons[0].features.shape[1], clouds[0].descriptors.shape[1])
    encoder.set_inputs(clouds)
    course = point_encoder.Course(steps=settings.steps, seed=settings.seed)
    losses: deque[float] = deque(maxlen=100)
    steps = point_encoder.taught(encoder, lessons, course)
    for loss, status in job.progress.track(steps, settings.steps, "teach"):
        losses.append(loss)
        status["mean loss"] = f"{sum(losses) / len(losses):.4f}"
    return encoder.eval()


def measured(encoder: PointEncoder, rooms: Sequence[Room], embeddings: np.ndarray) -> dict[str, float]:
    """Of points of rooms held out, the share whose label is right: by the teacher's averages, by shape, and by both."""
    right: dict[str, list[float]] = {"teacher": [], "shape": [], "both": []}
    for room in rooms:
        shape = encoder.predict(room.inputs)
        known = (room.labels >= 0) & (room.n_views > 0)
        for name, features in (("teacher", room.features), ("shape", shape), ("both", room.features + shape)):
            right[name].append(float((decode_labels(features, embeddings) == room.labels)[known].mean()))
    return {name: float(np.mean(values)) for name, values in right.items()}
