"""Descriptors that follow Gaussians in training: only regions whose members changed are described anew."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from chebsplat.settings import DescribeSection
from chebsplat.shape.described import n_degrees
from chebsplat.shape.descriptor import describe_members


class GaussianIds:
    """A number for each Gaussian that it keeps while others are removed or added behind the last."""

    def __init__(self) -> None:
        self.ids, self.next = np.zeros(0, np.int64), 0

    def of(self, n: int) -> np.ndarray:
        """Ids i64 [n] of the Gaussians as they are now."""
        added = n - len(self.ids)
        if added < 0:
            raise ValueError(f"{-added} Gaussians were removed and not announced")
        self.ids = np.concatenate([self.ids, np.arange(self.next, self.next + added)])
        self.next += added
        return self.ids

    def keep(self, rows: np.ndarray) -> None:
        """Those where `rows` [N] is false are gone; an order i64 [N] instead sorts them anew."""
        self.ids = self.of(len(rows))[rows]

    def state_dict(self, n: int) -> dict[str, Any]:
        """Of n Gaussians."""
        return {"ids": torch.from_numpy(self.of(n)), "next": self.next}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.ids, self.next = state["ids"].numpy(), state["next"]


class Descriptors:
    """Descriptors of regions beside the Gaussians that they were computed from.

    Their values are those of `describe_members`, bit for bit. Args: settings: of the descriptor.
    """

    def __init__(self, settings: DescribeSection):
        self.settings = settings
        self.n_described = self.n_regions = 0  # over all calls
        self.forget()

    @property
    def share_described(self) -> float:
        """Of the regions seen in all calls, the part that was described anew."""
        return self.n_described / max(self.n_regions, 1)

    def forget(self, region_size: int = 0) -> None:
        """Compare with nothing: the next `update` describes every region."""
        size = self.settings.n_angles * n_degrees(
            self.settings.spectrum, self.settings.max_degree, self.settings.from_degree
        )
        self.given = torch.zeros(0, region_size, 10)
        self.mask = torch.zeros(0, region_size, dtype=torch.bool)
        self.values = torch.zeros(0, region_size, size)

    def keep(self, rows: Tensor) -> None:
        """Of the regions, only `rows` [M] bool are left; the Gaussians' own indices do not matter here."""
        if len(rows) == len(self.values):
            self.given, self.mask, self.values = self.given[rows], self.mask[rows], self.values[rows]

    def state_dict(self) -> dict[str, Any]:
        """What the next `update` compares with, and the counts: tensors, not copied, and plain values."""
        counts = {"n_described": self.n_described, "n_regions": self.n_regions}
        return {"given": self.given, "mask": self.mask, "values": self.values} | counts

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.given, self.mask, self.values = state["given"], state["mask"], state["values"]
        self.n_described, self.n_regions = state["n_described"], state["n_regions"]

    def update(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        members: Tensor,
        known: Tensor | None = None,
    ) -> Tensor:
        """Descriptors [M, n, J P] of Gaussians [N] gathered by members [M, n], -1 where padded.

        Row r is compared with row r of the last call; rows may have been appended. `known` [M, n, J, P] spares the
        computation of all.
        """
        index, mask = members.clamp_min(0), members >= 0
        given = torch.cat([means[index], log_scales[index], quats[index]], -1)
        given = torch.where(mask[..., None], given, 0.0)
        if known is not None:
            self.given, self.mask, self.values = given, mask, known.flatten(2)
            return self.values
        if self.values.shape[1] != members.shape[1]:
            self.forget(members.shape[1])
        n_before = min(len(self.values), len(members))
        same = (given[:n_before] == self.given[:n_before]).all(-1).all(-1)
        same &= (mask[:n_before] == self.mask[:n_before]).all(-1)
        changed = torch.cat([~same, torch.ones(len(members) - n_before, dtype=torch.bool)])
        gaussians = means.numpy(), quats.numpy(), log_scales.exp().numpy()
        described = torch.from_numpy(describe_members(*gaussians, members[changed].numpy(), self.settings).values)
        values = described.new_zeros(len(members), members.shape[1], self.values.shape[2])
        before = values.new_zeros(len(members), *given.shape[1:])
        values[:n_before], before[:n_before] = self.values[:n_before], self.given[:n_before]
        values[changed], before[changed] = described.flatten(2), given[changed]
        self.values, self.given, self.mask = values, before, mask
        self.n_described += int(changed.sum())
        self.n_regions += len(members)
        return values
