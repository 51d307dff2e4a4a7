"""Figures of a scene from arrays: image fidelity, segmentation, features at points of a surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from chebsplat.splats.parts import first_of_each

IGNORE = -1
REACH = 4.0  # standard deviations
CELLS = 128  # along the longest side of what is measured
CHUNK = 2048  # Gaussians at a time, so that their pairs with points stay in memory


class Segmentation(NamedTuple):
    """Figures of one confusion matrix, as fractions; nan where undefined."""

    miou: float  # mean over classes that occur in truth or prediction
    macc: float  # mean recall over classes that occur in truth
    oa: float  # pixels right
    iou: np.ndarray  # [L], nan for a class that occurs in neither


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two u8 images, dB; infinite where they are equal.

    Raises: ValueError unless both are u8 of one shape: PSNR on floats is another number.
    """
    if image.dtype != np.uint8 or truth.dtype != np.uint8 or image.shape != truth.shape:
        raise ValueError(
            f"two u8 images of one shape are needed, not {image.dtype} {image.shape}, {truth.shape}"
        )
    error = np.mean((image.astype(np.float64) - truth) ** 2)
    return float(10 * np.log10(255**2 / error)) if error > 0 else float("inf")


def color_fitted(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The image u8 [..., 3] in the affine map of its colours that is nearest to the truth u8 [...,
    3], u8.

    Choices: least squares over all pixels, 12 numbers; then rounded and cut off to 8 bits, as any
      picture.
    """
    colors = np.concatenate([image.reshape(-1, 3) / 255, np.ones((image.size // 3, 1))], 1)
    weights = np.linalg.lstsq(
        colors.T @ colors, colors.T @ (truth.reshape(-1, 3) / 255), rcond=1e-9
    )[0]
    fitted: np.ndarray = (
        (255 * colors @ weights).round().clip(0, 255).astype(np.uint8).reshape(image.shape)
    )
    return fitted


def confusion(labels: np.ndarray, truth: np.ndarray, n_classes: int) -> np.ndarray:
    """[L, L] counts, rows by truth; pixels whose truth is IGNORE do not count.

    Raises: ValueError on a shape mismatch or a label outside 0...L-1 where it counts.
    """
    if labels.shape != truth.shape:
        raise ValueError(f"shapes disagree: {labels.shape}, {truth.shape}")
    counted = truth != IGNORE
    rows, columns = truth[counted].astype(np.int64), labels[counted].astype(np.int64)
    if len(rows) and (
        min(rows.min(), columns.min()) < 0 or max(rows.max(), columns.max()) >= n_classes
    ):
        raise ValueError(f"a label lies outside 0...{n_classes - 1}")
    return np.bincount(rows * n_classes + columns, minlength=n_classes**2).reshape(
        n_classes, n_classes
    )


def segmentation(matrix: np.ndarray) -> Segmentation:
    """Figures of a confusion matrix [L, L], summed over all views first."""
    right = np.diag(matrix).astype(np.float64)
    truth, union = matrix.sum(1), matrix.sum(1) + matrix.sum(0) - right
    iou = np.divide(right, union, out=np.full(len(right), np.nan), where=union > 0)
    recall = np.divide(right, truth, out=np.full(len(right), np.nan), where=truth > 0)
    total = matrix.sum()
    return Segmentation(
        float(np.nanmean(iou)) if total else float("nan"),
        float(np.nanmean(recall)) if total else float("nan"),
        float(right.sum() / total) if total else float("nan"),
        iou,
    )


def boundary_band(truth: np.ndarray, half_width: int) -> np.ndarray:
    """Pixels [H, W] within `half_width` (chessboard) of another label; IGNORE edges are none."""
    edge = np.zeros(truth.shape, bool)
    for axis in (0, 1):
        ahead, behind = np.moveaxis(truth, axis, 0)[1:], np.moveaxis(truth, axis, 0)[:-1]
        differs = (ahead != behind) & (ahead != IGNORE) & (behind != IGNORE)
        view = np.moveaxis(edge, axis, 0)
        view[1:] |= differs
        view[:-1] |= differs
    return (
        binary_dilation(edge, np.ones((2 * half_width - 1,) * 2, bool)) if half_width > 1 else edge
    )


def features_at(
    points: np.ndarray,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    features: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the features of all Gaussians at each point, weighted by their densities there.

    Args:
      points:    [M, 3] scene units.
      means:     [N, 3]; quats [N, 4] wxyz of any length; scales [N, 3] standard deviations;
        opacities [N] in (0, 1).
      features:  [N, C].
    Returns: features f32 [M, C], zero where no Gaussian reaches; weights f64 [M], their sums,
      in scene units⁻³.
    Choices: a Gaussian's density is its opacity times the normal density, so that of one opacity a
      small Gaussian says more of where it lies than a large one. It ends at 4 standard deviations.
      Nothing occludes anything: what lies in front of a point or behind it by more than that does
      not count.
    """
    sums, weights = np.zeros((len(points), features.shape[1])), np.zeros(len(points))
    if not len(points) or not len(means):
        return sums.astype(np.float32), weights
    tree = cKDTree(points)
    axes = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    peaks = opacities / np.prod(scales, axis=1, dtype=np.float64)
    for start in range(0, len(means), CHUNK):
        rows = slice(start, start + CHUNK)
        near = tree.query_ball_point(means[rows], REACH * scales[rows].max(1))
        row = np.repeat(np.arange(len(near)), [len(indices) for indices in near])
        point = np.fromiter((k for indices in near for k in indices), np.int64, len(row))
        gaussian = row + start
        local = (
            np.einsum("pi,pij->pj", points[point] - means[gaussian], axes[gaussian])
            / scales[gaussian]
        )
        squared = (local**2).sum(1)
        weight = np.where(squared <= REACH**2, peaks[gaussian] * np.exp(-0.5 * squared), 0.0)
        matrix = coo_matrix((weight, (point, row)), (len(points), len(near))).tocsr()
        sums += matrix @ features[rows]
        weights += np.asarray(matrix.sum(1))[:, 0]
    return (sums / np.where(weights > 0, weights, 1)[:, None]).astype(np.float32), weights


def thinned(points: np.ndarray) -> np.ndarray:
    """Rows of the first of points [M, 3] in each cell, so that an area counts as often as it is
    large.

    Choices: 128 cells along the longest side of the box that holds 98 % of the points along each
      axis; a stray depth beyond it does not coarsen them.
    """
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    side = float((high - low).max()) / CELLS or 1.0
    return first_of_each(points, side, low)
