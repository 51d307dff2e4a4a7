"""Parameters and results of a descriptor, shared by its compiled and its plain form. No torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

Values = TypeVar("Values")  # Tensor or np.ndarray


class Described(NamedTuple, Generic[Values]):
    """values [M, n, J, P], P = D - 1; n_exact regions took the float64 operator."""

    values: Values
    n_exact: int = 0


@dataclass(frozen=True)
class Descriptor:
    """Parameters, as in `settings.DescribeSection`: J angles, D degrees, a, the bandwidth."""

    n_angles: int = 8
    max_degree: int = 8
    anisotropy: float = 10.0
    bandwidth: float = 0.7
