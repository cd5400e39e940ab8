"""A law that levels off, and where it falls more slowly than a limit: arrays in, numbers out."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from scipy.optimize import approx_fprime, least_squares
from scipy.special import exprel

from linksweep.sweep.analysis.fits import chi2_about, relative_covariance, weigh
from linksweep.sweep.contract import Array, small_sample_factor

STARTS = (0.5, 2.0, 6.0)
"""First guesses of the rate, times the range of the points; the best fit is kept."""


@dataclass(frozen=True)
class Levelling:
    """y^2 = plateau^2 + c exp(-rate x), with one-sigma errors, scaled by sqrt(chi2/dof) where that is above one.

    ``plateau`` is NaN where the points do not level off.  ``end_fall`` is -d ln y / dx at the last point.  ``limit``
    is the x beyond which y falls by less than the given fraction per unit: -inf if it does so everywhere, inf if
    nowhere; it may lie beyond the points.
    """

    plateau: float
    plateau_error: float
    rate: float
    rate_error: float
    end_fall: float
    end_fall_error: float
    limit: float
    limit_error: float
    chi2: float
    dof: int


def levelling(x: Array, y: Array, errors: Array, fall: float, samples: float = np.inf) -> Levelling:
    """Return the law through points, and where it falls by the fraction ``fall`` per unit of x.

    ``x`` (n,) ascends, ``y`` (n,) is positive, n at least 4; ``errors`` are one sigma of y, (n,), or its covariance,
    (n, n), estimated from ``samples`` as in `power_law`.  Unless all errors are known, those of the law come from the
    scatter.  They are scaled up if points are farther from the law than their own errors allow.

    The parameters of the fit are y^2 at both ends and the rate: they are hardly correlated, and y^2 is positive
    in between whatever their values are.
    Raises ValueError where it does not converge, or for a covariance that is not positive definite.
    """
    relative, known = relative_covariance(y, errors)
    whiten, covariance = weigh(relative, samples)
    first, length, scale = x[0], x[-1] - x[0], y[-1]
    z, target = (x - first) / length, np.log(y / scale)

    def misfit(parameters: Array) -> Array:
        start, end, rate = np.exp(parameters[0]), np.exp(parameters[1]), parameters[2]
        return whiten(0.5 * np.log(_square(z, start, end, rate)) - target)

    with np.errstate(all="ignore"):  # a trial value of the rate may overflow; it is then rejected
        fits = [_least_squares(misfit, np.array([2.0 * target[0], 0.0, start])) for start in STARTS]
    converged = [each for each in fits if each is not None]
    if not converged:
        raise ValueError("the levelling law does not converge")
    found, slopes, misfit_squared = min(converged, key=lambda each: each[2])
    dof = len(x) - 3
    solve = np.linalg.pinv(slopes)
    spread = solve @ covariance @ solve.T * float(small_sample_factor(samples))
    if misfit_squared > dof or not known:
        spread = spread * misfit_squared / dof
    judge = known and not np.isnan(samples)
    chi2 = chi2_about(misfit(found), slopes, covariance, relative, samples) if judge else np.nan

    def derived(parameters: Array) -> Array:
        start, end, rate = np.exp(parameters[0]), np.exp(parameters[1]), parameters[2]
        floor = _floor(start, end, rate)
        plateau = scale * np.sqrt(floor) if floor > 0.0 else np.nan
        limit = first + length * _limit(start, end, rate, fall * length)
        end_fall = 0.5 * (start - end) / end / exprel(rate)
        return np.array([plateau, rate / length, end_fall / length, limit])

    values = derived(found)
    with np.errstate(invalid="ignore"):
        jacobian = approx_fprime(found, derived)
        sigmas = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, spread, jacobian))
    sigmas = np.where(np.isfinite(values), sigmas, np.nan)
    estimates = dict(zip(("plateau", "rate", "end_fall", "limit"), values.tolist(), strict=True))
    errors_of = {f"{name}_error": sigma for name, sigma in zip(estimates, sigmas.tolist(), strict=True)}
    return Levelling(**estimates, **errors_of, chi2=chi2, dof=dof)


def _least_squares(misfit: Callable[[Array], Array], start: Array) -> tuple[Array, Array, float] | None:
    """Return the parameters, the Jacobian of the misfit and its sum of squares; None if the fit fails."""
    try:
        found = least_squares(misfit, start, jac="3-point", xtol=1e-10, ftol=1e-12, gtol=1e-12, max_nfev=300)
        jacobian = np.asarray(found.jac, dtype=np.float64)
        np.linalg.inv(jacobian.T @ jacobian)
    except (ValueError, LinAlgError):  # residuals that are not finite; a parameter that nothing depends on
        return None
    return (found.x, jacobian, 2.0 * float(found.cost)) if found.success else None


# Below, z runs from 0 at the first point to 1 at the last, squares are y^2, and exprel(t) is (e^t - 1)/t, also at 0.


def _square(z: Array, start: float, end: float, rate: float) -> Array:
    return np.asarray(start + (end - start) * z * exprel(-rate * z) / exprel(-rate))


def _floor(start: float, end: float, rate: float) -> float:
    """Return the square that the law tends to; NaN if it does not level off."""
    return float(start + (end - start) / -np.expm1(-rate)) if rate > 0.0 else np.nan


def _limit(start: float, end: float, rate: float, fall: float) -> float:
    """Return the z where -d ln y / dz is ``fall``: rate/2 c t / (floor + c t) with t = exp(-rate z)."""
    if end >= start:
        return -np.inf
    floor = _floor(start, end, rate)
    if not floor > 0.0:
        return np.inf
    if rate <= 2.0 * fall:
        return -np.inf
    return float(np.log((start - floor) * (0.5 * rate / fall - 1.0) / floor) / rate)
