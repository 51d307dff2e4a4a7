"""What an encoder of points owes to rooms, radii, descriptor and size: error on rooms held out, against seconds.

Rooms are made once and kept (--rooms-in). Variants are taught alike, with each seed; a figure is the mIoU of a room's
points that some view sees, averaged over the rooms held out and the seeds: of shape alone, where depth shows the room,
where few photos do, and where a sweep of its photos does; and of both, blended with the teacher's averages as in a
scene whose training views ask for k = 2. In brackets the difference to the first variant, with its 95 % interval over
rooms.
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
from chebsplat.formats.knowledge import SHIPPED, read_knowledge
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.blend import blend, effective
from chebsplat.shape import point_encoder
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.shape.point_inputs import PointInputs
from chebsplat.stages.settings import KnowledgeSection
from chebsplat.stages.shape_models.teaching_rooms import Room, held, prepare
from chebsplat.stages.teach import lesson_of
from chebsplat.stages.teacher_models.text_encoder import found
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.layout import KNOWLEDGE

K = 2.0  # views that knowledge counts for
KINDS = {"depth": 0, "few photos": 2, "swept": 3}  # of `rooms_of` that are measured


def scores(features: Sequence[np.ndarray], rooms: Sequence[Room], embeddings: np.ndarray) -> list[float]:
    """mIoU, in per cent, of each room's features."""
    figures = []
    for values, room in zip(features, rooms, strict=True):
        labels = np.where(room.n_views > 0, room.labels, -1)
        counts = confusion(decode_labels(values, embeddings), labels, len(embeddings))
        figures.append(100 * float(np.nanmean(segmentation(counts).iou)))
    return figures


def made(folder: Path, seeds: Sequence[int], settings: KnowledgeSection, matrix: np.ndarray) -> list[list[Room]]:
    """The rooms of these seeds, as `rooms_of` gives them; kept in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(torch.get_num_threads(), mp_context=get_context("spawn")) as pool:
        list(pool.map(prepare, *zip(*((folder, seed, settings, matrix) for seed in seeds), strict=True)))
    return [held(folder, seed) for seed in seeds]


def narrowed(room: Room, n_scales: int, described: bool) -> Room:
    """The room as an encoder of fewer radii, or without descriptors, sees it."""
    inputs = room.inputs
    width = inputs.descriptors.shape[1] // inputs.neighbors.shape[1]
    descriptors = inputs.descriptors[:, : n_scales * width if described else 0]
    return room._replace(
        inputs=PointInputs(*inputs[:3], np.ascontiguousarray(descriptors), inputs.neighbors[:, :n_scales])
    )


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("teaching", __doc__)
    parser.add_argument("--rooms", type=int, nargs="*", default=[1, 4, 16, 64])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--held-out", type=int, default=8)
    parser.add_argument("--rooms-in", type=Path, default=Path("build/bench/teaching"))
    parser.add_argument("--only", help="variants whose names hold this")
    options = parser.parse_args(arguments)
    knowledge = read_knowledge(SHIPPED)
    embeddings = knowledge.embeddings[found(list(CLASS_NAMES), knowledge.words)].astype(np.float32)
    most, settings = max(options.rooms), KnowledgeSection()
    seeds = [*KNOWLEDGE[:most], *KNOWLEDGE[-options.held_out :]]
    rooms = made(options.rooms_in, seeds, settings, knowledge.matrix)
    tested = {name: [room[kind] for room in rooms[most:]] for name, kind in KINDS.items()}
    print(f"{options.steps} steps, seeds {options.seeds}, {options.held_out} rooms held out, {torch.get_num_threads()} "
          f"threads, {shared.processor()}")  # fmt: skip
    rows: list[dict[str, Any]] = []

    def add(variant: str, measure: str, seed: int, seconds: float, values: Sequence[float]) -> None:
        more = {"seed": seed, "seconds": seconds}
        rows.extend({"variant": variant, "measure": measure, "room": k, "miou": v} | more for k, v in enumerate(values))

    for measure, of in tested.items():
        add("the teacher", measure, 0, 0.0, scores([room.features for room in of], of, embeddings))
    variants: list[tuple[str, dict[str, Any]]] = [(f"{most} rooms, 4 radii", {})]
    variants += [(f"{n} rooms", {"n_rooms": n}) for n in options.rooms if n != most]
    variants += [(f"{n} radii", {"n_scales": n}) for n in (1, 2)]
    variants += [(f"{n} radii, no descriptor", {"n_scales": n, "described": False}) for n in (1, 2, 4)]
    variants += [("half as wide", {"hidden": 32}), ("twice as wide", {"hidden": 128})]
    variants += [("no worn rooms", {"kinds": (0, 2, 3)}), ("no half-seen rooms", {"kinds": (0, 1, 3)})]
    variants += [("no swept rooms", {"kinds": (0, 1, 2)}), ("as shipped", {})]
    for name, variant in variants:
        if options.only and options.only not in name and name != variants[0][0]:
            continue
        for seed in options.seeds[: 1 if name == "as shipped" else None]:
            if name == "as shipped":
                encoder, seconds = PointEncoder.restored(knowledge.encoder, knowledge.weights), 0.0
            else:
                encoder, seconds = taught(rooms[:most], variant, options.steps, embeddings, seed)
            seen = variant.get("n_scales", 4), variant.get("described", True)
            for measure, of in tested.items():
                answers = [encoder.predict(narrowed(room, *seen).inputs) for room in of]
                add(name, measure, seed, seconds, scores(answers, of, embeddings))
                if measure == "depth":
                    pairs = zip(of, answers, strict=True)
                    both = [blend(room.features, effective(room.n_views), says, K) for room, says in pairs]
                    add(name, "both", seed, seconds, scores(both, of, embeddings))
        print(line(rows, name, variants[0][0]), flush=True)
    print(line(rows, "the teacher", variants[0][0]))
    shared.write_csv(options.out / "teaching.csv", rows)


def line(rows: Sequence[dict[str, Any]], name: str, baseline: str) -> str:
    """A variant's means, and how they differ from the baseline's."""
    by: dict[tuple[str, str, int], list[float]] = defaultdict(list)
    for row in rows:
        by[row["variant"], row["measure"], row["room"]].append(row["miou"])
    parts, own = [f"{name:26s}"], [row for row in rows if row["variant"] == name]
    for measure in (*KINDS, "both"):
        tested = sorted({row["room"] for row in own if row["measure"] == measure})
        if not tested:
            continue
        means, beside = ([float(np.mean(by[of, measure, room])) for room in tested] for of in (name, baseline))
        text = f"{measure} {np.mean(means):5.1f}"
        if name != baseline:
            apart = paired_difference(means, beside, [str(room) for room in tested])
            text += f" ({apart.mean:+.1f}; {apart.low:+.1f} to {apart.high:+.1f})"
        parts.append(text)
    return "   ".join([*parts, f"{np.mean([row['seconds'] for row in own]):5.0f} s"])


def taught(
    rooms: list[list[Room]], variant: dict[str, Any], steps: int, embeddings: np.ndarray, seed: int
) -> tuple[PointEncoder, float]:
    """An encoder that was taught so in these rooms, and the seconds of teaching."""
    n_scales, described = variant.get("n_scales", 4), variant.get("described", True)
    kinds, n_rooms = variant.get("kinds", (0, 1, 2, 3)), variant.get("n_rooms", len(rooms))
    chosen = [room[kind] for kind in kinds for room in rooms[:n_rooms]]
    lessons = [lesson_of(narrowed(room, n_scales, described), embeddings) for room in chosen]
    torch.manual_seed(seed)
    width = lessons[0].cloud.descriptors.shape[1]
    encoder = PointEncoder(embeddings.shape[1], width, n_scales=n_scales, hidden=variant.get("hidden", 64))
    encoder.set_inputs([lesson.cloud for lesson in lessons])
    began = time.perf_counter()
    for _ in point_encoder.taught(encoder, lessons, point_encoder.Course(steps=steps, seed=seed)):
        pass
    return encoder.eval(), time.perf_counter() - began
