"""Gaussians that break plain quantisation (docs/usage.md, `chebsplat page`) and float32 files.

Errors are of all Gaussians but the odd one that a case is named for.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.stability.case import Outcome, beside, case, relative
from chebsplat.formats.packed import C0, pack, unpack
from chebsplat.formats.ply import read_ply, write_ply
from chebsplat.formats.world import World

N = 200
Parameters = dict[str, np.ndarray]
ODD = 3  # the Gaussian that is not like the others


def room(n: int = N, **changes: Callable[[np.ndarray], object]) -> Parameters:
    """Gaussians of 5 to 50 mm in a room of 5 m; changes are made in place."""
    rng = np.random.default_rng(0)
    raw = {
        "means": rng.uniform(0, 5, (n, 3)),
        "log_scales": np.log(rng.uniform(0.005, 0.05, (n, 3))),
        "quats": rng.normal(size=(n, 4)),
        "logit_opacities": rng.normal(size=n),
        "sh0": rng.normal(size=(n, 1, 3)),
        "shN": rng.normal(size=(n, 15, 3)),
        "features": rng.normal(size=(n, 8)),
    }
    raw = {name: values.astype(np.float32) for name, values in raw.items()}
    for name, change in changes.items():
        change(raw[name])
    return raw


def others(values: np.ndarray) -> np.ndarray:
    return np.delete(values, ODD, 0)


def odd(value: float) -> Callable[[np.ndarray], object]:
    return lambda values: values[ODD].fill(value)


def eight_bits(values: np.ndarray) -> np.ndarray:
    """The plain way: 256 levels from the least to the largest of each channel, in float32."""
    low, step = values.min(0), (values.max(0) - values.min(0)) / np.float32(255)
    return np.asarray(np.round((values - low) / step) * step + low)


SCALES: dict[str, Callable[[], Parameters]] = {
    "one of 1e+03": lambda: room(log_scales=odd(np.log(1e3))),
    "one of 1e+30": lambda: room(log_scales=odd(np.log(1e30))),
    "one of 1e-30": lambda: room(log_scales=odd(np.log(1e-30))),
    "needles of 1e-12": lambda: room(log_scales=lambda v: v[:, 1:].fill(np.log(1e-12))),
    "all alike": lambda: room(log_scales=lambda v: v.fill(-3)),
    "units of 1e-06": lambda: room(log_scales=lambda v: np.add(v, np.log(1e-6), out=v)),
    "units of 1e+06": lambda: room(log_scales=lambda v: np.add(v, np.log(1e6), out=v)),
}


@case("scales, {name}", name=SCALES)
def scales(name: str) -> Outcome:
    """Longest axes, relative: 8 bits of logarithms; plainly, cut off e^10 below the largest."""
    of = SCALES[name]()

    def longest(log_scales: np.ndarray) -> np.ndarray:
        return others(log_scales.astype(np.float64).max(1))

    def plainly() -> np.ndarray:
        return longest(eight_bits(of["log_scales"].clip(of["log_scales"].max() - np.float32(10.2))))

    def apart(ours: np.ndarray, exact: np.ndarray) -> float:
        return (
            float(np.expm1(np.abs(ours - exact)).max()) if np.isfinite(ours).all() else float("inf")
        )

    return beside(
        longest(unpack(pack(of))["log_scales"]), plainly, longest(of["log_scales"]), 0.04, apart
    )


PLACES: dict[str, tuple[Callable[[], Parameters], float]] = {
    **{f"one at {at:.0e}": (lambda at=at: room(means=odd(at)), 1e-3) for at in (1e4, 1e6, 1e18)},
    "1e+03 from the origin": (lambda: room(means=lambda v: np.add(v, 1e3, out=v)), 1e-3),
    "units of 1e-06": (lambda: room(means=lambda v: np.multiply(v, 1e-6, out=v)), 1e-9),
    "units of 1e+06": (lambda: room(means=lambda v: np.multiply(v, 1e6, out=v)), 1e3),
    "one Gaussian": (lambda: room(1), 1e-6),
    "a plane": (lambda: room(means=lambda v: v[:, 2].fill(7.7)), 1e-3),
}


@case("places, {name}", name=PLACES)
def places(name: str) -> Outcome:
    """The largest distance in scene units; the plain way has 16 bits of the range."""
    of, tolerance = PLACES[name][0](), PLACES[name][1]

    def compared(means: np.ndarray) -> np.ndarray:
        return others(means) if len(means) > 1 else means

    def plainly() -> np.ndarray:
        low, step = of["means"].min(0), np.ptp(of["means"], 0) / np.float32(65535)
        return compared(np.round((of["means"] - low) / step) * step + low)

    def apart(ours: np.ndarray, exact: np.ndarray) -> float:
        return (
            float(np.abs(ours.astype(float) - exact).max())
            if np.isfinite(ours).all()
            else float("inf")
        )

    return beside(
        compared(unpack(pack(of))["means"]), plainly, compared(of["means"]), tolerance, apart
    )


@case("a Gaussian that is seen at {at:.0e}", at=[1e4, 1e6, 1e18])
def far(at: float) -> Outcome:
    """Direction from the middle, size over distance; plainly, coordinates are clipped."""
    of = room(means=lambda v: v[ODD].__imul__([at, -at, 2 * at]), log_scales=odd(np.log(0.01 * at)))
    middle = np.median(of["means"].astype(np.float64), 0)

    def appearance(means: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
        away = means[ODD].astype(np.float64) - middle
        distance = np.linalg.norm(away)
        return np.append(away / distance, np.exp(log_scales[ODD].astype(np.float64)) / distance)

    def plainly() -> np.ndarray:
        return appearance(of["means"].clip(-5000, 5000), of["log_scales"])

    unpacked = unpack(pack(of))
    exact = appearance(of["means"], of["log_scales"])
    return beside(appearance(unpacked["means"], unpacked["log_scales"]), plainly, exact, 0.04)


@case("quaternions of length {length:.0e}", length=[1e-30, 1e-10, 1.0, 1e10, 1e30])
def quaternions(length: float) -> Outcome:
    """Angles between, rad; the plain way has 8 bits an entry of float32's unit quaternion."""
    of = room(quats=lambda v: np.multiply(v, length, out=v))

    def angles(ours: np.ndarray, exact: np.ndarray) -> float:
        if not np.isfinite(ours).all():
            return float("inf")
        a, b = (
            v / np.linalg.norm(v, axis=1, keepdims=True)
            for v in (ours.astype(float), exact.astype(float))
        )
        return float(2 * np.arccos(np.abs((a * b).sum(1)).clip(0, 1)).max())

    def plainly() -> np.ndarray:
        unit = of["quats"] / np.sqrt((of["quats"] ** 2).sum(1, keepdims=True))
        return np.round(unit * 127) / 127

    return beside(unpack(pack(of))["quats"], plainly, of["quats"], 4e-3, angles)  # 0.2 degrees


SHOWN: dict[str, Callable[[], Parameters]] = {
    "opacity logits of 1e+04": lambda: room(
        logit_opacities=lambda v: np.copyto(v, np.where(v > 0, 1e4, -1e4))
    ),
    "one logit of 1e+30": lambda: room(logit_opacities=odd(1e30)),
    "one colour of 1e+30": lambda: room(sh0=odd(1e30)),
    "one colour of -1e+30": lambda: room(sh0=odd(-1e30)),
    "all of one colour": lambda: room(sh0=lambda v: v.fill(0.2)),
}


@case("what is shown, {name}", name=SHOWN)
def pixel_values(name: str) -> Outcome:
    """Opacities and colours of a pixel, in [0, 1]; the plain way quantises what is stored."""
    of = SHOWN[name]()

    def pixels(logits: np.ndarray, sh0: np.ndarray) -> np.ndarray:
        opacity = 1 / (1 + np.exp(-logits.astype(np.float64).clip(-700, 700)))
        return np.column_stack(
            [others(opacity), others(sh0[:, 0].astype(float) * C0 + 0.5).clip(0, 1)]
        )

    unpacked = unpack(pack(of))
    stored = of["logit_opacities"], of["sh0"]

    def plainly() -> np.ndarray:
        return pixels(*map(eight_bits, stored))

    return beside(
        pixels(unpacked["logit_opacities"], unpacked["sh0"]), plainly, pixels(*stored), 0.01
    )


WORLDS = {
    "in units of 1e-06": (0.0, 1e-6),
    "in units of 1e+06": (0.0, 1e6),
    "at 5e+05": (5e5, 1.0),
    "at 5e+05 in units of 1e-03": (5e5, 1e-3),
    "at 1e+09": (1e9, 1.0),
    "at 1e+09 in units of 1e+06": (1e9, 1e6),
}


@case("a PLY of a world {name}", name=WORLDS)
def files(name: str) -> Outcome:
    """Places and sizes over the room's; plainly, the source's coordinates become float32."""
    origin, scale = WORLDS[name]
    of, world = (
        room() | {"degrees": np.full(N, 3, np.uint8)},
        World((origin, -origin, origin), scale),
    )
    with tempfile.TemporaryDirectory() as folder:
        write_ply(Path(folder) / "room.ply", of, 3, world=world)
        loaded, _, _ = read_ply(Path(folder) / "room.ply", world)

    def plainly() -> np.ndarray:
        return world.inward(world.outward(of["means"]).astype(np.float32))

    outcome = beside(loaded["means"], plainly, of["means"], 2e-6)
    sizes = relative(np.exp(loaded["log_scales"]), np.exp(of["log_scales"]))
    return outcome._replace(error=max(outcome.error, sizes))
