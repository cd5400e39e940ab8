"""Error models (steps C and D): the errors of a catalogue's observables, and how a study chooses them.

A new one is a subclass of `ErrorModel` and its entry in `ERROR_MODELS`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, Self

import numpy as np

from linksweep.core.catalogues import NEEDS_MAGNITUDES, SIDES, Catalogue, CatalogueKind, OwnErrors
from linksweep.core.frames import MAS, Array
from linksweep.core.missions import FunctionCurve, Mission, mission_of
from linksweep.sweep.contract import Named, Point, SweepError

# Magnitudes at which a user's function is tested before anything runs.
PROBES = 100


@dataclass(frozen=True, kw_only=True)
class ErrorModel:
    """The errors of one side: each is normal around zero, and those of different objects are independent.

    They are ``scale`` times those that `at` returns.  A ``floor`` (mas, mas/yr) is an independent error of each
    coordinate of position and of proper motion, which is added in quadrature.
    """

    # The sides that may have such errors.
    sides: ClassVar[tuple[str, ...]] = SIDES
    # The parameters of all models, and those of its own by the field that has their value; with {} for the side.
    common: ClassVar[tuple[str, ...]] = (
        *("error_scale", "{}_error_scale", "{}_error_ratio"),
        *("{}_floor_pos", "{}_floor_pm"),
    )
    parameters: ClassVar[Mapping[str, str]] = {}

    side: str = "satellite"
    scale: float = 1.0
    floor: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def uses(cls, side: str) -> frozenset[str]:
        """Return the names of the parameters that it reads, for one side."""
        return frozenset(name.format(side) for name in (*cls.common, *cls.parameters.values()))

    @classmethod
    def from_point(cls, point: Point, side: str) -> Self:
        """Return the model of a side at a point."""
        values: dict[str, Any] = {field: point[name.format(side)] for field, name in cls.parameters.items()}
        scale = float(point["error_scale"] * point[f"{side}_error_scale"])
        return cls(**values, side=side, scale=scale, floor=(point[f"{side}_floor_pos"], point[f"{side}_floor_pm"]))

    @property
    def is_elementwise(self) -> bool:
        """Whether the errors of an object follow from its magnitude alone, to the last bit, so that catalogues which
        begin with the same objects share them.
        """
        return True

    def at(self, v_mag: Array) -> tuple[Array | float, Array | float]:
        """Return the errors of a position (mas) and a proper motion (mas/yr) per coordinate at magnitudes."""
        raise NotImplementedError

    def without_floor(self, catalogue: Catalogue) -> Array:
        """Return the scaled errors of (ra*, dec, pmra, pmdec) of each object in rad and rad/yr; shape (N, 4)."""
        # broadcast: a model may give one number for all objects
        position, motion = (np.broadcast_to(self.scale * sigma, len(catalogue)) for sigma in self.at(catalogue.v_mag))
        return MAS * np.stack([position, position, motion, motion], axis=1)

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the errors of (ra*, dec, pmra, pmdec) of each object in rad and rad/yr; shape (N, 4)."""
        sigma = self.without_floor(catalogue)
        return np.hypot(sigma, MAS * np.repeat(self.floor, 2)) if any(self.floor) else sigma

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the correlations of each object's four errors, shape (N, 4, 4), or None where there are none."""
        return None

    def at_limit(self, point: Point, catalogue: CatalogueKind) -> tuple[float, float]:
        """Return the errors (mas, mas/yr) of an object at the faint limit of a catalogue that is drawn."""
        position, motion = self.at_faintest(point, catalogue)
        return math.hypot(self.scale * position, self.floor[0]), math.hypot(self.scale * motion, self.floor[1])

    def at_faintest(self, point: Point, catalogue: CatalogueKind) -> tuple[float, float]:
        """Return what `at` gives for the faint limit of a catalogue; it may not be read where it does not matter."""
        position, motion = self.at(np.array(math.nan))
        return float(position), float(motion)

    def has_errors(self, objects: Catalogue | None) -> bool:
        """Return whether there is any error of the objects that a catalogue lists, or of those that it draws (None)."""
        return self.scale > 0.0 or any(self.floor)

    def problem(self, point: Point, catalogue: CatalogueKind) -> str | None:
        """Return why the objects of a catalogue cannot have these errors, or None."""
        return None

    def warning(self, point: Point, catalogue: CatalogueKind) -> str | None:
        """Return why the errors are less certain than they seem, or None."""
        return None


@dataclass(frozen=True)
class NormalErrors(ErrorModel):
    """`"normal"`: the same errors for every object, ``position_mas`` per coordinate and ``motion_mas_yr``."""

    parameters: ClassVar[Mapping[str, str]] = {"position_mas": "{}_sigma_pos", "motion_mas_yr": "{}_sigma_pm"}

    position_mas: float
    motion_mas_yr: float

    def at(self, v_mag: Array) -> tuple[float, float]:
        """Return the sigmas, whatever the magnitude."""
        return self.position_mas, self.motion_mas_yr

    def has_errors(self, objects: Catalogue | None) -> bool:
        """Return whether a sigma, with its scale, or a floor is above zero."""
        return self.scale * max(self.position_mas, self.motion_mas_yr) > 0.0 or any(self.floor)


class ErrorFree(NormalErrors):
    """`"none"`: no errors, so that scales and floors do not matter either."""

    common: ClassVar[tuple[str, ...]] = ()
    parameters: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def from_point(cls, point: Point, side: str) -> Self:
        """Return the error-free model."""
        return cls(0.0, 0.0)


@dataclass(frozen=True)
class MagnitudeErrors(ErrorModel):
    """`"magnitude"`: the accuracy curve of a mission at a length (None: its nominal one)."""

    sides = ("satellite",)
    parameters: ClassVar[Mapping[str, str]] = {"model": "model", "mission_length_yr": "mission_length"}

    model: str | Named
    mission_length_yr: float | None = None

    @property
    def mission(self) -> Mission:
        """The mission of the model."""
        return mission_of(self.model)

    @property
    def is_elementwise(self) -> bool:
        """Whether no curve is a user's function, which may round differently among other objects."""
        curves = self.mission.curve_pos_mas, self.mission.curve_pm_mas_yr
        return not any(isinstance(curve, FunctionCurve) for curve in curves)

    def at(self, v_mag: Array) -> tuple[Array, Array]:
        """Return the curve at each magnitude."""
        mission, years = self.mission, self.mission_length_yr
        return mission.sigma_pos_mas(v_mag, years), mission.sigma_pm_mas_yr(v_mag, years)

    def at_faintest(self, point: Point, catalogue: CatalogueKind) -> tuple[float, float]:
        """Return the curve at the limit, computed once for all scales: a grid has a million points."""
        return _at_magnitude(self.model, self.mission_length_yr, catalogue.magnitudes(point)[1])

    def problem(self, point: Point, catalogue: CatalogueKind) -> str | None:
        """Return a problem if magnitudes are missing or beyond the end of the curve; raises SweepError where a user's
        function has no valid value.
        """
        brightest, faintest = catalogue.magnitudes(point)
        if math.isnan(faintest):
            return f"satellite_errors = 'magnitude' {NEEDS_MAGNITUDES}"
        if faintest > (end := self.mission.faint_limit_mag):
            return f"v_max = {faintest:g} mag: the curve of {str(self.model)!r} ends at {end:g} mag"
        if isinstance(self.model, Named):
            _probe(self.model, brightest, faintest)
        return None

    def warning(self, point: Point, catalogue: CatalogueKind) -> str | None:
        """Say which magnitudes lie outside the range in which the curve is known."""
        (brightest, faintest), (low, high) = catalogue.magnitudes(point), self.mission.valid_mag
        if low <= brightest and faintest <= high:
            return None
        said = f"model = {str(self.model)!r}: its accuracy curve is known from V = {low:g} to {high:g}, and the"
        return f"{said} catalogue has or may have objects beyond, where it is extrapolated or held at its floor"


@dataclass(frozen=True)
class CatalogueErrors(ErrorModel):
    """`"catalogue"`: the errors that the catalogue lists for each object of a side, with their correlations if any.

    Raises ValueError for a catalogue without errors of its own.
    """

    @property
    def is_elementwise(self) -> bool:
        """Whether the errors follow from magnitudes: they do not."""
        return False

    def without_floor(self, catalogue: Catalogue) -> Array:
        """Return the catalogue's own errors; shape (N, 4)."""
        return self.scale * self._listed(catalogue).sigma

    def has_errors(self, objects: Catalogue | None) -> bool:
        """Return whether an object has an error of its own that the scale leaves, or a floor."""
        listed = None if objects is None else objects.own_errors(self.side)
        return any(self.floor) or (listed is not None and self.scale > 0.0 and bool(np.any(listed.sigma)))

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the catalogue's own correlations; floors make them smaller, since these are independent."""
        correlation = self._listed(catalogue).correlation
        if correlation is None or not any(self.floor):
            return correlation
        part, total = self.without_floor(catalogue), self.standard_errors(catalogue)
        # the covariance D R D keeps its off-diagonal terms while D grows to the total
        share = np.divide(part, total, out=np.ones_like(part), where=total > 0.0)
        smaller = correlation * share[:, :, None] * share[:, None, :]
        smaller[:, range(4), range(4)] = 1.0
        return np.asarray(smaller)

    def _listed(self, catalogue: Catalogue) -> OwnErrors:
        if (listed := catalogue.own_errors(self.side)) is None:
            raise ValueError("the catalogue has no errors of its own")
        return listed

    def problem(self, point: Point, catalogue: CatalogueKind) -> str | None:
        """Return a problem unless the objects have errors, and of both sides where both are to have their own."""
        objects = catalogue.objects(point)
        if objects is None or objects.own_errors(self.side) is None:
            return f"{self.side}_errors = 'catalogue': the {point['catalogue']} catalogue has no errors of its own"
        if point["reference_errors"] != point["satellite_errors"] or objects.reference or objects.satellite:
            return None
        said = "reference_errors and satellite_errors are both 'catalogue', but objects have errors of one side only"
        return f"{said}; a file may have those of the other: columns = {{ reference_pmra_error = ... }}"


# The error models by the name that a study gives them.
ERROR_MODELS: Mapping[str, type[ErrorModel]] = {
    "none": ErrorFree,
    "normal": NormalErrors,
    "magnitude": MagnitudeErrors,
    "catalogue": CatalogueErrors,
}


def error_models(point: Point) -> list[ErrorModel]:
    """Return the error models of the reference and the satellite at a point."""
    return [ERROR_MODELS[point[f"{side}_errors"]].from_point(point, side) for side in SIDES]


@lru_cache(maxsize=2**16)
def _at_magnitude(model: str | Named, length_yr: float | None, v_mag: float) -> tuple[float, float]:
    with np.errstate(all="ignore"):  # far beyond its range a curve is infinite, which is refused later
        position, motion = MagnitudeErrors(model, length_yr).at(np.array(v_mag))
    return float(position), float(motion)


# Cached: every point of a grid asks, and a user's function may take long.
@lru_cache(maxsize=256)
def _probe(model: Named, brightest: float, faintest: float) -> None:
    """Raise SweepError where the functions of a user's mission have no valid values between two magnitudes, or other
    values in another call.
    """
    mission, v_mag = mission_of(model), np.linspace(brightest, faintest, PROBES)
    some = slice(-2, 0, -2)  # in another order and without the ends, so that a mean or an extreme differs
    for errors, sigma in (("positions", mission.sigma_pos_mas), ("proper motions", mission.sigma_pm_mas_yr)):
        values, again = sigma(v_mag)[some], sigma(v_mag[some])
        differs = ~np.isclose(values, again, rtol=1e-9, atol=0.0)  # a logarithm may round differently in another place
        if differs.any():
            first = int(np.argmax(differs))
            said = f"V = {v_mag[some][first]:g} mag is {values[first]:g} in one call and {again[first]:g} in another"
            said = f"the error of {errors} at {said}: it must depend on nothing but the magnitude"
            raise SweepError(f"model = {model.name!r}: {said}")
