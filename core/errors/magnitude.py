"""Errors that follow a mission's accuracy curve."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import Catalogue
from linksweep.core.catalogues.kind import CatalogueKind
from linksweep.core.errors.model import ErrorKind, ErrorModel, Errors, Objects, four_rows, scale_of
from linksweep.core.function_curve import CurveError, CurveOfFunction
from linksweep.core.missions import Mission
from linksweep.core.user_mission import mission_of
from linksweep.sweep.contract import Named, Point

PROBES = 100
"""Magnitudes at which a user's function is tested before anything runs."""


@dataclass(frozen=True)
class MagnitudeErrors(ErrorModel):
    """A mission's accuracy curve at a mission length (None: its nominal one), times ``scale``."""

    mission: Mission
    mission_length_yr: float | None = None
    scale: float = 1.0

    @property
    def elementwise(self) -> bool:
        """Whether no curve is a user's function, which may round differently among other objects."""
        curves = self.mission.curve_pos_mas, self.mission.curve_pm_mas_yr
        return not any(isinstance(curve, CurveOfFunction) for curve in curves)

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the curve at each object's magnitude; shape (4, N)."""
        return four_rows(
            self.scale * self.mission.sigma_pos_mas(catalogue.v_mag, self.mission_length_yr),
            self.scale * self.mission.sigma_pm_mas_yr(catalogue.v_mag, self.mission_length_yr),
        )


class Magnitude(ErrorKind):
    """`"magnitude"`: the curve of the point's mission."""

    sides = ("satellite",)

    def uses(self, side: str) -> frozenset[str]:
        """Return the mission, its length and the scales."""
        return super().uses(side) | {"model", "mission_length"}

    def model(self, point: Point, side: str) -> ErrorModel:
        """Return the model with the point's mission and length."""
        return MagnitudeErrors(mission_of(point["model"]), point["mission_length"], scale_of(point, side))

    def errors_at(self, point: Point, side: str, v_mag: Callable[[], float]) -> Errors:
        """Return the curve's values; infinite ones, not an overflow, far beyond its range."""
        scale, length_yr = scale_of(point, side), point["mission_length"]
        pos_mas, pm_mas_yr, nominal_yr = _curves(point["model"], v_mag())
        if length_yr is not None:
            ratio = length_yr / nominal_yr
            pos_mas, pm_mas_yr = pos_mas * _power(ratio, -0.5), pm_mas_yr * _power(ratio, -1.5)
        return Errors(scale * pos_mas, scale * pm_mas_yr)

    def any(self, point: Point, side: str, objects: Objects) -> bool:
        """Return whether the scale is above zero: a curve is positive everywhere."""
        return scale_of(point, side) > 0.0

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


@lru_cache(maxsize=1024)
def _curves(model: str | Named, v_mag: float) -> tuple[float, float, float]:
    """Return the errors at a magnitude and the nominal length, once for all scales and lengths."""
    mission, at = mission_of(model), np.array(v_mag)
    with np.errstate(over="ignore"):
        pos_mas, pm_mas_yr = float(mission.sigma_pos_mas(at)), float(mission.sigma_pm_mas_yr(at))
    return pos_mas, pm_mas_yr, mission.nominal_length_yr


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


def _power(ratio: float, exponent: float) -> float:
    try:
        return float(ratio**exponent)
    except (OverflowError, ZeroDivisionError):
        return math.inf
