"""Seconds, memory, processor, cores, threads, load of each process that worked on an artifact."""

from __future__ import annotations

import json
import logging
import os
import resource
import sys
import time
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from chebsplat.errors import InputError
from chebsplat.formats.files import atomic_write, parse_json
from chebsplat.kernels.threads import cores

log = logging.getLogger("chebsplat")
CPUS = Path("/proc/cpuinfo")  # which has no names on ARM
STATUS = Path("/proc/self/status")
PROCESSES = "processes.json"  # in the scratch folder of a stage that resumes


@cache
def processor() -> str:
    """The processor's name by Linux, or else LLVM's name of its kind."""
    lines = CPUS.read_text().splitlines() if CPUS.exists() else []
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    if name := next(named, ""):
        return name
    from llvmlite.binding import get_host_cpu_name

    return str(get_host_cpu_name())


def peak_megabytes() -> int:
    """Peak memory, MB, of this process or of its largest finished child, whichever is more."""
    unit = 1 if sys.platform == "darwin" else 1024  # bytes of ru_maxrss
    of = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    own, of_child = (resource.getrusage(who).ru_maxrss * unit for who in of)
    if STATUS.exists():  # Linux, whose ru_maxrss counts the parent when this process began
        lines = STATUS.read_text(encoding="utf-8").splitlines()
        own = next((1024 * int(s.split()[1]) for s in lines if s.startswith("VmHWM")), own)
    return round(max(own, of_child) / 1e6)


def load() -> float:
    """Processes that wanted a core of the machine in the last minute, anyone's."""
    return round(os.getloadavg()[0], 2)


@dataclass
class Stopwatch:
    """Seconds of this process and of earlier ones whose work it resumes, with their machines.

    A stage that resumes calls `keep` whenever it has saved something in its scratch folder, and
    `go_on` where it resumes from such a save: so the seconds are those of all work in the artifact.
    """

    threads: int = 1
    gpu: str = ""
    earlier: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.began = time.perf_counter()
        self.load = load()

    def processes(self) -> list[dict[str, Any]]:
        """processor, gpu, cores, threads, load at start and now, seconds, peak MB of each."""
        of_machine = {
            "processor": processor(),
            "gpu": self.gpu,
            "cores": cores(),
            "threads": self.threads,
        }
        seconds = round(time.perf_counter() - self.began, 3)
        spent = {"load": [self.load, load()], "seconds": seconds, "megabytes": peak_megabytes()}
        return [*self.earlier, of_machine | spent]

    def keep(self, scratch: Path) -> None:
        """Write the processes so far beside a save in the scratch folder."""
        atomic_write(scratch / PROCESSES, json.dumps(self.processes()))

    def go_on(self, scratch: Path) -> None:
        """Count the processes that have made the save in the scratch folder, too."""
        try:
            self.earlier = parse_json(scratch / PROCESSES)
        # a power cut may have damaged it; the save itself is worth more than its seconds
        except InputError as error:
            log.warning("seconds of what was done before are not counted: %s", error)
