"""Power laws through points with errors, correlated or not: arrays in, numbers out."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.stats import chi2 as chi2_distribution

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PowerLaw:
    """y = amplitude (x / pivot)^exponent; the pivot makes the one-sigma errors of both uncorrelated.

    ``chi2`` is NaN where the points have no errors: then all weigh the same and the errors come from the scatter.
    """

    exponent: float
    exponent_error: float
    amplitude: float
    amplitude_error: float
    pivot: float
    chi2: float
    dof: int

    def __call__(self, x: Array) -> Array:
        """Return the law at x, same shape."""
        return np.asarray(self.amplitude * (x / self.pivot) ** self.exponent)

    def relative_error(self, x: Array) -> Array:
        """Return the one-sigma error of the law at x over the law, same shape."""
        return np.hypot(self.amplitude_error / self.amplitude, np.log(x / self.pivot) * self.exponent_error)


def power_law(x: Array, y: Array, errors: Array) -> PowerLaw:
    """Return the power law through points, by generalised least squares of log y against log x.

    ``x`` and ``y`` (n,) are positive; ``errors`` are one sigma of y, (n,), or the covariance of y, (n, n).  The errors
    of the law are those that the errors of y give, whatever the scatter.  Unless every error in (n,) is known and
    positive all weigh the same, and the errors of the law come from the scatter (0 for two points, which have none).
    Raises ValueError for a covariance that is not positive definite.
    """
    known = are_known(errors)
    whiten = inverse_root_of(relative_covariance(y, errors) if known else np.eye(len(x)))
    ones, u, v = whiten(np.ones_like(x)), whiten(np.log(x)), whiten(np.log(y))
    total = ones @ ones
    centre, mean = ones @ u / total, ones @ v / total
    u, v = u - centre * ones, v - mean * ones
    information = u @ u
    exponent = u @ v / information
    residual = v - exponent * u
    chi2, dof = float(residual @ residual), len(x) - 2
    variance = 1.0 if known else chi2 / dof if dof > 0 else 0.0
    amplitude = np.exp(mean)
    return PowerLaw(
        exponent=float(exponent),
        exponent_error=float(np.sqrt(variance / information)),
        amplitude=float(amplitude),
        amplitude_error=float(amplitude * np.sqrt(variance / total)),
        pivot=float(np.exp(centre)),
        chi2=chi2 if known else np.nan,
        dof=dof,
    )


def p_value(chi2: float, dof: int) -> float:
    """Return the probability of a chi2 at least as large if the law holds; NaN without degrees of freedom."""
    return float(chi2_distribution.sf(chi2, dof)) if dof > 0 else np.nan


def are_known(errors: Array) -> bool:
    """Return whether points can be weighed: by a covariance (n, n), or errors (n,) that are all finite and positive."""
    return errors.ndim == 2 or bool(np.all((errors > 0.0) & np.isfinite(errors)))


def relative_covariance(y: Array, errors: Array) -> Array:
    """Return the covariance of log y to first order, (n, n), from errors (n,) or a covariance (n, n) of y."""
    return np.diag((errors / y) ** 2) if errors.ndim == 1 else errors / np.outer(y, y)


def inverse_root_of(covariance: Array) -> Callable[[Array], Array]:
    """Return the function that multiplies with the inverse of the Cholesky factor of a covariance (n, n): it makes
    errors independent and one.  Raises ValueError if there is none.
    """
    try:
        root = cholesky(covariance, lower=True)
    except (LinAlgError, ValueError) as error:
        raise ValueError("the covariance between the points is not positive definite") from error
    return lambda vector: np.asarray(solve_triangular(root, vector, lower=True))
