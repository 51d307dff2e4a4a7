"""Assembly of a trainer from artifacts and settings, for the stage and for every benchmark."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from chebsplat.cameras import extent
from chebsplat.errors import ConfigError, DataFailure, InputError
from chebsplat.formats.cameras import Cameras
from chebsplat.formats.capture import Capture
from chebsplat.formats.features import Features
from chebsplat.formats.gaussians import Gaussians
from chebsplat.formats.points import Points, thinned
from chebsplat.formats.splats import read_splats
from chebsplat.formats.world import HERE, World
from chebsplat.kernels.threads import n_threads
from chebsplat.settings import DescribeSection, TrainSection, default_gaussians
from chebsplat.splats.gaussians import initial_gaussians, sh0_of, surface_of
from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.progress import Progress
from chebsplat.stages.settings import LiftSection
from chebsplat.stages.training.defaults import (
    LIFTED_FROM,
    OPEN,
    decided,
    evidence_of,
    from_measured_depth,
    n_training_pixels,
    resolved,
)
from chebsplat.stages.training.lifting import lifted_from
from chebsplat.stages.training.photos import Exposures, exposures_of
from chebsplat.stages.training.placing import in_frame
from chebsplat.stages.training.views import training_views
from chebsplat.training.model import SceneModel
from chebsplat.training.printed import PrintedScene
from chebsplat.training.trainer import Trainer

log = logging.getLogger("chebsplat")
PRINTED_METHOD = "train.method is printed"
KNOWLEDGE = "knowledge."  # begins the names of bases among a training's modules


@dataclass
class Inputs:
    """Artifacts of a training. features: None without semantics; exposures: None where they are
    not measured.
    """

    capture: Capture
    points: Points
    features: Features | None = None
    exposures: Exposures | None = None


def read_inputs(job: Job) -> Inputs:
    """The artifacts that this training reads, with at most `train.max_gaussians` of the points.

    Raises: InputError if artifacts do not belong together or are damaged.
    """
    train = job.config.train
    capture = Capture.read(job.inputs["capture"])
    points = within_cap(job, capture, Points.read(job.inputs["points"]))
    learns = "features" in job.inputs and train.semantics and train.features == "trained"
    features = Features.read(job.inputs["features"]) if learns else None
    return Inputs(capture, points, features, measure_exposures(job, capture, points))


def assemble(job: Job, inputs: Inputs, backend: str = "auto") -> Trainer:
    """A trainer before its first step, its open settings resolved; adds facts on these, and on
    parts left out.

    Args: backend: of `rasterize`.
    Raises: ConfigError, InputError or DataFailure, as its parts do.
    """
    capture, points, features = inputs.capture, inputs.points, inputs.features
    evidence = evidence_of(job.config.train, capture, points, features)
    spread = inputs.exposures.spread if inputs.exposures else None
    train = resolved(job.config.train, replace(evidence, exposure_spread=spread))
    job.facts["decided"] = decided(job.config.train, train, features is not None)
    _note_left_out(job, train, features is not None, evidence.no_depth)
    # Our method's long operations are kernels, with threads of their own. What is left to torch is
    # short, and its threads wait for each other every time: for long on a shared machine.
    torch.set_num_threads(1 if train.method == "ours" else n_threads())
    model = model_of(points, features, train, job.config.describe, job.device, backend, capture)
    measured = None
    if train.exposure == "measured":
        assert inputs.exposures is not None
        measured = inputs.exposures.measured
        log.info("exposures of photos differ by %.2f stops: renders take them", spread)
    views = training_views(capture, points, features, bool(train.weight_depth), measured).to(
        job.device
    )
    if features is not None and train.feature_start == "lifted":
        if not start_features(model, capture, points, features, job.progress):
            job.left_out("lifted start of features", "no training view says anything of a Gaussian")
    elif features is not None:
        why = PRINTED_METHOD if train.method == "printed" else "train.feature_start is zero"
        if train.method == "ours" and job.config.train.feature_start in OPEN:
            why = f"of {len(views.names)} training views, fewer than {LIFTED_FROM}, it costs colour"
        job.left_out("lifted start of features", why)
    if isinstance(model, PrintedScene) and "earlier" in job.inputs:
        model.bases = knowledge_of(job.inputs["earlier"], model)
    return Trainer(model, views, train, extent(points.cam_from_world))


def knowledge_of(earlier: Path, model: PrintedScene) -> dict[str, Tensor]:
    """Bases of the training of the scene before (Eq 15).

    Raises: InputError if they are of an encoder of another shape.
    """
    modules = Gaussians.read(earlier).modules
    own = {n: torch.from_numpy(v) for n, v in modules.items() if n.startswith(KNOWLEDGE)}
    bases = {name.removeprefix(KNOWLEDGE): basis for name, basis in own.items()}
    maps = model.printed.encoder.key_projections()
    if any(name not in maps or len(basis) != len(maps[name]) for name, basis in bases.items()):
        raise InputError(f"{earlier} has knowledge of another encoder; start another sequence")
    return bases


def measure_exposures(job: Job, capture: Capture, points: Points) -> Exposures | None:
    """Exposures of the photos, whose spread becomes a fact; None where they are not needed."""
    train = job.config.train
    generated = train.exposure == "auto" and capture.source.get("kind") == "generated"
    if train.exposure == "off" or train.method == "printed" or generated:
        return None
    exposures = exposures_of(capture, points)
    job.facts["exposure_spread"] = exposures.spread
    return exposures


def _why_no_exposure(train: TrainSection, spread: float | None) -> str:
    """Reason for leaving photos' exposures as they are. spread: in stops; None: not measured."""
    if spread is not None:
        return f"photos differ by {spread:.2f} stops"
    return "train.exposure is off" if train.exposure == "off" else "views are generated, all alike"


def _note_left_out(job: Job, train: TrainSection, has_semantics: bool, no_depth: str) -> None:
    """Note the parts that this training leaves out, and why. train: resolved."""
    requested = job.config.train
    spread = job.facts.get("exposure_spread")
    if requested.method == "printed":
        for what in ("depth loss", "exposure by photo"):
            job.left_out(what, PRINTED_METHOD)
    else:
        if not train.weight_depth:
            job.left_out(
                "depth loss",
                "train.weight_depth is 0" if requested.weight_depth is not None else no_depth,
            )
        if train.exposure == "off":
            job.left_out("exposure by photo", _why_no_exposure(requested, spread))
    if not has_semantics:
        job.left_out("semantic branch", "colours alone are trained: no teacher's features are read")
    if train.without != "nothing":
        job.left_out(f"{train.without} of the printed method", "train.without")
    unneeded = {
        "pruning": [(not train.prune, "train.prune is false")],
        "densification": [(requested.densify == "off", "train.densify is off")],
        "SH pruning": [(not train.sh_prune, "train.sh_prune is false")],
    }
    for what, reasons in unneeded.items():
        applying = [reason for applies, reason in reasons if applies]
        if applying:
            job.left_out(what, applying[0])


def model_of(
    points: Points,
    features: Features | None,
    train: TrainSection,
    describe: DescribeSection,
    device: str = "cpu",
    backend: str = "auto",
    capture: Capture | None = None,
) -> SceneModel:
    """The scene before training: a Gaussian at each point, or those of `train.start`; modules drawn
    by the training's seed.

    Args: train: resolved; backend: of `rasterize`; capture: to find the frame of `train.start`.
    """
    torch.manual_seed(train.seed)
    if train.start:
        initial = read_start(Path(train.start), points, train, capture)
    else:
        assert train.opacity is not None
        initial = initial_gaussians(points.means, points.colors, points.covariances, train.opacity)
    raw = {name: value.to(device) for name, value in initial.items()}
    if train.method == "printed":
        if features is None:
            raise ConfigError("train.method = printed is semantic: it needs a teacher")
        return PrintedScene(raw, describe, train, features.features.shape[-1], backend)
    return SceneModel(
        raw, describe, train, None if features is None else features.features.shape[-1], backend
    )


def start_features(
    model: SceneModel, capture: Capture, points: Points, features: Features, progress: Progress
) -> int:
    """Initialise features by lifting the teacher's to the Gaussians, by one pass over views.

    Returns: number of Gaussians with features.
    Choices: means of the views, without steps towards their median: training follows.
    """
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


def read_start(
    ply: Path, points: Points, train: TrainSection, capture: Capture | None
) -> dict[str, Tensor]:
    """Raw parameters of a splat's Gaussians, with SH bands, in the frame of the scene's cameras.

    Raises: InputError naming the file, as `in_frame` does; ConfigError where they are more than
      `train.max_gaussians`.
    Choices: Gaussians all of one colour take that of the nearest of the scene's points: a training
      moves colours too slowly to find them.
    """
    world = HERE if capture is None else World.read(capture.source)
    parameters, degree, _ = read_splats(ply, world)
    n = len(parameters["means"])
    if n == 0:
        raise InputError(f"{ply} holds no Gaussians; choose another train.start")
    if n > (train.max_gaussians or n):
        raise ConfigError(f"{ply} holds {n} Gaussians; set train.max_gaussians={n} or more")
    if capture is not None:
        cameras = Cameras(points.names, points.Ks, points.cam_from_world, *capture.size)
        theirs = read_splats(ply)[0] if world.notes else None
        parameters = in_frame(ply, parameters, capture, cameras, points.means, theirs)
    raw = {
        name: parameters[name]
        for name in ("means", "log_scales", "quats", "logit_opacities", "sh0")
    }
    for band in range(1, min(degree, train.sh_degree) + 1):
        raw[f"sh{band}"] = parameters["shN"][:, band**2 - 1 : (band + 1) ** 2 - 1]
    colors = surface_of(parameters)[1]
    if np.abs(colors - np.median(colors, 0)).mean() < 1 / 255:
        log.warning(
            "%s has Gaussians of one colour; they take those of the points beside them", ply
        )
        raw["sh0"] = sh0_of(points.colors[cKDTree(points.means).query(parameters["means"])[1]])
    return {name: torch.tensor(values, dtype=torch.float32) for name, values in raw.items()}


def within_cap(job: Job, capture: Capture, points: Points) -> Points:
    """The points that a training starts from: all, or `max_gaussians` of them."""
    n, most = len(points.means), job.config.train.max_gaussians
    measured = from_measured_depth(points)
    most = most or default_gaussians(n_training_pixels(capture, points), measured)
    if n > most:
        job.left_out(f"{n - most} of {n} initial points", f"train.max_gaussians is {most}")
    return thinned(points, most, job.config.train.seed)
