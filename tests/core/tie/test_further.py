"""Stars whose paths are not straight, against least squares in which each parameter of each star is an unknown."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from linksweep.core.tie.astrometry import bends, differences
from linksweep.core.tie.problem import Problem
from linksweep.core.tie.solution import sources_of
from tests.core.tie.made import MAS, PAIRS, noise, parse_unknowns, stars

UNKNOWNS = parse_unknowns("orientation,spin")
ORBITS = np.array([[3.7, 0.4, 0.6, 0.5, -0.7, 0.6, 0.4], [0.0] * 7, [0.9, 0.0, -3.0, 1.0, 0.2, -0.1, 0.8]]).T


def sky(seed, n=5):
    """Return a satellite's table with further parameters and rows at many epochs, mean, single or of all five."""
    rng = np.random.default_rng(seed)
    own = replace(stars(n, seed, pm=30.0), radial_velocity=np.zeros(n))
    half = rng.normal(size=(n, 10, 12))
    covariance = half @ half.swapaxes(1, 2)
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    correlations = covariance / sigma[:, :, None] / sigma[:, None, :]
    errors = rng.uniform(0.05, 0.2, (5, n)) * MAS * rng.integers(0, 2, (5, n))
    further = np.array([rng.normal(0.0, 0.5, (5, n)) * MAS * (errors > 0.0), errors])
    bent = replace(
        own,
        further=further,
        correlations=np.array([correlations[:, i, j] for i, j in PAIRS]),
        further_correlations=np.moveaxis(correlations, 0, -1)[:, 5:],
        orbit=ORBITS[:, rng.integers(0, 3, n)],
    )
    source = np.repeat(np.arange(n), 4)
    rows = replace(own.taken(source), epoch=2016.0 + rng.uniform(-9.0, 9.0, 4 * n), columns={})
    errors = rows.errors.copy()
    kind = rng.integers(0, 3, 4 * n)
    errors[2:, kind > 0] = np.nan
    rows = replace(rows, errors=errors, apparent=kind == 1)
    off = differences(bent, replace(rows, values=np.where(np.isnan(errors), np.nan, rows.values)), source).values.T
    values = rows.values - off / [np.cos(rows.values[1]), *np.ones((4, len(source)))] + 0.3 * noise(rng, rows)
    return bent, replace(rows, values=np.where(np.isnan(errors), np.nan, values)), source


def with_every_parameter(problem):
    """Return the unknowns and their covariance from one large system: the rows, and the satellite's own parameters."""
    star, n = problem.satellite, len(problem.satellite)
    off = problem.differences()
    design = problem.unknowns.matrix(*problem.objects(star))
    blocks, values = [], []
    for r, s in enumerate(problem.source):
        seen = off.present[r]
        part = np.zeros((seen.sum(), 6 + 10 * n))
        part[:, :6] = (off.partials[r, :, :5] @ design[s])[seen]
        part[:, 6 + 10 * s : 16 + 10 * s] = off.partials[r][seen]
        half = np.linalg.cholesky(off.covariance[r][np.ix_(seen, seen)])
        blocks.append(np.linalg.solve(half, part))
        values.append(np.linalg.solve(half, off.values[r, seen]))
    for s, covariance in enumerate(star.covariance()):
        free = np.flatnonzero(np.diag(covariance) > 0.0)
        part = np.zeros((10, 6 + 10 * n))
        part[range(10), range(6 + 10 * s, 16 + 10 * s)] = 1e6 / MAS  # what a star lacks is zero
        half = np.linalg.cholesky(covariance[np.ix_(free, free)])
        part[free] = np.linalg.solve(half, part[free] * 1e-6 * MAS)
        blocks.append(part)
        values.append(np.zeros(10))
    matrix, right = np.concatenate(blocks) * MAS, np.concatenate(values)
    found, *_ = np.linalg.lstsq(matrix, right, rcond=None)
    return found[:6], np.linalg.inv(matrix.T @ matrix)[:6, :6], np.sum((right - matrix @ found) ** 2)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_a_link_is_that_with_every_parameter_of_every_star(seed):
    star, rows, source = sky(seed)
    problem = Problem(star, rows, source, UNKNOWNS, 2016.0)
    solution = sources_of(problem).solve(np.ones(len(star)))
    estimate, covariance, squares = with_every_parameter(problem)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(solution.estimate / MAS / sigma, estimate / sigma, atol=1e-6)
    np.testing.assert_allclose(solution.covariance / MAS**2, covariance, rtol=1e-6, atol=1e-6 * np.max(covariance))
    assert solution.squares == pytest.approx(squares, rel=1e-6)


@given(
    st.floats(0.05, 30.0), st.floats(0.0, 0.98), st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(0.0, 3.14)
)
def test_an_orbit_solves_the_equation_of_kepler(period, e, periastron, years, inclination):
    """With the root found by bisection; the axis of the orbit points north."""
    orbit = np.array([[period, e, periastron, 1.0, 0.0, 0.0, np.cos(inclination)]]).T
    mean = 2.0 * np.pi * (((years - periastron) / period) % 1.0)
    anomaly = brentq(lambda x: x - e * np.sin(x) - mean, 0.0, 2.0 * np.pi, xtol=1e-14)
    north, east = np.cos(anomaly) - e, np.sqrt(1.0 - e**2) * np.sin(anomaly) * np.cos(inclination)
    bend = bends(np.array([years]), orbit)[0]
    np.testing.assert_allclose(bend[:, 4], [east, north, 0.0, 0.0, 0.0], atol=1e-7)


@given(st.floats(-20.0, 20.0))
def test_motions_are_the_derivatives_of_positions(years):
    low, here, high = bends(years + np.array([-1e-4, 0.0, 1e-4]))
    np.testing.assert_allclose((high - low)[:2, :4] / 2e-4, here[3:, :4], rtol=1e-6, atol=1e-6)
