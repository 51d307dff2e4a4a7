"""What computes: the CPU, until training on a GPU is there."""

from __future__ import annotations

from pathlib import Path

from chebsplat.errors import ConfigError

DRIVER = Path("/proc/driver/nvidia/version")  # there where an NVIDIA driver is
NO_GPU = "this version does not train on a GPU yet"
DEVICES = ("auto", "cpu", "cuda")


def resolve(wanted: str, driver: Path | None = None) -> tuple[str, str]:
    """What computes, and why it is not the GPU of a machine that has one ("": there is nothing to say).

    Args: driver: a file that is there where an NVIDIA driver is; default: DRIVER.
    Raises: ConfigError on `cuda`.
    """
    present = (driver or DRIVER).exists()
    if wanted == "cuda":
        lead = "an NVIDIA driver was found, but" if present else "no NVIDIA driver was found, and"
        raise ConfigError(f"--device cuda: {lead} {NO_GPU}; use cpu, or auto")
    mention = wanted == "auto" and present
    return "cpu", f"an NVIDIA driver was found, but {NO_GPU}: everything runs on the CPU" if mention else ""
