"""The forms of accuracy curves: the standard error of one object against its magnitude."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from core.arrays import Array

Curve = Callable[[Array], Array]
"""A standard error as a function of magnitude: that at each magnitude, same shape."""


@dataclass(frozen=True)
class Exponentials:
    """The sum of ``amplitude * exp(slope * (V - pivot))`` over terms (amplitude, slope 1/mag, pivot mag)."""

    terms: tuple[tuple[float, float, float], ...]

    def __call__(self, v_mag: Array) -> Array:
        """Return the sum at each magnitude."""
        return np.asarray(sum(a * np.exp(slope * (v_mag - pivot)) for a, slope, pivot in self.terms))

    def times(self, factor: float) -> "Exponentials":
        """Return the curve times a factor."""
        return Exponentials(tuple((factor * a, slope, pivot) for a, slope, pivot in self.terms))


@dataclass(frozen=True)
class LogLinear:
    """Log-linear interpolation in a table; constant outside its ends."""

    magnitudes: tuple[float, ...]
    values: tuple[float, ...]

    def __call__(self, v_mag: Array) -> Array:
        """Return the interpolated value at each magnitude."""
        return np.asarray(np.exp(np.interp(v_mag, self.magnitudes, np.log(self.values))))

    def times(self, factor: float) -> "LogLinear":
        """Return the curve times a factor."""
        return LogLinear(self.magnitudes, tuple(factor * value for value in self.values))
