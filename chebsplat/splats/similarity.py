"""Similarities: points, cameras and Gaussians turned, scaled and shifted into another frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from chebsplat.splats.sh import MAX_DEGREE, basis


class Similarity(NamedTuple):
    """x' = scale rotation x + shift. rotation [3, 3], shift [3]."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    def of_points(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3] in the other frame."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)

    def of_cameras(self, cam_from_world: np.ndarray) -> np.ndarray:
        """Poses [V, 4, 4] of cameras that see the same in the other frame, in its unit."""
        poses = cam_from_world.astype(np.float64)
        poses[:, :3, :3] = poses[:, :3, :3] @ self.rotation.T
        poses[:, :3, 3] = self.scale * poses[:, :3, 3] - poses[:, :3, :3] @ self.shift
        return poses

    def of_gaussians(self, parameters: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Raw parameters of Gaussians that look the same in the other frame, light turned too."""
        w, x, y, z = parameters["quats"].astype(np.float64).T
        a, b, c, d = Rotation.from_matrix(self.rotation).as_quat(scalar_first=True)
        product = [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y]
        product += [a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w]
        changed = {
            "means": self.of_points(parameters["means"].astype(np.float64)),
            "log_scales": parameters["log_scales"] + np.log(self.scale),
            "quats": np.stack(product, 1),
            "shN": np.einsum("kj,njc->nkc", turned_light(self.rotation), parameters["shN"]),
        }
        return parameters | {name: values.astype(np.float32) for name, values in changed.items()}

    def inverse(self) -> Similarity:
        """The way back."""
        return Similarity(
            1 / self.scale, self.rotation.T, -self.rotation.T @ self.shift / self.scale
        )

    def after(self, first: Similarity) -> Similarity:
        """`first`, and then this one."""
        return Similarity(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.of_points(first.shift[None])[0],
        )


def fitted(points: np.ndarray, others: np.ndarray) -> Similarity:
    """The similarity that brings points [N, 3] nearest to others [N, 3], by Umeyama's method."""
    middle, other = points.mean(0), others.mean(0)
    left, lengths, right = np.linalg.svd((others - other).T @ (points - middle))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ (signs[:, None] * right)
    scale = float((signs * lengths).sum() / ((points - middle) ** 2).sum())
    return Similarity(scale, rotation, other - scale * rotation @ middle)


def turned_light(rotation: np.ndarray) -> np.ndarray:
    """The matrix [15, 15] by which coefficients of bands 1 to 3 show along R d what they did along
    d.

    Choices: by the light along more directions than there are coefficients, which determine these
      exactly.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (
        basis(torch.from_numpy(d), MAX_DEGREE).numpy()[:, 1:]
        for d in (directions, directions @ rotation.T)
    )
    return np.asarray(np.linalg.lstsq(after, before, rcond=None)[0])
