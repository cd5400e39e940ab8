"""Rows made by astropy from a known frame come back; solutions are least squares of all parameters and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import Distance, SkyCoord, get_body_barycentric
from astropy.time import Time
from hypothesis import given, strategies as st
from scipy.linalg import block_diag, lstsq
from scipy.optimize import brentq

from linksweep.core.frames import MAS, position, triad
from linksweep.core.tie.astrometry import Astrometry, bends, differences, propagated
from linksweep.core.tie.problem import Problem, leave_one_out, solve, source_sums
from linksweep.core.unknowns import parse_unknowns
from tests.core.tie.made import missions, seen_by_satellite, stars

EPSILON = np.array([70.0, -130.0, 90.0]) * MAS
OMEGA = np.array([0.9, -1.4, 0.6]) * MAS
YEARS = st.floats(-40.0, 40.0)


def by_astropy(reference, epoch):
    ra, dec, parallax, pmra, pmdec = reference.values
    here, rate = (ra * units.rad, dec * units.rad, Distance(parallax=parallax * units.rad)), units.rad / units.yr
    moves = {"pm_ra_cosdec": pmra * rate, "pm_dec": pmdec * rate}
    moves["radial_velocity"] = reference.radial_velocity * units.km / units.s
    before, after = (Time(when, format="jyear", scale="tdb") for when in (reference.epoch[0], epoch))
    there = SkyCoord(*here, **moves, obstime=before).apply_space_motion(new_obstime=after)
    motions = (pm.to_value(rate) for pm in (there.pm_ra_cosdec, there.pm_dec))
    return np.array([there.ra.rad, there.dec.rad, there.distance.parallax.rad, *motions])


def apparent(values, epoch):
    earth = get_body_barycentric("earth", Time(epoch, format="jyear", scale="tdb"), ephemeris="builtin")
    return position(triad(values[0], values[1]).r - values[2] * earth.xyz.to_value(units.au)[:, None])


def made(used, years, unknowns, n=30):
    truth = stars(n, 2, pm=3000.0, parallax=60.0)
    satellite = replace(truth, values=seen_by_satellite(truth, EPSILON, OMEGA, zero_point=0.04 * MAS))
    epoch = truth.epoch[0] + years
    values = by_astropy(truth, epoch) if years else truth.values.copy()
    single = used == slice(0, 2)
    if single:
        values[:2] = apparent(values, epoch)
    errors = np.full((5, n), np.nan)
    errors[used] = 0.1 * MAS
    values[np.isnan(errors)] = np.nan
    rows = Astrometry(values, errors, np.full(n, epoch), apparent=np.full(n, single))
    return Problem(satellite, rows, np.arange(n), parse_unknowns(unknowns), float(truth.epoch[0]))


def test_five_parameters_come_back_and_positions_of_a_single_epoch_are_displaced_by_the_parallax():
    problem = made(slice(0, 5), 0.0, "orientation,spin,parallax")
    result = solve(source_sums(problem)).estimate / MAS
    np.testing.assert_allclose(result[:3], EPSILON / MAS, atol=2e-4)
    np.testing.assert_allclose(result[3:6], OMEGA / MAS, atol=2e-6)
    assert result[6] == pytest.approx(0.04, abs=1e-5)
    turns = solve(source_sums(made(slice(3, 5), 25.0, "spin"))).estimate / MAS  # by 1 mas/yr in these years
    np.testing.assert_allclose(turns, OMEGA / MAS, atol=5e-3)
    east, north, _ = triad(*problem.satellite.values[:2])
    apart = np.einsum("kin,in->nk", [east, north], triad(*problem.rows.values[:2]).r)
    np.testing.assert_allclose(problem.differences().values[:, :2], apart, atol=1e-15)
    for years in (-20.8, 0.0, 10.7):
        result = solve(source_sums(made(slice(0, 2), years, "orientation"))).estimate / MAS
        np.testing.assert_allclose(result, (EPSILON + years * OMEGA) / MAS, atol=0.02)  # of parallaxes of 60 mas


def test_the_motion_is_astropys():
    truth = stars(50, 5, pm=5000.0, parallax=300.0)
    for epoch in (1950.0, 2030.0):
        ours = propagated(truth.values, truth.radial_velocity, truth.epoch, np.full(50, epoch))
        theirs = by_astropy(truth, epoch)
        np.testing.assert_allclose(ours[:2], theirs[:2], atol=1e-3 * MAS)
        np.testing.assert_allclose(ours[2:], theirs[2:], rtol=1e-7, atol=1e-6 * MAS)


@given(st.floats(0.05, 30.0), st.floats(0.0, 0.98), YEARS, YEARS, st.floats(0.0, 3.14))
def test_an_orbit_solves_the_equation_of_kepler(period, e, periastron, years, inclination):
    """With the root found by bisection; the axis of the orbit points north."""
    orbit = np.array([[period, e, periastron, 1.0, 0.0, 0.0, np.cos(inclination)]]).T
    mean = 2.0 * np.pi * (((years - periastron) / period) % 1.0)
    anomaly = brentq(lambda x: x - e * np.sin(x) - mean, 0.0, 2.0 * np.pi, xtol=1e-14)
    north, east = np.cos(anomaly) - e, np.sqrt(1.0 - e**2) * np.sin(anomaly) * np.cos(inclination)
    np.testing.assert_allclose(bends(np.array([years]), orbit)[0][:, 4], [east, north, 0.0, 0.0, 0.0], atol=1e-7)


def test_an_orbit_is_seen_at_single_epochs_and_not_in_mean_positions():
    problem, further = made(slice(0, 2), 3.0, "orientation"), np.zeros((2, 5, 30)) + MAS * np.eye(5)[:, [4]]
    orbit = np.tile([[2.0, 0.3, 0.5, 1.0, 0.0, 0.0, 0.5]], (30, 1)).T
    both = problem.satellite, replace(problem.satellite, further=further, orbit=orbit)
    for single in (True, False):
        rows = replace(problem.rows, apparent=np.full(30, single))
        free, bound = (differences(one, rows, problem.source).values[:, :2] for one in both)
        expected = single * MAS * bends(np.full(30, 3.0), orbit)[:, :2, 4]
        np.testing.assert_allclose(free - bound, expected, atol=1e-15)


def test_it_is_the_least_squares_of_all_tables_and_leaving_out_what_determines_an_unknown_is_found():
    problem = missions()
    mine, rows, n = problem.satellite, problem.rows, len(problem.satellite)
    result = differences(mine, rows, problem.source)
    single = parse_unknowns("orientation,spin").matrix(*problem.objects(mine))  # of each star; (n, 5, 6)
    design = np.zeros((n + len(rows), 5, 5 * n + 12))
    for i in range(n):
        design[i, :, 5 * i : 5 * i + 5] = np.eye(5)
    design[:n, :, 5 * n : 5 * n + 6] = -single  # a mission sees the star minus what its frame adds
    for r, i in enumerate(problem.source):
        design[n + r, :, 5 * i : 5 * i + 5] = result.partials[r]
        if rows.frame[r]:
            design[n + r, :, 5 * n + 6 :] = -result.partials[r] @ single[i]
    half = np.linalg.inv(np.linalg.cholesky(block_diag(*mine.covariance(), *result.covariance) / MAS**2))
    right = np.concatenate([np.zeros(5 * n), *result.values])
    a, y = half @ np.concatenate(design), half @ right / MAS
    x, *_ = lstsq(a, y)
    covariance = np.linalg.inv(a.T @ a)[5 * n :, 5 * n :] * MAS**2
    error, solution = np.sqrt(np.diag(covariance)), solve(source_sums(problem))
    np.testing.assert_allclose(solution.estimate / error, x[5 * n :] * MAS / error, atol=1e-9)
    np.testing.assert_allclose((solution.covariance - covariance) / np.outer(error, error), 0.0, atol=1e-9)
    assert solution.squares == pytest.approx(np.sum((y - a @ x) ** 2), rel=1e-9)
    assert solution.dof == 5 * len(rows) - 12
    sums = source_sums(missions(n=30))
    normal, right = sums.normal.sum(axis=0), sums.right.sum(axis=0)
    alone = sums.taken(np.arange(3))
    alone.normal[1], alone.right[1] = normal, right
    result = leave_one_out(alone, normal, right)
    assert np.isnan(result).all(axis=1).tolist() == [False, True, False]
    np.testing.assert_array_equal(result[[0, 2]], leave_one_out(sums.taken(np.array([0, 2])), normal, right))
