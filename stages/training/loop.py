"""The steps of a training with its trace of error against run time, saved and resumed."""

from __future__ import annotations

import logging
from collections import deque
from functools import partial
from typing import Any

import numpy as np
from torch import Tensor

from chebsplat.stages.runtime.command import Job
from chebsplat.stages.runtime.stopping import deferred
from chebsplat.stages.training.saves import Saves
from chebsplat.training.trainer import Trainer

log = logging.getLogger("chebsplat")


def follow(job: Job, trainer: Trainer) -> list[dict[str, float]]:
    """Run the steps, from the last save where there is one; returns the trace.

    A row holds means of the losses since the row before; its seconds are those of training alone,
    without measurements.
    """
    n_views = len(trainer.views.names)
    watched = list(range(0, n_views, max(n_views // 4, 1)))[:4]
    saves, train = Saves(job), trainer.settings
    trace: list[dict[str, float]] = []
    since: list[dict[str, float | Tensor]] = []
    if (saved := saves.load()) is not None:
        trainer.load_state_dict(saved["trainer"])
        trace, since = saved["trace"], saved["since"]
        job.facts["resumed_at"] = [*saved["resumed_at"], trainer.step]
        log.info("resumed at step %d", trainer.step)
    with deferred() as request:
        # features have a loss in one step of so many
        losses: deque[float | Tensor] = deque(maxlen=trainer.feature_every)
        rounds = job.progress.track(
            trainer.steps(), lambda: expected(trainer), "train", start=trainer.step
        )
        for figures, status in rounds:
            since.append(figures)
            if trainer.step % train.report_every == 0 or trainer.share >= 1:
                trace.append(trace_row(trainer, since, watched))
                since = []
                job.progress.record(**trace[-1])
            losses.append(figures["loss"])
            if trainer.reads:
                mean = np.mean([float(loss) for loss in losses])
                status |= {"mean loss": f"{mean:.4f}", "gaussians": figures["n"]}
                status |= describe_last(trace)
            saves.offer(partial(state, trainer, trace, since, job), now=request.stop is not None)
            if request.stop is not None:
                log.info("saved at step %d; the same command goes on from there", trainer.step)
                break
    columns = sorted(
        {k for row in trace for k in row}, key=lambda k: (k != "step", k != "seconds", k)
    )
    return [{k: row.get(k, 0.0) for k in columns} for row in trace]


def trace_row(
    trainer: Trainer, since: list[dict[str, float | Tensor]], watched: list[int]
) -> dict[str, float]:
    """A row of the trace: figures of steps since the row before, PSNR of watched training views."""
    row: dict[str, float | Tensor] = {
        "step": trainer.step,
        "seconds": trainer.seconds,
        "n": since[-1]["n"],
    }
    for name in {name for entry in since for name in entry} - row.keys():
        # features have a loss in some steps only
        values = [entry[name] for entry in since if name in entry]
        row[name] = sum(values) / len(values)
    row |= {"psnr": trainer.held_in_psnr(watched), "sh_kept": trainer.model.sh_kept()}
    return {k: float(v) for k, v in row.items()}


def describe_last(trace: list[dict[str, float]]) -> dict[str, str]:
    """The last measurement, on training views, for the progress line."""
    return (
        {"train PSNR": f"{trace[-1]['psnr']:.2f}", "sh": f"{trace[-1]['sh_kept']:.0%}"}
        if trace
        else {}
    )


def expected(trainer: Trainer) -> int:
    """Expected number of steps, for the progress line."""
    return trainer.schedule.last_step(trainer.step, trainer.seconds)


def state(
    trainer: Trainer,
    trace: list[dict[str, float]],
    since: list[dict[str, float | Tensor]],
    job: Job,
) -> dict[str, Any]:
    """The state that a training resumes from."""
    resumed = job.facts.get("resumed_at", [])
    return {"trainer": trainer.state_dict(), "trace": trace, "since": since, "resumed_at": resumed}
