"""Made tables whose truth is known."""

# ruff: noqa: F401 (tests import from here what they need of the core)
from dataclasses import replace

import numpy as np
from astropy.table import Table

from linksweep.core.frames import ARCSEC, DEGREE, MAS, satellite_catalogue
from linksweep.core.tie.astrometry import PAIRS, Astrometry, by_errors, joined, parallax_factors, propagated
from linksweep.core.tie.problem import Problem
from linksweep.core.unknowns import SPIN_BLOCK, Objects, parse_unknowns
from linksweep.sweep.cli import main

NAMES = ("ra", "dec", "parallax", "pmra", "pmdec")
POSITION = np.array([True, True, False, False, False])
GAIA, HIPPARCOS = 2016.0, 1991.25
EPSILON = np.array([[0.4, -0.3, 0.9], [-1.1, 0.7, 0.2]]) * MAS
OMEGA = np.array([[0.02, -0.1, 0.06], [0.3, -0.2, 0.15]]) * MAS
UNKNOWNS = parse_unknowns("orientation,spin,hipparcos:orientation,hipparcos:spin", missions=("hipparcos",))


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
    correlations, radial_velocity = random_correlations(rng, n), rng.normal(0.0, 40.0, n)
    return Astrometry(values, errors, np.full(n, epoch), correlations, radial_velocity, columns={})


def seen_by_satellite(reference, epsilon, omega, zero_point=0.0):
    """Return the values of a reference's stars in the satellite's frame, exactly."""
    ra, dec, parallax, pmra, pmdec = reference.values
    new = satellite_catalogue(ra, dec, pmra, pmdec, np.asarray(epsilon), np.asarray(omega))
    return np.array([new[0], new[1], parallax - zero_point, new[2], new[3]])


def noise(rng, astrometry):
    values, vectors = np.linalg.eigh(astrometry.covariance())
    half = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return np.einsum("nij,nj->in", half, rng.normal(size=(len(astrometry), 5)))


def only(made, present, **changes):
    """Return an astrometry that has no more than the parameters that are ``present``, as (5,) or (5, N)."""
    made = replace(made, **changes)
    present = np.broadcast_to(np.asarray(present).T, made.errors.T.shape).T
    values, errors = (np.where(present, array, np.nan) for array in (made.values, made.errors))
    return replace(made, values=values, errors=errors)


def gaia_table(made, **changes):
    """Return a table with the names of the Gaia archive, without units as in its CSV."""
    table = Table({"source_id": np.arange(len(made)) + 10**17})
    for i, name in enumerate(NAMES):
        table[name] = made.values[i] / (DEGREE if i < 2 else MAS)
        table[f"{name}_error"] = made.errors[i] / MAS
    for row, (i, j) in zip(made.correlations, PAIRS, strict=True):
        table[f"{NAMES[i]}_{NAMES[j]}_corr"] = row
    table["ref_epoch"] = made.epoch
    table["radial_velocity"] = made.radial_velocity
    table["phot_g_mean_mag"] = np.linspace(4.0, 12.0, len(made))
    for name, column in changes.items():
        table[name] = column
    return table


def gaia(path, made, **changes):
    gaia_table(made, **changes).write(path, overwrite=True)
    return path


def missions(n=14, n_reference=6, seed=5):
    """Return the problem of two missions and a reference of a few of their stars; orientations are those of 2016.0."""
    rng = np.random.default_rng(seed)
    truth = stars(n, seed, pm=60.0)
    gaia = replace(truth, values=seen_by_satellite(truth, EPSILON[0], OMEGA[0]))
    then = np.full(n, HIPPARCOS)
    there = propagated(truth.values, truth.radial_velocity, truth.epoch, then)
    there = replace(truth, values=there, epoch=then, errors=8.0 * truth.errors)
    turned = EPSILON[1] + (HIPPARCOS - GAIA) * OMEGA[1]
    hipparcos = replace(there, values=seen_by_satellite(there, turned, OMEGA[1]), frame=np.ones(n, dtype=int))
    vlbi, earlier = truth.taken(np.arange(n_reference)), truth.epoch[:n_reference] - 9.0
    values = propagated(vlbi.values, vlbi.radial_velocity, vlbi.epoch, earlier)
    vlbi = replace(vlbi, values=values, epoch=earlier)
    gaia, hipparcos, vlbi = (replace(one, values=one.values + noise(rng, one)) for one in (gaia, hipparcos, vlbi))
    source = np.concatenate([np.arange(n), np.arange(n_reference)])
    return Problem(gaia, joined(hipparcos, vlbi), source, UNKNOWNS, GAIA)
