"""Adam, whose step on the CPU is a kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from chebsplat.kernels.threads import in_parts

TINY = 1e-15  # added to the root of the mean square


def adam(groups: list[dict[str, Any]]) -> torch.optim.Adam:
    """Of groups of parameters: torch's fused one on a GPU, the kernel's for float32 on the CPU."""
    parameters = [parameter for group in groups for parameter in group["params"]]
    if all(p.device.type == "cpu" and p.dtype == torch.float32 for p in parameters):
        return KernelAdam(groups)
    return torch.optim.Adam(groups, eps=TINY, fused=True)


class KernelAdam(torch.optim.Adam):
    """Adam of contiguous float32 on the CPU, with torch's own state and default settings.

    Choices: a training gives torch one thread (`stages.training.assembly`), and this step is long
      enough to be worth more. The same bits for any number of the kernel's threads.
    """

    def __init__(self, groups: list[dict[str, Any]]):
        super().__init__(groups, eps=TINY)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """One step of every parameter that has a gradient; a closure is refused."""
        from chebsplat.training.adam_kernel import update

        if closure is not None:
            raise ValueError("KernelAdam takes no closure")
        for group in self.param_groups:
            rate, tiny, betas = group["lr"], np.float32(group["eps"]), group["betas"]
            shares = [np.float32(1 - beta) for beta in betas]
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"] = torch.zeros_like(parameter)
                    state["exp_avg_sq"] = torch.zeros_like(parameter)
                state["step"] += 1
                count = state["step"].item()
                size = np.float32(rate / (1 - betas[0] ** count))
                scale = np.float32(1 / math.sqrt(1 - betas[1] ** count))
                moments = state["exp_avg"], state["exp_avg_sq"]
                tensors = parameter, parameter.grad.contiguous(), *moments
                flat = [tensor.view(-1).numpy() for tensor in tensors]
                in_parts(update, len(flat[0]), *flat, size, scale, tiny, *shares)
