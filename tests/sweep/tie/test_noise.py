"""Estimated noise against dense restricted likelihoods, closed forms and its coverage; errors of calibrators."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import block_diag, null_space
from scipy.optimize import minimize

import linksweep
from linksweep.core.tie.forecast import Simulation
from linksweep.core.tie.noise import estimated, noises
from linksweep.core.tie.problem import Problem, solve, source_sums
from tests.core.tie.made import MAS, gaia, joined, noise, parse_unknowns, stars
from tests.sweep.tie.test_against_least_squares import drawn_tables, linked, pieces_of, turned
from tests.tiers import slow

WHICH = {"position": [0, 1], "parallax": [2], "motion": [3, 4]}


def noises_of(piece, kinds):
    """The covariances of the observations of a source by a noise of variance 1 in each quantity, by its label."""
    parts = {}
    for quantity, which in WHICH.items():
        parts[f"satellite:{quantity}"] = piece.m[:, which] @ piece.m[:, which].T
        for kind in np.unique(kinds):
            parts[f"{kind}:{quantity}"] = np.diag([float(kinds[k] == kind and p in which) for k, p in piece.observed])
    return parts


@pytest.mark.parametrize(("seed", "n"), [(1, 18), *(slow(seed, 30) for seed in (2, 3))])
def test_the_noise_has_the_largest_restricted_likelihood(tmp_path, seed, n):
    tables = drawn_tables(tmp_path, seed, n=n, scale=2.0)
    plain, link = linked(tables), linked(tables, jitter="estimate")
    pieces, labels = list(pieces_of(tables, plain.difference.values)), [str(name) for name in link.noise.values]
    y, a = (np.concatenate([vars(one)[name] for one in pieces]) for name in "ya")
    d, parts = block_diag(*(one.d for one in pieces)), [noises_of(one, plain.row_kind.values) for one in pieces]
    whole_noises = np.array([block_diag(*(one[label] for one in parts)) for label in labels])
    both = np.hstack([a, block_diag(*(one.b for one in pieces))])
    contrasts = null_space(both.T)
    noisy, known, z = contrasts.T @ whole_noises @ contrasts, contrasts.T @ d @ contrasts, contrasts.T @ y

    def deviance(variances):
        whole = known + np.tensordot(variances, noisy, axes=1)
        return np.linalg.slogdet(whole)[1] + z @ np.linalg.solve(whole, z)

    found = link.noise_size.values**2
    best = min(
        minimize(deviance, start, bounds=[(0.0, None)] * len(found), options={"maxfun": 10_000}).fun
        for start in (0.02 * np.ones(len(found)), found + 1e-3)
    )
    assert deviance(found) < best + 1e-4
    # the information, 1/2 tr(P G P G), and the solution with these errors
    half = np.linalg.inv(known + np.tensordot(found, noisy, axes=1)) @ noisy
    deviation = np.sqrt(np.diag(np.linalg.inv(0.5 * np.einsum("cij,dji->cd", half, half))))
    with np.errstate(divide="ignore"):
        expected = np.minimum(deviation / (2.0 * np.sqrt(found)), np.sqrt(deviation))
    np.testing.assert_allclose(link.noise_error, expected, rtol=1e-3)

    def solution(variances):
        """The matrix that makes the unknowns of the differences, and their covariance."""
        weights = np.linalg.inv(d + np.tensordot(variances, whole_noises, axes=1))
        inverse = np.linalg.pinv(both.T @ weights @ both, rcond=1e-14)[:6]
        return inverse @ both.T @ weights, inverse[:, :6]

    _, covariance = solution(found)
    np.testing.assert_allclose(link.covariances.sel(error_kind="formal"), covariance, rtol=1e-3, atol=1e-7)
    # Kenward & Roger 1997: twice the scatter of the unknowns with the noise, and Student's t of the errors of errors
    above, step = np.flatnonzero(found > 0.0), 1e-5
    ends = [[solution(found + sign * step * unit) for sign in (1.0, -1.0)] for unit in np.eye(len(found))[above]]
    moved, slope = (np.array([(one[k] - other[k]) / (2.0 * step) for one, other in ends]) for k in (0, 1))
    scatter = np.linalg.inv(0.5 * np.einsum("cij,dji->cd", half[above], half[above]))
    whole = d + np.tensordot(found, whole_noises, axes=1)
    lacking = 2.0 * np.einsum("cd,cki,ij,dlj->kl", scatter, moved, whole, moved)
    relative = np.einsum("ckk,cd,dkk->k", slope, scatter, slope) / np.diag(covariance) ** 2
    student = stats.t.ppf(stats.norm.cdf(1.0), 2.0 / relative)
    np.testing.assert_allclose(link.error, student * np.sqrt(np.diag(covariance + lacking)), rtol=1e-3)
    assert list(link.error_kind.values[:2]) == ["estimated", "scaled"]


def alike(folder, seed, n=20, size=0.5, error=0.1):
    """Write tables with equal errors, whose positions scatter by ``size`` beside them."""
    rng = np.random.default_rng(seed)
    own = stars(n, seed)
    own = replace(own, errors=np.full((5, n), error * MAS), correlations=np.zeros((10, n)))
    values = own.values.copy()
    offset = rng.normal(0.0, np.hypot(size, np.sqrt(2.0) * error), (2, n)) * MAS
    values[:2] += offset / np.array([np.cos(own.values[1]), np.ones(n)])
    errors = np.where(np.arange(5)[:, None] < 2, own.errors, np.nan)
    rows = replace(own, values=np.where(np.isnan(errors), np.nan, values), errors=errors)
    return gaia(folder / "a.ecsv", own), gaia(folder / "b.ecsv", rows), own, offset / MAS


def test_equal_errors_have_a_closed_form(tmp_path):
    satellite, reference, own, offset = alike(tmp_path, 3)
    link = linksweep.tie(satellite, reference, "orientation", positions="mean", jitter="estimate")
    design = np.concatenate([turned(*place) for place in own.values[:2].T])
    x, squares, *_ = np.linalg.lstsq(design, offset.T.ravel(), rcond=None)
    nu = design.shape[0] - 3
    variance = squares[0] / nu
    size = np.sqrt(variance - 2.0 * 0.1**2)
    assert link.noise.values.tolist() == ["position:position"]
    assert float(link.noise_size[0]) == pytest.approx(size, rel=1e-4)
    assert float(link.noise_error[0]) == pytest.approx(variance * np.sqrt(2.0 / nu) / (2.0 * size), rel=1e-3)
    np.testing.assert_allclose(link.estimate, x, rtol=1e-3, atol=1e-4)
    formal = variance * np.linalg.inv(design.T @ design)
    np.testing.assert_allclose(link.covariances.sel(error_kind="formal"), formal, rtol=1e-3, atol=1e-6)
    # the weights do not depend on the noise, so that errors are those of Student's t
    factor = stats.t.ppf(stats.norm.cdf(1.0), nu)
    np.testing.assert_allclose(link.error, factor * np.sqrt(np.diag(formal)), rtol=1e-3)
    assert float(link.chi2) == pytest.approx(nu, rel=1e-3)
    assert "satellite:position" in " ".join(link.attrs["notes"])


def test_errors_that_are_right_or_too_large_have_no_noise():
    link = linksweep.tie("psrpi-de200", "timing-de200", "orientation", jitter="estimate")
    plain = linksweep.tie("psrpi-de200", "timing-de200", "orientation")
    np.testing.assert_array_equal(link.noise_size, 0.0)
    np.testing.assert_allclose(link.estimate, plain.estimate)
    np.testing.assert_allclose(link.error, plain.errors.sel(error_kind="formal"))


def drawn(seed, n, rows_each, kind, part=1.0, factor=3.0):
    """A problem without any rotation, whose ``part`` of stars has errors ``factor`` times those of the tables."""
    rng = np.random.default_rng(seed)
    truth = replace(stars(n, seed, pm=1e-3), radial_velocity=np.zeros(n))
    large = np.where(rng.random(n) < part, factor, 1.0)
    pieces = []
    for k in range(rows_each):
        years, row = rng.uniform(-12.0, 12.0, n), stars(n, seed + 1000 * (k + 1))
        values = truth.values.copy()
        values[0] += years * values[3] / np.cos(values[1])
        values[1] += years * values[4]
        row = replace(row, values=values + large * noise(rng, row), epoch=truth.epoch + years)
        if kind == "position":
            errors = np.where(np.arange(5)[:, None] < 2, row.errors, np.nan)
            row = replace(row, errors=errors, values=np.where(np.isnan(errors), np.nan, row.values))
        pieces.append(row)
    own = replace(truth, values=truth.values + large * noise(rng, truth))
    source = np.tile(np.arange(n), rows_each)
    return Problem(own, joined(*pieces), source, parse_unknowns("orientation,spin"), float(truth.epoch[0]))


CASES = [(30, 3, "position", 1.0), (30, 3, "position", 0.3), (50, 1, "five", 1.0), (50, 1, "five", 0.4)]


@pytest.mark.parametrize(("seeds", "case"), [(12, CASES[0]), *(slow(400, case) for case in CASES)])
def test_the_truth_is_within_the_error_as_often_as_it_should_be(seeds, case):
    """The stars have errors three times those of the tables; formal errors without noise contain it 0.25 of times."""
    inside, plain = [], []
    for seed in range(seeds):
        problem = drawn(seed, *case)
        wanted = noises(problem, {"reference": {"all": "estimate"}})
        found = estimated(problem, wanted)
        solved = solve(source_sums(found.added_to(problem, wanted)))
        inside.append(np.abs(solved.estimate) < np.sqrt(np.diag(found.covariance(solved))))
        solved = solve(source_sums(problem))
        plain.append(np.abs(solved.estimate) < np.sqrt(np.diag(solved.covariance)))
    assert abs(np.mean(inside) - 0.683) < (0.02 if seeds > 100 else 0.15)
    assert np.mean(plain) < 0.6


# ---- calibrators


def with_calibrators(folder, seed, n=14):
    """Write single-epoch rows of which some share a calibrator; return what dense least squares need."""
    rng = np.random.default_rng(seed)
    own = replace(stars(n, seed, pm=5.0), radial_velocity=np.zeros(n))
    source = np.repeat(np.arange(n), 4)
    rows = replace(own.taken(source), epoch=2016.0 + rng.uniform(-10.0, 10.0, 4 * n))
    names = rng.choice(["", "J1", "J2"], 4 * n)
    shared = np.where(names == "", 0.0, rng.uniform(0.1, 1.0, 4 * n))
    values = rows.values.copy()
    years = rows.epoch - own.epoch[source]
    values[0] += (years * values[3] + rng.normal(0.0, 0.3 * MAS, 4 * n)) / np.cos(values[1])
    values[1] += years * values[4] + rng.normal(0.0, 0.3 * MAS, 4 * n)
    errors = np.where(np.arange(5)[:, None] < 2, rows.errors, np.nan)
    rows = replace(rows, values=np.where(np.isnan(errors), np.nan, values), errors=errors)
    columns = {"source_id": source + 10**17, "calibrator": names, "calibrator_error": shared}
    satellite, reference = gaia(folder / "own.ecsv", own), gaia(folder / "rows.ecsv", rows, **columns)
    return SimpleNamespace(
        satellite=satellite, reference=reference, own=own, rows=rows, source=source, names=names, shared=shared
    )


@pytest.mark.parametrize("seed", [1, slow(2)])
def test_rows_that_share_a_calibrator_share_its_error(tmp_path, seed):
    tables = with_calibrators(tmp_path, seed)
    link = linked(tables)
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for s, one in enumerate(pieces_of(tables, link.difference.values)):
        at = np.flatnonzero(tables.source == s)
        same = (tables.names[at][:, None] == tables.names[at]) * tables.shared[at][:, None] * tables.shared[at]
        weights = np.linalg.inv(one.d + np.kron(same, np.eye(2)))
        normal, right = normal + one.a.T @ weights @ one.a, right + one.a.T @ weights @ one.y
    np.testing.assert_allclose(link.estimate, np.linalg.solve(normal, right), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(link.covariances.sel(error_kind="formal"), np.linalg.inv(normal), rtol=1e-4, atol=1e-7)
    assert linked(tables, jitter="estimate").noise.size


def test_draws_have_the_errors_that_calibrators_share(tmp_path):
    tables = with_calibrators(tmp_path, 3)
    from linksweep.sweep.tie.options import Options
    from linksweep.sweep.tie.setup import set_up

    problem = set_up(tables.satellite, tables.reference, Options("orientation,spin", positions="mean")).problem
    expected = solve(source_sums(problem)).covariance
    draws = Simulation(problem, np.zeros(6)).draws(600, np.random.default_rng(1))
    found = np.array([solve(one.sums).estimate for one in draws])
    np.testing.assert_allclose(np.diag(np.cov(found.T)), np.diag(expected), rtol=0.25)
