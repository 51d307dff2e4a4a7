"""evaluate: measure the exported scene on the test views."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from chebsplat.errors import DataFailure
from chebsplat.stages.command import Job, command

if TYPE_CHECKING:
    import numpy as np

    from chebsplat.formats.capture import Capture
    from chebsplat.formats.features import Features
    from chebsplat.formats.scene import Scene
    from chebsplat.views import View


def run(job: Job) -> None:
    import numpy as np

    from chebsplat.formats.capture import read_capture
    from chebsplat.formats.evaluation import Evaluation, write_evaluation
    from chebsplat.formats.features import read_features
    from chebsplat.formats.scene import read_scene
    from chebsplat.render import SceneRenderer

    settings = job.config.evaluate
    capture, scene = read_capture(job.inputs["capture"]), read_scene(job.inputs["scene"])
    row = {name: view for view, name in enumerate(capture.names)}
    tests = [k for k, name in enumerate(scene.cameras.names) if name in row and capture.is_test[row[name]]]
    if not tests:
        raise DataFailure("no test view has a camera; lower ingest.test_every")
    views = [row[scene.cameras.names[k]] for k in tests]
    names = [capture.names[v] for v in views]
    renderer = SceneRenderer(scene.parameters)
    cameras = [camera(scene, k) for k in tests]
    renders, features = [], []
    for view, _ in job.progress.track(cameras, len(cameras), "evaluate"):
        image, feature = renderer.render(view, with_features=scene.labels is not None)
        renders.append(image)
        features.append(feature)
    truth = np.stack([capture.images[v] for v in views])
    pictures: dict[str, Any] = {"truth": truth, "renders": np.stack(renders)}
    masks = None if capture.loss_mask is None else [capture.loss_mask[v] for v in views]
    figures: dict[str, Any] = {"names": names, "protocol": capture.protocol, "source": capture.source}
    figures["image"] = image_figures(pictures["renders"], truth, masks)
    figures["n_gaussians"] = len(scene.parameters["means"])
    figures["bytes"] = scene.summary["bytes"]
    figures["frames_per_second"] = timing(renderer, cameras, settings.timing_repeats, scene.labels is not None)
    figures["lpips"] = None
    job.left_out("LPIPS", "no backbone weights are given: not measured")
    if scene.labels is None:
        job.left_out("segmentation", "the scene has no semantics")
    else:
        teacher = read_features(job.inputs["features"]) if "features" in job.inputs else None
        figures["segmentation"] = label_figures(job, capture, scene, views, features, teacher, pictures)
    figures["left_out"] = scene.summary["left_out"] | job.facts.get("left_out", {})
    job.facts |= {"psnr": figures["image"]["psnr"], "n_test": len(tests)}
    if figures.get("segmentation"):
        job.facts["miou"] = figures["segmentation"]["scene"]["miou"]
    write_evaluation(job.out, Evaluation(figures, pictures))


def camera(scene: Scene, index: int) -> View:
    import torch

    from chebsplat.views import View

    cameras = scene.cameras
    K, pose = (torch.from_numpy(m[index]).float() for m in (cameras.Ks, cameras.cam_from_world))
    return View(K, pose, cameras.width, cameras.height)


def image_figures(renders: np.ndarray, truth: np.ndarray, masks: list[np.ndarray] | None) -> dict[str, Any]:
    """PSNR and SSIM by view and in the mean. Masked pixels do not count; for SSIM they take the true colour."""
    import numpy as np

    from chebsplat.losses import ssim
    from chebsplat.metrics import psnr

    rows = []
    for k, (render, true) in enumerate(zip(renders, truth, strict=True)):
        counted = np.ones(true.shape[:2], bool) if masks is None else masks[k]
        filled = np.where(counted[..., None], render, true)
        rows.append((min(psnr(render[counted], true[counted]), 100.0), ssim(filled, true)))
    table = np.array(rows)
    per_view = {"psnr": table[:, 0].tolist(), "ssim": table[:, 1].tolist()}
    return {"psnr": float(table[:, 0].mean()), "ssim": float(table[:, 1].mean()), "per_view": per_view}


def timing(renderer: Any, cameras: list[View], repeats: int, semantic: bool) -> dict[str, float]:
    """Frames a second over all test views, the best of `repeats`: colour alone, and with features."""
    figures = {}
    for name, with_features in (("color", False), ("color_and_features", True)):
        if with_features and not semantic:
            continue
        best = float("inf")
        for _ in range(repeats):
            began = time.perf_counter()
            for view in cameras:
                renderer.render(view, with_features)
            best = min(best, time.perf_counter() - began)
        figures[name] = len(cameras) / best
    return figures


def label_figures(
    job: Job,
    capture: Capture,
    scene: Scene,
    views: list[int],
    features: list[Any],
    teacher: Features | None,
    pictures: dict[str, Any],
) -> dict[str, Any]:
    """mIoU, mAcc, OA, IoU by class and within the boundary band: of the scene, and of its teacher on the same views."""
    import numpy as np

    from chebsplat.noisy_teacher import decode

    assert scene.label_embeddings is not None and scene.label_names is not None
    predicted = np.stack([decode(f, scene.label_embeddings)[0] for f in features])
    pictures["predicted"] = predicted
    of_teacher = None
    if teacher is not None:
        row = {name: k for k, name in enumerate(teacher.names)}
        size = predicted.shape[1:]
        found = (labels_of(teacher, row[capture.names[v]]) for v in views)  # one view's features at a time
        of_teacher = pictures["teacher"] = np.stack([enlarged(labels, size) for labels in found])
    if capture.labels is None or capture.class_names is None:
        job.left_out("mIoU", "the capture has no labels to compare with")
        return {}
    truth = pictures["labels"] = np.stack([capture.labels[v] for v in views])
    classes = capture.class_names
    result = {"classes": classes, "scene": measured(predicted, scene.label_names, truth, classes, job)}
    if of_teacher is not None and teacher is not None:
        result["teacher"] = measured(of_teacher, teacher.label_names, truth, classes, job)
    return result


def labels_of(teacher: Features, view: int) -> np.ndarray:
    """What a teacher says of a view, [h, w]: its own labels where it told them, before any projection."""
    import numpy as np

    from chebsplat.noisy_teacher import decode

    if teacher.pseudo_labels is not None:
        return np.asarray(teacher.pseudo_labels[view])
    return decode(teacher.features[view].astype(np.float32), teacher.label_embeddings)[0]


def enlarged(labels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Nearest-neighbour enlargement of labels [h, w] to a size (H, W)."""
    import numpy as np

    rows = np.minimum(np.arange(size[0]) * labels.shape[0] // size[0], labels.shape[0] - 1)
    columns = np.minimum(np.arange(size[1]) * labels.shape[1] // size[1], labels.shape[1] - 1)
    return labels[rows[:, None], columns]


def measured(
    predicted: np.ndarray, names: list[str], truth: np.ndarray, classes: list[str], job: Job
) -> dict[str, Any]:
    """Figures of one confusion matrix over all test views. A label whose name is no class counts as wrong."""
    import numpy as np

    from chebsplat.metrics import IGNORE, boundary_band, confusion, segmentation

    n = len(classes)
    to_class = np.array([classes.index(name) if name in classes else n for name in names])
    mapped = to_class[predicted]
    band = np.stack([boundary_band(t, job.config.evaluate.boundary) for t in truth])
    whole = segmentation(confusion(mapped, truth, n + 1))
    edges = segmentation(confusion(mapped, np.where(band, truth, IGNORE), n + 1))

    def mean(values: np.ndarray) -> float | None:
        return None if np.isnan(values[:n]).all() else float(np.nanmean(values[:n]))

    return {
        "miou": mean(whole.iou),
        "macc": whole.macc,
        "oa": whole.oa,
        "boundary_miou": mean(edges.iou),
        "iou": {name: None if np.isnan(v) else float(v) for name, v in zip(classes, whole.iou, strict=False)},
    }


main = command("evaluate", run)
