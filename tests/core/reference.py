"""The link of one catalogue by a singular value decomposition of its design matrix: what the sums are compared with."""

from types import SimpleNamespace

import numpy as np

from tests.core.points import LinkError

POLE = 1e-8


def design_matrix(ra, dec, pmra, pmdec, corrections=True, glide=False):
    """Derivatives of the observables by the unknowns (4, ..., K), with NumPy alone; Metz & Geffert 2004, Eqs. 1-13."""
    sin_ra, cos_ra, sin_dec, cos_dec, zero = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec), np.zeros_like(ra)
    if np.any(cos_dec < POLE):
        at = np.argwhere(cos_dec < POLE)[0]
        raise LinkError(f"object {at[-1]} is at a celestial pole")
    p = np.stack([-sin_ra, cos_ra, zero], axis=-1)
    q = np.stack([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec], axis=-1)
    design = np.zeros((4, *np.shape(ra), 9))
    design[0, ..., :3] = design[2, ..., 3:6] = q
    design[1, ..., :3] = design[3, ..., 3:6] = -p
    design[2, ..., 6:], design[3, ..., 6:] = p, q
    if corrections:
        eta = np.stack([cos_ra / cos_dec, sin_ra / cos_dec, zero], axis=-1)
        design[2, ..., :3], design[3, ..., :3] = -pmdec[..., None] * eta, pmra[..., None] * eta
    return design if glide else design[..., :6]


def solve(design, differences, sigma, weighting="inverse-variance"):
    """Solution for a design (4, N, K), differences and errors (4, N), with the gain G (K, 4, N) and sandwich errors."""
    a, y, s = design.reshape(-1, design.shape[-1]), differences.ravel(), sigma.ravel()
    root_weight = 1.0 / s if weighting == "inverse-variance" else np.ones_like(s)
    weighted = root_weight[:, None] * a
    length = np.sqrt(np.sum(weighted**2, axis=0))
    scale = np.where(length > 0.0, length, 1.0)  # positions and proper motions may differ by many orders of magnitude
    u, singular, vt = np.linalg.svd(weighted / scale, full_matrices=False)
    if len(y) < len(scale) or singular[-1] <= singular[0] * max(a.shape) * np.finfo(float).eps:
        raise LinkError("the link is rank deficient")
    gain = (vt.T / singular) @ (u.T * root_weight) / scale[:, None]
    estimate = gain @ y
    numbers = {"chi2": float(np.sum(((y - a @ estimate) / s) ** 2)), "condition_number": singular[0] / singular[-1]}
    numbers |= {"estimate": estimate, "formal_error": np.sqrt(np.sum((gain * s) ** 2, axis=1))}
    return SimpleNamespace(gain=gain.reshape(len(scale), *differences.shape), **numbers)
