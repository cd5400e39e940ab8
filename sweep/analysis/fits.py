"""The power law and the law that levels off, through points with errors, correlated or not: arrays in, numbers out."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError

from linksweep.sweep.contract import Array, small_sample_factor

# A law is judged only if the errors that points do not share are this many times the neglected second order.
FIRST_ORDER = 5.0
STARTS = (0.5, 2.0, 6.0)  # first guesses of the rate, times the range of the points; the best fit is kept


@dataclass(frozen=True)
class PowerLaw:
    """y = amplitude (x / pivot)^exponent, with the one-sigma errors of both and their ``correlation``, which the pivot
    makes 0 unless the covariance of the points was estimated from samples.

    ``chi2`` is NaN where the points have no errors: then all weigh the same and the errors come from the scatter.
    """

    exponent: float
    exponent_error: float
    amplitude: float
    amplitude_error: float
    correlation: float
    pivot: float
    chi2: float
    dof: int

    def __call__(self, x: Array) -> Array:
        """Return the law at x, same shape."""
        return np.asarray(self.amplitude * (x / self.pivot) ** self.exponent)

    def relative_error(self, x: Array) -> Array:
        """Return the relative one-sigma error of the law at x, same shape."""
        height, tilt = self.amplitude_error / self.amplitude, np.log(x / self.pivot) * self.exponent_error
        return np.sqrt(np.maximum(height**2 + tilt**2 + 2.0 * self.correlation * height * tilt, 0.0))


@dataclass(frozen=True)
class Levelling:
    """y^2 = plateau^2 + c exp(-rate x), with one-sigma errors, scaled by sqrt(chi2/dof) where that is above one.

    ``plateau`` is NaN where the points do not level off.  ``end_fall`` is -d ln y / dx at the last point.  ``limit``
    is the x beyond which y falls by less than the wanted fraction per unit: -inf if it does so everywhere, inf if
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


def power_law(x: Array, y: Array, errors: Array, samples: float = np.inf) -> PowerLaw:
    """Return the power law through points, by generalised least squares of log y against log x.

    ``x`` and ``y`` (n,) are positive; ``errors`` are one sigma of y, (n,), or the covariance of y, (n, n).  The errors
    of the law follow from the errors of y, whatever the scatter.  Unless all errors (n,) are known and positive, all
    points weigh the same, and the errors of the law come from the scatter (0 for two points, which have none).
    If the covariance was estimated from ``samples``, only its diagonal gives weights, as its inverse would follow its
    noise; the errors of the law with these weights are computed from all of it.  If ``samples`` is NaN, the
    covariance of points with errors (n,) is not known: the errors give weights, and the errors of the law are NaN.
    Raises ValueError for a covariance that is not positive definite.
    """
    relative, known = _relative_covariance(y, errors)
    whiten, covariance = _weigh(relative, samples)
    ones, u, v = whiten(np.ones_like(x)), whiten(np.log(x)), whiten(np.log(y))
    total = ones @ ones
    centre, mean = ones @ u / total, ones @ v / total
    u, v = u - centre * ones, v - mean * ones  # about the centre, amplitude and exponent are not correlated
    information = u @ u
    exponent = u @ v / information
    dof = len(x) - 2
    chi2 = _chi2(v - exponent * u, np.stack([ones, u], axis=1), covariance, relative, samples)
    unit = 1.0 if known else chi2 / dof if dof > 0 else 0.0
    solve = np.stack([u / information, ones / total])
    spread = unit * float(small_sample_factor(samples)) * solve @ covariance @ solve.T
    exponent_error, relative_error = np.sqrt(np.diag(spread).clip(min=0.0))  # 0 but for rounding where all is shared
    both = exponent_error * relative_error
    amplitude = np.exp(mean)
    return PowerLaw(
        exponent=float(exponent),
        exponent_error=float(exponent_error),
        amplitude=float(amplitude),
        amplitude_error=float(amplitude * relative_error),
        correlation=float(spread[0, 1] / both) if both > 0.0 else 0.0,
        pivot=float(np.exp(centre)),
        chi2=chi2 if known and not np.isnan(samples) else np.nan,
        dof=dof,
    )


def levelling(x: Array, y: Array, errors: Array, fall: float, samples: float = np.inf) -> Levelling:
    """Return the law that levels off, and where it falls by the fraction ``fall`` per unit of x.

    ``x`` (n,) ascends, ``y`` (n,) is positive, n at least 4; ``errors`` and ``samples`` are as in `power_law`.  Unless
    all errors are known, those of the law come from the scatter.  They are scaled up if points are farther from the law
    than their own errors allow.
    Raises ValueError where it does not converge, or for a covariance that is not positive definite.
    """
    # here, as a run that only compares with claims does not need to read it
    from scipy.optimize import approx_fprime, least_squares
    from scipy.special import exprel

    relative, known = _relative_covariance(y, errors)
    whiten, covariance = _weigh(relative, samples)
    first, length, scale = x[0], x[-1] - x[0], y[-1]
    z, target = (x - first) / length, np.log(y / scale)  # z runs from 0 at the first point to 1 at the last

    # The parameters are log y^2 at both ends and the rate: they are hardly correlated, and y^2 is positive in between
    # whatever their values are.
    def misfit(parameters: Array) -> Array:
        start, end, rate = np.exp(parameters[0]), np.exp(parameters[1]), parameters[2]
        square = start + (end - start) * z * exprel(-rate * z) / exprel(-rate)
        return whiten(0.5 * np.log(np.asarray(square)) - target)

    converged = []
    for guess in STARTS:
        with np.errstate(all="ignore"), suppress(ValueError, LinAlgError):
            # a trial value of the rate may overflow and is then rejected; a parameter that nothing depends on has
            # no error, and its matrix no inverse
            begin = np.array([2.0 * target[0], 0.0, guess])
            fit = least_squares(misfit, begin, jac="3-point", xtol=1e-10, ftol=1e-12, gtol=1e-12, max_nfev=300)
            jacobian = np.asarray(fit.jac, dtype=np.float64)
            np.linalg.inv(jacobian.T @ jacobian)
            if fit.success:
                converged.append((2.0 * float(fit.cost), fit.x, jacobian))
    if not converged:
        raise ValueError("the levelling law does not converge")
    misfit_squared, best, slopes = min(converged, key=lambda each: each[0])
    dof = len(x) - 3
    solve = np.linalg.pinv(slopes)
    spread = solve @ covariance @ solve.T * float(small_sample_factor(samples))
    if misfit_squared > dof or not known:
        spread = spread * misfit_squared / dof

    def derived(parameters: Array) -> Array:
        start, end, rate = np.exp(parameters[0]), np.exp(parameters[1]), parameters[2]
        floor = float(start + (end - start) / -np.expm1(-rate)) if rate > 0.0 else np.nan  # what y^2 tends to
        plateau = scale * np.sqrt(floor) if floor > 0.0 else np.nan
        limit = first + length * _limit(start, end, rate, floor, fall * length)
        return np.array([plateau, rate / length, 0.5 * (start - end) / end / exprel(rate) / length, limit])

    values = derived(best)
    with np.errstate(invalid="ignore"):
        jacobian = approx_fprime(best, derived)
        sigmas = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, spread, jacobian))
    sigmas = np.where(np.isfinite(values), sigmas, np.nan)
    judged = known and not np.isnan(samples)
    chi2 = _chi2(misfit(best), slopes, covariance, relative, samples) if judged else np.nan
    plateau, rate, end_fall, limit = zip(values.tolist(), sigmas.tolist(), strict=True)
    return Levelling(*plateau, *rate, *end_fall, *limit, chi2, dof)


def p_value(chi2: float, dof: int, samples: float = np.inf) -> float:
    """Return the probability of a chi2 at least as large if the law holds; NaN without degrees of freedom.

    With a covariance estimated from ``samples``, chi2 is Hotelling's T^2, which has an F distribution.
    """
    from scipy.special import chdtrc, fdtrc  # scipy.stats takes longer to import than a small study to run

    if not np.isfinite(samples):
        return float(chdtrc(dof, chi2)) if dof > 0 else np.nan
    left = samples - dof
    return float(fdtrc(dof, left, chi2 * left / (dof * (samples - 1.0)))) if dof > 0 < left else np.nan


def _relative_covariance(y: Array, errors: Array) -> tuple[Array, bool]:
    """Return the covariance of log y to first order, (n, n), from errors (n,) or a covariance (n, n) of y, and whether
    it is known: unless errors (n,) are all finite and positive, it is the unit matrix, for points of equal weight.
    """
    if errors.ndim == 2:
        return errors / np.outer(y, y), True
    known = bool(np.all((errors > 0.0) & np.isfinite(errors)))
    return np.diag((errors / y) ** 2) if known else np.eye(len(y)), known


def _weigh(covariance: Array, samples: float) -> tuple[Callable[[Array], Array], Array]:
    """Return the function that weights points, and the covariance (n, n) of weighted points.  An exact covariance
    gives all weights, and leaves the unit matrix; one estimated from ``samples`` gives weights by its diagonal only.
    Raises ValueError for a covariance that is not positive definite, or one from samples with points without error.
    """
    if np.isfinite(samples):
        sigma = np.sqrt(np.diag(covariance))
        if not np.all(sigma > 0.0):
            raise ValueError("the covariance between the points has points without error")
        return (lambda vector: vector / sigma), covariance / np.outer(sigma, sigma)
    try:
        root = np.linalg.cholesky(covariance)
    except LinAlgError:
        root = np.full_like(covariance, np.nan)
    if not np.all(np.isfinite(root)):  # NaN in is NaN out, without an error
        raise ValueError("the covariance between the points is not positive definite")
    return (lambda vector: np.linalg.solve(root, vector)), np.eye(len(covariance))


def _chi2(residual: Array, design: Array, covariance: Array, relative: Array, samples: float) -> float:
    """Return the sum of squared residuals of weighted points, in units of their errors, about a law with the ``design``
    (n, parameters).  NaN if points with a ``relative`` covariance from ``samples`` share so much of their errors that
    the rest is not known: the covariance is of first order, and the second is about the square of the relative error.
    """
    rest = np.linalg.qr(design, mode="complete")[0][:, design.shape[1] :]
    free = rest.T @ covariance @ rest
    if not free.size:
        return 0.0
    error = float(np.sqrt(np.max(np.diag(relative)))) if np.isfinite(samples) else 0.0
    if np.linalg.eigvalsh(free)[0] < (FIRST_ORDER * error) ** 2:
        return np.nan
    return float(residual @ rest @ np.linalg.solve(free, rest.T @ residual))


def _limit(start: float, end: float, rate: float, floor: float, fall: float) -> float:
    """Return the z where -d ln y / dz is ``fall``: rate/2 c t / (floor + c t) with t = exp(-rate z)."""
    if end >= start:
        return -np.inf
    if not floor > 0.0:
        return np.inf
    if rate <= 2.0 * fall:
        return -np.inf
    return float(np.log((start - floor) * (0.5 * rate / fall - 1.0) / floor) / rate)
