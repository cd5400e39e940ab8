"""The link: weights, solutions of normal equations, of one realisation and of many, and the poles."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from linksweep.core.frames import MAS, Array

Weighting = Literal["inverse-variance", "equal"]

POLE_LIMIT = 1e-8
"""cos(dec) below which ra is degenerate for a link (2 mas from the pole): differences of ra are no longer small
there.
"""


OBSERVABLES = (slice(0, 2), slice(2, 4))
"""The observables that are positions, and those that are proper motions."""

SMALLEST_EIGENVALUE = 1e-12
"""Eigenvalue of a normal matrix scaled to a diagonal of 1 below which the link is rank deficient."""


class LinkError(ValueError):
    """The link cannot be solved; the message names the object or the cause."""


class UnlikeError(LinkError):
    """Catalogues cannot be computed together."""


def require_off_poles(dec: Array, cos_dec: Array) -> None:
    """Raise LinkError for the first object (last axis of ``dec``, rad) at a pole, where ra is undefined."""
    at_pole = cos_dec < POLE_LIMIT
    if np.any(at_pole):
        at = tuple(np.argwhere(at_pole)[0])
        raise pole_error(int(at[-1]), float(dec[at]))


def pole_error(item: int, dec: float) -> LinkError:
    """Return the error that names the object at a pole."""
    return LinkError(
        f"object {item} is at a celestial pole or, with its error, beyond (dec = {np.degrees(dec)} deg): "
        "ra is undefined there"
    )


def measured(sigma: Array) -> tuple[bool, bool]:
    """Return whether positions and proper motions are measured, from combined errors (N, 4): if only one kind has
    errors, the other is not measured; if neither has, both are.
    """
    positions, motions = (bool(np.any(sigma[:, kind])) for kind in OBSERVABLES)
    return positions or not motions, motions or not positions


def combined_error(sigma_reference: Array, sigma_satellite: Array) -> Array:
    """Return the standard error of the differences, sqrt(ref^2 + sat^2), as the link weighs them; shape (N, 4).

    Error-free data (all zero) get unit errors of 1 mas and 1 mas/yr, that is equal weights; so does a kind of
    observable that is not `measured`, only to keep its weights finite.  Raises LinkError where an error is negative or
    not finite, or zero beside non-zero ones of its kind.
    """
    # hypot takes hundreds of times as long as abs, and most studies have an exact reference
    sigma = np.hypot(sigma_reference, sigma_satellite) if np.any(sigma_reference) else np.abs(sigma_satellite)
    _require(np.isfinite(sigma), "non-finite standard error")
    _require(np.minimum(sigma_reference, sigma_satellite) >= 0.0, "negative standard error")
    if not np.any(sigma):
        return np.full_like(sigma, MAS)
    for kind, is_measured in zip(OBSERVABLES, measured(sigma), strict=True):
        if not is_measured:
            sigma[:, kind] = MAS
    _require(sigma > 0.0, "zero standard error beside non-zero ones, so an infinite weight,")
    return sigma


def hold(normal: Array, fixed: slice) -> Array:
    """Return normal matrices (K, K, ...) with 1 on the diagonal of unknowns that nothing determines.

    Their rows and columns are zero, so the solution is zero for them and unchanged for the others.  Nor does the
    eigenvalue 1 change the condition number: it lies between those of the others, whose mean is 1.
    """
    for k in range(len(normal))[fixed]:
        normal[k, k] = 1.0
    return normal


def inverse_and_condition(normal: Array) -> tuple[Array, Array]:
    """Return the inverse of normal matrices A^T W A of shape (..., K, K), and the condition number (...) of each:
    the ratio of the largest to the smallest eigenvalue, 1 where the unknowns are independent.

    Matrices are scaled to a diagonal of 1 first, so that units do not matter.  For a sky that determines the link the
    condition is of order 1 and the inverse equals the SVD's to rounding (a test checks how well).  Raises LinkError
    where the smallest eigenvalue of a scaled matrix is not above `SMALLEST_EIGENVALUE`.
    """
    scale = _scale(np.einsum("...ii->...i", normal))
    scaled = normal * scale[..., :, None] * scale[..., None, :]
    eigenvalues = require_rank(scaled)
    inverse = np.linalg.inv(scaled) * scale[..., :, None] * scale[..., None, :]
    return inverse, np.asarray(eigenvalues[..., -1] / eigenvalues[..., 0])


def solve_normal(normal: Array, right: Array) -> Array:
    """Return x of ``normal`` x = ``right``, shapes (K, K, ...) and (K, ...), as `inverse_and_condition` would give it.

    All systems are solved together by elimination without pivoting on matrices scaled to a diagonal of 1, which equals
    Cholesky's method and is as stable.  Raises LinkError as `inverse_and_condition`.  The pivots give the determinant,
    and since the other eigenvalues cannot multiply to more than (K/(K-1))^(K-1), it bounds the smallest one from below:
    eigenvalues themselves are only computed where that bound does not decide.
    """
    unknowns = len(normal)
    scale = _scale(np.einsum("kk...->k...", normal))
    scaled = normal * scale[:, None] * scale
    solved = right * scale
    upper = scaled.copy()  # the matrix itself is needed where the bound does not decide
    with np.errstate(all="ignore"):  # a pivot of zero shows in the determinant
        for k in range(unknowns - 1):
            factor = upper[k, k + 1 :] / upper[k, k]
            upper[k + 1 :, k + 1 :] -= factor[:, None] * upper[k, k + 1 :]
            solved[k + 1 :] -= factor * solved[k]
        pivots = np.einsum("kk...->k...", upper)
        bound = np.prod(pivots, axis=0) / (unknowns / (unknowns - 1.0)) ** (unknowns - 1)
        unclear = ~(np.all(pivots > 0.0, axis=0) & (bound > SMALLEST_EIGENVALUE))
    if np.any(unclear):
        require_rank(np.moveaxis(scaled[:, :, unclear], -1, 0))
    for k in reversed(range(unknowns)):
        solved[k] /= upper[k, k]
        solved[:k] -= upper[:k, k] * solved[k]
    return np.asarray(solved * scale)


def require_rank(scaled: Array) -> Array:
    """Return the eigenvalues (..., K) of matrices (..., K, K) with a diagonal of 1, the smallest first.

    Raises LinkError where that is not above `SMALLEST_EIGENVALUE`.
    """
    eigenvalues = np.linalg.eigvalsh(scaled)
    if not np.all(eigenvalues[..., 0] > SMALLEST_EIGENVALUE):
        raise LinkError("the link is rank deficient: the objects do not determine all unknowns")
    return np.asarray(eigenvalues)


def _scale(diagonal: Array) -> Array:
    """Return the factors that make a diagonal 1; raises LinkError for an unknown without weight."""
    if not np.all(diagonal > 0.0):
        raise LinkError("the link is rank deficient: an unknown has no weight at all")
    return np.asarray(1.0 / np.sqrt(diagonal))


def _require(good: NDArray[np.bool_], what: str) -> None:
    if not np.all(good):
        item, observable = np.argwhere(~good)[0]
        name = ("ra", "dec", "pmra", "pmdec")[observable]
        raise LinkError(f"{what} in {name} of object {item}")
