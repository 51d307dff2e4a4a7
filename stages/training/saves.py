"""Saves of a training, from which an interrupted one resumes to the same bytes."""

from __future__ import annotations

import logging
import time
from importlib.metadata import version
from typing import Any

import torch

from chebsplat.formats.artifact import digest, read_manifest
from chebsplat.formats.files import atomic_path
from chebsplat.stages.runtime.command import Job

log = logging.getLogger("chebsplat")
SECONDS = 30.0  # between two saves
LAYOUT = 3  # of a state: one of another layout is not resumed


class Saves:
    """Saves of the state of one training in the job's scratch folder; the last one stays.

    A state fits only the same settings, inputs, package versions, device and number of torch's
    threads: otherwise the training starts anew, with a warning.
    """

    def __init__(self, job: Job):
        inputs = {role: read_manifest(path).key for role, path in job.inputs.items()}
        settings = job.config.sections(("describe", "train"))
        versions = {name: version(name) for name in ("torch", "numba")}
        self.identity = digest(
            {
                "inputs": inputs,
                "config": settings,
                "device": job.device,
                "versions": versions,
                "threads": torch.get_num_threads(),
                "layout": LAYOUT,
            }
        )
        self.job, self.file = job, job.scratch / "training.pt"
        self.saved = time.monotonic()

    def load(self) -> dict[str, Any] | None:
        """The last state, or None."""
        if not self.file.is_file():
            return None
        try:
            save = torch.load(self.file, weights_only=True)
        except Exception as error:  # torch raises any kind on a damaged file
            log.warning("%s is damaged (%s): training starts anew", self.file, error)
            return None
        if save["identity"] != self.identity:
            log.warning("%s is of another training: this one starts anew", self.file)
            return None
        self.job.watch.go_on(self.job.scratch)
        return dict(save["state"])

    def offer(self, state: Any, now: bool = False) -> None:
        """Save `state()`, whole or not at all, if the last save is long ago, or `now`."""
        if not now and time.monotonic() - self.saved < SECONDS:
            return

        self.saved, save = time.monotonic(), {"identity": self.identity, "state": state()}
        try:
            with atomic_path(self.file) as temporary, temporary.open("wb") as handle:
                torch.save(save, handle)
            self.job.watch.keep(self.job.scratch)
        except (OSError, RuntimeError) as error:  # torch has its own word for a full disk
            log.warning("%s cannot be saved (%s): the training goes on without", self.file, error)
