"""Rows of parameters and of the optimizer's moments as Gaussians come, go and change order."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from chebsplat.training.densify import Additions


def select(raw: dict[str, Tensor], keep: Tensor) -> dict[str, Tensor]:
    """Rows `keep` [N] bool of tensors [N, ...], or [N_l, ...] of the first N_l Gaussians alone."""
    return {name: value.detach()[keep[: len(value)]] for name, value in raw.items()}


def append(raw: dict[str, Tensor], rows: dict[str, Tensor]) -> dict[str, Tensor]:
    """Every tensor [N, ...] followed by its new rows [A, ...]; ValueError if they do not fit."""
    if raw.keys() != rows.keys() or len({len(value) for value in rows.values()}) > 1:
        shapes = {name: tuple(value.shape) for name, value in rows.items()}
        raise ValueError(f"rows {shapes} do not fit parameters {sorted(raw)}")
    return {name: torch.cat([value.detach(), rows[name].to(value)]) for name, value in raw.items()}


def prune_optimizer(optimizer: torch.optim.Optimizer, raw: dict[str, Tensor], keep: Tensor) -> None:
    """Keep rows `keep` [N] of parameters and moments; `raw` and groups get the new leaves."""
    _replace(optimizer, raw, select(raw, keep), lambda moment: moment[keep[: len(moment)]])


def reorder_optimizer(
    optimizer: torch.optim.Optimizer, raw: dict[str, Tensor], rows: dict[str, Tensor]
) -> None:
    """Put rows i64, by name, in place of parameters and moments; drop what has none left."""
    for name, order in rows.items():
        _replace(
            optimizer,
            raw,
            {name: raw[name].detach()[order]},
            partial(torch.index_select, dim=0, index=order),
        )
        if len(order) == 0:
            drop(optimizer, raw, name)


def drop(optimizer: torch.optim.Optimizer, raw: dict[str, Tensor], name: str) -> None:
    """One parameter less to hold and to train."""
    gone = raw.pop(name)
    optimizer.state.pop(gone, None)
    for group in optimizer.param_groups:
        group["params"][:] = [parameter for parameter in group["params"] if parameter is not gone]
    optimizer.param_groups[:] = [group for group in optimizer.param_groups if group["params"]]


def extend_optimizer(
    optimizer: torch.optim.Optimizer, raw: dict[str, Tensor], rows: dict[str, Tensor]
) -> None:
    """Append rows [A, ...] to parameters; their moments start at zero, those of the others stay.

    Choices: the step count is one for a parameter, so new rows share it: their first steps are up
      to 3 times longer.
    """
    count = len(next(iter(rows.values())))
    _replace(
        optimizer,
        raw,
        append(raw, rows),
        lambda moment: torch.cat([moment, moment.new_zeros(count, *moment.shape[1:])]),
    )


def apply_additions(
    optimizer: torch.optim.Optimizer, raw: dict[str, Tensor], additions: Additions
) -> None:
    """Write what the parents take on, with zero moments where it differs, and append the new rows.

    Choices: a clone's parent, unchanged, keeps its moments, so that the two do not move as one for
      ever.
    """
    if len(additions.parents) == 0:
        return
    with torch.no_grad():
        for name, values in additions.changed.items():
            differs = (raw[name][additions.parents] != values).reshape(len(values), -1).any(1)
            parents = additions.parents[differs]
            raw[name][parents] = values[differs]
            for moment in _moments(optimizer, raw[name]).values():
                moment[parents] = 0.0
    extend_optimizer(optimizer, raw, additions.rows)


def forget(optimizer: torch.optim.Optimizer, parameter: Tensor) -> None:
    """Zero the moments of a parameter."""
    for moment in _moments(optimizer, parameter).values():
        moment.zero_()


def _moments(optimizer: torch.optim.Optimizer, parameter: Tensor) -> dict[str, Tensor]:
    """Moments that the optimizer has for each entry of a parameter; its step count is none."""
    state = optimizer.state.get(parameter, {})
    return {
        k: v
        for k, v in state.items()
        if isinstance(v, Tensor) and v.ndim and v.shape == parameter.shape
    }


def _replace(
    optimizer: torch.optim.Optimizer,
    raw: dict[str, Tensor],
    values: dict[str, Tensor],
    moved: Callable[[Tensor], Tensor],
) -> None:
    for name, value in values.items():
        old = raw[name]
        raw[name] = fresh = value.clone().requires_grad_(old.requires_grad)
        for group in optimizer.param_groups:
            group["params"][:] = [
                fresh if parameter is old else parameter for parameter in group["params"]
            ]
        moments = {key: moved(moment) for key, moment in _moments(optimizer, old).items()}
        state = optimizer.state.pop(old, {})
        if state:
            optimizer.state[fresh] = state | moments
