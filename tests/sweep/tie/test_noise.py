"""Estimated noise against dense restricted likelihoods and its coverage; errors of calibrators."""

import re
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from scipy import stats
from scipy.linalg import block_diag, null_space
from scipy.optimize import minimize

import linksweep
from linksweep.core.tie.astrometry import joined, propagated
from linksweep.core.tie.forecast import Simulation
from linksweep.core.tie.noise import estimated, noises
from linksweep.core.tie.problem import Problem, solve, source_sums
from linksweep.core.unknowns import parse_unknowns
from linksweep.sweep.tie.options import Options
from linksweep.sweep.tie.setup import set_up
from tests.core.tie.made import MAS, POSITION, gaia, gaia_table, noise, only, stars
from tests.sweep.tie.test_against_least_squares import drawn_tables, linked, pieces_of, turned
from tests.tiers import slow

CASES = [(30, 3, "position", 1.0), (30, 3, "position", 0.3), (50, 1, "five", 1.0), (50, 1, "five", 0.4)]


def noises_of(piece, kinds):
    """The covariances of the observations of a source by a noise of variance 1 in each quantity, by its label."""
    parts = {}
    for quantity, which in {"position": [0, 1], "parallax": [2], "motion": [3, 4]}.items():
        parts[f"satellite:{quantity}"] = piece.m[:, which] @ piece.m[:, which].T
        for kind in np.unique(kinds):
            parts[f"{kind}:{quantity}"] = np.diag([float(kinds[k] == kind and p in which) for k, p in piece.observed])
    return parts


def in_one(pieces):
    y, a = (np.concatenate([vars(one)[name] for one in pieces]) for name in "ya")
    return y, np.hstack([a, block_diag(*(one.b for one in pieces))]), block_diag(*(one.d for one in pieces))


@pytest.mark.parametrize(("seed", "n"), [(1, 18), *(slow(seed, 30) for seed in (2, 3))])
def test_the_noise_has_the_largest_restricted_likelihood(tmp_path, seed, n):
    tables = drawn_tables(tmp_path, seed, n=n, scale=2.0)
    plain, link = linked(tables), linked(tables, jitter="estimate")
    pieces, labels = list(pieces_of(tables, plain.difference.values)), [str(name) for name in link.noise.values]
    y, both, d = in_one(pieces)
    parts = [noises_of(one, plain.row_kind.values) for one in pieces]
    whole_noises = np.array([block_diag(*(one[label] for one in parts)) for label in labels])
    contrasts = null_space(both.T)
    noisy, known, z = contrasts.T @ whole_noises @ contrasts, contrasts.T @ d @ contrasts, contrasts.T @ y

    def deviance(variances):
        whole = known + np.tensordot(variances, noisy, axes=1)
        return np.linalg.slogdet(whole)[1] + z @ np.linalg.solve(whole, z)

    result = link.noise_size.values**2
    starts, how = (0.02 * np.ones(len(result)), result + 1e-3), {"options": {"maxfun": 10_000}}
    best = min(minimize(deviance, start, bounds=[(0.0, None)] * len(result), **how).fun for start in starts)
    assert deviance(result) < best + 1e-4
    # the information, 1/2 tr(P G P G), and the solution with these errors
    half = np.linalg.inv(known + np.tensordot(result, noisy, axes=1)) @ noisy
    deviation = np.sqrt(np.diag(np.linalg.inv(0.5 * np.einsum("cij,dji->cd", half, half))))
    with np.errstate(divide="ignore"):
        expected = np.minimum(deviation / (2.0 * np.sqrt(result)), np.sqrt(deviation))
    np.testing.assert_allclose(link.noise_error, expected, rtol=1e-3)

    def solution(variances):
        weights = np.linalg.inv(d + np.tensordot(variances, whole_noises, axes=1))
        inverse = np.linalg.pinv(both.T @ weights @ both, rcond=1e-14)[:6]
        return inverse @ both.T @ weights, inverse[:, :6]

    gain, covariance = solution(result)
    np.testing.assert_allclose(link.estimate, gain @ y, rtol=1e-3, atol=1e-3 * np.sqrt(covariance.diagonal().min()))
    np.testing.assert_allclose(link.covariances.sel(error_kind="formal"), covariance, rtol=1e-3, atol=1e-7)
    # Kenward & Roger 1997: twice the scatter of the unknowns with the noise, and Student's t of the errors of errors
    above, step = np.flatnonzero(result > 0.0), 1e-5
    ends = [[solution(result + sign * step * unit) for sign in (1.0, -1.0)] for unit in np.eye(len(result))[above]]
    moved, slope = (np.array([(one[k] - other[k]) / (2.0 * step) for one, other in ends]) for k in (0, 1))
    scatter = np.linalg.inv(0.5 * np.einsum("cij,dji->cd", half[above], half[above]))
    whole = d + np.tensordot(result, whole_noises, axes=1)
    lacking = 2.0 * np.einsum("cd,cki,ij,dlj->kl", scatter, moved, whole, moved)
    relative = np.einsum("ckk,cd,dkk->k", slope, scatter, slope) / np.diag(covariance) ** 2
    student = stats.t.ppf(stats.norm.cdf(1.0), 2.0 / relative)
    np.testing.assert_allclose(link.error, student * np.sqrt(np.diag(covariance + lacking)), rtol=1e-3)
    assert list(link.error_kind.values[:2]) == ["estimated", "scaled"]


def test_errors_that_are_right_have_no_noise_and_that_of_a_mission_is_its_own(tmp_path):
    pulsars = "psrpi-de200", "timing-de200", "orientation"
    link, plain = linksweep.tie(*pulsars, jitter="estimate"), linksweep.tie(*pulsars)
    np.testing.assert_array_equal(link.noise_size, 0.0)
    np.testing.assert_allclose(link.estimate, plain.estimate)
    np.testing.assert_allclose(link.error, plain.errors.sel(error_kind="formal"))
    beside = linksweep.tie(*pulsars, missions={"satellite-2": pulsars[1]}, jitter="satellite-2:all=estimate")
    assert beside.noise.values.tolist() == ["satellite-2:position:position"]
    ours = replace(stars(20, 3), errors=np.full((5, 20), 0.1 * MAS), correlations=np.zeros((10, 20)))
    values = ours.values + np.random.default_rng(4).normal(0.0, 0.5 * MAS, (5, 20))
    hip, blocks = gaia(tmp_path / "hip.ecsv", replace(ours, values=values)), "orientation,hip:orientation"
    table, rows = gaia(tmp_path / "own.ecsv", ours), gaia(tmp_path / "rows.ecsv", only(ours, POSITION))
    link = linksweep.tie(table, rows, "orientation", positions="mean", jitter="estimate")  # nobody knows whose it is
    assert link.noise.values.tolist() == ["position:position"]
    assert "satellite:position" in str(link.attrs["notes"])
    link = linksweep.tie(table, table, blocks, missions={"hip": hip}, jitter="hip:all=estimate")
    np.testing.assert_allclose(link.noise_size[[0, 2]], 0.5, rtol=0.25)  # rows of the reference have none
    of_hip = np.flatnonzero(link.row_table == "hip")
    step, places = link.estimate.values[:3] - link.estimate.values[3:], ours.values[:2, link.row_source_index[of_hip]]
    moved = (link.difference - link.residual).values[of_hip, :2]
    np.testing.assert_allclose(moved, [turned(*place) @ step for place in places.T], atol=1e-9)


def drawn(seed, n, rows_each, kind, part=1.0, factor=3.0):
    """A problem without any rotation, whose ``part`` of stars has errors ``factor`` times those of the tables."""
    rng = np.random.default_rng(seed)
    truth = replace(stars(n, seed, pm=1e-3), radial_velocity=np.zeros(n))
    large, present = np.where(rng.random(n) < part, factor, 1.0), POSITION if kind == "position" else POSITION | True
    pieces = []
    for k in range(rows_each):
        row = stars(n, seed + 1000 * (k + 1), epoch=truth.epoch + rng.uniform(-12.0, 12.0, n))
        values = propagated(truth.values, None, truth.epoch, row.epoch) + large * noise(rng, row)
        pieces.append(only(row, present, values=values))
    ours = replace(truth, values=truth.values + large * noise(rng, truth))
    source = np.tile(np.arange(n), rows_each)
    return Problem(ours, joined(*pieces), source, parse_unknowns("orientation,spin"), float(truth.epoch[0]))


@pytest.mark.parametrize(("seeds", "case"), [(8, CASES[0]), *(slow(400, case) for case in CASES)])
def test_the_truth_is_within_the_error_as_often_as_it_should_be(seeds, case):
    """The stars have errors three times those of the tables; formal errors without noise contain it 0.25 of times."""
    inside, plain = [], []
    for problem in (drawn(seed, *case) for seed in range(seeds)):
        jitter = {"reference": {"all": "estimate"}}
        result, without = estimated(problem, noises(problem, jitter)), solve(source_sums(problem))
        solved = solve(source_sums(result.added_to(problem, jitter)))
        inside.append(np.abs(solved.estimate) < np.sqrt(np.diag(result.covariance(solved))))
        plain.append(np.abs(without.estimate) < np.sqrt(np.diag(without.covariance)))
    assert abs(np.mean(inside) - 0.683) < (0.02 if seeds > 100 else 0.15)
    assert np.mean(plain) < 0.6


@pytest.mark.parametrize("seed", [1, slow(2)])
def test_rows_that_share_a_calibrator_share_its_error_also_in_draws(tmp_path, seed):
    tables = drawn_tables(tmp_path, seed, n=40, calibrators=("", "J1", "J2"))
    link = linked(tables)
    pieces, shared = list(pieces_of(tables, link.difference.values)), []
    for one in pieces:
        k, which = np.array(one.observed).T
        same = (tables.names[k][:, None] == tables.names[k]) & (which[:, None] == which) & (which < 2)
        shared.append(same * np.outer(tables.shared[k], tables.shared[k]))
    assert sum(np.count_nonzero(np.triu(one, 1)) for one in shared) > 4
    y, both, d = in_one(pieces)
    weights = np.linalg.inv(d + block_diag(*shared))
    inverse = np.linalg.pinv(both.T @ weights @ both, rcond=1e-14)[:6]
    np.testing.assert_allclose(link.estimate, inverse @ both.T @ weights @ y, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(link.covariances.sel(error_kind="formal"), inverse[:, :6], rtol=1e-4, atol=1e-7)
    assert linked(tables, jitter="estimate").noise.size
    how = {"add": [2030.0], "error": 1e6, "positions": "mean"}  # which says nothing
    plan = linksweep.forecast(tables.satellite, tables.reference, "orientation,spin", epoch=2016.0, **how)
    np.testing.assert_allclose(plan.error[1], link.errors.sel(error_kind="formal"), rtol=1e-6)
    small = linked(tables, units=["reference:calibrator_error=uas"], accept_misfit=True)
    assert any("row" in note and "is it in arcsec? Say --unit" in note for note in small.attrs["notes"])
    problem = set_up(tables.satellite, tables.reference, Options("orientation,spin", positions="mean")).problem
    expected = solve(source_sums(problem)).covariance
    draws = Simulation(problem, np.zeros(6), 0.5, 1.0, 2.0).draws(600, np.random.default_rng(1))
    result = np.array([solve(one.sums).estimate for one in draws])
    np.testing.assert_allclose(np.diag(np.cov(result.T)), np.diag(expected), rtol=0.25)


@pytest.mark.slow
def test_the_advice_for_a_kind_with_few_rows_works_and_what_results_say_is_an_option(tmp_path):
    truth = stars(20)
    noisy = replace(truth, values=truth.values + noise(np.random.default_rng(1), truth))
    table = Table(gaia_table(noisy), masked=True)
    for name in table.colnames[1:]:
        table[name].mask[:4] = "pm" in name or "parallax" in name
        table[name].mask[4] = name != "ref_epoch"  # a row of nothing
    table.write(tmp_path / "reference.ecsv")
    tables = gaia(tmp_path / "satellite.ecsv", stars(20)), tmp_path / "reference.ecsv"
    with pytest.raises(linksweep.SweepError) as refused:
        linksweep.tie(*tables, "orientation", jitter="estimate")
    advice = re.search("--jitter '(.+?)'", str(refused.value))[1]
    assert advice == "single epoch=0.1"
    link = linksweep.tie(*tables, "orientation", jitter=["estimate", advice], known_spin="none")
    assert {name.partition(":")[0] for name in link.noise.values.tolist()} == {"five-parameter", "satellite"}
    plain = linksweep.tie(*tables, "orientation")
    assert linksweep.tie(*tables, "orientation", jitter=plain.attrs["jitter"]).identical(plain)
