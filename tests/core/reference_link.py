"""What the link is compared with: one realisation solved by singular value decomposition, and the paper's matrix."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.arrays import Array
from core.design import design_matrix
from core.link import LinkError, Weighting


@dataclass(frozen=True)
class LinkSolution:
    """A solved link; K unknowns in rad and rad/yr, in the order of the design matrix.

    ``estimate`` and ``formal_error`` (K,), ``covariance`` and ``correlation`` (K, K), ``residuals`` (4, N), and the
    numbers chi2 (sum of (residual/sigma)^2), dof, rank and condition number of the weighted design matrix with its
    columns scaled to length 1.  For equal weights chi2 is not at its minimum, so it is larger than dof on average.
    """

    estimate: Array
    covariance: Array
    residuals: Array
    chi2: float
    dof: int
    rank: int
    condition_number: float

    @property
    def formal_error(self) -> Array:
        """Square root of the diagonal of the covariance; shape (K,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Array:
        """Correlation matrix of the unknowns; shape (K, K)."""
        return self.covariance / np.outer(self.formal_error, self.formal_error)


def solve(design: Array, differences: Array, sigma: Array, weighting: Weighting = "inverse-variance") -> LinkSolution:
    """Solve the link by singular value decomposition.

    ``design`` (4, N, K), ``differences`` reference - satellite (4, N), their standard errors ``sigma`` (4, N), all in
    rad and rad/yr.  Weights are 1/sigma^2, or one for all with ``weighting="equal"``, where the covariance is the
    sandwich G diag(sigma^2) G^T.  Raises LinkError for non-finite input, non-positive sigma, too few objects or rank
    deficiency.
    """
    n_unknown = design.shape[-1]
    _require(np.isfinite(differences), "non-finite difference")
    _require(np.isfinite(design), "non-finite design matrix")
    _require(np.isfinite(sigma) & (sigma > 0.0), "standard error that is not positive and finite")
    a, y, s = design.reshape(-1, n_unknown), differences.ravel(), sigma.ravel()
    _require_unknowns(len(y), n_unknown)

    root_weight = 1.0 / s if weighting == "inverse-variance" else np.ones_like(s)
    weighted = root_weight[:, None] * a
    length = np.sqrt(np.sum(weighted**2, axis=0))
    scale = np.where(length > 0.0, length, 1.0)  # positions and proper motions may differ by many orders of magnitude
    u, singular, vt = np.linalg.svd(weighted / scale, full_matrices=False)
    rank = int(np.sum(singular > singular[0] * max(a.shape) * np.finfo(float).eps))
    if rank < n_unknown:
        raise LinkError(
            f"the link is rank deficient: {rank} of {n_unknown} unknowns are determined by these {len(y) // 4} objects"
        )
    gain = (vt.T / singular) @ (u.T * root_weight) / scale[:, None]
    estimate = gain @ y
    residuals = y - a @ estimate
    scaled_gain = gain * s
    return LinkSolution(
        estimate=estimate,
        covariance=scaled_gain @ scaled_gain.T,
        residuals=residuals.reshape(differences.shape),
        chi2=float(np.sum((residuals / s) ** 2)),
        dof=len(y) - n_unknown,
        rank=rank,
        condition_number=float(singular[0] / singular[-1]),
    )


def _require(good: NDArray[np.bool_], what: str) -> None:
    if not np.all(good):
        observable, item = np.argwhere(~good)[0][:2]
        raise LinkError(f"{what} in {('ra', 'dec', 'pmra', 'pmdec')[observable]} of object {item}")


def _require_unknowns(n_observed: int, n_unknown: int) -> None:
    if n_observed < n_unknown:
        raise LinkError(f"too few objects: {n_observed // 4} give {n_observed} observables for {n_unknown} unknowns")


def paper_design_matrix(ra: Array, dec: Array, mu_alpha: Array, mu_delta: Array) -> Array:
    """Return the paper's matrix for mu_alpha = d(alpha)/dt *without* cos dec; shape (4, N, 6).

    Its third observable is ``(mu_alpha,ref - mu_alpha,sat) cos(dec_ref)``, not a difference of mu_alpha*.
    Source: Metz & Geffert 2004, Eqs. 11-13.  A21 as printed is right; Eq. 9 has ``cos^2 dec`` for ``1/cos^2 dec``.
    """
    design = design_matrix(ra, dec, mu_alpha, mu_delta, corrections=False)
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    design[2, :, 0] = -cos_ra / cos_dec * mu_delta + sin_dec * sin_ra * mu_alpha
    design[2, :, 1] = -sin_ra / cos_dec * mu_delta - sin_dec * cos_ra * mu_alpha
    design[3, :, 0] = cos_ra * mu_alpha
    design[3, :, 1] = sin_ra * mu_alpha
    return design
