"""Cases of the stability benchmark, and the way to run one."""

from __future__ import annotations

import itertools
import time
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np


class Outcome(NamedTuple):
    """Outcome of a case; it passes if error <= tolerance, so NaN fails."""

    # of our float32 result, relative to the oracle's largest value unless the module says otherwise
    error: float
    tolerance: float
    # error of the plain way to compute the same in float32, where the case has one
    naive: float = float("nan")


class Row(NamedTuple):
    module: str
    case: str
    error: float
    tolerance: float
    naive: float
    passed: bool
    note: str
    seconds: float


CASES: dict[tuple[str, str], Callable[[], Outcome]] = {}


def case(
    name: str, /, **values: Iterable[Any]
) -> Callable[[Callable[..., Outcome]], Callable[..., Outcome]]:
    """Register a function as a case of its module, or one for each combination of keyword values.

    Args: name: unique in its module; keyword values are filled in by `str.format`.
    """

    def register(function: Callable[..., Outcome]) -> Callable[..., Outcome]:
        module = function.__module__.rpartition(".")[2]
        for combination in itertools.product(*values.values()):
            arguments = dict(zip(values, combination, strict=True))
            key = (module, name.format(**arguments))
            if key in CASES:
                raise ValueError(f"two cases are called {key}")
            CASES[key] = partial(function, **arguments)
        return function

    return register


def run(key: tuple[str, str]) -> Row:
    """Run a case; an exception or a warning of ours is a failure, and named."""
    began = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            outcome, note = CASES[key](), ""
    except Exception as error:
        outcome, note = Outcome(float("inf"), 0.0), f"{type(error).__name__}: {error}"
    passed = bool(outcome.error <= outcome.tolerance)
    return Row(*key, *outcome, passed, note, time.perf_counter() - began)


def relative(ours: Any, exact: Any) -> float:
    """Largest absolute difference over the largest absolute value (or 1); inf if not finite."""
    ours, exact = np.asarray(ours, np.float64), np.asarray(exact, np.float64)
    if ours.shape != exact.shape or not (np.isfinite(ours).all() and np.isfinite(exact).all()):
        return float("inf")
    if not ours.size:
        return 0.0
    return float(np.abs(ours - exact).max() / (np.abs(exact).max() or 1.0))


def beside(
    ours: Any,
    naive: Callable[[], Any],
    exact: Any,
    tolerance: float,
    measure: Callable[[Any, Any], float] = relative,
) -> Outcome:
    """Our value and the plain one against the exact one; a plain way that raises is inf off."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            plain = measure(naive(), exact)
        # LinAlgError is a ValueError
        except (ArithmeticError, IndexError, RuntimeError, ValueError):
            plain = float("inf")
    return Outcome(measure(ours, exact), tolerance, plain)
