"""Worth of transformers and descriptors in an encoder of points: error in new rooms by seconds.

Rooms are made once and kept (--rooms-in). Variants are taught alike, with each seed, have as many
features, and answer by the map that the rooms' lessons give in closed form. A figure is the mIoU of
a room's points that some view sees, averaged over the rooms held out and the seeds: of shape alone,
where depth shows the room, where few photos do, and where a sweep of its photos does; and of both,
blended with the teacher's averages as in a scene whose training views ask for k = 2. In brackets
the difference to pooling, with its 95 % interval over rooms.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import shared
from chebsplat.evaluation.metrics import confusion, segmentation
from chebsplat.evaluation.statistics import paired_difference
from chebsplat.formats.capture import Capture
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.features import Features
from chebsplat.formats.knowledge import SHIPPED, read_knowledge
from chebsplat.formats.points import Points
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.averages import averaged
from chebsplat.lifting.blend import blend, effective
from chebsplat.pipelines.work.finished import artifact_of
from chebsplat.shape import point_encoder
from chebsplat.shape.lessons import RIDGE, combined, solved
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.shape.point_inputs import PointInputs
from chebsplat.stages.settings import TeachSection
from chebsplat.stages.shape_models.surfaces import in_scene
from chebsplat.stages.shape_models.teaching_rooms import Room, load_room, prepare
from chebsplat.stages.teach import drawn_lesson, example_of
from chebsplat.stages.teacher_models.text_encoder import match_names
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import KNOWLEDGE, MODELLED

BASELINE = "pooling"
VARIANTS: dict[str, dict[str, Any]] = {
    BASELINE: {"attends": False},
    "transformers": {},
    "transformers, no descriptor": {"described": False},
    "pooling, no descriptor": {"attends": False, "described": False},
    "transformers, modelled rooms too": {"modelled": True},
}
K = 2.0  # views that knowledge counts for
KINDS = {"depth": 0, "few photos": 2, "swept": 3}  # of `rooms_of` that are measured


def scores(
    features: Sequence[np.ndarray], rooms: Sequence[Room], embeddings: np.ndarray
) -> list[float]:
    """mIoU, in per cent, of each room's features."""
    figures = []
    for values, room in zip(features, rooms, strict=True):
        labels = np.where(room.n_views > 0, room.labels, -1)
        counts = confusion(decode_labels(values, embeddings), labels, len(embeddings))
        figures.append(100 * float(np.nanmean(segmentation(counts).iou)))
    return figures


def prepare_rooms(
    folder: Path, seeds: Sequence[int], settings: TeachSection, matrix: np.ndarray
) -> list[list[Room]]:
    """The rooms of these seeds, as `rooms_of` gives them; kept in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(torch.get_num_threads(), mp_context=get_context("spawn")) as pool:
        list(
            pool.map(
                prepare, *zip(*((folder, seed, settings, matrix) for seed in seeds), strict=True)
            )
        )
    return [load_room(folder, seed) for seed in seeds]


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("teaching", __doc__)
    parser.add_argument("--rooms", type=int, default=64)
    parser.add_argument(
        "--modelled",
        type=int,
        default=0,
        help="rooms of modelled furniture, on which one variant is taught, too",
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--held-out", type=int, default=8)
    parser.add_argument("--rooms-in", type=Path, default=Path("build/bench/teaching"))
    parser.add_argument(
        "--scenes",
        nargs="*",
        default=[],
        help="finished scenes of the teacher, to be measured in too",
    )
    parser.add_argument("--only", help="variants whose names hold this")
    options = parser.parse_args(arguments)
    knowledge, settings = read_knowledge(SHIPPED), TeachSection()
    embeddings = knowledge.embeddings[match_names(list(CLASS_NAMES), knowledge.words)].astype(
        np.float32
    )
    rooms, modelled, held_out = (
        prepare_rooms(options.rooms_in, seeds, settings, knowledge.matrix)
        for seeds in (
            KNOWLEDGE[: options.rooms],
            MODELLED[: options.modelled],
            KNOWLEDGE[-options.held_out :],
        )
    )
    tested = {name: [room[kind] for room in held_out] for name, kind in KINDS.items()}
    tested |= {name: [scene_room(name)] for name in options.scenes}
    print(
        f"{options.steps} steps, seeds {options.seeds}, {options.rooms} rooms, "
        f"{options.held_out} held out, {torch.get_num_threads()} threads, {shared.processor()}"
    )
    rows: list[dict[str, Any]] = []

    def add(variant: str, measure: str, seed: int, seconds: float, values: Sequence[float]) -> None:
        more = {"seed": seed, "seconds": seconds}
        rows.extend(
            {"variant": variant, "measure": measure, "room": k, "miou": v} | more
            for k, v in enumerate(values)
        )

    for measure, of in tested.items():
        add("the teacher", measure, 0, 0.0, scores([room.features for room in of], of, embeddings))
    for name, variant in VARIANTS.items():
        if options.only and options.only not in name and name != BASELINE:
            continue
        if variant.get("modelled") and not modelled:
            continue
        for seed in options.seeds:
            lessons = [*rooms, *(modelled if variant.get("modelled") else [])]
            encoder, found_map, seconds = train_encoder(
                lessons, variant, options.steps, embeddings, seed
            )
            for measure, of in tested.items():
                answers = [
                    encoder.encode(room.inputs) @ found_map[:, : embeddings.shape[1]] for room in of
                ]
                add(name, measure, seed, seconds, scores(answers, of, embeddings))
                pairs = zip(of, answers, strict=True)
                both = [
                    blend(room.features, effective(room.n_views), says, K) for room, says in pairs
                ]
                add(name, f"{measure}, both", seed, seconds, scores(both, of, embeddings))
        for text in lines(rows, name):
            print(text, flush=True)
    for text in lines(rows, "the teacher"):
        print(text)
    shared.write_csv(options.out / "teaching.csv", rows)


def scene_room(name: str) -> Room:
    """A finished scene's described points as a room: its teacher's features, the true labels."""
    capture, points, features, described = (
        kind.read(artifact_of(name, stage))
        for kind, stage in (
            (Capture, "ingest"),
            (Points, "sfm"),
            (Features, "teacher"),
            (Descriptors, "describe"),
        )
    )
    assert (
        capture.labels is not None and capture.depth is not None and capture.class_names is not None
    )
    row, place = (
        {name: k for k, name in enumerate(names)} for names in (capture.names, features.names)
    )
    used = [k for k, name in enumerate(points.names) if not capture.is_test[row[name]]]
    depth = [capture.depth[row[points.names[k]]] for k in used]
    means, cameras = in_scene(described)[0], (points.Ks[used], points.cam_from_world[used])
    grids = [features.features[place[points.names[k]]].astype(np.float32) for k in used]
    mean, n_views = averaged(means, depth, grids, features.features.shape[-1], *cameras)
    classes = match_names(capture.class_names, list(CLASS_NAMES))
    one_hot = np.eye(len(CLASS_NAMES) + 1, dtype=np.float32)[[*classes, -1]]  # -1: none, the last
    truth = (one_hot[capture.labels[row[points.names[k]]]] for k in used)
    votes, _ = averaged(means, depth, truth, one_hot.shape[1], *cameras)
    labels = np.where(votes.argmax(1) < len(CLASS_NAMES), votes.argmax(1), -1)
    of = described
    return Room(
        PointInputs(of.own, of.means, of.normals, of.descriptors, of.neighbors),
        mean,
        n_views,
        labels,
    )


def lines(rows: Sequence[dict[str, Any]], name: str) -> list[str]:
    """A variant's means, and how they differ from the baseline's."""
    by: dict[tuple[str, str, int], list[float]] = defaultdict(list)
    for row in rows:
        by[row["variant"], row["measure"], row["room"]].append(row["miou"])
    own = [row for row in rows if row["variant"] == name]
    found_lines = [f"{name}, {np.mean([row['seconds'] for row in own]):.0f} s"]
    for measure in dict.fromkeys(row["measure"] for row in own):
        tested = sorted({row["room"] for row in own if row["measure"] == measure})
        means, beside = (
            [float(np.mean(by[of, measure, room])) for room in tested] for of in (name, BASELINE)
        )
        text = f"  {measure:24s} {np.mean(means):5.1f}"
        if name != BASELINE and (BASELINE, measure, 0) in by:
            apart = paired_difference(means, beside, [str(room) for room in tested])
            among = f"; {apart.low:+.1f} to {apart.high:+.1f}" if len(tested) > 1 else ""
            text += f" ({apart.mean:+.1f}{among})"
        found_lines.append(text)
    return found_lines


def train_encoder(
    rooms: list[list[Room]], variant: dict[str, Any], steps: int, embeddings: np.ndarray, seed: int
) -> tuple[PointEncoder, np.ndarray, float]:
    """An encoder trained so in these rooms, their lessons' map, and the seconds of training."""
    training_rooms = [room[kind] for kind in variant.get("kinds", (0, 1, 2, 3)) for room in rooms]
    examples = [example_of(room, embeddings) for room in training_rooms]
    torch.manual_seed(seed)
    width = examples[0].cloud.descriptors.shape[1] if variant.get("described", True) else 0
    encoder = PointEncoder(embeddings.shape[1], width, attends=variant.get("attends", True))
    encoder.set_inputs([example.cloud for example in examples])
    began = time.perf_counter()
    for _ in point_encoder.train_encoder(
        encoder, examples, point_encoder.Course(steps=steps, seed=seed)
    ):
        pass
    encoder.eval()
    seconds = time.perf_counter() - began
    sums = (drawn_lesson(encoder, room, embeddings) for room in training_rooms)
    total = next(sums)
    for one in sums:
        total = combined([total, one], [1.0, 1.0])
    return encoder, solved(total, RIDGE).astype(np.float32), seconds
