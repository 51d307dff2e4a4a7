"""evaluate: measure the exported scene on the views of its protocol."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from chebsplat.cameras import unproject
from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.evaluation import protocols
from chebsplat.evaluation.lpips import NET, NORMALIZE
from chebsplat.evaluation.metrics import features_at
from chebsplat.evaluation.protocols.task import EvaluatedView, MapsByName, Task, resized, translated
from chebsplat.formats.artifact import checked, read_manifest
from chebsplat.formats.capture import Capture
from chebsplat.formats.evaluation import Evaluation
from chebsplat.formats.features import Features
from chebsplat.formats.names import few
from chebsplat.formats.ply import read_ply
from chebsplat.formats.scene import Scene
from chebsplat.formats.world import World
from chebsplat.labels.decode import decode_labels
from chebsplat.labels.names import lacking
from chebsplat.render import SceneRenderer
from chebsplat.stages.measuring.image_quality import (
    covisible_figures,
    figures_as_taken,
    frame_split,
    image_figures,
    load_lpips,
    mean_psnr,
    timing,
)
from chebsplat.stages.runtime.command import Job
from chebsplat.views import View

log = logging.getLogger("chebsplat")


def run(job: Job) -> None:
    """Measure the exported scene on its protocol's views (docs/method.md, sections 10 and 15).

    Reads `capture`, `scene` and, for the teacher's own figures, `features`. Writes `evaluation`.
    """
    settings = job.config.evaluate
    capture, scene = Capture.read(job.inputs["capture"]), Scene.read(job.inputs["scene"])
    named = str(capture.protocol.get("name"))
    if named not in protocols.NAMES:
        raise ConfigError(
            f"{job.inputs['capture']}: its protocol {named:.60} is unknown; ingest it again"
        )
    protocol = protocols.load(named)
    if capture.size != (scene.cameras.width, scene.cameras.height):
        raise InputError(
            f"{job.inputs['scene']} has cameras of another size than the capture; "
            "pass those of one scene"
        )
    lpips = (
        load_lpips(Path(settings.lpips_weights).expanduser()) if settings.lpips_weights else None
    )
    row = {name: view for view, name in enumerate(capture.names)}
    evaluated = capture.is_test if not protocol.RULE.on_training else ~capture.is_test
    places = [
        k for k, name in enumerate(scene.cameras.names) if name in row and evaluated[row[name]]
    ]
    if capture.loss_mask is not None:
        counted = [k for k in places if capture.loss_mask[row[scene.cameras.names[k]]].any()]
        if hidden := len(places) - len(counted):
            job.left_out(
                f"{hidden} of {len(places)} views", "masks and transparency leave no pixel of them"
            )
        places = counted
    if not places:
        raise DataFailure(
            "no view to evaluate has a camera and a pixel that counts; lower ingest.test_every"
        )
    names = [scene.cameras.names[k] for k in places]
    renderer = SceneRenderer(scene.parameters, job.device, scene.cameras.Ks)
    cameras = [camera(scene, k) for k in places]
    stops = {name: scene.cameras.stops(k) for name, k in zip(names, places, strict=True)}
    pictures: dict[str, Any] = {"truth": np.stack([capture.images[row[name]] for name in names])}
    measured = capture.protocol | {"resolution": "x".join(map(str, capture.size))}
    figures: dict[str, Any] = {"names": names, "protocol": measured, "source": capture.source}
    stacks: dict[str, list[np.ndarray]] = {"renders": []}
    views = evaluated_views(
        job, renderer, dict(zip(names, cameras, strict=True)), capture, scene, stacks
    )
    segmentation = segmented(job, protocol, views, capture, scene, renderer)
    for _ in views:  # views that the protocol did not use
        pass
    job.facts["layout_error"] = layout_error(job, scene, cameras[0], stacks["renders"][0])
    as_shown = stacks["renders"]
    if scene.cameras.exposures is not None:
        stacks["renders"] = [
            renderer.render(view, stops=stops[name])[0]
            for name, view in zip(names, cameras, strict=True)
        ]
    pictures |= {name: np.stack(maps) for name, maps in stacks.items()}
    masks = None if capture.loss_mask is None else [capture.loss_mask[row[name]] for name in names]
    figures["image"] = image_figures(pictures["renders"], pictures["truth"], masks, lpips)
    if scene.cameras.exposures is not None:
        figures["image"]["psnr_as_shown"] = mean_psnr(np.stack(as_shown), pictures["truth"], masks)
    figures["n_gaussians"] = len(scene.parameters["means"])
    figures["bytes"] = scene.summary["bytes"]
    figures |= timings(job, renderer, cameras, scene.labels is not None)
    figures["lpips"] = figures["image"]["lpips"]
    if lpips is None:
        job.left_out("LPIPS", "evaluate.lpips_weights names no file: not measured")
    else:
        figures["lpips_net"] = {"net": NET, "normalize": NORMALIZE}
    as_taken = figures_as_taken(capture, renderer, dict(zip(names, cameras, strict=True)), stops)
    if as_taken is not None:
        figures["image"]["as_taken"] = as_taken
    if not protocol.RULE.on_training:
        covisible = covisible_figures(capture, scene.cameras, names, pictures["renders"])
        if covisible is not None:
            figures["image"]["covisible"] = covisible
    if segmentation is not None:
        figures["segmentation"] = segmentation
    figures["left_out"] = scene.summary.get("left_out", {}) | job.facts.get("left_out", {})
    job.facts |= {"psnr": figures["image"]["psnr"], "n_test": len(names)}
    if segmentation:
        job.facts |= {
            "miou": segmentation["scene"]["miou"],
            "miou_of": segmentation["counted"]["miou"],
        }
    Evaluation(figures, pictures).write(job.out)


def segmented(
    job: Job,
    protocol: ModuleType,
    views: Iterator[EvaluatedView],
    capture: Capture,
    scene: Scene,
    renderer: SceneRenderer,
) -> dict[str, Any] | None:
    """Segmentation figures by the protocol, and unmatched labels; None without semantics."""
    if scene.labels is None:
        job.left_out("segmentation", "the scene has no semantics")
        return None
    if protocol.RULE.truth == "labels" and (capture.labels is None or capture.class_names is None):
        job.left_out("mIoU", "the capture has no labels to compare with")
        return {}
    figures: dict[str, Any] = protocol.measure(views, task(job, capture, scene, renderer))
    if figures["scene"]["miou"] is None:
        job.left_out("mIoU", too_little(figures["counted"]["miou"]))
    elif "point_miou" in figures["scene"] and figures["scene"]["point_miou"] is None:
        rests = figures["counted"]["point_miou"]
        job.left_out(
            "3D point mIoU",
            too_little(rests) if rests["classes"] else "the capture has no depth with poses",
        )
    if protocol.RULE.truth == "labels":
        figures["unmatched"] = unmatched(scene.label_names or [], capture.class_names or [])
    return figures


def too_little(rests: dict[str, int]) -> str:
    """Why there is no mIoU of a truth of so many `classes`, of pixels or of points."""
    if not rests["classes"]:
        return (
            "no pixel of the evaluated views has a label; label some of them, or choose others "
            "(ingest.test_every)"
        )
    return "what the evaluated views show is of one class alone: a mean over classes needs two"


def unmatched(names: list[str], classes: list[str]) -> dict[str, list[str]]:
    """Log and return the scene's labels without a true class, and true classes without a label."""
    absent = {"scene": lacking(names, classes), "truth": lacking(classes, names)}
    if absent["truth"]:
        log.warning(
            "no label of the scene is called like these classes of the truth: %s",
            few(absent["truth"]),
        )
    if absent["scene"]:
        log.info("labels of the scene that the truth has no class for: %s", few(absent["scene"]))
    return {side: some for side, some in absent.items() if some}


def timings(
    job: Job, renderer: SceneRenderer, cameras: list[View], semantic: bool
) -> dict[str, Any]:
    """Frames a second, and on the CPU milliseconds of a frame by part."""
    repeats, split = job.config.evaluate.timing_repeats, {}
    if not repeats:
        job.left_out("frames a second", "evaluate.timing_repeats is 0")
        return {"frames_per_second": {}, "milliseconds": {}}
    per_second = timing(renderer, cameras, repeats, semantic)
    if job.device == "cpu":
        split = frame_split(renderer, cameras, repeats)
    else:
        job.left_out(
            "milliseconds of a frame by part", "gsplat renders a frame on the GPU in one go"
        )
    return {"frames_per_second": per_second, "milliseconds": split}


def layout_error(job: Job, scene: Scene, view: View, image: np.ndarray) -> int:
    """Largest difference, grey levels of 255, of a view rendered from scene.ply and `image`.

    Args: image: u8 [H, W, 3], the view rendered from the ragged arrays.
    """
    path, world = job.inputs["scene"], World.read(scene.summary)
    ply = checked(path, read_manifest(path, Scene.SCHEMA), "scene.ply")
    render = SceneRenderer(read_ply(ply, world)[0], job.device).render(view)[0]
    return int(np.abs(render.astype(int) - image).max())


def camera(scene: Scene, index: int) -> View:
    """The view of a scene's camera `index`."""
    cameras = scene.cameras
    K, pose = (torch.from_numpy(m[index]).float() for m in (cameras.Ks, cameras.cam_from_world))
    return View(K, pose, cameras.width, cameras.height)


def unproject_view(depth: np.ndarray, view: View) -> np.ndarray:
    """World points f64 [H, W, 3] of a view's pixels; nan where its depth [H, W] is."""
    pixels = np.indices(depth.shape).reshape(2, -1).T
    K, pose = (matrix.double().numpy() for matrix in (view.K, view.viewmat))
    return unproject(depth, K, pose, pixels).reshape(*depth.shape, 3)


def task(job: Job, capture: Capture, scene: Scene, renderer: SceneRenderer) -> Any:
    """Input of a protocol beside the views: classes, and features at points of surfaces."""

    def at(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = (renderer.means, renderer.quats, renderer.scales, renderer.opacities)
        means, quats, scales, opacities = (part.double().cpu().numpy() for part in parts)
        return features_at(points, means, quats, scales, opacities, scene.parameters["features"])

    assert scene.label_embeddings is not None and scene.label_names is not None
    names, boundary = capture.class_names or [], job.config.evaluate.boundary
    return Task(scene.label_names, scene.label_embeddings, names, boundary, at)


def evaluated_views(
    job: Job,
    renderer: SceneRenderer,
    cameras: dict[str, View],
    capture: Capture,
    scene: Scene,
    stacks: dict[str, list[np.ndarray]],
) -> Iterator[EvaluatedView]:
    """Render one view after another, joined on its name; append its pictures to `stacks`."""

    def as_classes(labels: np.ndarray) -> np.ndarray:
        """Labels numbered as the truth's classes, -1 where the truth has no such class."""
        if scene.label_names is None or capture.class_names is None:
            return labels
        return translated(labels, scene.label_names, capture.class_names, -1)

    truths = None if capture.labels is None else MapsByName(capture.names, capture.labels, "labels")
    depths = None  # in the scene's units only where the scene was built on the capture's own poses
    if capture.depth is not None and capture.cam_from_world is not None:
        depths = MapsByName(capture.names, capture.depth, "depth")
    teachers = pseudo_labels = None
    if "features" in job.inputs and scene.labels is not None:
        teacher = Features.read(job.inputs["features"])
        own = scene.label_embeddings
        if (
            teacher.label_names != scene.label_names
            or own is None
            or teacher.label_embeddings.shape != own.shape
        ):
            raise InputError(
                f"{job.inputs['features']} has other labels than the scene; export the scene again"
            )
        teachers = MapsByName(teacher.names, teacher.features, "features of a teacher")
        if teacher.pseudo_labels is not None:  # of its own channels
            pseudo_labels = MapsByName(teacher.names, teacher.pseudo_labels, "labels of a teacher")
    for name, _ in job.progress.track(list(cameras), len(cameras), "evaluate"):
        image, features = renderer.render(cameras[name], with_features=scene.labels is not None)
        stacks["renders"].append(image)
        if features is None or scene.label_embeddings is None:
            continue
        view = EvaluatedView(name, features, decode_labels(features, scene.label_embeddings))
        stacks.setdefault("predicted", []).append(as_classes(view.labels))
        if teachers is not None:
            view.teacher = teachers[name].astype(np.float32)
            if pseudo_labels is None:
                small = decode_labels(view.teacher, scene.label_embeddings)
            else:
                small = pseudo_labels[name]
            view.teacher_labels = resized(small, view.labels.shape)
            stacks.setdefault("teacher", []).append(as_classes(view.teacher_labels))
        if truths is not None:
            view.truth = truths[name]
            if depths is not None:
                view.surface = unproject_view(depths[name], cameras[name])
            stacks.setdefault("labels", []).append(view.truth)
        yield view
