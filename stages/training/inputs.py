"""What a training reads of its input artifacts: views, an earlier scene's knowledge, the first regions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.training.depth import measured_depth
from chebsplat.stages.training.saves import without_basis

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from torch import Tensor

    from chebsplat.formats.capture import Capture
    from chebsplat.formats.descriptors import Descriptors
    from chebsplat.formats.features import Features
    from chebsplat.formats.points import Points
    from chebsplat.settings import DescribeSection, TrainSection
    from chebsplat.shape.regions import Regions
    from chebsplat.stages.runtime.progress import Progress
    from chebsplat.training.model import SceneModel
    from chebsplat.views import TaughtLabels, Views

FEATURE_BYTES = 64 << 20  # of features that are kept in memory; what is beyond is read when its view is looked at
PHOTO_BYTES, MASK_BYTES = 2 << 30, 512 << 20  # of photos and masks likewise


def training_views(
    capture: Capture,
    points: Points,
    features: Features | None,
    with_depth: bool = False,
    exposures: np.ndarray | None = None,
) -> Views:
    """The registered training views, joined by name, with their depth where asked for, and without these exposures
    [V, 3], in stops.

    Raises: InputError if artifacts do not belong together.
    """
    import torch

    from chebsplat.photos.exposures import relit
    from chebsplat.views import Views, remembered, stacked

    row = {name: view for view, name in enumerate(capture.names)}
    unknown = [name for name in points.names if name not in row]
    if unknown:
        raise InputError(f"the points know a view {unknown[0]} that the capture does not; pass artifacts of one scene")
    used = [k for k, name in enumerate(points.names) if not capture.is_test[row[name]]]
    if not used:
        raise DataFailure("no training view is registered")
    names = [points.names[k] for k in used]
    images, masks = capture.images, capture.loss_mask
    chosen = [row[name] for name in names]
    of = labels_of = None
    if features is not None:
        source = {name: view for view, name in enumerate(features.names)}
        absent = [name for name in names if name not in source]
        if absent:
            raise InputError(f"the features have no view {absent[0]}; run the teacher stage on this capture")
        stored = features.features
        read = remembered(lambda index: torch.from_numpy(stored[source[names[index]]]), FEATURE_BYTES)

        def of(index: int) -> torch.Tensor:
            return read(index).float()

        if features.pseudo_labels is not None and features.confidence is not None:
            labels_of = taught_labels(features, [source[name] for name in names])

    def photo(k: int) -> torch.Tensor:
        image = images[chosen[k]]
        return torch.from_numpy(image if exposures is None else relit(image, -exposures[k]))

    depth_of = measured_depth(capture, points, used) if with_depth else None
    return Views(
        names,
        stacked(photo, len(chosen), PHOTO_BYTES),
        torch.from_numpy(points.Ks[used]).float(),
        torch.from_numpy(points.cam_from_world[used]).float(),
        None if masks is None else stacked(lambda k: torch.from_numpy(masks[chosen[k]]), len(chosen), MASK_BYTES),
        of,
        labels_of,
        depth_of,
    )


def taught_labels(features: Features, rows: list[int]) -> Callable[[int], TaughtLabels]:
    """The labels of the training views, whose rows in the features these are; FEATURE_BYTES of a kind are kept."""
    import torch

    from chebsplat.views import TaughtLabels, remembered

    labels, confidence, codes = features.pseudo_labels, features.confidence, torch.from_numpy(features.label_embeddings)
    assert labels is not None
    assert confidence is not None

    classes = remembered(lambda index: torch.from_numpy(labels[rows[index]]).long(), FEATURE_BYTES)
    certainty = remembered(lambda index: torch.from_numpy(confidence[rows[index]]).float(), FEATURE_BYTES)

    def of(index: int) -> TaughtLabels:
        found = classes(index)
        return TaughtLabels(found, certainty(index), codes, bool((found >= 0).all()))

    return of


def with_feature_loss(train: TrainSection, features: Features | None) -> TrainSection:
    """The loss that features ask for, where the config leaves it open. Raises ConfigError if theirs cannot be had."""
    if features is None:
        return train
    if train.feature_loss is None:
        given = features.convention.get("kind") == "given"
        return train.model_copy(update={"feature_loss": "cross-entropy" if given else "length"})
    if train.feature_loss == "cross-entropy" and (features.pseudo_labels is None or features.confidence is None):
        raise ConfigError(
            "train.feature_loss is cross-entropy, but the teacher brings no labels with a confidence; use length"
        )
    return train


def model_of(
    points: Points,
    features: Features | None,
    train: TrainSection,
    describe: DescribeSection,
    device: str = "cpu",
    backend: str = "auto",
) -> SceneModel:
    """The scene before training: a Gaussian at each point, or those of `train.start`; modules drawn by the training's
    seed. backend: of `rasterize`.
    """
    import torch

    from chebsplat.splats.gaussians import initial_gaussians
    from chebsplat.training.model import SceneModel

    torch.manual_seed(train.seed)
    if train.start:
        initial = started(Path(train.start), train)
    else:
        opacity = start_opacity(points) if train.opacity is None else train.opacity
        initial = initial_gaussians(points.means, points.colors, points.covariances, opacity)
    raw = {name: value.to(device) for name, value in initial.items()}
    return SceneModel(raw, describe, train, None if features is None else features.features.shape[-1], backend)


def begin_features(
    job: Job, model: SceneModel, capture: Capture, points: Points, features: Features, n_views: int
) -> None:
    """Features begin lifted where `starts_lifted` says so; otherwise at nothing, and it is noted."""
    from chebsplat.training.schedule import starts_lifted

    given = job.config.train.feature_start
    if not starts_lifted(job.config.train, n_views):
        why = f"of {n_views} training views it costs colour" if given is None else f"train.feature_start is {given}"
        job.left_out("lifted start of features", why)
    elif not start_features(model, capture, points, features, job.progress):
        job.left_out("lifted start of features", "no training view says anything of a Gaussian")


def start_features(model: SceneModel, capture: Capture, points: Points, features: Features, progress: Progress) -> int:
    """Features begin as what the teacher says of the Gaussians where they are, by one pass over the training views.

    Returns: of how many Gaussians anything is said.
    Choices: means of the views, without steps towards their median: training follows.
    """
    import torch

    from chebsplat.formats.cameras import Cameras
    from chebsplat.stages.lift import lifted_from
    from chebsplat.stages.settings import LiftSection

    cameras = Cameras(points.names, points.Ks, points.cam_from_world, *capture.size)
    parameters = {name: value.detach().cpu().numpy() for name, value in model.raw.items()}
    try:
        gate = LiftSection().gate
        lifted = lifted_from(capture, cameras, parameters, features, gate, progress, median_steps=0)
    except DataFailure:
        return 0
    with torch.no_grad():
        model.raw["features"].copy_(torch.from_numpy(lifted.features))
    return int(lifted.features.any(1).sum())


def start_opacity(points: Points) -> float:
    """Of the Gaussians that start at these points.

    Choices: where depth is measured there is a surface at each point; matched and swept ones are less sure of it.
    """
    return 0.7 if points.notes.get("how") == "depth" or "n_from_depth" in points.notes else 0.3


def started(ply: Path, train: TrainSection) -> dict[str, Tensor]:
    """Raw parameters of the Gaussians of a 3DGS PLY, in the frame of the scene's cameras, with its SH bands.

    Raises: InputError naming the file; ConfigError where they are more than `train.max_gaussians`.
    """
    import torch

    from chebsplat.formats.ply import read_ply

    parameters, degree, _ = read_ply(ply)
    n = len(parameters["means"])
    if n == 0:
        raise InputError(f"{ply} holds no Gaussians; choose another train.start")
    if n > train.max_gaussians:
        raise ConfigError(f"{ply} holds {n} Gaussians; set train.max_gaussians={n} or more")
    raw = {name: parameters[name] for name in ("means", "log_scales", "quats", "logit_opacities", "sh0")}
    for band in range(1, min(degree, train.sh_degree) + 1):
        raw[f"sh{band}"] = parameters["shN"][:, band**2 - 1 : (band + 1) ** 2 - 1]
    return {name: torch.tensor(values, dtype=torch.float32) for name, values in raw.items()}


def knowledge(job: Job, model: SceneModel, train: TrainSection) -> dict[str, Tensor]:
    """Bases of earlier scenes; with `train.warm_start` the encoder also starts from their weights."""
    if "basis" not in job.inputs or model.shape is None:
        return {}
    import torch

    from chebsplat.formats.basis import read_basis

    basis, maps = read_basis(job.inputs["basis"]), model.shape.encoder.linear_maps()
    unfit, wrong = without_basis(maps, basis.bases)
    if wrong:
        raise InputError(f"{job.inputs['basis']} does not fit the encoder at {wrong[0]}; start another sequence")
    if unfit:
        job.left_out(f"knowledge of {', '.join(unfit)}", "the earlier encoder has none of this shape")
    if train.warm_start:
        state = model.shape.encoder.state_dict()
        fitting = {k: torch.from_numpy(v) for k, v in basis.weights.items() if k in state and state[k].shape == v.shape}
        model.shape.encoder.load_state_dict(state | fitting)
        model.shape.keeps_norm = any(name.startswith("norm_input.") for name in fitting)
        job.facts["warm_started"] = len(fitting)
        if other := sorted(state.keys() - fitting.keys()):
            job.left_out(f"warm start of {', '.join(other)}", "the earlier encoder has none of this shape")
    followed = maps.keys() - set(unfit) if train.weight_basis > 0 else set()
    return {name: torch.from_numpy(basis.bases[name]) for name in maps if name in followed}


def within_cap(job: Job, points: Points) -> Points:
    """The points that a training starts from: all, or as many as `max_gaussians` lets in."""
    from chebsplat.formats.points import thinned

    n, most = len(points.means), job.config.train.max_gaussians
    if n > most:
        job.left_out(f"{n - most} of {n} initial points, and regions of all", f"train.max_gaussians is {most}")
    return thinned(points, most, job.config.train.seed)


def described(job: Job, points: Points) -> Descriptors | None:
    """The describe stage's regions where there are any. Raises InputError unless they are of these points and settings.

    They are read before anything is built, so that a wrong artifact costs no time.
    """
    from chebsplat.formats.descriptors import read_descriptors

    if "descriptors" not in job.inputs:
        return None
    path = job.inputs["descriptors"]
    stored = read_descriptors(path)
    if max(stored.members.max(initial=-1), stored.centers.max(initial=-1)) >= len(points.means):
        raise InputError(f"{path} describes other points; run the describe stage on these points")
    describe = job.config.describe
    wrong = [f"describe.{name}" for name, value in describe.model_dump().items() if stored.settings.get(name) != value]
    if wrong:
        raise InputError(f"{path} has another {wrong[0]}; run the describe stage with this config")
    if stored.values.shape[1:3] != (stored.members.shape[1], describe.n_angles):
        raise InputError(f"{path} has descriptors of another shape; run the describe stage again")
    return stored


def first_regions(stored: Descriptors | None) -> tuple[Regions | None, Tensor | None]:
    """The describe stage's regions and descriptors for a training to start from; None: it makes its own."""
    import torch

    from chebsplat.shape.regions import Regions

    if stored is None:
        return None, None
    regions = Regions(stored.centers, stored.members, stored.settings["radius"], stored.settings["share"])
    return regions, torch.from_numpy(stored.values)
