"""Slight corrections of camera poses, learned from photos with the scene, or against it.

A correction is a twist ξ = (ω, τ) in the camera's frame, radians and scene units: x' = x + ω × x + τ to first order.
The rasterizer gives cameras no gradient; Gaussians that are moved the other way round have the same picture. So every
step renders at the pose that was reached, and moves the Gaussians in view by a twist of zero, which changes nothing but
has a gradient.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from chebsplat.training.row_adam import RowAdam
from chebsplat.views import View

DECAYS = 0.7, 0.95  # of the moments: a view is seen a dozen times in a short training, too seldom for Adam's own
DAMPING = 1e-3  # of the least eigenvalues of a preconditioner, relative to their mean


def hat(vectors: Tensor) -> Tensor:
    """Matrices [..., 3, 3] of the cross product with vectors [..., 3]."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.stack(rows, -2)


def motion(twists: Tensor) -> Tensor:
    """Rigid motions exp(ξ) [..., 4, 4] of twists [..., 6]."""
    generator = twists.new_zeros(*twists.shape[:-1], 4, 4)
    generator[..., :3, :3], generator[..., :3, 3] = hat(twists[..., :3]), twists[..., 3:]
    motions: Tensor = torch.linalg.matrix_exp(generator)
    last = motions.new_tensor([0, 0, 0, 1]).expand(*motions.shape[:-2], 1, 4)  # exactly: poses are tested for it
    return torch.cat([motions[..., :3, :], last], -2)


def small_twist(motions: Tensor) -> Tensor:
    """Twists [..., 6] of motions [..., 4, 4] that are near the identity, to first order."""
    turn = 0.5 * (motions[..., :3, :3] - motions[..., :3, :3].mT)
    return torch.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0], *motions[..., :3, 3].unbind(-1)], -1)


def moved(means: Tensor, quats: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Means [V, 3] and quaternions [V, 4] wxyz as they are, with the gradient to `view.twist` of moving the camera."""
    assert view.twist is not None
    turn, shift = (part @ view.viewmat[:3, :3] for part in view.twist.split(3))  # in the world
    eye = -view.viewmat[:3, 3] @ view.viewmat[:3, :3]
    turned = torch.linalg.cross(turn.expand_as(means), means.detach() - eye)
    w, xyz = quats.detach().split([1, 3], -1)
    across = torch.linalg.cross(turn.expand_as(xyz), xyz)
    slope = torch.cat([-(turn * xyz).sum(-1, keepdim=True), w * turn + across], -1)
    return means + turned + shift, quats + 0.5 * slope


def preconditioner(points: Tensor, K: Tensor, viewmat: Tensor, size: tuple[int, int]) -> Tensor:
    """P [6, 6] float64 such that the twist P z moves the points in view by about |z| pixels (CamP, Park et al. 2023).

    Args: points [N, 3] of the scene; K [3, 3]; viewmat [4, 4]; size: width, height.
    Choices: (JᵀJ / n)^(-1/2), J the projection's Jacobian; turning and shifting a camera move a picture almost alike,
      and a step in either alone is a step back in the other. Zero, so that the pose stays, where under 16 points are
      in view.
    """
    camera = points.double() @ viewmat[:3, :3].double().T + viewmat[:3, 3].double()
    camera = camera[camera[:, 2] > 1e-3]
    image = (camera / camera[:, 2:]) @ K.double().T
    camera = camera[((image[:, :2] >= 0) & (image[:, :2] < torch.tensor(size))).all(1)]
    if len(camera) < 16:
        return torch.zeros(6, 6, dtype=torch.float64)
    depth = camera[:, 2].median()
    x, y, z = camera.unbind(-1)
    zero, fx, fy = torch.zeros_like(z), K[0, 0].double(), K[1, 1].double()
    onto = torch.stack(
        [torch.stack([fx / z, zero, -fx * x / z**2], -1), torch.stack([zero, fy / z, -fy * y / z**2], -1)], -2
    )
    jacobian = torch.cat([onto @ -hat(camera), onto * depth], -1).flatten(0, 1)  # shifts in units of the depth
    values, axes = torch.linalg.eigh(jacobian.T @ jacobian / len(camera))
    scale = torch.tensor([1.0, 1, 1, depth, depth, depth], dtype=torch.float64)
    twists: Tensor = scale[:, None] * (axes * (values + DAMPING * values.mean()).rsqrt()) @ axes.T
    return twists


class Poses:
    """Poses of V training views that follow the gradient of what is rendered with them.

    Args: viewmats [V, 4, 4] and Ks [V, 3, 3] as given, on the CPU; size: width, height; points [N, 3] of the scene;
      rate: pixels that a view may move by in its first step; free: nothing ties the views to each other; device: of
      the Gaussians.
    Choices: the mean of all corrections, as motions of the world, stays zero to first order: no photo sees a motion of
      all cameras and the scene together, and test views would.
    """

    def __init__(
        self,
        viewmats: Tensor,
        Ks: Tensor,
        size: tuple[int, int],
        points: Tensor,
        rate: float,
        free: bool = False,
        device: str | torch.device = "cpu",
    ):
        pairs = zip(Ks, viewmats.double(), strict=True)
        self.scales = torch.stack([preconditioner(points, K, viewmat, size) for K, viewmat in pairs]).to(device)
        self.rate, self.given, self.free = rate, viewmats.double().to(device), free
        self.viewmats, self.inverse = self.given.clone(), torch.linalg.inv(self.given)
        self.optimizer = RowAdam(len(viewmats), 6, DECAYS, joint=True, device=device)
        self.twist = torch.zeros(6, device=device)

    def camera(self, camera: View, view: int, learning: bool = True) -> View:
        """A view's camera at the pose that was reached; `step` follows the gradient of the last one that is learned."""
        twist = None
        if learning:
            twist = self.twist = torch.zeros(6, device=self.given.device, requires_grad=True)
        return View(camera.K, self.viewmats[view].float(), camera.width, camera.height, twist)

    def step(self, view: int, share: float) -> None:
        """Follow the gradient of the view that was last rendered."""
        if self.twist.grad is None:
            return
        scale = self.scales[view]
        change = scale @ self.optimizer.change(view, scale.T @ self.twist.grad.double(), self.rate * 0.03**share)
        self.viewmats[view] = motion(change) @ self.viewmats[view]
        if self.free:
            return
        drift = small_twist(self.inverse @ self.viewmats).mean(0)
        self.viewmats = self.viewmats @ motion(-drift)

    def state_dict(self) -> dict[str, Any]:
        return {"viewmats": self.viewmats, "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.viewmats = state["viewmats"]
        self.optimizer.load_state_dict(state["optimizer"])
