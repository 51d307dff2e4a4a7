"""What a scene is measured by: image fidelity and segmentation, from arrays alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

IGNORE = -1


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
        raise ValueError(f"two u8 images of one shape are needed, not {image.dtype} {image.shape}, {truth.shape}")
    error = np.mean((image.astype(np.float64) - truth) ** 2)
    return float(10 * np.log10(255**2 / error)) if error > 0 else float("inf")


def color_fitted(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The image u8 [..., 3] in the affine map of its colours that is nearest to the truth u8 [..., 3], u8.

    Choices: least squares over all pixels, 12 numbers; then rounded and cut off to 8 bits, as any picture.
    """
    colors = np.concatenate([image.reshape(-1, 3) / 255, np.ones((image.size // 3, 1))], 1)
    weights = np.linalg.lstsq(colors.T @ colors, colors.T @ (truth.reshape(-1, 3) / 255), rcond=1e-9)[0]
    fitted: np.ndarray = (255 * colors @ weights).round().clip(0, 255).astype(np.uint8).reshape(image.shape)
    return fitted


def confusion(labels: np.ndarray, truth: np.ndarray, n_classes: int) -> np.ndarray:
    """[L, L] counts, rows by truth; pixels whose truth is IGNORE do not count.

    Raises: ValueError on a shape mismatch or a label outside 0...L-1 where it counts.
    """
    if labels.shape != truth.shape:
        raise ValueError(f"shapes disagree: {labels.shape}, {truth.shape}")
    counted = truth != IGNORE
    rows, columns = truth[counted].astype(np.int64), labels[counted].astype(np.int64)
    if len(rows) and (min(rows.min(), columns.min()) < 0 or max(rows.max(), columns.max()) >= n_classes):
        raise ValueError(f"a label lies outside 0...{n_classes - 1}")
    return np.bincount(rows * n_classes + columns, minlength=n_classes**2).reshape(n_classes, n_classes)


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
    """Pixels [H, W] within `half_width` pixels (chessboard) of a pixel with another label, IGNORE edges not counted."""
    from scipy.ndimage import binary_dilation

    edge = np.zeros(truth.shape, bool)
    for axis in (0, 1):
        ahead, behind = np.moveaxis(truth, axis, 0)[1:], np.moveaxis(truth, axis, 0)[:-1]
        differs = (ahead != behind) & (ahead != IGNORE) & (behind != IGNORE)
        view = np.moveaxis(edge, axis, 0)
        view[1:] |= differs
        view[:-1] |= differs
    return binary_dilation(edge, np.ones((2 * half_width - 1,) * 2, bool)) if half_width > 1 else edge
