"""Power laws through points with errors, correlated or not: arrays in, numbers out."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from linksweep.sweep.contract import Array, small_sample_factor

FIRST_ORDER = 5.0
"""A law is judged only if the errors that points do not share are this many times the neglected second order."""


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
    relative, known = relative_covariance(y, errors)
    whiten, covariance = weigh(relative, samples)
    ones, u, v = whiten(np.ones_like(x)), whiten(np.log(x)), whiten(np.log(y))
    total = ones @ ones
    centre, mean = ones @ u / total, ones @ v / total
    u, v = u - centre * ones, v - mean * ones
    information = u @ u
    exponent = u @ v / information
    residual = v - exponent * u
    dof = len(x) - 2
    chi2 = chi2_about(residual, np.stack([ones, u], axis=1), covariance, relative, samples)
    unit = 1.0 if known else chi2 / dof if dof > 0 else 0.0
    solve = np.stack([u / information, ones / total])
    spread = unit * float(small_sample_factor(samples)) * solve @ covariance @ solve.T
    exponent_error, relative_error = np.sqrt(np.diag(spread))
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


def weigh(covariance: Array, samples: float) -> tuple[Callable[[Array], Array], Array]:
    """Return the function that weights points, and the covariance (n, n) of weighted points.  An exact covariance
    gives all weights, and leaves the unit matrix; one estimated from ``samples`` gives weights by its diagonal only.
    Raises ValueError for a covariance that is not positive definite, or one from samples with points without error.
    """
    if np.isfinite(samples):
        own = np.sqrt(np.diag(covariance))
        if not np.all(own > 0.0):
            raise ValueError("the covariance between the points has points without error")
        return (lambda vector: vector / own), covariance / np.outer(own, own)
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        root = np.full_like(covariance, np.nan)
    if not np.all(np.isfinite(root)):  # NaN in is NaN out, without an error
        raise ValueError("the covariance between the points is not positive definite")
    return (lambda vector: np.linalg.solve(root, vector)), np.eye(len(covariance))


def chi2_about(residual: Array, design: Array, covariance: Array, relative: Array, samples: float) -> float:
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


def p_value(chi2: float, dof: int, samples: float = np.inf) -> float:
    """Return the probability of a chi2 at least as large if the law holds; NaN without degrees of freedom.

    With a covariance estimated from ``samples``, chi2 is Hotelling's T^2, which has an F distribution.
    """
    from scipy.special import chdtrc, fdtrc  # scipy.stats takes longer to import than a small study to run

    if not np.isfinite(samples):
        return float(chdtrc(dof, chi2)) if dof > 0 else np.nan
    left = samples - dof
    return float(fdtrc(dof, left, chi2 * left / (dof * (samples - 1.0)))) if dof > 0 < left else np.nan


def relative_covariance(y: Array, errors: Array) -> tuple[Array, bool]:
    """Return the covariance of log y to first order, (n, n), from errors (n,) or a covariance (n, n) of y, and whether
    it is known: unless errors (n,) are all finite and positive, it is the unit matrix, for points of equal weight.
    """
    if errors.ndim == 2:
        return errors / np.outer(y, y), True
    known = bool(np.all((errors > 0.0) & np.isfinite(errors)))
    return np.diag((errors / y) ** 2) if known else np.eye(len(y)), known
