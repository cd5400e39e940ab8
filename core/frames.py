"""Frames and their link: units, types of arrays, vectors on the sphere (the triad, step B exactly, differences of two
catalogues), weights, and solutions of normal equations.

Conventions of `linksweep.core`, the same in every module (a test checks each):

* Inside ``core`` angles are radians and proper motions rad/yr; a number in another unit has that unit
  in its name (``sigma_mas``, ``mission_length_yr``).  Vectors are ``(3, ...)`` and objects come last.
* ``pmra`` is mu_alpha* = (d alpha/dt) cos(dec), as in the Gaia archive.
* Differences are **reference - satellite**.  The orientation epsilon and the spin omega rotate the *vector*:
  ``r_ref = R r_sat`` and ``v_ref = R v_sat + omega x r_ref`` with ``R = exp([epsilon x])``.
* The four observables of an object are, in this order, ``(d alpha*, d dec, d pmra, d pmdec)``; the unknowns
  are ``(epsilon_x, epsilon_y, epsilon_z, omega_x, omega_y, omega_z)``.
* Every random number comes from a generator that the caller passes in, except the few of `designs.neglected`, which
  are always the same.

Nothing here prints, logs, reads a clock, touches a file or imports dask, xarray, zarr or click.

Catalogues of one size may be computed together, as a stack: then arrays have a leading axis of catalogues.  What
belongs to one of them does not depend, to the last bit, on the others: sums go over the objects of each by itself.
"""

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]
Texts = NDArray[np.str_]
Names = NDArray[Any]  # of sources: texts, or numbers

# The leading axis of arrays: none for one catalogue, the number of catalogues for a stack.
Stack = tuple[int, ...]


def product_sum(a: Array, b: Array) -> Array:
    """Return the sum of a b over objects, observables and realisations, the last three axes; shape (...)."""
    stack = a.shape[:-3]
    return np.asarray(np.vecdot(a.reshape(*stack, -1), b.reshape(*stack, -1)))


def transposed_product(a: Array, b: Array) -> Array:
    """Return a^T b, summed over objects and observables, of shapes (..., n, 4, A) and (..., n, 4, B); (..., A, B)."""
    stack = a.shape[:-3]
    return np.asarray(a.reshape(*stack, -1, a.shape[-1]).swapaxes(-1, -2) @ b.reshape(*stack, -1, b.shape[-1]))


# One milliarcsecond in radians.
MAS = np.pi / (180.0 * 3600.0 * 1000.0)

# One microarcsecond in radians.
MICROARCSEC = MAS / 1000.0

# One degree in radians.
DEGREE = np.pi / 180.0

# One arcsecond in radians.
ARCSEC = DEGREE / 3600.0


def _galactic_axes() -> Array:
    """Return the Galactic x, y and z axes in ICRS coordinates as rows; shape (3, 3).

    Source: ESA 1997, The Hipparcos and Tycho Catalogues, vol. 1, sect. 1.5.3: pole at (192.85948, 27.12825) deg,
    longitude of the ascending node of the Galactic plane on the equator 32.93192 deg.
    """
    pole_ra, pole_dec, node = 192.85948 * DEGREE, 27.12825 * DEGREE, 32.93192 * DEGREE
    ascending = np.array([-np.sin(pole_ra), np.cos(pole_ra), 0.0])
    pole = np.array([np.cos(pole_dec) * np.cos(pole_ra), np.cos(pole_dec) * np.sin(pole_ra), np.sin(pole_dec)])
    in_plane = np.cross(pole, ascending)
    x = np.cos(node) * ascending - np.sin(node) * in_plane
    return np.stack([x, np.cross(pole, x), pole])


# Matrix that rotates an ICRS vector to Galactic axes; shape (3, 3).
GALACTIC_AXES = _galactic_axes()


class Triad(NamedTuple):
    """The unit vectors p (east), q (north) and r (to the object), each of shape (3, ...)."""

    p: Array
    q: Array
    r: Array


def triad(ra: Array, dec: Array) -> Triad:
    """Return p = <z x r>, q = r x p and r at the given positions.

    ``ra`` and ``dec`` are in radians, of any one shape ``(...)``.  At a pole p is the limit along the given ``ra``.
    Source: Metz & Geffert 2004, Eqs. 1-3 (after Murray 1983).

    >>> at_the_equinox = triad(np.array(0.0), np.array(0.0))
    >>> [(vector + 0.0).tolist() for vector in at_the_equinox]  # + 0.0: without negative zeros
    [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    """
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    return Triad(
        p=np.array([-sin_ra, cos_ra, np.zeros_like(sin_ra)]),
        q=np.array([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec]),
        r=np.array([cos_dec * cos_ra, cos_dec * sin_ra, sin_dec]),
    )


def position(r: Array) -> tuple[Array, Array]:
    """Return (ra, dec) in radians, ra in [0, 2 pi), of vectors of shape (3, ...) and any length.

    >>> ra, dec = position(np.array([0.0, -1.0, 1.0]))
    >>> float(np.degrees(ra)), float(np.degrees(dec))
    (270.0, 45.0)
    """
    angle = np.arctan2(r[1], r[0])
    ra = np.where(angle < 0.0, angle + 2.0 * np.pi, np.abs(angle))  # as % 2 pi, which takes five times as long
    return np.where(ra < 2.0 * np.pi, ra, 0.0), np.arctan2(r[2], np.hypot(r[0], r[1]))  # -tiny + 2 pi is 2 pi


def galactic(ra: Array, dec: Array) -> tuple[Array, Array]:
    """Return Galactic longitude in [0, 2 pi) and latitude of ICRS positions, all in rad and of shape (N,)."""
    return position(GALACTIC_AXES @ triad(ra, dec).r)


def _cross(a: Array, b: Array) -> Array:
    """Return a x b along the first axis; np.cross takes five times as long for few objects."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def along(vector: Array, axes: Array) -> Array:
    """Return the scalar products of one vector (3,) with many, (3, ...).

    Unlike in a matrix product, the bits of each result depend neither on the number of vectors nor on its place.
    """
    return np.asarray(vector[0] * axes[0] + vector[1] * axes[1] + vector[2] * axes[2])


def turned(matrix: Array, vectors: Array) -> Array:
    """Return ``matrix @ vectors`` of shape (3, ...), each vector by itself as in `along`."""
    return np.array([along(row, vectors) for row in matrix])


def rotation_minus_identity(epsilon: Array) -> Array:
    """Return R - I for R = exp([epsilon x]), without cancellation for small angles; shape (3, 3).

    ``epsilon`` is the rotation vector in radians, shape (3,).  Source: Rodrigues' formula with
    1 - cos t = 2 sin^2(t/2).
    """
    x, y, z = epsilon
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.sqrt(epsilon @ epsilon))
    half = np.sinc(0.5 * angle / np.pi)  # sin(t/2)/(t/2), 1 at t = 0
    return np.asarray(np.sinc(angle / np.pi) * cross + 0.5 * half**2 * (cross @ cross))


def rotation_matrix(epsilon: Array) -> Array:
    """Return R = exp([epsilon x]), which turns a vector by |epsilon| radians about epsilon; shape (3, 3).

    >>> quarter = rotation_matrix(np.array([0.0, 0.0, np.pi / 2]))
    >>> (quarter @ [1.0, 0.0, 0.0]).round(12).tolist()
    [0.0, 1.0, 0.0]
    """
    return np.eye(3) + rotation_minus_identity(epsilon)


def satellite_catalogue(
    ra: Array, dec: Array, pmra: Array, pmdec: Array, epsilon: Array, omega: Array
) -> tuple[Array, Array, Array, Array]:
    """Return (ra, dec, pmra, pmdec) of reference objects as measured in the satellite's frame (step B).

    Exact for finite angles: ``r_sat = R^T r_ref``, ``v_sat = R^T (v_ref - omega x r_ref)``, projected on the triad
    at the new position.  Arrays have shape (N,), radians and rad/yr; ``epsilon`` (rad) and ``omega`` (rad/yr) shape
    (3,).
    """
    reference = triad(ra, dec)
    back = rotation_matrix(epsilon).T
    velocity = reference.p * pmra + reference.q * pmdec - _cross(omega, reference.r)
    ra_sat, dec_sat = position(turned(back, reference.r))
    satellite = triad(ra_sat, dec_sat)
    v_sat = turned(back, velocity)
    return ra_sat, dec_sat, np.sum(satellite.p * v_sat, axis=0), np.sum(satellite.q * v_sat, axis=0)


def stored_differences(ra: Array, dec: Array, pmra: Array, pmdec: Array, epsilon: Array, omega: Array) -> Array:
    """Return the observables reference - satellite by subtracting two stored catalogues; shape (4, N).

    This is what the paper's program did: the difference of two large angles keeps at best the last bit of the angle,
    about 4e-7 mas in ra (paper, Sect. 4.2).  The difference in ra is wrapped to [-pi, pi).
    """
    ra_sat, dec_sat, pmra_sat, pmdec_sat = satellite_catalogue(ra, dec, pmra, pmdec, epsilon, omega)
    d_ra = (ra - ra_sat + np.pi) % (2.0 * np.pi) - np.pi
    return np.array([d_ra * np.cos(dec), dec - dec_sat, pmra - pmra_sat, pmdec - pmdec_sat])


def exact_differences(
    ra: Array, dec: Array, pmra: Array, pmdec: Array, epsilon: Array, omega: Array, axes: Triad | None = None
) -> Array:
    """Return the same observables as `stored_differences`, exact to a relative rounding error; shape (4, N).

    No two large angles are subtracted: the displacement is (R^T - I) r, and every difference of angles, lengths and
    triads is written in terms of it.  ``axes`` is the triad at ra, dec if it is already known.
    """
    p, q, r = axes or triad(ra, dec)
    back_minus_identity = rotation_minus_identity(-epsilon)
    step = turned(back_minus_identity, r)  # r_sat - r_ref
    rho = q[2]
    rho_sat = np.hypot(r[0] + step[0], r[1] + step[1])
    rho_step = (step[0] * (2.0 * r[0] + step[0]) + step[1] * (2.0 * r[1] + step[1])) / (rho + rho_sat)

    # sine and cosine of (ra_sat - ra) and (dec_sat - dec)
    sin_ra = (r[0] * step[1] - r[1] * step[0]) / (rho * rho_sat)
    cos_ra = (r[0] * (r[0] + step[0]) + r[1] * (r[1] + step[1])) / (rho * rho_sat)
    sin_dec = step[2] * rho - r[2] * rho_step
    cos_dec = rho * rho_sat + r[2] * (r[2] + step[2])
    d_ra, d_dec = np.arctan2(sin_ra, cos_ra), np.arctan2(sin_dec, cos_dec)

    # v_ref.p_ref - v_sat.p_sat = -(v_sat - v_ref).p_sat - v_ref.(p_sat - p_ref), and the same for q
    velocity = p * pmra + q * pmdec
    spin = _cross(omega, r)
    velocity_step = turned(back_minus_identity, velocity - spin) - spin
    satellite = triad(ra + d_ra, dec + d_dec)
    one_minus_cos = 2.0 * np.sin(0.5 * d_ra) ** 2
    p_step = np.array([-p[1] * sin_ra - p[0] * one_minus_cos, p[0] * sin_ra - p[1] * one_minus_cos, 0.0 * sin_ra])
    q_step = _cross(step, p) + _cross(r + step, p_step)  # of q = r x p
    d_pmra = -np.sum(velocity_step * satellite.p + velocity * p_step, axis=0)
    d_pmdec = -np.sum(velocity_step * satellite.q + velocity * q_step, axis=0)
    return np.array([-d_ra * rho, -d_dec, d_pmra, d_pmdec])


# ---- the link: weights, solutions of normal equations, of one realisation and of many, and the poles

Weighting = Literal["inverse-variance", "equal"]

# cos(dec) below which ra is degenerate for a link (2 mas from the pole): differences of ra are no longer small
# there.
POLE_LIMIT = 1e-8


# The observables that are positions, and those that are proper motions.
OBSERVABLES = (slice(0, 2), slice(2, 4))

# Eigenvalue of a normal matrix scaled to a diagonal of 1 below which the link is rank deficient.
SMALLEST_EIGENVALUE = 1e-12


class LinkError(ValueError):
    """The link cannot be solved; the message names the object or the cause."""


def require_off_poles(dec: Array, cos_dec: Array) -> None:
    """Raise LinkError for the first object (last axis of ``dec``, rad) at a pole, where ra is undefined."""
    at_pole = cos_dec < POLE_LIMIT
    if np.any(at_pole):
        at = tuple(np.argwhere(at_pole)[0])
        raise pole_error(int(at[-1]), float(dec[at]))


def pole_error(item: int, dec: float) -> LinkError:
    """Return the error that names the object at a pole, by its number from 1."""
    said = f"object {item + 1} is at a celestial pole or, with its error, beyond (dec = {np.degrees(dec)} deg):"
    return LinkError(f"{said} ra is undefined there")


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
