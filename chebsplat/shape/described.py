"""Parameters and results of a descriptor, shared by its compiled and its plain form. No torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, NamedTuple, TypeVar

Spectrum = Literal["full", "taper", "hard"]
Metric = Literal["relative", "printed"]
Axis = Literal["tangent", "world"]
Values = TypeVar("Values")  # Tensor or np.ndarray


class Described(NamedTuple, Generic[Values]):
    """values [M, n, J, P]; of the n_cuts cuts of the spectrum (region and angle), n_clustered fell into a cluster of
    eigenvalues; n_exact regions took the float64 operator; of n_guarded (region and angle, too) the kept eigenvalues
    are all but 0, where the print divides by them. All counts are 0 where they do not apply.
    """

    values: Values
    n_cuts: int = 0
    n_clustered: int = 0
    n_exact: int = 0
    n_guarded: int = 0


@dataclass(frozen=True)
class Descriptor:
    """Numbers and rules of a descriptor, as in `settings.DescribeSection`: J angles, D degrees, a, the width; the whole
    spectrum, or what `albo.cut_spectrum` leaves of it with K = n_eigs; the printed metric, axis and first degree.
    """

    n_angles: int = 8
    max_degree: int = 8
    anisotropy: float = 10.0
    bandwidth: float = 0.7
    spectrum: Spectrum = "full"
    n_eigs: int = 16
    metric: Metric = "relative"
    axis: Axis = "tangent"
    from_degree: int | None = None


def n_degrees(spectrum: Spectrum, max_degree: int, from_degree: int | None = None) -> int:
    """P, values of one angle: degrees 2...D of the full spectrum, whose first two vanish, and 0...D of a cut one,
    unless `from_degree` says where to begin.
    """
    if from_degree is None:
        from_degree = 2 if spectrum == "full" else 0
    return max_degree + 1 - from_degree


def compiles(spectrum: Spectrum, metric: Metric, axis: Axis) -> bool:
    """Does the numba backend, and so a machine without torch, know this descriptor?"""
    return spectrum == "full" and metric == "relative" and axis == "tangent"
