"""Worth of lessons of scenes in other scenes: mIoU of shape alone, and blended with the teacher's.

Of finished scenes (--scenes), each is asked in turn with lessons of the others: of 1, 2, 4, ... of
them, alone and beside what ships; of few of their points; of points that a user labelled in one of
them. A figure is the mean over the scenes of a scene's mIoU over its described points, in per cent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks import shared
from benchmarks.teachers.teaching import K, scene_room, scores
from chebsplat.formats.knowledge import SHIPPED, Knowledge, read_knowledge
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.blend import blend, effective
from chebsplat.shape.lessons import (
    RIDGE,
    SHIPPED_WORTH,
    Sums,
    combined,
    mean_of,
    odds,
    solved,
    summed,
)
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.stages.shape_models.answers import units
from chebsplat.stages.shape_models.teaching_rooms import Room
from chebsplat.stages.teacher_models.text_encoder import match_names
from chebsplat.synthetic import CLASS_NAMES


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("lessons", __doc__)
    parser.add_argument(
        "--scenes", nargs="+", required=True, help="finished scenes of the embedded teacher"
    )
    options = parser.parse_args(arguments)
    knowledge = read_knowledge(SHIPPED)
    encoder = PointEncoder.restored(knowledge.encoder, knowledge.weights)
    classes = knowledge.embeddings[match_names(list(CLASS_NAMES), knowledge.words)].astype(
        np.float32
    )
    rooms = [scene_room(name) for name in options.scenes]
    features = [encoder.encode(room.inputs) for room in rooms]
    scenes = Scenes(knowledge, rooms, features, classes)
    print(f"{len(rooms)} scenes; {shared.machine()}")
    rows = [{"variant": "the teacher's averages", "shape": "", "both": scenes.teacher()}]
    rows.append({"variant": "what ships"} | scenes.figures([[] for _ in rooms], SHIPPED_WORTH))
    everyone = [scenes.learn(k) for k in range(len(rooms))]
    for count in (1, 2, 4, 8, 16):
        if count < len(rooms):
            lessons = [
                [everyone[(k + 1 + step) % len(rooms)] for step in range(count)]
                for k in range(len(rooms))
            ]
            rows.append({"variant": f"{count} lessons alone"} | scenes.figures(lessons, 0.0))
            name = f"{count} lessons and what ships"
            rows.append({"variant": name} | scenes.figures(lessons, SHIPPED_WORTH))
    for points in (300, 1000, 3000):
        fewer = [scenes.learn(k, points) for k in range(len(rooms))]
        lessons = [[of for other, of in enumerate(fewer) if other != k] for k in range(len(rooms))]
        rows.append({"variant": f"lessons of {points} points alone"} | scenes.figures(lessons, 0.0))
    for points in (100, 300, 1000):
        marked = [scenes.labelled(k, points) for k in range(len(rooms))]
        lessons = [[marked[(k + 1) % len(rooms)]] for k in range(len(rooms))]
        rows.append(
            {"variant": f"{points} labelled points of one scene, alone"}
            | scenes.figures(lessons, 0.0)
        )
        name = f"{points} labelled points, and what ships"
        rows.append({"variant": name} | scenes.figures(lessons, SHIPPED_WORTH))
    for row in rows:
        print(f"{row['variant']:42s} shape {row['shape']:>5}   both {row['both']:>5}")
    shared.write_csv(options.out / "lessons.csv", rows)


class Scenes:
    """Scenes with their features of shape, and figures of maps of lessons in them."""

    def __init__(
        self,
        knowledge: Knowledge,
        rooms: list[Room],
        features: list[np.ndarray],
        classes: np.ndarray,
    ):
        self.rooms, self.features, self.classes = rooms, features, classes
        self.shipped = mean_of([Sums(*of) for of in knowledge.shipped])

    def teacher(self) -> str:
        """mIoU of the teacher's averages."""
        features = [room.features for room in self.rooms]
        return f"{np.mean(scores(features, self.rooms, self.classes)):.1f}"

    def learn(self, scene: int, points: int | None = None) -> Sums:
        """The lesson of a scene, or of some of its points."""
        room = self.rooms[scene]
        labels = decode_labels(room.features, self.classes)
        weights = odds(room.n_views, labels)
        if points is not None:
            rows = np.random.default_rng(scene).choice(len(weights), points, p=weights)
            weights = np.bincount(rows, minlength=len(weights)).astype(np.float64)
        return summed(self.features[scene], units(self.classes)[labels], weights)

    def labelled(self, scene: int, points: int) -> Sums:
        """The lesson of points whose true class a user has said, rare things more often."""
        room = self.rooms[scene]
        rows = np.flatnonzero(room.labels >= 0)
        share = 1 / np.sqrt(np.bincount(room.labels[rows])[room.labels[rows]])
        rows = np.random.default_rng(scene).choice(
            rows, points, replace=False, p=share / share.sum()
        )
        weights = odds(np.full(points, 2), room.labels[rows])
        return summed(self.features[scene][rows], units(self.classes)[room.labels[rows]], weights)

    def figures(self, lessons: list[list[Sums]], worth: float) -> dict[str, str]:
        """mIoU of shape alone and of both, each scene by its lessons and `worth` of what ships."""
        answers = []
        for z, of in zip(self.features, lessons, strict=True):
            whole = combined([self.shipped, *of], [worth if of else 1.0, *[1.0] * len(of)])
            answers.append(z @ solved(whole, RIDGE).astype(np.float32))
        pairs = list(zip(self.rooms, answers, strict=True))
        both = [blend(room.features, effective(room.n_views), says, K) for room, says in pairs]
        shape = scores(answers, self.rooms, units(self.classes))
        return {
            "shape": f"{np.mean(shape):.1f}",
            "both": f"{np.mean(scores(both, self.rooms, self.classes)):.1f}",
        }
