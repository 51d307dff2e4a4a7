"""Error against run time of what follows a training: the lift, smoothing, and knowledge of shape.

mIoU is of rendered test views, beside the processor seconds that each form takes once kernels are
compiled, all that it needs included: knowledge needs the lift, for its evidence, and smoothing.
Figures and picture go to `--out`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks import shared
from chebsplat.evaluation.metrics import confusion, segmentation
from chebsplat.formats.capture import Capture
from chebsplat.formats.descriptors import Descriptors
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.knowledge import SHIPPED, read_knowledge
from chebsplat.labels.decode import decode_labels
from chebsplat.lifting.blend import (
    Shape,
    believed,
    blend,
    effective,
    errors_alike,
    familiar,
    reliable,
    strength_of,
    supported,
    trusted,
)
from chebsplat.lifting.observations import carry
from chebsplat.lifting.smoothing import affinities, smooth
from chebsplat.render import SceneRenderer
from chebsplat.splats.gaussians import surface_of
from chebsplat.stages.evaluate import camera
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.settings import LiftSection
from chebsplat.stages.shape_models.answers import answered, answering, inputs_of, into_channels
from chebsplat.stages.shape_models.surfaces import in_scene
from chebsplat.stages.training.lifting import lifted_from

Result = TypeVar("Result")


class Scene:
    """A trained scene with a teacher, its artifacts below `work`."""

    def __init__(self, work: Path):
        self.capture, self.gaussians = Capture.read(work / "ingest"), Gaussians.read(work / "train")
        self.taught = Features.read(work / "teacher")
        parameters = self.gaussians.parameters
        self.means, self.surface = parameters["means"], surface_of(parameters)
        self.features: np.ndarray = parameters["features"]

    def score(self, features: np.ndarray) -> tuple[float, float]:
        """mIoU and OA of the test views, by these features [N, C]."""
        capture, cameras, names = (
            self.capture,
            self.gaussians.cameras,
            list(self.capture.class_names or []),
        )
        parameters = self.gaussians.parameters
        renderer, row = (
            SceneRenderer(parameters | {"features": features}),
            {n: k for k, n in enumerate(capture.names)},
        )
        as_class = np.array(
            [names.index(name) if name in names else len(names) for name in self.taught.label_names]
        )
        counts = np.zeros((len(names) + 1,) * 2, np.int64)
        for k, name in enumerate(cameras.names):
            if capture.is_test[row[name]]:
                _, rendered = renderer.render(camera(self.gaussians, k), with_features=True)
                assert rendered is not None and capture.labels is not None
                prediction = as_class[decode_labels(rendered, self.taught.label_embeddings)]
                counts += confusion(prediction, capture.labels[row[name]], len(names) + 1)
        figures = segmentation(counts)
        return 100 * float(np.nanmean(figures.iou[: len(names)])), 100 * figures.oa


def timed(make: Callable[[], Result]) -> tuple[Result, float]:
    """Value of the second call and its processor seconds, of all threads; the first compiles."""
    make()
    began = time.process_time()
    return make(), time.process_time() - began


def main(arguments: Sequence[str]) -> None:
    parser = shared.parser("refine", __doc__, work=True)
    options = parser.parse_args(arguments)
    scene, shipped = Scene(options.work), read_knowledge(SHIPPED)
    inputs_of_lift = (
        scene.capture,
        scene.gaussians.cameras,
        scene.gaussians.parameters,
        scene.taught,
    )
    lifted, to_lift = timed(
        lambda: lifted_from(*inputs_of_lift, LiftSection().gate, Progress(False))
    )
    near, to_compare = timed(lambda: affinities(scene.means, *scene.surface))
    smoothed, to_smooth = timed(lambda: smooth(scene.features, lifted.n_views, near))
    rows: list[dict[str, Any]] = []

    def add(name: str, seconds: float, features: np.ndarray) -> None:
        miou, oa = scene.score(features)
        rows.append(
            {
                "form": name,
                "processor_seconds": round(seconds, 2),
                "miou": round(miou, 2),
                "oa": round(oa, 2),
            }
        )
        print(f"{name:34s}{seconds:7.2f} s   mIoU {miou:5.1f}   OA {oa:5.1f}", flush=True)

    add("features as trained", 0.0, scene.features)
    add("lifted features", to_lift, lifted.features)
    add("smoothed", to_lift + to_compare + to_smooth, smoothed)
    translated, described = (
        into_channels(SHIPPED, shipped, scene.taught),
        Descriptors.read(options.work / "describe"),
    )
    inputs, (means, normals) = inputs_of(SHIPPED, described, shipped), in_scene(described)

    def carry_knowledge() -> Shape:
        answers, _ = carry(
            translated(answered(shipped, inputs)), means, normals, scene.means, scene.surface[0]
        )
        return answering(SHIPPED, shipped, scene.taught, answers)

    shape, to_know = timed(carry_knowledge)

    def blended() -> np.ndarray:
        seen, halves = (lifted.features, lifted.n_views), (lifted.halves, lifted.half_views)
        worth = familiar(lifted.features, shape.answers, shape.embeddings)
        evidence = effective(lifted.n_views, errors_alike(lifted.agreement, *halves))
        evidence = evidence * reliable(*halves) * worth
        support = supported(*seen, lifted.agreement, shape)
        strength = strength_of(support, worth, believed(*seen, shape, worth))
        knowledge = shape.beside(scene.features)
        result = blend(scene.features, evidence, knowledge, strength)
        return smooth(result, evidence + trusted(knowledge, strength), near)

    result, to_blend = timed(blended)
    add("and knowledge", to_lift + to_compare + to_know + to_blend, result)
    shared.write_csv(options.out / "refine.csv", rows)
    draw(options.out / "refine.png", rows, options.work.resolve().name)


def draw(path: Path, rows: list[dict[str, Any]], scene: str) -> None:
    """mIoU against processor seconds, a point a form, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8, 4.2), layout="constrained")
    for number, row in enumerate(rows, 1):
        place, form = (row["processor_seconds"], row["miou"]), row["form"].removeprefix("and ")
        axis.plot(
            *place, "o", color="C0" if "knowledge" in form else "C1", label=f"{number}  {form}"
        )
        axis.annotate(str(number), place, fontsize=9, xytext=(5, 4), textcoords="offset points")
    figure.legend(
        loc="outside right upper", fontsize=8, handlelength=0, markerscale=0.6, frameon=False
    )
    axis.set_xlabel("processor seconds after the training")
    axis.set_ylabel("mIoU of test views, %")
    axis.set_title(f"What follows a training: {scene.partition('@')[0]}", fontsize=10)
    axis.margins(0.08, 0.1)
    axis.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    plt.close(figure)
