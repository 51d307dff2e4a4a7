"""One vector per region from each descriptor; what it says of each Gaussian is pooled over the region's Gaussians."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from benchmarks.shapes.samples import Regions
from chebsplat.shape.descriptor import describe

NEIGHBORS = 16


POOLING: dict[str, Callable[[np.ndarray], list[np.ndarray]]] = {
    "mean and deviation": lambda v: [v.mean(1), v.std(1)],
    "quartiles": lambda v: list(np.quantile(v, [0.25, 0.5, 0.75], axis=1)),
}


def pooled(values: np.ndarray, pooling: str) -> np.ndarray:
    """[M, n, F] -> [M, kF]."""
    return np.concatenate(POOLING[pooling](values), 1)


def canonical(regions: Regions) -> Regions:
    """Mean 0, rms radius 1."""
    means = regions.means - regions.means.mean(1, keepdims=True)
    radius = np.sqrt((means**2).sum(2).mean(1))[:, None, None]
    return regions._replace(means=means / radius, scales=regions.scales / radius)


def ours(regions: Regions, **options: float) -> np.ndarray:
    """Ours, [M, n, J * (D - 1)]."""
    parts = []
    for rows in np.array_split(np.arange(len(regions.labels)), max(1, len(regions.labels) // 256)):
        given = [torch.from_numpy(v[rows]) for v in (regions.means, regions.scales, regions.rotmats)]
        mask = torch.ones(given[0].shape[:2], dtype=torch.bool)
        parts.append(describe(*given, mask, **options).values.flatten(2).numpy())  # type: ignore[arg-type]
    return np.concatenate(parts)


def printed(regions: Regions, n_eigs: int = 16, n_angles: int = 4, max_degree: int = 8) -> np.ndarray:
    """Eqs 1-6 in the printed style: K eigenvectors, hard cut, rotations about the world's z axis.

    Kinder than print: float64, a region of unit size, a symmetric eigensolver, so that nothing raises, and squares of
    eigenvectors times n, so that a region of fewer Gaussians has features of the same size.
    """
    means, scales, R = (torch.from_numpy(v) for v in canonical(regions)[:3])
    n, eye = means.shape[1], torch.eye(3, dtype=torch.float64)
    metric = torch.linalg.inv(eye + 30.0 * R @ (scales[..., None] ** 2 * R.mT))
    columns, n_eigs = [], min(n_eigs, n)
    for angle in 2 * np.pi * np.arange(n_angles) / n_angles:
        cos, sin = np.cos(angle), np.sin(angle)
        turned = means @ torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        delta = turned[:, :, None] - turned[:, None]
        lengths = (delta @ metric * delta).sum(-1)
        weights = torch.exp(-(lengths + lengths.mT) / (2 * 0.7**2)) * (1 - torch.eye(n))
        root = weights.sum(2).clamp_min(1e-300).rsqrt()
        values, vectors = torch.linalg.eigh(torch.eye(n) - root[:, :, None] * weights * root[:, None])
        values, vectors = values[:, :n_eigs], root[:, :, None] * vectors[:, :, :n_eigs]
        squares = n * vectors**2 / (vectors**2).sum(1, keepdim=True)
        x = (2 * values / values[:, -1:].clamp_min(1e-12) - 1).clamp(-1, 1)
        columns += [((d * x.arccos()).cos()[:, None] * squares).sum(2) for d in range(max_degree + 1)]
    return torch.stack(columns, -1).numpy()


def eigenvalues(regions: Regions) -> np.ndarray:
    """Linearity, planarity, sphericity, change of curvature and eigenentropy of each centre's 16 neighbours."""
    delta = regions.means[:, :, None] - regions.means[:, None]
    nearest = np.argsort((delta**2).sum(-1), -1)[..., :NEIGHBORS]
    around = np.take_along_axis(regions.means[:, None], nearest[..., None], 2)
    around = around - around.mean(2, keepdims=True)
    low, middle, high = np.moveaxis(np.linalg.eigvalsh(np.swapaxes(around, 2, 3) @ around).clip(1e-300), -1, 0)
    share = np.stack([low, middle, high]) / (low + middle + high)
    entropy = -(share * np.log(share.clip(1e-12))).sum(0)
    return np.stack([(high - middle) / high, (middle - low) / high, low / high, share[0], entropy], -1)


def moments(regions: Regions) -> np.ndarray:
    """Eigenvalues of the centres' covariance, of the mean normal's tensor and of the mean covariance; each scale.

    The first nine are the region's, and the same for each of its Gaussians.
    """
    regions = canonical(regions)
    R, n = regions.rotmats, regions.means.shape[1]
    covariances = R @ (regions.scales[..., None] ** 2 * np.swapaxes(R, 2, 3))
    tensors = [np.swapaxes(v, 1, 2) @ v / n for v in (regions.means, R[..., -1])] + [covariances.mean(1)]
    whole = np.concatenate([np.linalg.eigvalsh(t) for t in tensors], 1)
    return np.concatenate([np.repeat(whole[:, None], n, 1), regions.scales], 2)


def fpfh(regions: Regions, normals: str, radius: float) -> np.ndarray:
    """Fast point feature histograms [33] of each centre.

    Args: normals: `estimated` from 16 neighbours, or the `gaussian`'s own; both turned to agree with their neighbours'.
      radius: rms radii of the region.
    """
    import open3d

    regions, found = canonical(regions), []
    for means, rotmats in zip(regions.means, regions.rotmats, strict=True):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(means))
        if normals == "estimated":
            cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBORS))
        else:
            cloud.normals = open3d.utility.Vector3dVector(rotmats[:, :, 2])
        cloud.orient_normals_consistent_tangent_plane(8)
        search = open3d.geometry.KDTreeSearchParamHybrid(radius, len(means))
        found.append(open3d.pipelines.registration.compute_fpfh_feature(cloud, search).data.T)
    return np.stack(found)


FEATURES: dict[str, Callable[[Regions], np.ndarray]] = {
    "ours": ours,
    "ours, 4 angles, a = 30": lambda regions: ours(regions, n_angles=4, anisotropy=30.0),
    "no rotations": lambda regions: ours(regions, n_angles=1),
    "isotropic": lambda regions: ours(regions, anisotropy=0.0),
    "printed, hard K": printed,
    "FPFH, Gaussian normals": lambda regions: fpfh(regions, "gaussian", 1.0),
    "FPFH, Gaussian normals, whole region": lambda regions: fpfh(regions, "gaussian", 3.0),
    "FPFH, estimated normals": lambda regions: fpfh(regions, "estimated", 1.0),
    "FPFH, estimated normals, whole region": lambda regions: fpfh(regions, "estimated", 3.0),
    "eigenvalues": eigenvalues,
    "Gaussian moments": moments,
}
BOTH = "ours + moments"
