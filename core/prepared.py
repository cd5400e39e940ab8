"""What all realisations of one catalogue share."""

import math
from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array, Stack
from linksweep.core.catalogue import Catalogue
from linksweep.core.design import ORIENTATION, SPIN
from linksweep.core.frames import along, exact_differences, stored_differences
from linksweep.core.link import OBSERVABLES, UnlikeError, combined_error, measured
from linksweep.core.noise import Noise
from linksweep.core.scenario import Scenario
from linksweep.core.shared_arrays import Prefixes


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
    def held(self) -> slice:
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
    sigma, kinds = _weighing(reference.sigma, satellite.sigma, shared)
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


def _weighing(reference: Array, satellite: Array, shared: Prefixes) -> tuple[Array, tuple[bool, bool]]:
    """Return the errors for the weights, (N, 4), and whether positions and proper motions are measured."""

    def combine(*sides: Array) -> Array:
        return np.ascontiguousarray(combined_error(*(side.T for side in sides)).T)

    if np.all(satellite > 0.0):  # then the result of an object depends on no other one
        return shared.once("combined errors", combine, reference, satellite), (True, True)
    return combine(reference, satellite), measured(reference.T + satellite.T)


def _differences(scenario: Scenario, drawn: Draw, shared: Prefixes) -> Array:
    catalogue, vectors = drawn.catalogue, np.array([drawn.epsilon, drawn.omega, scenario.aberration])
    epsilon, omega, glide = vectors
    systematics = scenario.systematics

    def compute(ra: Array, dec: Array, pmra: Array, pmdec: Array, *v_mag: Array) -> Array:
        found = np.empty((len(ra), 4))
        for part, here in shared.objects(ra, dec, pmra, pmdec):
            observed = here.ra, here.dec, here.pmra, here.pmdec
            if scenario.arithmetic == "exact":
                found[part] = exact_differences(*observed, epsilon, omega, here.triad).T
            else:
                found[part] = stored_differences(*observed, epsilon, omega).T
            if np.any(glide):
                found[part, 2] -= along(glide, here.triad.p)  # minus: the glide is in the satellite's motions
                found[part, 3] -= along(glide, here.triad.q)
            if systematics:
                found[part, 2:] += systematics.differences(here.ra, here.dec, *(v[part] for v in v_mag)).T
        return found

    settings = "differences", scenario.arithmetic, vectors.tobytes(), systematics
    # magnitudes only where they matter, so that objects that differ in nothing else are shared
    v_mag = (catalogue.v_mag,) if systematics.need_magnitudes else ()
    return shared.once(settings, compute, catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec, *v_mag)
