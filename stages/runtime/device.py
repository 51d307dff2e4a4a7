"""What computes: an NVIDIA GPU where torch and gsplat can use one, otherwise the CPU, and why."""

from __future__ import annotations

from pathlib import Path

from chebsplat.errors import ConfigError

DRIVER = Path("/proc/driver/nvidia/version")  # there where an NVIDIA driver is
DEVICES = ("auto", "cpu", "cuda")
REMEDY = "`make setup device=cuda` adds it"


def resolve(wanted: str) -> tuple[str, str]:
    """What computes, `cpu` or `cuda`, and why it is not the GPU of a machine that has one ("":
    nothing is to be said).

    Raises: ConfigError, with the remedy, on `cuda` where something is missing.
    Choices: `auto` loads no torch to ask it on a machine without an NVIDIA driver; `cuda` asks it
      in any case.
    """
    if wanted == "cpu" or (wanted == "auto" and not DRIVER.exists()):
        return "cpu", ""
    lack = missing()
    if not lack:
        return "cuda", ""
    if wanted == "cuda":
        raise ConfigError(f"--device cuda: {lack}; or use cpu, or auto")
    return "cpu", f"an NVIDIA driver was found, but {lack}: everything runs on the CPU"


def name_of(device: str) -> str:
    """The GPU's name; nothing of the CPU."""
    if device != "cuda":
        return ""
    import torch

    return torch.cuda.get_device_name()


def missing() -> str:
    """What a GPU lacks here to train on it, and what adds it: CUDA in torch, an answer, or gsplat;
    "": nothing.
    """
    import torch

    if torch.version.cuda is None:
        return f"torch {torch.__version__} is built without CUDA ({REMEDY})"
    if not torch.cuda.is_available():
        return (
            "no GPU answers (`nvidia-smi` says more; the driver must know CUDA "
            + torch.version.cuda
            + ")"
        )
    try:
        import gsplat  # noqa: F401
    except ImportError as error:
        return f"gsplat cannot be imported: {error} ({REMEDY})"
    return ""
