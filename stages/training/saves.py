"""An interrupted training goes on where it was last saved, to the same bytes."""

from __future__ import annotations

import logging
import time
from importlib.metadata import version
from typing import Any

import torch

from chebsplat.formats.artifact import digest, read_manifest
from chebsplat.formats.files import atomic_path
from chebsplat.stages.runtime.command import Job, n_threads

log = logging.getLogger("chebsplat")
SECONDS = 30.0  # between two saves
LAYOUT = 3  # of a state: one of another layout is not gone on from


class Saves:
    """States of one training, the last one kept, in the job's scratch folder.

    A state fits only the same settings, inputs, package versions, device and number of threads:
    from another one the training starts anew and says so.
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
                "threads": n_threads(),
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
            held = torch.load(self.file, weights_only=True)
        except Exception as error:  # whatever a damaged file makes torch raise
            log.warning("%s is damaged (%s): training starts anew", self.file, error)
            return None
        if held["identity"] != self.identity:
            log.warning("%s is of another training: this one starts anew", self.file)
            return None
        self.job.watch.go_on(self.job.scratch)
        return dict(held["state"])

    def offer(self, state: Any, now: bool = False) -> None:
        """Save what `state()` returns if the last save is long ago, or `now`: whole or not at
        all.
        """
        if not now and time.monotonic() - self.saved < SECONDS:
            return

        self.saved, held = time.monotonic(), {"identity": self.identity, "state": state()}
        try:
            with atomic_path(self.file) as temporary, temporary.open("wb") as handle:
                torch.save(held, handle)
            self.job.watch.keep(self.job.scratch)
        except (OSError, RuntimeError) as error:  # torch has its own word for a full disk
            log.warning("%s cannot be saved (%s): the training goes on without", self.file, error)
