"""Choice of the device: an NVIDIA GPU where torch and gsplat can use one, otherwise the CPU."""

from __future__ import annotations

from pathlib import Path

from chebsplat.errors import ConfigError

DRIVER = Path("/proc/driver/nvidia/version")  # there where an NVIDIA driver is
DEVICES = ("auto", "cpu", "cuda")
REMEDY = "`make setup device=cuda` adds it"


def resolve(requested: str) -> tuple[str, str]:
    """The device, `cpu` or `cuda`, and why a machine's GPU is not used, "" where there is none.

    Raises: ConfigError, with the remedy, on `cuda` where something is missing.
    Choices: `auto` loads no torch on a machine without an NVIDIA driver; `cuda` does in any case.
    """
    if requested == "cpu" or (requested == "auto" and not DRIVER.exists()):
        return "cpu", ""
    lack = missing()
    if not lack:
        return "cuda", ""
    if requested == "cuda":
        raise ConfigError(f"--device cuda: {lack}; or use cpu, or auto")
    return "cpu", f"an NVIDIA driver was found, but {lack}: everything runs on the CPU"


def name_of(device: str) -> str:
    """The GPU's name; nothing of the CPU."""
    if device != "cuda":
        return ""
    import torch

    return torch.cuda.get_device_name()


def missing() -> str:
    """Reason why no GPU can train here, with its remedy; "" where one can."""
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
