"""train: the semantic Gaussian scene (Eqs 7-13), with its trace of error against run time."""

from __future__ import annotations

import logging
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any

from chebsplat.errors import DataFailure
from chebsplat.stages.runtime.command import Job, n_threads
from chebsplat.stages.runtime.stopping import deferred
from chebsplat.stages.training.depth import with_depth_loss
from chebsplat.stages.training.inputs import (
    begin_features,
    described,
    first_regions,
    knowledge,
    model_of,
    training_views,
    with_feature_loss,
    within_cap,
)
from chebsplat.stages.training.photos import exposures
from chebsplat.stages.training.saves import Saves

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from chebsplat.settings import TrainSection
    from chebsplat.training.trainer import Trainer

log = logging.getLogger("chebsplat")


def run(job: Job) -> None:
    """Optimise Gaussians, their semantics and the shape encoder (Eqs 7-13; docs/method.md, sections 3 to 8).

    Reads `capture`, `points` and, with semantics, `features`, `descriptors` and the `basis` of earlier scenes. Writes
    `gaussians`.
    """
    from chebsplat.cameras import extent
    from chebsplat.formats.cameras import Cameras
    from chebsplat.formats.capture import Capture
    from chebsplat.formats.features import Features
    from chebsplat.formats.gaussians import Gaussians
    from chebsplat.formats.points import Points

    train = job.config.train
    capture, given = Capture.read(job.inputs["capture"]), Points.read(job.inputs["points"])
    descriptors, points = described(job, given), within_cap(job, given)
    taught = "features" in job.inputs and train.semantics and train.features == "trained"
    features = Features.read(job.inputs["features"]) if taught else None
    train, without_depth = with_depth_loss(with_feature_loss(train, features), capture, points)
    if without_depth:
        job.left_out("depth loss", without_depth)
    note_left_out(job, train, features is not None)
    import torch  # once its inputs are known to be usable

    from chebsplat.training.trainer import Trainer

    torch.set_num_threads(n_threads())  # sums of torch depend on it; the same bytes are promised for the same number
    model = model_of(points, features, train, job.config.describe, job.device)
    n_initial = len(model)
    regions, described_values = first_regions(descriptors if points is given and not train.start else None)
    undone = exposures(job, capture, points)
    views = training_views(capture, points, features, bool(train.weight_depth), undone).to(job.device)
    if features is not None:
        begin_features(job, model, capture, points, features, len(views.names))
    trainer = Trainer(
        model,
        views,
        train,
        extent(points.cam_from_world),
        basis=knowledge(job, model, train),
        regions=regions,
        descriptors=described_values,
    )
    trace = follow(job, trainer, train)
    parameters, population = trainer.finish(), trainer.population
    if population.n_broken:
        log.warning("%d Gaussians became non-finite and were removed", population.n_broken)
    left = parameters["degrees"].size
    if left == 0:
        raise DataFailure("no Gaussian is left; lower train.weight_mask or raise train.min_gaussians")
    modules = {
        f"{n}.{k}": v.detach().cpu().numpy() for n, m in model.modules.items() for k, v in m.state_dict().items()
    }
    cameras = Cameras(points.names, points.Ks, points.cam_from_world, *capture.size)
    notes: dict[str, Any] = {"left_out": job.facts.get("left_out", {}), "n_added": population.n_added}
    notes |= {"n_removed": population.n_removed, "n_broken": population.n_broken, "n_initial": n_initial}
    if features is not None:
        notes |= {"label_names": features.label_names, "convention": features.convention}
    if model.shape is not None:
        encoder = model.shape.encoder
        notes["encoder"] = {"n_inputs": encoder.n_inputs, "n_channels": encoder.n_channels} | encoder.settings
        job.facts["described_anew"] = model.shape.described.share_described
        if train.inflation == 0:
            job.facts["guarded"] = model.shape.share_undefined
        if model.shape.modulation is not None and trainer.basis:
            job.facts["alpha"] = float(model.shape.modulation(model.shape.cache.mean(0)))
    if model.shape is not None and features is not None:
        job.facts["encoder"] = agreement(
            model.shape.alone().cpu().numpy(), parameters["features"], features.label_embeddings
        )
    if features is not None:
        mask = trainer.final_mask()
        soft = None if mask is None else mask.cpu().numpy()
        job.facts["guidance"] = guidance(parameters, soft, features.label_embeddings)
    timed = max(trainer.step - 1, 1)  # all but the first
    job.facts |= {"n_gaussians": left, "steps": trainer.step, "seconds_per_step": trace[-1]["seconds"] / timed}
    if job.device == "cuda":
        job.facts["peak_device_bytes"] = torch.cuda.max_memory_allocated()
    job.facts["milliseconds"] = {part: 1e3 * seconds / timed for part, seconds in trainer.laps.seconds.items()}
    Gaussians(parameters, cameras, modules, trace, notes).write(job.out)


def agreement(alone: np.ndarray, features: np.ndarray, embeddings: np.ndarray) -> dict[str, float]:
    """What encodings alone know: of the Gaussians, the part whose label [L, C] by them is that by their own features,
    and the part that has the commonest label, which an encoder that knows nothing reaches.
    """
    import numpy as np

    from chebsplat.labels.decode import decode_labels

    named, wanted = decode_labels(alone, embeddings), decode_labels(features, embeddings)
    return {"agreement": float((named == wanted).mean()), "commonest": float(np.bincount(wanted).max() / len(wanted))}


FEW = 20  # a class of fewer Gaussians has no mean worth comparing


def guidance(
    parameters: dict[str, np.ndarray], mask: np.ndarray | None, embeddings: np.ndarray
) -> dict[str, float | None]:
    """What shape and semantics changed: labels, and which Gaussians and SH bands go.

    Args: parameters: of a finished training; mask [N]: m̂ of its Gaussians, None without pruning; embeddings [L, C].
    Returns: `labels_changed`, the part of Gaussians whose label the fusion changed; `mask_spread` and `band_spread`,
      standard deviations over classes of the mean m̂ and of the mean share of SH coefficients kept. None: not there.
    """
    import numpy as np

    from chebsplat.labels.decode import decode_labels

    own = decode_labels(parameters["features"], embeddings)
    fused = decode_labels(parameters["fused"], embeddings) if "fused" in parameters else own

    def spread(values: np.ndarray) -> float:
        counts, sums = np.bincount(fused), np.bincount(fused, values)
        return float((sums / np.maximum(counts, 1))[counts >= FEW].std()) if (counts >= FEW).any() else 0.0

    kept = (parameters["degrees"].astype(np.float64) + 1) ** 2 / 16
    return {
        "labels_changed": float((own != fused).mean()) if "fused" in parameters else None,
        "mask_spread": None if mask is None else spread(mask.astype(np.float64)),
        "band_spread": spread(kept),
    }


def note_left_out(job: Job, train: TrainSection, has_semantics: bool) -> None:
    """Say what this training does without, and why."""
    if not has_semantics:
        why = "no teacher features: rendering only" if train.semantics else "train.semantics is false"
        if train.semantics and train.features == "lifted":
            why = "train.features is lifted: they follow the training"
        job.left_out("semantic branch", why)
    unneeded = {
        "shape encoder": [
            (not has_semantics, "no semantics to encode"),
            (not train.trains_encoder, f"train.encoder is {train.encoder}"),
        ],
        "pruning": [(not train.prune, "train.prune is false")],
        "densification": [(train.densify == "off", "train.densify is off")],
        "SH pruning": [(not train.sh_prune, "train.sh_prune is false")],
        "knowledge basis": [("basis" not in job.inputs, "no sequence is named: this scene starts from nothing")],
    }
    for what, reasons in unneeded.items():
        applying = [reason for applies, reason in reasons if applies]
        if applying:
            job.left_out(what, applying[0])


def follow(job: Job, trainer: Trainer, train: TrainSection) -> list[dict[str, float]]:
    """Run the steps, from the last save where there is one; returns the trace.

    A row holds means of the losses since the row before; its seconds count training alone, not the held-in
    measurements.
    """
    import numpy as np

    n_views = len(trainer.views.names)
    watched = list(range(0, n_views, max(n_views // 4, 1)))[:4]
    saves = Saves(job)
    trace: list[dict[str, float]] = []
    since: list[dict[str, float | Tensor]] = []
    if (held := saves.load()) is not None:
        trainer.load_state_dict(held["trainer"])
        trace, since = held["trace"], held["since"]
        job.facts["resumed_at"] = [*held["resumed_at"], trainer.step]
        log.info("resumed at step %d", trainer.step)
    with deferred() as asked:
        periods = train.encode_every, trainer.feature_every
        losses: deque[float | Tensor] = deque(maxlen=max(periods))  # some terms are in one step of so many alone
        rounds = job.progress.track(trainer.steps(), lambda: expected(trainer), "train", start=trainer.step)
        for figures, status in rounds:
            since.append(figures)
            if trainer.step % train.report_every == 0 or trainer.share >= 1:
                trace.append(measured(trainer, since, watched))
                since = []
                job.progress.record(**trace[-1])
            losses.append(figures["loss"])
            if trainer.reads:
                mean = np.mean([float(loss) for loss in losses])
                status |= {"mean loss": f"{mean:.4f}", "gaussians": figures["n"]} | shown(trace)
            saves.offer(partial(state, trainer, trace, since, job), now=asked.stop is not None)
            if asked.stop is not None:
                log.info("saved at step %d; the same command goes on from there", trainer.step)
                break
    columns = sorted({k for row in trace for k in row}, key=lambda k: (k != "step", k != "seconds", k))
    return [{k: row.get(k, 0.0) for k in columns} for row in trace]


def measured(trainer: Trainer, since: list[dict[str, float | Tensor]], watched: list[int]) -> dict[str, float]:
    """A row of the trace, from the figures of steps since the row before and the PSNR of the training views watched."""
    row: dict[str, float | Tensor] = {"step": trainer.step, "seconds": trainer.seconds, "n": since[-1]["n"]}
    for name in {name for entry in since for name in entry} - row.keys():
        values = [entry[name] for entry in since if name in entry]  # encodings have a loss in some steps only
        row[name] = sum(values) / len(values)
    row |= {"psnr": trainer.held_in_psnr(watched), "sh_kept": trainer.model.sh_kept()}
    return {k: float(v) for k, v in row.items()}


def shown(trace: list[dict[str, float]]) -> dict[str, str]:
    """What the progress line says of the last measurement: on views that are trained on, not on test views."""
    return {"train PSNR": f"{trace[-1]['psnr']:.2f}", "sh": f"{trace[-1]['sh_kept']:.0%}"} if trace else {}


def expected(trainer: Trainer) -> int:
    """How many steps there will be, for the progress line."""
    return trainer.schedule.last_step(trainer.step, trainer.seconds)


def state(
    trainer: Trainer, trace: list[dict[str, float]], since: list[dict[str, float | Tensor]], job: Job
) -> dict[str, Any]:
    """All that a resumed training goes on from."""
    resumed = job.facts.get("resumed_at", [])
    return {"trainer": trainer.state_dict(), "trace": trace, "since": since, "resumed_at": resumed}
