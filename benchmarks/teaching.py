"""What an encoder of points owes to rooms, radii, descriptor and size: error on rooms held out, against seconds.

Rooms are made once and kept (--rooms-in). Variants are taught alike, with one seed; figures are OA and mIoU of points
that some view sees, over the held-out rooms: of the teacher's averages, of shape alone, and of both (counted as in a
scene whose training views ask for k = 2); of shape alone, too, where few photos show the rooms.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import shared
from chebsplat.evaluation.metrics import confusion, segmentation
from chebsplat.formats.knowledge import SHIPPED, read_knowledge
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.blend import blend, effective
from chebsplat.shape import teach
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.shape.point_inputs import PointInputs
from chebsplat.stages.settings import KnowledgeSection
from chebsplat.stages.teach import lesson_of
from chebsplat.stages.teaching_rooms import Room, held, prepare
from chebsplat.stages.text import found
from chebsplat.synthetic import CLASS_NAMES
from chebsplat.synthetic.seeds import KNOWLEDGE

K = 2.0  # views that knowledge counts for


def score(features: np.ndarray, rooms: Sequence[Room], embeddings: np.ndarray) -> str:
    """OA and mIoU, in per cent, of the rooms' stacked features."""
    labels = np.concatenate([np.where(room.n_views > 0, room.labels, -1) for room in rooms])
    figures = segmentation(confusion(decode_labels(features, embeddings), labels, len(embeddings)))
    return f"{100 * figures.oa:5.1f} {100 * np.nanmean(figures.iou):5.1f}"


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
    parser.add_argument("--rooms", type=int, nargs="*", default=[1, 4, 16])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--held-out", type=int, default=6)
    parser.add_argument("--rooms-in", type=Path, default=Path("build/bench/teaching"))
    options = parser.parse_args(arguments)
    knowledge = read_knowledge(SHIPPED)
    embeddings = knowledge.embeddings[found(list(CLASS_NAMES), knowledge.words)].astype(np.float32)
    most, settings = max(options.rooms), KnowledgeSection()
    seeds = [*KNOWLEDGE[:most], *KNOWLEDGE[-options.held_out :]]
    rooms = made(options.rooms_in, seeds, settings, knowledge.matrix)
    tested, few = ([room[kind] for room in rooms[most:]] for kind in (0, 2))
    averages = np.concatenate([room.features for room in tested])
    n_views = np.concatenate([room.n_views for room in tested])
    print(f"{most} rooms at most, {options.steps} steps, {len(tested)} rooms held out; OA mIoU\n"
          f"{'the teacher':34s}{score(averages, tested, embeddings)}   half-seen rooms "
          f"{score(np.concatenate([room.features for room in few]), few, embeddings)}")  # fmt: skip
    variants: list[tuple[str, dict[str, Any]]] = [(f"{n} rooms", {"n_rooms": n}) for n in options.rooms]
    variants += [(f"{n} radii", {"n_scales": n}) for n in (1, 2)]
    variants += [(f"{n} radii, no descriptor", {"n_scales": n, "described": False}) for n in (1, 4)]
    variants += [("half as wide", {"hidden": 16}), ("twice as wide", {"hidden": 64})]
    variants += [("no worn rooms", {"kinds": (0, 2)}), ("no half-seen rooms", {"kinds": (0, 1)})]
    for name, variant in [*variants, ("as shipped", {})]:
        if name == "as shipped":
            encoder, seconds = PointEncoder.restored(knowledge.encoder, knowledge.weights), 0.0
        else:
            encoder, seconds = taught(rooms[:most], variant, options.steps, embeddings)
        seen = variant.get("n_scales", 4), variant.get("described", True)
        result, half_seen = (
            np.concatenate([encoder.predict(narrowed(room, *seen).inputs) for room in of]) for of in (tested, few)
        )
        both = blend(averages, effective(n_views), result, K)
        print(f"{name:34s}{score(result, tested, embeddings)}   both {score(both, tested, embeddings)}   "
              f"half seen {score(half_seen, few, embeddings)}   {seconds:5.0f} s", flush=True)  # fmt: skip


def taught(
    rooms: list[list[Room]], variant: dict[str, Any], steps: int, embeddings: np.ndarray
) -> tuple[PointEncoder, float]:
    """An encoder that was taught so in these rooms, and the seconds of teaching."""
    n_scales, described = variant.get("n_scales", 4), variant.get("described", True)
    kinds, n_rooms = variant.get("kinds", (0, 1, 2)), variant.get("n_rooms", len(rooms))
    chosen = [room[kind] for kind in kinds for room in rooms[:n_rooms]]
    lessons = [lesson_of(narrowed(room, n_scales, described), embeddings) for room in chosen]
    torch.manual_seed(0)
    width = lessons[0].cloud.descriptors.shape[1]
    encoder = PointEncoder(embeddings.shape[1], width, n_scales=n_scales, hidden=variant.get("hidden", 32))
    encoder.set_inputs([lesson.cloud for lesson in lessons])
    began = time.perf_counter()
    for _ in teach.taught(encoder, lessons, teach.Course(steps=steps)):
        pass
    return encoder.eval(), time.perf_counter() - began
