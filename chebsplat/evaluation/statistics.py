"""Means with their spread, and paired differences with an interval, of the runs of a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

Values = np.ndarray | Sequence[float]

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Summary:
    """Mean and sample standard deviation of `n` values; the spread of one value is nan."""

    mean: float
    spread: float
    n: int


@dataclass(frozen=True)
class Difference:
    """A mean paired difference (or ratio), its spread over pairs, and its 95 % interval.

    `low`, `high`, `error` are nan with a single unit, which tests no other scene or seed.
    """

    mean: float
    spread: float
    error: float
    low: float
    high: float
    n_pairs: int
    n_units: int
    neutral: float  # what "no effect" is: 0 of a difference, 1 of a ratio

    @property
    def excluded(self) -> bool:
        """True where the interval excludes "no effect"."""
        return bool(self.low > self.neutral or self.high < self.neutral)


def summarize(values: Values) -> Summary:
    """Mean ± sample standard deviation of values [N]. ValueError on none or a non-finite one."""
    values = _finite(values)
    return Summary(
        float(values.mean()),
        float(values.std(ddof=1)) if len(values) > 1 else float("nan"),
        len(values),
    )


def paired_difference(
    values: Values, baseline: Values, scenes: list[str], ratio: bool = False
) -> Difference:
    """values − baseline (or values / baseline) over pairs of the same scene and seed.

    Args: values, baseline [N], the same scene and seed at each index; scenes: N names; ratio:
      positive values whose quotient is meant; the mean is then geometric.
    Raises: ValueError on no pair, lengths that disagree, a value that is not finite, or a ratio of
      one that is not > 0.
    Choices: seeds of one scene are not independent of each other, so the interval is Student's over
      the scenes' means; with one scene it is over the seeds, and does not hold for other scenes.
      `error` and `spread` of a ratio are of its logarithm, that is, relative.
    """
    values, baseline = _finite(values), _finite(baseline)
    if not len(values) == len(baseline) == len(scenes):
        raise ValueError(
            f"{len(values)} values, {len(baseline)} of the baseline, {len(scenes)} scenes"
        )
    if ratio and min(values.min(), baseline.min()) <= 0:
        raise ValueError("a ratio needs values > 0")
    steps = np.log(values) - np.log(baseline) if ratio else values - baseline
    names = sorted(set(scenes))
    units = (
        np.array([steps[[s == name for s in scenes]].mean() for name in names])
        if len(names) > 1
        else steps
    )
    mean, n = float(units.mean()), len(units)
    error = float(units.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
    reach = quantile(n - 1) * error if n > 1 else float("nan")
    spread = float(steps.std(ddof=1)) if len(steps) > 1 else float("nan")
    low, high = mean - reach, mean + reach
    if ratio:
        mean, low, high = (float(np.exp(x)) for x in (mean, low, high))
    return Difference(mean, spread, error, low, high, len(steps), n, 1.0 if ratio else 0.0)


def quantile(freedom: int) -> float:
    """Student's two-sided 95 % quantile."""
    return float(stdtrit(freedom, 0.5 + CONFIDENCE / 2))


def _finite(values: Values) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.ndim != 1 or len(values) == 0 or not np.isfinite(values).all():
        raise ValueError(f"finite values [N], N > 0, are needed, not {values!r}")
    return values
