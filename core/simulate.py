"""Steps A-F of the simulation for a block of realisations of one catalogue, in bounded memory."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.catalogue import Catalogue
from core.constants import MAS
from core.errors import ErrorModel
from core.frames import exact_differences, stored_differences
from core.link import UNKNOWNS, Weighting, combined_error, design_matrix, normal_inverse

Array = NDArray[np.float64]
Arithmetic = Literal["exact", "stored"]

CHUNK = 65536
"""Normals drawn at a time: 512 KiB stay in a core's own cache."""

TILE = 4096
"""Observables of one realisation that are drawn at a time, so that their part of the gain stays in cache too."""


@dataclass(frozen=True)
class Scenario:
    """One point's physics: how a catalogue is drawn, its errors, the true rotation (rad) and spin (rad/yr), the
    solution.
    """

    draw_catalogue: Callable[[np.random.Generator], Catalogue]
    reference_errors: ErrorModel
    satellite_errors: ErrorModel
    epsilon: tuple[float, float, float]
    omega: tuple[float, float, float]
    corrections: bool = True
    weighting: Weighting = "inverse-variance"
    arithmetic: Arithmetic = "exact"


@dataclass(frozen=True)
class BlockSums:
    """Sums over realisations; errors (estimate - truth) in mas and mas/yr, unknowns in the order of `UNKNOWNS`.

    ``error`` (6,), ``error_products`` (6, 6), ``chi2``; and, counted once per realisation of the catalogue,
    ``predicted_variance`` (6,) from the closed form, its square, and the number of objects.
    """

    error: Array
    error_products: Array
    chi2: float
    predicted_variance: Array
    predicted_variance_squared: Array
    n_obj: float


@dataclass(frozen=True)
class _Setup:
    """What all realisations of one catalogue share; observables in the order (4, N), in rad and rad/yr."""

    catalogue: Catalogue
    truth: Array  # (6,)
    differences: Array  # (4, N) without errors
    design: Array  # (4, N, 6) at the true reference catalogue
    sigma_reference: Array  # (4, N)
    sigma_satellite: Array  # (4, N)
    sigma: Array  # (4, N), as the link weighs the differences
    gain: Array  # (4N, 6): estimate - truth = misclosure @ gain


def simulate(scenario: Scenario, n_sim: int, rng: np.random.Generator, catalogue_rng: np.random.Generator) -> BlockSums:
    """Draw a catalogue, then link ``n_sim`` error realisations of it and add up what came out.

    ``catalogue_rng`` decides the catalogue (step A), ``rng`` its errors (steps C and D).  Memory does not grow with
    ``n_sim``. Raises LinkError where the catalogue does not determine the link.
    """
    setup = _prepare(scenario, catalogue_rng)
    errors = np.zeros(6)
    products = np.zeros((6, 6))
    chi2 = 0.0
    for error, chi2_sum in _linked_chunks(setup, scenario, n_sim, rng):
        errors += error.sum(axis=0)
        products += error.T @ error
        chi2 += chi2_sum
    noise = np.hypot(setup.sigma_reference, setup.sigma_satellite).reshape(-1, 1) * setup.gain
    predicted = np.sum((noise / MAS) ** 2, axis=0)
    return BlockSums(
        error=errors / MAS,
        error_products=products / MAS**2,
        chi2=chi2,
        predicted_variance=n_sim * predicted,
        predicted_variance_squared=n_sim * predicted**2,
        n_obj=float(n_sim * len(setup.catalogue)),
    )


def _prepare(scenario: Scenario, catalogue_rng: np.random.Generator) -> _Setup:
    catalogue = scenario.draw_catalogue(catalogue_rng)
    columns = (catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec)
    epsilon, omega = np.array(scenario.epsilon), np.array(scenario.omega)
    subtract = exact_differences if scenario.arithmetic == "exact" else stored_differences
    sigma_reference = scenario.reference_errors.standard_errors(catalogue)
    sigma_satellite = scenario.satellite_errors.standard_errors(catalogue)
    sigma = combined_error(sigma_reference, sigma_satellite)
    design = design_matrix(*columns, corrections=scenario.corrections)
    return _Setup(
        catalogue=catalogue,
        truth=np.concatenate([epsilon, omega]),
        differences=subtract(*columns, epsilon, omega),
        design=design,
        sigma_reference=sigma_reference,
        sigma_satellite=sigma_satellite,
        sigma=sigma,
        gain=_gain(design, sigma, scenario.weighting),
    )


def _gain(design: Array, sigma: Array, weighting: Weighting) -> Array:
    """Return (A^T W A)^-1 A^T W, transposed; shape (4N, 6)."""
    a = design.reshape(-1, design.shape[-1])
    weighted = a / np.square(sigma).reshape(-1, 1) if weighting == "inverse-variance" else a
    gain: Array = weighted @ normal_inverse(weighted.T @ a)
    return gain


def _linked_chunks(
    setup: _Setup, scenario: Scenario, n_sim: int, rng: np.random.Generator
) -> Iterator[tuple[Array, float]]:
    """Yield (estimate - truth of each realisation, shape (rows, 6); sum of chi2) until ``n_sim`` are done."""
    if np.any(setup.sigma_reference):
        yield from _noisy_reference(setup, scenario, n_sim, rng)
    else:
        yield from _fixed_reference(setup, scenario, n_sim, rng)


def _fixed_reference(
    setup: _Setup, scenario: Scenario, n_sim: int, rng: np.random.Generator
) -> Iterator[tuple[Array, float]]:
    """The design is the same in every realisation: matrix products turn unit normals into estimates, tile by tile."""
    sigma = setup.sigma.reshape(-1)
    design = setup.design.reshape(len(sigma), -1)
    whitened = design / sigma[:, None]
    normal = whitened.T @ whitened
    inverse = normal_inverse(normal)
    misclosure = (setup.differences.reshape(-1) - design @ setup.truth) / sigma
    noisy = bool(np.any(setup.sigma_satellite))
    optimal = scenario.weighting == "inverse-variance"
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
        whitened_sum = projected[:, :6]
        error = whitened_sum @ inverse if optimal else projected[:, 6:]
        yield error, squares + float(np.sum(error * (error @ normal - 2.0 * whitened_sum)))


def _noisy_reference(
    setup: _Setup, scenario: Scenario, n_sim: int, rng: np.random.Generator
) -> Iterator[tuple[Array, float]]:
    """The reference has errors too: the design matrix is built anew from the noisy reference of each realisation."""
    true = setup.catalogue
    cos_dec = np.cos(true.dec)
    sigma = setup.sigma
    for rows in _chunks(n_sim, max(1, CHUNK // (8 * len(true)))):
        reference = rng.standard_normal((rows, 4, len(true))) * setup.sigma_reference
        satellite = rng.standard_normal((rows, 4, len(true))) * setup.sigma_satellite
        design = design_matrix(
            true.ra + reference[:, 0] / cos_dec,
            true.dec + reference[:, 1],
            true.pmra + reference[:, 2],
            true.pmdec + reference[:, 3],
            corrections=scenario.corrections,
        )
        a = np.moveaxis(design, 0, 1).reshape(rows, -1, len(UNKNOWNS))
        misclosure = (setup.differences + reference - satellite).reshape(rows, -1, 1) - a @ setup.truth[:, None]
        weight = (sigma**-2 if scenario.weighting == "inverse-variance" else np.ones_like(sigma)).reshape(-1, 1)
        weighted = np.swapaxes(a * weight, 1, 2)
        error = normal_inverse(weighted @ a) @ (weighted @ misclosure)
        residual = (misclosure - a @ error) / sigma.reshape(-1, 1)
        yield error[..., 0], float(np.sum(residual**2))


def _chunks(total: int, size: int) -> Iterator[int]:
    for start in range(0, total, size):
        yield min(size, total - start)
