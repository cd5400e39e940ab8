"""What all realisations of one catalogue share: differences without errors, weights, and the errors of both sides."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from linksweep.core.arrays import Array, Stack
from linksweep.core.catalogue import Catalogue
from linksweep.core.errors import ErrorModel
from linksweep.core.frames import along, exact_differences, stored_differences
from linksweep.core.link import OBSERVABLES, UnlikeError, combined_error, measured
from linksweep.core.scenario import Scenario
from linksweep.core.setup import Prefixes
from linksweep.core.systematics import DrawnField, Field, ZonalErrors
from linksweep.core.unknowns import ORIENTATION, SPIN


@dataclass(frozen=True)
class Noise:
    """True errors of one side: standard errors (N, 4) and, where they are correlated, Cholesky factors (N, 4, 4).

    They are ``inflation`` times the errors in the weights.  A ``field`` has further errors, which objects share.
    """

    sigma: Array
    factor: Array | None
    inflation: float = 1.0
    field: Field | None = None

    @staticmethod
    def of(model: ErrorModel, catalogue: Catalogue, shared: Prefixes) -> "Noise":
        """Return the errors that a model gives the objects of a catalogue."""

        def compute(*_: Array) -> Array:
            return np.ascontiguousarray(model.standard_errors(catalogue).T)

        correlation = model.correlation(catalogue)
        sigma = shared.once(("errors", model), compute, catalogue.v_mag) if model.is_elementwise() else compute()
        return Noise(sigma, None if correlation is None else np.asarray(np.linalg.cholesky(correlation)))

    def inflated(self, factor: float) -> "Noise":
        """Return errors ``factor`` times as large, with the same weights."""
        if factor == 1.0 or not self._any:
            return self
        return replace(self, sigma=factor * self.sigma, inflation=factor * self.inflation)

    def with_zonal(self, errors: ZonalErrors | None, catalogue: Catalogue) -> "Noise":
        """Return these errors with zonal errors of the objects of a catalogue added."""
        return self if errors is None else replace(self, field=Field(errors, catalogue.ra, catalogue.dec))

    def __bool__(self) -> bool:
        return self.field is not None or self._any

    @cached_property
    def _any(self) -> bool:
        return bool(np.any(self.sigma))

    @property
    def as_weighed(self) -> bool:
        """Whether all errors are independent and equal to those in the weights."""
        return self.factor is None and self.field is None and self.inflation == 1.0

    @property
    def ratio(self) -> float:
        """The errors of single objects over those in the weights; 0 where only a field has errors."""
        return self.inflation if self._any else 0.0

    def draw_field(self, rows: int, rng: np.random.Generator) -> DrawnField | None:
        """Return ``rows`` realisations of the errors that objects share, or None."""
        return None if self.field is None else self.field.draw(rows, rng)

    def standardised(self, normals: Array, start: int) -> Array:
        """Return errors in units of their sigma from the unit normals (m, 4, rows) of the objects from ``start`` on."""
        return normals if self.factor is None else self.factor[start : start + len(normals)] @ normals

    def variance_through(self, gain: Array) -> Array:
        """Return the variance of each unknown from these errors; ``gain`` (N, 4, K), result (K,)."""
        scaled = self.sigma[..., None] * gain
        if self.factor is not None:
            scaled = np.swapaxes(self.factor, 1, 2) @ scaled
        variance = np.asarray(np.einsum("nik,nik->k", scaled, scaled))
        return variance if self.field is None else variance + self.field.variance_through(gain)


@dataclass(frozen=True)
class Setup:
    """What all realisations of one catalogue share, in rad and rad/yr; K unknowns, N objects.

    In a ``stack`` of catalogues the objects of one follow those of the one before, and the truth is the same for all.
    """

    scenario: Scenario
    catalogue: Catalogue
    truth: Array  # (K,)
    differences: Array  # (N, 4) without errors, reference - satellite
    reference: Noise
    satellite: Noise
    sigma: Array  # (N, 4), as the link weighs the differences
    measured: tuple[bool, bool] = (True, True)  # positions, proper motions
    stack: Stack = ()

    @property
    def n_obj(self) -> int:
        """The number of objects of one catalogue."""
        return len(self.catalogue) // math.prod(self.stack)

    def stacked(self, rows: Array) -> Array:
        """Return an array over all objects with its first axis split into catalogues and objects."""
        return rows.reshape(*self.stack, self.n_obj, *rows.shape[1:])

    @property
    def observables(self) -> slice:
        """The observables that are measured."""
        positions, motions = self.measured
        return slice(OBSERVABLES[0 if positions else 1].start, OBSERVABLES[1 if motions else 0].stop)

    @property
    def counted(self) -> Array:
        """1 for each observable that is measured, 0 for the others; shape (4,)."""
        return np.repeat(self.measured, 2).astype(float)

    @property
    def fixed(self) -> slice:
        """The unknowns that no measured observable determines, which stay at their true values."""
        positions, motions = self.measured
        return slice(SPIN.start if positions else ORIENTATION.start, SPIN.start if motions else len(self.truth))


@dataclass(frozen=True)
class Draw:
    """One catalogue and the true orientation (rad) and spin (rad/yr) that go with it: steps A and B."""

    catalogue: Catalogue
    epsilon: Array
    omega: Array
    stack: Stack = ()

    @staticmethod
    def of(scenario: Scenario, catalogue: Catalogue, direction_rng: np.random.Generator, stack: Stack = ()) -> "Draw":
        """Draw the vectors that go with a catalogue, or with all of a stack, for which they are not random."""
        return Draw(catalogue, scenario.epsilon.draw(direction_rng), scenario.omega.draw(direction_rng), stack)


def prepare(scenario: Scenario, drawn: Draw, shared: Prefixes) -> Setup:
    """Return the errors and differences of the objects; raises LinkError where these cannot be weighed, UnlikeError
    for a stack in which only some catalogues have errors, or errors are correlated.
    """
    catalogue, glide = drawn.catalogue, np.array(scenario.aberration)
    reference = Noise.of(scenario.reference_errors, catalogue, shared)
    satellite = Noise.of(scenario.satellite_errors, catalogue, shared)
    for side in (reference, satellite) if drawn.stack else ():
        if side.factor is not None:
            raise UnlikeError("the errors of an object are correlated")
        any_errors = side.sigma.reshape(*drawn.stack, -1).any(axis=-1)
        if any_errors.any() and not any_errors.all():
            raise UnlikeError("some of the catalogues have no errors")

    def combine(*sides: Array) -> Array:
        return np.ascontiguousarray(combined_error(*(side.T for side in sides)).T)

    if np.all(satellite.sigma > 0.0):  # then the result of an object depends on no other one
        sigma, kinds = shared.once("combined errors", combine, reference.sigma, satellite.sigma), (True, True)
    else:
        sigma, kinds = combine(reference.sigma, satellite.sigma), measured(reference.sigma.T + satellite.sigma.T)
    return Setup(
        scenario=scenario,
        catalogue=catalogue,
        truth=np.concatenate([drawn.epsilon, drawn.omega, *([-glide] if scenario.solve_glide else [])]),
        differences=_differences(scenario, drawn, shared),
        reference=reference.inflated(scenario.reference_error_ratio),
        satellite=satellite.inflated(scenario.satellite_error_ratio).with_zonal(scenario.zonal, catalogue),
        sigma=sigma,
        measured=kinds,
        stack=drawn.stack,
    )


def _differences(scenario: Scenario, drawn: Draw, shared: Prefixes) -> Array:
    """Return the observables reference - satellite without random errors; shape (N, 4)."""
    catalogue, vectors = drawn.catalogue, np.array([drawn.epsilon, drawn.omega, scenario.aberration])
    epsilon, omega, glide = vectors
    systematics = scenario.systematics

    def compute(ra: Array, dec: Array, pmra: Array, pmdec: Array, *v_mag: Array) -> Array:
        differences = np.empty((len(ra), 4))
        for part, here in shared.objects(ra, dec, pmra, pmdec):
            observed = here.ra, here.dec, here.pmra, here.pmdec
            if scenario.arithmetic == "exact":
                differences[part] = exact_differences(*observed, epsilon, omega, here.triad).T
            else:
                differences[part] = stored_differences(*observed, epsilon, omega).T
            if np.any(glide):
                differences[part, 2] -= along(glide, here.triad.p)  # minus: the glide is in the satellite's motions
                differences[part, 3] -= along(glide, here.triad.q)
            if systematics:
                differences[part, 2:] += systematics.differences(here.ra, here.dec, *(v[part] for v in v_mag)).T
        return differences

    settings = "differences", scenario.arithmetic, vectors.tobytes(), systematics
    # magnitudes only where they matter, so that objects that differ in nothing else are shared
    v_mag = (catalogue.v_mag,) if systematics.need_magnitudes else ()
    return shared.once(settings, compute, catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec, *v_mag)
