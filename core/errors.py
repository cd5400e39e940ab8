"""Error models (steps C and D): the errors of a catalogue's observables, and how a study chooses them.

A new one is a subclass of `ErrorModel`, a subclass of `ErrorKind` and its entry in `ERROR_KINDS`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from linksweep.core.catalogue import SIDES, Catalogue, OwnErrors
from linksweep.core.catalogues import CATALOGUES, CatalogueKind
from linksweep.core.frames import MAS, Array
from linksweep.core.missions import CurveError, FunctionCurve, Mission, mission_of
from linksweep.sweep.contract import Named, Point

PROBES = 100
"""Magnitudes at which a user's function is tested before anything runs."""


class Errors(NamedTuple):
    """Errors of a position (mas) and a proper motion (mas/yr)."""

    pos_mas: float
    pm_mas_yr: float


class ErrorModel:
    """The errors of one side: each is normal around zero, and those of different objects are independent."""

    def is_elementwise(self) -> bool:
        """Return whether the errors of an object follow from its magnitude alone, to the last bit, so that catalogues
        which begin with the same objects share them.
        """
        return False

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the errors of (ra*, dec, pmra, pmdec) of each object in rad and rad/yr; shape (4, N)."""
        raise NotImplementedError

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the correlations of each object's four errors, shape (N, 4, 4), or None where there are none."""
        return None

    def at(self, v_mag: Callable[[], float]) -> Errors:
        """Return the errors of an object of magnitude ``v_mag()``, which is called only where it matters, with a few
        multiplications; not implemented for errors that a catalogue lists.
        """
        raise NotImplementedError


def _four_rows(sigma_pos_mas: Array, sigma_pm_mas_yr: Array) -> Array:
    """Return errors of (ra*, dec, pmra, pmdec) in rad and rad/yr, shape (4, N), from those of a coordinate (N,)."""
    return MAS * np.stack([sigma_pos_mas, sigma_pos_mas, sigma_pm_mas_yr, sigma_pm_mas_yr])


@dataclass(frozen=True)
class NormalErrors(ErrorModel):
    """The same errors for every object: ``sigma_pos_mas`` per coordinate and ``sigma_pm_mas_yr``, times ``scale``."""

    sigma_pos_mas: float
    sigma_pm_mas_yr: float
    scale: float = 1.0

    def is_elementwise(self) -> bool:
        """Return True."""
        return True

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return constants; shape (4, N)."""
        return _four_rows(*(np.full(len(catalogue), sigma) for sigma in self.at(lambda: math.nan)))

    def at(self, v_mag: Callable[[], float]) -> Errors:
        """Return the sigmas, whatever the magnitude."""
        return Errors(self.scale * self.sigma_pos_mas, self.scale * self.sigma_pm_mas_yr)


NO_ERRORS = NormalErrors(0.0, 0.0)
"""The model of error-free data."""


@dataclass(frozen=True)
class MagnitudeErrors(ErrorModel):
    """A mission's accuracy curve at a mission length (None: its nominal one), times ``scale``."""

    mission: Mission
    mission_length_yr: float | None = None
    scale: float = 1.0

    def is_elementwise(self) -> bool:
        """Return whether no curve is a user's function, which may round differently among other objects."""
        curves = self.mission.curve_pos_mas, self.mission.curve_pm_mas_yr
        return not any(isinstance(curve, FunctionCurve) for curve in curves)

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the curve at each object's magnitude; shape (4, N)."""
        return _four_rows(
            self.scale * self.mission.sigma_pos_mas(catalogue.v_mag, self.mission_length_yr),
            self.scale * self.mission.sigma_pm_mas_yr(catalogue.v_mag, self.mission_length_yr),
        )

    def at(self, v_mag: Callable[[], float]) -> Errors:
        """Return the curve's values; infinite ones, not an overflow, far beyond its range."""
        pos_mas, pm_mas_yr = _nominal_errors(self.mission, v_mag())
        if self.mission_length_yr is not None:
            ratio = np.float64(self.mission_length_yr / self.mission.nominal_length_yr)
            with np.errstate(all="ignore"):
                pos_mas, pm_mas_yr = pos_mas * float(ratio**-0.5), pm_mas_yr * float(ratio**-1.5)
        return Errors(self.scale * pos_mas, self.scale * pm_mas_yr)


@dataclass(frozen=True)
class CatalogueErrors(ErrorModel):
    """The errors that the catalogue lists for each object of a side, with their correlations if any, times ``scale``.

    Raises ValueError for a catalogue without errors of its own.
    """

    scale: float = 1.0
    side: str = "satellite"

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the catalogue's own errors; shape (4, N)."""
        return self.scale * self._listed(catalogue).sigma

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the catalogue's own correlations; shape (N, 4, 4)."""
        return self._listed(catalogue).correlation

    def _listed(self, catalogue: Catalogue) -> OwnErrors:
        if (listed := catalogue.own_errors(self.side)) is None:
            raise ValueError("the catalogue has no errors of its own")
        return listed


@dataclass(frozen=True)
class FlooredErrors(ErrorModel):
    """The errors of ``model`` and an independent one of ``floor`` in each observable, in quadrature."""

    model: ErrorModel
    floor: Errors

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the root of the sum of both squares; shape (4, N)."""
        floor = NormalErrors(*self.floor).standard_errors(catalogue)
        return np.asarray(np.hypot(self.model.standard_errors(catalogue), floor))

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the correlations of the sums: smaller than those of the model, since floors are independent."""
        correlation = self.model.correlation(catalogue)
        if correlation is None:
            return None
        part, total = self.model.standard_errors(catalogue).T, self.standard_errors(catalogue).T
        share = np.divide(part, total, out=np.ones_like(part), where=total > 0.0)
        smaller = correlation * share[:, :, None] * share[:, None, :]
        smaller[:, range(4), range(4)] = 1.0
        return np.asarray(smaller)

    def at(self, v_mag: Callable[[], float]) -> Errors:
        """Return the root of the sum of both squares."""
        return Errors(*map(math.hypot, self.model.at(v_mag), self.floor))


class ErrorKind:
    """One value of `reference_errors` and `satellite_errors`: an error model as a study chooses it.

    ``sides`` are those that may have it; ``names`` the parameters of its own, with {side} for the side.
    """

    sides: tuple[str, ...] = SIDES
    names: tuple[str, ...] = ()

    def uses(self, side: str) -> frozenset[str]:
        """Return the names of the parameters that it reads, for one side."""
        common = ("error_scale", "{}_error_scale", "{}_error_ratio", "{}_floor_pos", "{}_floor_pm")
        return frozenset(name.format(side) for name in (*common, *self.names))

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the error model of a point, without its floor."""
        raise NotImplementedError

    def any(self, point: Point, side: str) -> bool:
        """Return whether there is any error, by default whether the scales are above zero."""
        return _scale(point, side) > 0.0

    def problem(self, point: Point, side: str, catalogue: CatalogueKind) -> str | None:
        """Return why the objects of a catalogue cannot have these errors, or None."""
        return None

    def warning(self, point: Point, catalogue: CatalogueKind) -> str | None:
        """Return why the errors are less certain than they seem, or None."""
        return None


class ErrorFree(ErrorKind):
    """`"none"`: no errors."""

    def uses(self, side: str) -> frozenset[str]:
        """Return no names: the scales do not matter either."""
        return frozenset()

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the error-free model."""
        return NO_ERRORS

    def any(self, point: Point, side: str) -> bool:
        """Return False."""
        return False


class Normal(ErrorKind):
    """`"normal"`: the sigmas of the study."""

    names = ("{}_sigma_pos", "{}_sigma_pm")

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the model with the point's sigmas."""
        return NormalErrors(point[f"{side}_sigma_pos"], point[f"{side}_sigma_pm"], _scale(point, side))

    def any(self, point: Point, side: str) -> bool:
        """Return whether the scales and a sigma are above zero."""
        return max(self.model(point, side).at(lambda: math.nan)) > 0.0


class Magnitude(ErrorKind):
    """`"magnitude"`: the curve of the point's mission."""

    sides = ("satellite",)
    names = ("model", "mission_length")

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the model with the point's mission and length."""
        return MagnitudeErrors(mission_of(point["model"]), point["mission_length"], _scale(point, side))

    def problem(self, point: Point, side: str, catalogue: CatalogueKind) -> str | None:
        """Return a problem if magnitudes are missing or beyond the end of the curve; raises CurveError where a user's
        function has no valid value.
        """
        brightest, faintest = catalogue.magnitudes(point)
        if math.isnan(faintest):
            return f"{side}_errors = 'magnitude' needs a magnitude column (v_mag, phot_g_mean_mag) in the file"
        model = point["model"]
        end = mission_of(model).faint_limit_mag
        if faintest > end:
            return f"v_max = {faintest:g} mag: the curve of {str(model)!r} ends at {end:g} mag"
        if not isinstance(model, str):
            _probe(model, brightest, faintest)
        return None

    def warning(self, point: Point, catalogue: CatalogueKind) -> str | None:
        """Say which magnitudes lie outside the range in which the curve is known."""
        name, mission = str(point["model"]), mission_of(point["model"])
        brightest, faintest = catalogue.magnitudes(point)
        low, high = mission.valid_mag
        outside = [f"brighter than V = {low:g}"] if brightest < low else []
        outside += [f"fainter than V = {high:g}"] if faintest > high else []
        if not outside:
            return None
        known = f"up to V = {high:g}" if low == -math.inf else f"from V = {low:g}"
        known += f" to {high:g}" if -math.inf < low and high < math.inf else ""
        return (
            f"model = {name!r}: its accuracy curve is known {known}, and the catalogue has or may have objects "
            f"{' and '.join(outside)}, where it is extrapolated or held at its floor"
        )


class Listed(ErrorKind):
    """`"catalogue"`: the errors that the catalogue lists."""

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the model with the point's scale."""
        return CatalogueErrors(_scale(point, side), side)

    def any(self, point: Point, side: str) -> bool:
        """Return whether the scales and any object's error are above zero."""
        objects = CATALOGUES[point["catalogue"]].objects(point) if _scale(point, side) > 0.0 else None
        listed = None if objects is None else objects.own_errors(side)
        return listed is not None and bool(np.any(listed.sigma))

    def problem(self, point: Point, side: str, catalogue: CatalogueKind) -> str | None:
        """Return a problem unless the objects have errors, and of both sides where both are to have their own."""
        objects = catalogue.objects(point)
        if objects is None or objects.own_errors(side) is None:
            return f"{side}_errors = 'catalogue': the {point['catalogue']} catalogue has no errors of its own"
        if point["reference_errors"] != point["satellite_errors"] or objects.reference is not None:
            return None
        both = "reference_errors and satellite_errors are both 'catalogue'"
        hint = "; name those of the other: columns = { reference_pmra_error = ... }"
        return f"{both}, but the objects have errors of one side only{hint if 'file' in catalogue.parameters else ''}"


ERROR_KINDS: Mapping[str, ErrorKind] = MappingProxyType(
    {
        "none": ErrorFree(),
        "normal": Normal(),
        "magnitude": Magnitude(),
        "catalogue": Listed(),
    }
)
"""The error models by the name that a study gives them."""


def error_kinds(side: str) -> str:
    """Return the names of the error models that a side may have, with spaces between."""
    return " ".join(name for name, kind in ERROR_KINDS.items() if side in kind.sides)


def error_kind(point: Point, side: str) -> ErrorKind:
    """Return the kind of errors of one side, "reference" or "satellite"."""
    return ERROR_KINDS[point[f"{side}_errors"]]


def floor_of(point: Point, side: str) -> Errors | None:
    """Return the floor of one side's errors; None where it has none or its kind of errors cannot have one."""
    floor = Errors(point[f"{side}_floor_pos"], point[f"{side}_floor_pm"])
    return floor if any(floor) and f"{side}_floor_pos" in error_kind(point, side).uses(side) else None


def error_model(point: Point, side: str) -> ErrorModel:
    """Return the error model of one side with its floor."""
    model, floor = error_kind(point, side).model(point, side), floor_of(point, side)
    return model if floor is None else FlooredErrors(model, floor)


def _scale(point: Point, side: str) -> float:
    """Return the factor on all errors of one side."""
    return float(point["error_scale"] * point[f"{side}_error_scale"])


@lru_cache(maxsize=1024)
def _nominal_errors(mission: Mission, v_mag: float) -> tuple[float, float]:
    """Return the errors at a magnitude for the nominal length, once for all scales and lengths."""
    at = np.array(v_mag)
    with np.errstate(over="ignore"):
        return float(mission.sigma_pos_mas(at)), float(mission.sigma_pm_mas_yr(at))


@lru_cache(maxsize=256)
def _probe(model: Named, brightest: float, faintest: float) -> None:
    """Raise CurveError where the functions of a user's mission have no valid values between two magnitudes, or other
    values in another call.
    """
    mission, v_mag = mission_of(model), np.linspace(brightest, faintest, PROBES)
    some = slice(-2, 0, -2)  # in another order and without the ends, so that a mean or an extreme differs
    for errors, sigma in (("positions", mission.sigma_pos_mas), ("proper motions", mission.sigma_pm_mas_yr)):
        values, again = sigma(v_mag)[some], sigma(v_mag[some])
        differs = ~np.isclose(values, again, rtol=1e-9, atol=0.0)  # a logarithm may round differently in another place
        if differs.any():
            first = int(np.argmax(differs))
            raise CurveError(
                f"model = {model.name!r}: the error of {errors} at V = {v_mag[some][first]:g} mag is {values[first]:g} "
                f"in one call and {again[first]:g} in another: it must depend on nothing but the magnitude"
            )
