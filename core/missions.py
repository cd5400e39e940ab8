"""Mission accuracy curves: the standard error of a position and a proper motion against magnitude."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Curve(Protocol):
    """A standard error as a function of magnitude."""

    def __call__(self, v_mag: Array) -> Array:
        """Return the standard error at each magnitude, same shape."""
        ...


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
class PyGaia:
    """The predicted error of a Gaia release per coordinate, mean square of ra* and dec, in mas or mas/yr.

    The study's V is taken as G; for quasars G - V is about -0.1 to 0 mag, which changes an error by at most 9 %.  The
    formula holds for G = 3 to 21 and is constant brighter than 13.
    Raises MissionUnavailableError, when it is called, without the package PyGaia.
    Source: PyGaia (A. Brown), `pygaia.errors.astrometric`, the model of ESA's Gaia science performance pages.
    """

    quantity: Literal["position", "proper_motion"]
    release: Literal["dr3", "dr4", "dr5"]

    def __call__(self, v_mag: Array) -> Array:
        """Return the error at each magnitude."""
        try:  # only here: PyGaia is optional, and importing it takes half a second
            from pygaia.errors import astrometric
        except ImportError as error:
            raise MissionUnavailableError(
                f"the model 'gaia-{self.release}' needs PyGaia: pip install 'linksweep[gaia]' ({error})"
            ) from error
        formula = getattr(astrometric, f"{self.quantity}_uncertainty")
        ra_uas, dec_uas = formula(np.atleast_1d(v_mag), release=self.release)
        sigma_mas: Array = np.sqrt((ra_uas**2 + dec_uas**2) / 2.0) / 1000.0
        return sigma_mas.reshape(np.shape(v_mag))


@dataclass(frozen=True)
class Mission:
    """One mission's accuracy at its nominal length, and how it changes with length.

    Positions improve as T^-1/2 and proper motions as T^-3/2.  ``faint_limit_mag`` is where the curve ends.
    """

    curve_pos_mas: Curve
    curve_pm_mas_yr: Curve
    nominal_length_yr: float
    faint_limit_mag: float
    source: str

    def sigma_pos_mas(self, v_mag: Array, mission_length_yr: float | None = None) -> Array:
        """Return the position error per coordinate in mas; ``v_mag`` of any shape, None for the nominal length."""
        return self.curve_pos_mas(v_mag) * np.float64(self._length_ratio(mission_length_yr)) ** -0.5

    def sigma_pm_mas_yr(self, v_mag: Array, mission_length_yr: float | None = None) -> Array:
        """Return the proper-motion error per coordinate in mas/yr."""
        return self.curve_pm_mas_yr(v_mag) * np.float64(self._length_ratio(mission_length_yr)) ** -1.5

    def _length_ratio(self, mission_length_yr: float | None) -> float:
        return 1.0 if mission_length_yr is None else mission_length_yr / self.nominal_length_yr


class AccuracyCurves(NamedTuple):
    """Curves of M missions at V magnitudes: names (M,), mag (V,), sigma_pos in mas and sigma_pm in mas/yr (M, V).

    NaN is beyond a mission's faint limit.
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


def _gaia_release(release: Literal["dr3", "dr4", "dr5"], months: float) -> Mission:
    return Mission(
        curve_pos_mas=PyGaia("position", release),
        curve_pm_mas_yr=PyGaia("proper_motion", release),
        nominal_length_yr=months / 12.0,
        faint_limit_mag=21.0,
        source=f"PyGaia, pygaia.errors.astrometric, release {release}; V taken as G; {months:g} months of data",
    )


AMEX_PM = Exponentials(((0.139, 0.215, 9.0), (14.2, 0.973, 15.0)))
GAIA_PM = Exponentials(((0.01496, 0.443, 15.0),))
_GAIA_2001_MAG = tuple(float(g) for g in range(10, 22))
_GAIA_2001_PM_UAS = (3, 3, 3, 4, 5, 8, 13, 20, 34, 60, 120, 380)
_GAIA_2001_POS_UAS = (3, 3, 3, 4, 6, 9, 15, 23, 39, 70, 140, 440)

MISSIONS: Mapping[str, Mission] = MappingProxyType(
    {
        "amex": Mission(
            curve_pos_mas=AMEX_PM.times(0.60),
            curve_pm_mas_yr=AMEX_PM,
            nominal_length_yr=2.0,
            faint_limit_mag=np.inf,
            source="two exponentials fitted to the 28 AMEX numbers of Metz & Geffert 2004 (Tables 1 and 2) with "
            "inverse-variance weights; position/motion ratio of DIVA, 0.15 mas to 0.25 mas/yr (at V = 9, where the "
            "fitted curve has 0.18 mas/yr)",
        ),
        "gaia": Mission(
            curve_pos_mas=GAIA_PM.times(1.15),
            curve_pm_mas_yr=GAIA_PM,
            nominal_length_yr=5.0,
            faint_limit_mag=np.inf,
            source="one exponential fitted to the GAIA column of Metz & Geffert 2004, Table 1",
        ),
        "gaia-2001": Mission(
            curve_pos_mas=LogLinear(_GAIA_2001_MAG, tuple(s / 1000.0 for s in _GAIA_2001_POS_UAS)),
            curve_pm_mas_yr=LogLinear(_GAIA_2001_MAG, tuple(s / 1000.0 for s in _GAIA_2001_PM_UAS)),
            nominal_length_yr=5.0,
            faint_limit_mag=21.0,
            source="ESA's 2001 prediction for G = 10..21 (Perryman et al. 2001), log-linear between; "
            "the table was not confirmed in print",
        ),
        # The length is the one PyGaia's numbers stand for: it puts DR4 at 60 months, though DR4 itself will have 66.
        "gaia-dr3": _gaia_release("dr3", 34),
        "gaia-dr4": _gaia_release("dr4", 60),
        "gaia-dr5": _gaia_release("dr5", 120),
    }
)
"""The built-in missions by name."""
