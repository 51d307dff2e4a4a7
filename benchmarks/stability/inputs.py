"""Clouds that break inputs and features of the encoder of shape (docs/method.md, 2 and 14).

A cloud that was scaled with its unit, moved, turned with `up` or put into another order is the same
room: the truth is what is seen of it as it was, in double precision throughout but for the
descriptors. Errors are relative to the largest of each kind of input.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.stability.case import Outcome, beside, case, relative
from chebsplat.shape.point_encoder import PointEncoder
from chebsplat.shape.point_inputs import PointInputs, point_inputs

N, NEIGHBORS = 300, 12
SEEN = 1e-5  # float32 places of a room
ENCODED = 1e-4  # as of the ONNX graph: a network of float32, whose features are about 1


class Cloud(NamedTuple):
    """As `point_inputs` takes it."""

    means: np.ndarray
    normals: np.ndarray
    covariances: np.ndarray
    up: np.ndarray
    unit: float = 1.0


def cloud(n: int = N) -> Cloud:
    """A floor and a wall, 2 m wide, of flat disks."""
    rng = np.random.default_rng(0)
    means, wall = rng.uniform(0, 2, (n, 3)), np.arange(n) % 2 == 0
    means[wall, 0], means[~wall, 2] = 0, 0
    normals = np.where(wall[:, None], (1.0, 0, 0), (0, 0, 1.0))
    sizes = 1e-3 * rng.uniform(1, 2, (n, 1, 1))
    return Cloud(
        means,
        normals,
        sizes * (np.eye(3) - 0.9 * normals[:, :, None] * normals[:, None]),
        np.eye(3)[2],
    )


def place(unit: float = 1.0, shift: Any = 0.0) -> Cloud:
    of = cloud()
    return Cloud(unit * of.means + shift, of.normals, unit**2 * of.covariances, of.up, unit)


def turned(of: Cloud, up: float = 1.0) -> Cloud:
    turn = Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix()
    covariances = turn @ of.covariances @ turn.T
    return Cloud(of.means @ turn.T, of.normals @ turn.T, covariances, up * turn @ of.up)


def inputs_of(of: Cloud) -> PointInputs:
    return point_inputs(*of[:3], up=of.up, unit=of.unit, n_neighbors=NEIGHBORS)


SAME: dict[str, Callable[[], Cloud]] = {
    "in units of 1e-03": lambda: place(1e-3),
    "in units of 1e+03": lambda: place(1e3),
    "in units of 1e+06": lambda: place(1e6),
    "1e+04 from the origin": lambda: place(shift=1e4),
    "1e+06 from the origin": lambda: place(shift=1e6),
    "up of length 1e-30": lambda: cloud()._replace(up=1e-30 * cloud().up),
    "up of length 1e+30": lambda: cloud()._replace(up=1e30 * cloud().up),
}


def apart(ours: PointInputs, exact: PointInputs) -> float:
    """Largest error of own inputs, places, normals, descriptors; inf if a neighbour is another."""
    if not np.array_equal(ours.neighbors, exact.neighbors):
        return float("inf")
    return max(relative(a, b) for a, b in zip(ours[:4], exact[:4], strict=True))


@case("a room {name}", name=SAME)
def same(name: str) -> Outcome:
    """As the room at its place; the plain way takes it in float32 as it stands."""
    of = SAME[name]()

    def plainly() -> PointInputs:
        return inputs_of(Cloud(*(np.asarray(part, np.float32) for part in of[:4]), of.unit))

    return beside(inputs_of(of), plainly, inputs_of(cloud()), SEEN, apart)


@case("a room turned with up of length {length:.0e}", length=[1e-30, 1.0, 1e30])
def turning(length: float) -> Outcome:
    """Inputs that do not depend on where north is: own ones, distances, neighbours, descriptors."""
    ours, exact = inputs_of(turned(cloud(), length)), inputs_of(cloud())
    lengths = [np.linalg.norm(of.means[:, None] - of.means, axis=-1) for of in (ours, exact)]
    return Outcome(max(relative(ours.own, exact.own), relative(*lengths)), SEEN)


FEW: dict[str, Callable[[], Cloud]] = {
    "no point": lambda: cloud(0),
    "one point": lambda: cloud(1),
    "two points": lambda: cloud(2),
    "points in one place": lambda: cloud()._replace(means=cloud().means * 0 + 5),
    "points on a line": lambda: cloud()._replace(means=cloud().means * [0, 1, 0]),
    "pairs": lambda: cloud()._replace(means=np.repeat(cloud().means[::2], 2, 0)),
    "an outlier at 1e+09": lambda: cloud()._replace(
        means=np.where(np.arange(N)[:, None] == 7, 1e9, cloud().means)
    ),
    "covariances of 0": lambda: cloud()._replace(covariances=0 * cloud().covariances),
    "covariances of 1e-30": lambda: cloud()._replace(covariances=1e-30 * cloud().covariances),
    "covariances of 1e+30": lambda: cloud()._replace(covariances=1e30 * cloud().covariances),
    "covariances of rank 1": lambda: cloud()._replace(
        covariances=np.tile(np.diag([1e-3, 0, 0]), (N, 1, 1))
    ),
}


@case("own inputs, {name}", name=FEW)
def own(name: str) -> Outcome:
    """Heights, slopes and shapes of covariances against what they are; every other input is finite.

    The plain way takes the roots of eigenvalues in float32, which rounding has below 0.
    """
    of = FEW[name]()
    inputs = inputs_of(of)
    if not all(np.isfinite(part).all() for part in inputs):
        raise ValueError("an input is not finite")
    heights = of.means[:, 2] - (np.quantile(of.means[:, 2], 0.005) if len(of.means) else 0)
    values = np.linalg.eigvalsh(of.covariances.astype(np.longdouble).astype(np.float64)).clip(1e-14)
    slopes = of.normals[:, 2]

    def columns(values: np.ndarray) -> np.ndarray:
        sizes = np.sqrt(values)
        ratios = sizes[:, :2] / sizes[:, 2:]
        return np.column_stack([heights, slopes, np.abs(slopes), ratios, np.log(sizes[:, 2])])

    def plainly() -> np.ndarray:
        return columns(np.linalg.eigvalsh(of.covariances.astype(np.float32)))

    return beside(inputs.own, plainly, columns(values), SEEN)


def encoder(attends: bool = True) -> PointEncoder:
    """With weights as they begin, inputs standardised as in a room."""
    torch.manual_seed(0)
    network = PointEncoder(
        4,
        inputs_of(cloud(1)).descriptors.shape[1],
        n_components=16,
        width=16,
        hidden=16,
        attends=attends,
    )
    network.norm_own.deviation[:] = 0.5
    network.components.normal_(0, 0.1)
    return network.eval()


def encoded(of: PointInputs, dtype: torch.dtype, attends: bool = True) -> np.ndarray:
    """Features of points in this precision."""
    from chebsplat.shape.point_encoder import cloud_of

    network, tensors = encoder(attends).to(dtype), cloud_of(of)
    tensors = type(tensors)(*(part.to(dtype) for part in tensors[:4]), tensors.neighbors)
    with torch.no_grad():
        features = network(
            tensors,
            network.embedded(tensors.own, tensors.descriptors),
            torch.arange(len(tensors.own)),
            tensors.neighbors,
        )
    return features.numpy()


def spoiled(change: Callable[[PointInputs], dict[str, np.ndarray]]) -> PointInputs:
    of = inputs_of(cloud(60))
    return of._replace(
        **{name: values.astype(getattr(of, name).dtype) for name, values in change(of).items()}
    )


def filled(of: PointInputs) -> PointInputs:
    """Inputs without a missing neighbour: the first point takes the place of each."""
    return of._replace(neighbors=np.maximum(of.neighbors, 0))


ENCODE: dict[str, Callable[[], PointInputs]] = {
    "nobody near": lambda: spoiled(lambda of: {"neighbors": of.neighbors * 0 - 1}),
    "everybody in one place": lambda: spoiled(lambda of: {"means": of.means * 0}),
    "the same neighbour twelve times": lambda: spoiled(
        lambda of: {"neighbors": of.neighbors[:, :, :1].repeat(12, 2)}
    ),
    "own inputs of 1e+30": lambda: spoiled(lambda of: {"own": 1e30 * of.own}),
    "descriptors of 1e+30": lambda: spoiled(lambda of: {"descriptors": 1e30 * of.descriptors}),
    "descriptors of 0": lambda: spoiled(lambda of: {"descriptors": 0 * of.descriptors}),
    "neighbours at 1e+04": lambda: spoiled(lambda of: {"means": 1e4 * of.means}),
    "neighbours at 1e-20": lambda: spoiled(lambda of: {"means": 1e-20 * of.means}),
    "normals of 0": lambda: spoiled(lambda of: {"normals": 0 * of.normals}),
}


@case("encoded, {name}", name=ENCODE)
def encodes(name: str) -> Outcome:
    """float32 beside float64, with attention and without; plainly, the first point fills gaps."""
    of = ENCODE[name]()

    def both(of: PointInputs, dtype: torch.dtype) -> np.ndarray:
        return np.stack([encoded(of, dtype, attends) for attends in (True, False)])

    return beside(
        both(of, torch.float32),
        lambda: both(filled(of), torch.float32),
        both(of, torch.float64),
        ENCODED,
    )


@case(
    "encoded, {name}",
    name=["neighbours in another order", "neighbours padded", "points in another order"],
)
def reordered(name: str) -> Outcome:
    """As before, point by point."""
    of = inputs_of(cloud(60))
    exact, rows = encoded(of, torch.float64), np.arange(60)
    if "points" in name:
        rows = np.random.default_rng(0).permutation(60)
        inverse = np.argsort(rows)
        neighbors = np.where(of.neighbors >= 0, inverse[of.neighbors], -1)[rows]
        other = PointInputs(*(part[rows] for part in of[:4]), neighbors)
    elif "padded" in name:
        other = of._replace(
            neighbors=np.concatenate([of.neighbors, np.full_like(of.neighbors, -1)], 2)
        )
    else:
        other = of._replace(neighbors=np.ascontiguousarray(of.neighbors[:, :, ::-1]))
    return Outcome(relative(encoded(other, torch.float32), exact[rows]), ENCODED)
