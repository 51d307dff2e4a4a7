"""Exposure and white balance of photos, measured where several of them show the same points.

Exposures are f64 [V, 3]: stops (log2 of linear light) by channel, relative to the mean view.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.distance import cdist

from chebsplat.cameras import centers

CELL = 8  # pixels: colours of a point are means over squares of this side
MOST_POINTS, LEAST_POINTS = (
    4000,
    30,
)  # points without tracks, and of a view whose exposure is measured
MOST = 300_000  # sightings of points that are looked at, or about as many
# linear light beyond which a sensor is not linear, or saturated
DARK, BRIGHT = 0.005, 0.85
DIM = 0.08  # linear light of points below which a camera's curve is seldom sRGB's
ROUNDS, LEAST_RESIDUAL = 10, 0.01  # of least squares; stops
MOST_VIEWS = 1000  # whose exposures tell what to expect of others
# how far apart views share an exposure, in median distances and radians
REACHES = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
RATIOS = 10.0 ** np.arange(-4, 4.1, 0.25)  # what is a photo's own over what is shared, as variances
# orthonormal
BRIGHTNESS_AND_HUES = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])


def light_of(values: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values, both from 0 to 1 (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def relit(image: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """An image u8 [H, W, 3] after so many more stops [3]; what becomes too bright is cut off."""
    lit = np.minimum(light_of(np.arange(256)[:, None] / 255) * 2.0 ** np.asarray(stops), 1)
    tables = 255 * np.where(lit <= 0.0031308, 12.92 * lit, 1.055 * lit ** (1 / 2.4) - 0.055)
    tables = tables.round().astype(np.uint8)
    return np.stack([tables[image[..., channel], channel] for channel in range(3)], -1)


def measured_exposures(
    images: Iterable[np.ndarray],
    Ks: np.ndarray,
    cam_from_world: np.ndarray,
    points: np.ndarray,
    tracks: np.ndarray | None = None,
) -> np.ndarray:
    """Exposures [V, 3] of V photos of the same points; NaN of those that show too few of them.

    Args: images: u8 [H, W, 3] of V views; Ks [V, 3, 3] pixels; cam_from_world [V, 4, 4]; points [N,
      3]; tracks: int [T, 2] (point, view), or None: points are seen by all views that have them
      within their frame.
    Choices: light is that of a point times its view's exposure. Logarithms of both are fitted at
      once, with least absolute residuals, so that walls in between and highlights count little.
      Medians by turns, of points and of views, stop long before: where each point is seen by few
      neighbours, they find next to nothing of a drift along a path. Of points that are DIM in a
      channel, in the mean exposure, only the brighter half counts: by dark ones the blue of a
      yellow still life seems to vary by ± .8 stops (banana), by others by ± .2. Of many, some: with
      tracks as many as are seen MOST times in all.
    """
    n_views = len(Ks)
    n_points = (
        min(MOST_POINTS, 4 * MOST // n_views)
        if tracks is None
        else len(points) * MOST // max(len(tracks), 1)
    )
    sample = np.linspace(0, len(points) - 1, min(len(points), max(n_points, 1))).astype(int)
    if tracks is None:
        visible = [sample] * n_views
    else:
        tracks = tracks[np.isin(tracks[:, 0], sample)]
        tracks = tracks[np.argsort(tracks[:, 1], kind="stable")]
        visible = np.split(tracks[:, 0], np.searchsorted(tracks[:, 1], np.arange(1, n_views)))
    measured = [
        _light_at(*view)
        for view in zip(images, Ks, cam_from_world, (points[some] for some in visible), strict=True)
    ]
    light = np.concatenate([values for values, _ in measured])
    point = np.concatenate(
        [some[there] for some, (_, there) in zip(visible, measured, strict=True)]
    )
    view = np.repeat(np.arange(n_views), [len(values) for values, _ in measured])
    shared = np.bincount(point, minlength=len(points))[point] >= 2
    light, point, view = light[shared], point[shared], view[shared]
    light = np.log2(light)
    exposures = _fitted(light, view, point, n_views)
    in_mean = light - exposures[view]  # nan of views without an exposure
    finite = np.isfinite(in_mean).all(1)
    if not finite.any():
        return exposures
    light, view, point, in_mean = light[finite], view[finite], point[finite], in_mean[finite]
    sums = np.stack([np.bincount(point, values) for values in in_mean.T], 1)
    darkest = (sums / np.maximum(np.bincount(point), 1)[:, None]).min(1)[point]
    bright = darkest >= min(np.log2(DIM), np.median(darkest))
    return _fitted(light[bright], view[bright], point[bright], n_views)


def _fitted(light: np.ndarray, view: np.ndarray, point: np.ndarray, n_views: int) -> np.ndarray:
    """Exposures [V, 3] by sightings, log2 of light [M, 3], view [M] and point [M]; NaN of views
    with fewer than LEAST_POINTS of them.
    """
    exposures = np.full((n_views, 3), np.nan)
    enough = np.bincount(view, minlength=n_views) >= LEAST_POINTS
    if enough.sum() < 2:
        return exposures
    usable = enough[view]
    light, point = light[usable], np.unique(point[usable], return_inverse=True)[1]
    view = np.unique(view[usable], return_inverse=True)[1]
    exposures[enough] = np.stack([_of_views(values, view, point) for values in light.T], 1)
    return exposures


def _of_views(light: np.ndarray, view: np.ndarray, point: np.ndarray) -> np.ndarray:
    """e [V], of mean 0, of the e and a that make Σ |light − a[point] − e[view]| about least, for
    sightings light [M], view [M] and point [M].

    Choices: least squares, each weighted by one over its last residual, ROUNDS times. Points are
      eliminated: what is solved has as many unknowns as there are views.
    """
    weights = np.ones(len(light))
    for _ in range(ROUNDS):
        sightings = csr_array((weights, (point, view)))  # [P, V]
        of_points = sightings.sum(1)
        mean = np.bincount(point, weights * light) / of_points
        normal = (
            np.diag(sightings.sum(0)) - (sightings.T @ (sightings / of_points[:, None])).toarray()
        )
        right = np.bincount(view, weights * (light - mean[point]))
        e: np.ndarray = np.linalg.lstsq(normal, right, rcond=None)[0]
        e -= e.mean()
        a = mean - sightings @ e / of_points
        weights = 1 / np.maximum(np.abs(light - a[point] - e[view]), LEAST_RESIDUAL)
    return e


def _light_at(
    image: np.ndarray, K: np.ndarray, pose: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean linear light [M, 3] about points [P, 3] in an image; mask [P] of those measured."""
    height, width = image.shape[:2]
    half = min(CELL, height, width) // 2
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    front = camera[:, 2] > 1e-3
    place = ((camera / np.where(front, camera[:, 2], 1)[:, None]) @ K.T)[:, :2]
    there = front & ((place >= half) & (place <= np.array([width, height]) - half)).all(1)
    sums = np.pad(
        light_of(np.arange(256) / 255)[image].cumsum(0).cumsum(1), ((1, 0), (1, 0), (0, 0))
    )
    x, y = place[there].astype(int).T
    right, left = (sums[y + half, end] - sums[y - half, end] for end in (x + half, x - half))
    means = (right - left) / (2 * half) ** 2
    usable = ((means > DARK) & (means < BRIGHT)).all(1)
    there[there] = usable
    return means[usable], there


def expected_exposures(
    exposures: np.ndarray, cam_from_world: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """Exposures [Q, 3] that photos from the poses `at` [Q, 4, 4] may be expected to have, by those
    [V, 3] of photos from `cam_from_world` [V, 4, 4]; 0, the mean, where fewer than three are known.

    Args:    exposures: NaN where unknown.
    Choices: exposures are a Gaussian process over camera centres, in median distances, and
      directions (Matérn, 3/2), plus noise that is each photo's own and cannot be expected; its
      reach and the noise's share are those of the largest marginal likelihood, by brightness and by
      hue. Of more than MOST_VIEWS photos, every second counts, or every third.
    """
    finite = np.flatnonzero(np.isfinite(exposures).all(1))
    if len(finite) < 3:
        return np.zeros((len(at), 3))
    some = finite[:: -(-len(finite) // MOST_VIEWS)]
    eyes = centers(cam_from_world[some])
    apart = cdist(eyes, eyes)
    unit = np.median(apart[apart > 0]) if apart.any() else 1.0
    here, there = (
        np.concatenate([centers(poses) / unit, poses[:, 2, :3]], 1)
        for poses in (cam_from_world[some], at)
    )
    spectra = []
    for reach in REACHES:
        eigenvalues, vectors = np.linalg.eigh(_covariance(here, here, reach))
        spectra.append((eigenvalues, vectors, _covariance(there, here, reach) @ vectors))
    axes = exposures[some] @ BRIGHTNESS_AND_HUES.T
    return np.stack([_expected(values, spectra) for values in axes.T], 1) @ BRIGHTNESS_AND_HUES


def _covariance(places: np.ndarray, others: np.ndarray, reach: float) -> np.ndarray:
    """Covariances [N, M] of values at places [N, 6] and [M, 6], their variance being 1."""
    distance = np.sqrt(3) * cdist(places, others) / reach
    covariance: np.ndarray = (1 + distance) * np.exp(-distance)
    return covariance


def _expected(values: np.ndarray, spectra: Sequence[tuple[np.ndarray, ...]]) -> np.ndarray:
    """Values [Q] expected by values [V] of unknown mean, whose covariance is one of these
    (eigenvalues, eigenvectors) plus one of RATIOS, times a factor; third of each: covariances of
    the Q with the V, in the eigenvectors' basis.
    """
    best, expected = -np.inf, np.full(len(spectra[0][2]), values.mean())
    if np.ptp(values) < 1e-9:
        return expected
    for eigenvalues, vectors, across in spectra:
        rotated, ones = vectors.T @ values, vectors.sum(0)
        for ratio in RATIOS:
            weights = 1 / (eigenvalues.clip(0) + ratio)
            total = (weights * ones**2).sum()
            mean = (weights * ones * rotated).sum() / total
            residual = rotated - mean * ones
            square = (weights * residual**2).sum()
            likelihood = -(len(values) - 1) * np.log(square) + np.log(weights).sum() - np.log(total)
            if likelihood > best:
                best, expected = likelihood, mean + across @ (weights * residual)
    return expected
