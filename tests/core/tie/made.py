"""Made tables whose truth is known."""

import numpy as np

from linksweep.core.frames import MAS, satellite_catalogue
from linksweep.core.tie.astrometry import PAIRS, Astrometry


def random_correlations(rng, n):
    """Return (10, n) of random positive definite matrices."""
    half = rng.normal(size=(n, 5, 7))
    covariance = half @ half.swapaxes(1, 2)
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    return np.array([covariance[:, i, j] / sigma[:, i] / sigma[:, j] for i, j in PAIRS])


def stars(n, seed=1, pm=100.0, parallax=10.0, epoch=2016.0):
    """Return five-parameter astrometry with errors near 0.1 mas, all correlations and radial velocities."""
    rng = np.random.default_rng(seed)
    ra, dec = rng.uniform(0.0, 2.0 * np.pi, n), np.arcsin(rng.uniform(-0.98, 0.98, n))
    values = np.array([ra, dec, rng.uniform(0.2 * parallax, parallax, n) * MAS, *(rng.normal(0.0, pm * MAS, (2, n)))])
    errors = rng.uniform(0.05, 0.2, (5, n)) * MAS
    return Astrometry(
        values, errors, np.full(n, epoch), random_correlations(rng, n), rng.normal(0.0, 40.0, n), columns={}
    )


def seen_by_satellite(reference, epsilon, omega, zero_point=0.0):
    """Return the values of a reference's stars in the satellite's frame, exactly."""
    ra, dec, parallax, pmra, pmdec = reference.values
    new = satellite_catalogue(ra, dec, pmra, pmdec, np.asarray(epsilon), np.asarray(omega))
    return np.array([new[0], new[1], parallax - zero_point, new[2], new[3]])


def noise(rng, astrometry):
    """Return errors of the values of an astrometry; (5, N), zero where one is missing."""
    covariance = astrometry.covariance()
    values, vectors = np.linalg.eigh(covariance)
    half = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return np.einsum("nij,nj->in", half, rng.normal(size=(len(astrometry), 5)))
