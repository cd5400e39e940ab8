"""One point's physics, and what all realisations of one catalogue share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.catalogue import Catalogue
from core.errors import ErrorModel
from core.frames import exact_differences, stored_differences, triad
from core.link import Weighting, combined_error
from core.noise import Noise

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Arithmetic = Literal["exact", "stored"]
Method = Literal["catalogue", "projected"]

PART = 2048
"""Objects that are prepared at a time, so that intermediate arrays stay in cache."""


@dataclass(frozen=True)
class TrueVector:
    """A true rotation or spin: one vector for all catalogues, or one of its length in a random direction for each."""

    vector: Vector
    random_direction: bool = False

    def draw(self, rng: np.random.Generator) -> Array:
        """Return the vector of one catalogue; shape (3,)."""
        fixed = np.array(self.vector)
        if not self.random_direction:
            return fixed
        direction = rng.standard_normal(3)
        return np.asarray(np.linalg.norm(fixed) * direction / np.linalg.norm(direction))


@dataclass(frozen=True)
class Scenario:
    """One point's physics: how a catalogue is drawn, its errors, the truth (rad, rad/yr) and how the link is solved.

    ``aberration`` is a glide (rad/yr) added to the satellite's proper motions; ``solve_glide`` adds it to the unknowns.
    ``method`` says whether the errors of every object are drawn or what the link makes of them.
    """

    draw_catalogue: Callable[[np.random.Generator], Catalogue]
    reference_errors: ErrorModel
    satellite_errors: ErrorModel
    epsilon: TrueVector
    omega: TrueVector
    aberration: Vector = (0.0, 0.0, 0.0)
    solve_glide: bool = False
    corrections: bool = True
    weighting: Weighting = "inverse-variance"
    arithmetic: Arithmetic = "exact"
    method: Method = "catalogue"


@dataclass(frozen=True)
class Setup:
    """What all realisations of one catalogue share, in rad and rad/yr; K unknowns, N objects."""

    scenario: Scenario
    catalogue: Catalogue
    truth: Array  # (K,)
    differences: Array  # (N, 4) without errors, reference - satellite
    reference: Noise
    satellite: Noise
    sigma: Array  # (N, 4), as the link weighs the differences


def prepare(scenario: Scenario, catalogue_rng: np.random.Generator, direction_rng: np.random.Generator) -> Setup:
    """Draw a catalogue and the truth (steps A and B) and the errors of its objects; raises LinkError where these
    cannot be weighed.
    """
    catalogue = scenario.draw_catalogue(catalogue_rng)
    epsilon, omega = scenario.epsilon.draw(direction_rng), scenario.omega.draw(direction_rng)
    glide = np.array(scenario.aberration)
    reference = Noise.of(scenario.reference_errors, catalogue)
    satellite = Noise.of(scenario.satellite_errors, catalogue)
    return Setup(
        scenario=scenario,
        catalogue=catalogue,
        truth=np.concatenate([epsilon, omega, -glide] if scenario.solve_glide else [epsilon, omega]),
        differences=_differences(scenario, catalogue, epsilon, omega, glide),
        reference=reference,
        satellite=satellite,
        sigma=np.ascontiguousarray(combined_error(reference.sigma.T, satellite.sigma.T).T),
    )


def parts(n_obj: int) -> list[slice]:
    """Return the slices of at most `PART` objects that make up a catalogue."""
    return [slice(start, min(start + PART, n_obj)) for start in range(0, n_obj, PART)]


def _differences(scenario: Scenario, catalogue: Catalogue, epsilon: Array, omega: Array, glide: Array) -> Array:
    subtract = exact_differences if scenario.arithmetic == "exact" else stored_differences
    found = np.empty((len(catalogue), 4))
    for part in parts(len(catalogue)):
        ra, dec = catalogue.ra[part], catalogue.dec[part]
        found[part] = subtract(ra, dec, catalogue.pmra[part], catalogue.pmdec[part], epsilon, omega).T
        if np.any(glide):
            p, q, _ = triad(ra, dec)
            found[part, 2] -= glide @ p  # it is in the satellite's motions
            found[part, 3] -= glide @ q
    return found
