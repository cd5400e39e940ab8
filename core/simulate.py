"""Steps A-F of the simulation for a block of realisations of one catalogue, in bounded memory."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.catalogue import Catalogue
from core.constants import MAS
from core.errors import ErrorModel
from core.frames import exact_differences, stored_differences, triad
from core.link import Weighting, combined_error, design_matrix, normal_inverse

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Arithmetic = Literal["exact", "stored"]

CHUNK = 65536
"""Normals drawn at a time: 512 KiB stay in a core's own cache."""

TILE = 4096
"""Observables of one realisation that are drawn at a time, so that their part of the gain stays in cache too."""


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


@dataclass(frozen=True)
class BlockSums:
    """Sums over realisations; errors (estimate - truth) in mas and mas/yr, K = 6 unknowns or 9 with a glide.

    ``error`` (K,), ``error_products`` (K, K), ``chi2``; and, counted once per realisation of the catalogue, the closed
    form's ``predicted_variance`` (K,), the squares of its elements and of its mean over orientation and over spin, and
    the number of objects.
    """

    error: Array
    error_products: Array
    chi2: float
    predicted_variance: Array
    predicted_variance_squared: Array
    n_obj: float


@dataclass(frozen=True)
class _Noise:
    """Errors of one side: standard errors (4, N) and, where they are correlated, Cholesky factors (N, 4, 4)."""

    sigma: Array
    correlation: Array | None

    def __bool__(self) -> bool:
        return bool(np.any(self.sigma))

    def draw(self, rng: np.random.Generator, rows: int) -> Array:
        """Return errors of ``rows`` realisations; shape (rows, 4, N)."""
        unit = rng.standard_normal((rows, *self.sigma.shape))
        if self.correlation is not None:
            unit = np.einsum("nij,rjn->rin", np.linalg.cholesky(self.correlation), unit)
        return np.asarray(unit * self.sigma)

    def variance_through(self, gain: Array) -> Array:
        """Return the variance of each unknown from these errors; ``gain`` (4, N, K), result (K,)."""
        scaled = self.sigma[..., None] * gain
        if self.correlation is None:
            return np.asarray(np.sum(scaled**2, axis=(0, 1)))
        return np.asarray(np.einsum("ink,nij,jnk->k", scaled, self.correlation, scaled))


@dataclass(frozen=True)
class _Setup:
    """What all realisations of one catalogue share; observables in the order (4, N), in rad and rad/yr."""

    scenario: Scenario
    catalogue: Catalogue
    truth: Array  # (K,)
    differences: Array  # (4, N) without errors
    design: Array  # (4, N, K) at the true reference catalogue
    reference: _Noise
    satellite: _Noise
    sigma: Array  # (4, N), as the link weighs the differences
    gain: Array  # (4N, K): estimate - truth = misclosure @ gain


def simulate(scenario: Scenario, n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator) -> BlockSums:
    """Draw a catalogue, then link ``n_sim`` error realisations of it and add up what came out.

    ``catalogue_rng`` decides the catalogue (step A) and the truth, ``rng`` the errors (steps C and D).  Memory does
    not grow with ``n_sim``.  Raises LinkError where the catalogue does not determine the link.
    """
    setup = _prepare(scenario, catalogue_rng)
    unknowns = len(setup.truth)
    errors = np.zeros(unknowns)
    products = np.zeros((unknowns, unknowns))
    chi2 = 0.0
    for error, chi2_sum in _linked_chunks(setup, n_sim, rng):
        errors += error.sum(axis=0)
        products += error.T @ error
        chi2 += chi2_sum
    gain = setup.gain.reshape(setup.design.shape)
    predicted = (setup.reference.variance_through(gain) + setup.satellite.variance_through(gain)) / MAS**2
    means = (predicted[:3].mean(), predicted[3:6].mean())
    return BlockSums(
        error=errors / MAS,
        error_products=products / MAS**2,
        chi2=chi2,
        predicted_variance=n_sim * predicted,
        predicted_variance_squared=n_sim * np.square([*predicted, *means]),
        n_obj=float(n_sim * len(setup.catalogue)),
    )


def sample(scenario: Scenario, n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator) -> Array:
    """Return the estimates (mas, mas/yr) of the realisations that `simulate` adds up from equal generators; (n_sim,
    K).
    """
    setup = _prepare(scenario, catalogue_rng)
    errors = [error for error, _ in _linked_chunks(setup, n_sim, rng)]
    return (np.concatenate(errors) + setup.truth) / MAS


def _prepare(scenario: Scenario, catalogue_rng: np.random.Generator) -> _Setup:
    catalogue = scenario.draw_catalogue(catalogue_rng)
    epsilon, omega = scenario.epsilon.draw(catalogue_rng), scenario.omega.draw(catalogue_rng)
    glide = np.array(scenario.aberration)
    columns = (catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec)
    subtract = exact_differences if scenario.arithmetic == "exact" else stored_differences
    differences = subtract(*columns, epsilon, omega)
    if np.any(glide):
        p, q, _ = triad(catalogue.ra, catalogue.dec)
        differences[2:] -= np.stack([glide @ p, glide @ q])  # it is in the satellite's motions
    sides = (scenario.reference_errors, scenario.satellite_errors)
    reference, satellite = (_Noise(m.standard_errors(catalogue), m.correlation(catalogue)) for m in sides)
    sigma = combined_error(reference.sigma, satellite.sigma)
    design = design_matrix(*columns, corrections=scenario.corrections, glide=scenario.solve_glide)
    return _Setup(
        scenario=scenario,
        catalogue=catalogue,
        truth=np.concatenate([epsilon, omega, -glide] if scenario.solve_glide else [epsilon, omega]),
        differences=differences,
        design=design,
        reference=reference,
        satellite=satellite,
        sigma=sigma,
        gain=_gain(design, sigma, scenario.weighting),
    )


def _gain(design: Array, sigma: Array, weighting: Weighting) -> Array:
    """Return (A^T W A)^-1 A^T W, transposed; shape (4N, K)."""
    a = design.reshape(-1, design.shape[-1])
    weighted = a / np.square(sigma).reshape(-1, 1) if weighting == "inverse-variance" else a
    gain: Array = weighted @ normal_inverse(weighted.T @ a)
    return gain


def _linked_chunks(setup: _Setup, n_sim: int, rng: np.random.Generator) -> Iterator[tuple[Array, float]]:
    """Yield (estimate - truth of each realisation, shape (rows, K); sum of chi2) until ``n_sim`` are done."""
    if setup.reference or setup.satellite.correlation is not None:
        return _design_by_realisation(setup, n_sim, rng)
    return _fixed_design(setup, n_sim, rng)


def _fixed_design(setup: _Setup, n_sim: int, rng: np.random.Generator) -> Iterator[tuple[Array, float]]:
    """The reference has no errors: matrix products turn unit normals into estimates, tile by tile."""
    sigma = setup.sigma.reshape(-1)
    design = setup.design.reshape(len(sigma), -1)
    unknowns = design.shape[1]
    whitened = design / sigma[:, None]
    normal = whitened.T @ whitened
    inverse = normal_inverse(normal)
    misclosure = (setup.differences.reshape(-1) - design @ setup.truth) / sigma
    noisy = bool(setup.satellite)
    optimal = setup.scenario.weighting == "inverse-variance"
    projector = np.asfortranarray(whitened if optimal else np.hstack([whitened, setup.gain * sigma[:, None]]))

    width = min(TILE, len(sigma))
    buffer = np.empty((min(n_sim, CHUNK // width), width))
    for rows in _chunks(n_sim, len(buffer)):
        projected = np.zeros((rows, projector.shape[1]))
        squares = 0.0
        for start in range(0, len(sigma), width):
            part = slice(start, start + width)
            columns = len(sigma[part])
            observed = buffer.reshape(-1)[: rows * columns].reshape(rows, columns)
            if noisy:
                rng.standard_normal(out=observed)
                np.subtract(misclosure[part], observed, out=observed)  # reference - satellite
            else:
                observed[:] = misclosure[part]
            projected += observed @ projector[part]
            flat = observed.reshape(-1)
            squares += float(flat @ flat)
        whitened_sum = projected[:, :unknowns]
        error = whitened_sum @ inverse if optimal else projected[:, unknowns:]
        yield error, squares + float(np.sum(error * (error @ normal - 2.0 * whitened_sum)))


def _design_by_realisation(setup: _Setup, n_sim: int, rng: np.random.Generator) -> Iterator[tuple[Array, float]]:
    """The reference has errors too: the design matrix is built anew from the noisy reference of each realisation."""
    true, scenario = setup.catalogue, setup.scenario
    cos_dec = np.cos(true.dec)
    sigma = setup.sigma.reshape(-1, 1)
    weight = sigma**-2 if scenario.weighting == "inverse-variance" else np.ones_like(sigma)
    for rows in _chunks(n_sim, max(1, CHUNK // (8 * len(true)))):
        reference = setup.reference.draw(rng, rows) if setup.reference else np.zeros((rows, 4, len(true)))
        satellite = setup.satellite.draw(rng, rows) if setup.satellite else 0.0
        design = design_matrix(
            true.ra + reference[:, 0] / cos_dec,
            true.dec + reference[:, 1],
            true.pmra + reference[:, 2],
            true.pmdec + reference[:, 3],
            corrections=scenario.corrections,
            glide=scenario.solve_glide,
        )
        a = np.moveaxis(design, 0, 1).reshape(rows, len(sigma), -1)
        misclosure = (setup.differences + reference - satellite).reshape(rows, -1, 1) - a @ setup.truth[:, None]
        weighted = np.swapaxes(a * weight, 1, 2)
        error = normal_inverse(weighted @ a) @ (weighted @ misclosure)
        residual = (misclosure - a @ error) / sigma
        yield error[..., 0], float(np.sum(residual**2))


def _chunks(total: int, size: int) -> Iterator[int]:
    for start in range(0, total, size):
        yield min(size, total - start)
