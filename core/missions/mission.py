"""A mission: its accuracy curves, where they are valid, the least errors at the bright end, and its length."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from linksweep.core.arrays import Array

Curve = Callable[[Array], Array]
"""A function that returns the standard error at each magnitude, in the same shape."""


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


class MissionUnavailableError(ImportError):
    """A mission's curve needs a package that is not installed; the message says how to install it."""


@dataclass(frozen=True)
class Floor:
    """The least errors at the nominal length, of objects brighter than ``brighter_than_mag`` (of all by default)."""

    pos_mas: float = 0.0
    pm_mas_yr: float = 0.0
    brighter_than_mag: float = np.inf
    source: str = ""


@dataclass(frozen=True)
class Mission:
    """One mission's accuracy at its nominal length, and how it changes with length.

    Errors of positions fall as T^-1/2 and those of proper motions as T^-3/2, those of the ``floor`` too.
    ``faint_limit_mag`` is where the curve ends; from ``valid_mag[0]`` to ``valid_mag[1]`` it rests on the data that
    ``source`` names, and objects outside cause a warning.
    """

    curve_pos_mas: Curve
    curve_pm_mas_yr: Curve
    nominal_length_yr: float
    faint_limit_mag: float
    source: str
    valid_mag: tuple[float, float] = (-np.inf, np.inf)
    floor: Floor = Floor()

    def sigma_pos_mas(self, v_mag: Array, mission_length_yr: float | None = None) -> Array:
        """Return the position error per coordinate in mas; ``v_mag`` of any shape, None for the nominal length."""
        nominal = self._at_least(self.floor.pos_mas, self.curve_pos_mas(v_mag), v_mag)
        return nominal * np.float64(self._length_ratio(mission_length_yr)) ** -0.5

    def sigma_pm_mas_yr(self, v_mag: Array, mission_length_yr: float | None = None) -> Array:
        """Return the proper-motion error per coordinate in mas/yr."""
        nominal = self._at_least(self.floor.pm_mas_yr, self.curve_pm_mas_yr(v_mag), v_mag)
        return nominal * np.float64(self._length_ratio(mission_length_yr)) ** -1.5

    def _at_least(self, least: float, sigma: Array, v_mag: Array) -> Array:
        if not least > 0.0:
            return sigma
        return np.asarray(np.where(v_mag < self.floor.brighter_than_mag, np.maximum(sigma, least), sigma))

    def _length_ratio(self, mission_length_yr: float | None) -> float:
        return 1.0 if mission_length_yr is None else mission_length_yr / self.nominal_length_yr


class AccuracyCurves(NamedTuple):
    """Curves of M missions at V magnitudes: names (M,), mag (V,), sigma_pos in mas and sigma_pm in mas/yr (M, V).

    Values are NaN beyond a mission's faint limit.
    """

    name: tuple[str, ...]
    v_mag: Array
    sigma_pos_mas: Array
    sigma_pm_mas_yr: Array


def accuracy_curves(missions: Mapping[str, Mission], v_mag: Array) -> AccuracyCurves:
    """Return the curves of missions at their nominal lengths; raises MissionUnavailableError, CurveError."""
    sigmas = np.full((2, len(missions), len(v_mag)), np.nan)
    for row, mission in enumerate(missions.values()):
        seen = v_mag <= mission.faint_limit_mag
        sigmas[0, row, seen] = mission.sigma_pos_mas(v_mag[seen])
        sigmas[1, row, seen] = mission.sigma_pm_mas_yr(v_mag[seen])
    return AccuracyCurves(tuple(missions), v_mag, *sigmas)
