"""Closed forms, the closed loop, clips, influence and forecasts."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import kstest

from linksweep.core.fields import terms
from linksweep.core.frames import MAS
from linksweep.core.tie.astrometry import PAIRS, Astrometry, positive_definite
from linksweep.core.tie.forecast import Goal, choose, with_new_rows
from linksweep.core.tie.problem import Problem, source_sums
from linksweep.core.tie.solution import (
    MEDIAN_RAYLEIGH,
    clipped,
    leave_one_out,
    parse_clip,
    separation,
    sky_cells,
    solve,
    sources_of,
)
from linksweep.core.unknowns import parse_unknowns
from tests.core.tie.made import noise, random_correlations, stars
from tests.core.tie.test_elimination import mixed


def quasars(n, sigma=0.3, unknowns="spin", seed=1, where="motion"):
    """Return positions or motions of quasars on a uniform grid of the sky, all with one error."""
    golden = np.arange(n) + 0.5
    ra, dec = (golden * np.pi * (1.0 + np.sqrt(5.0))) % (2.0 * np.pi), np.arcsin(1.0 - 2.0 * golden / n)
    values, errors = np.zeros((5, n)), np.full((5, n), np.nan)
    rng = np.random.default_rng(seed)
    used = slice(3, 5) if where == "motion" else slice(0, 2)
    errors[used] = sigma * MAS
    values[:2] = ra, dec
    satellite = values.copy()
    rows = np.where(np.isfinite(errors), values, np.nan)
    step = rng.normal(0.0, sigma * MAS, (2, n))
    rows[used] += step / np.array([np.cos(dec), np.ones(n)]) if where == "position" else step
    exact = np.zeros((5, n))
    nan = np.full(n, np.nan)
    return Problem(
        Astrometry(satellite, exact, nan), Astrometry(rows, errors, nan), np.arange(n), parse_unknowns(unknowns), 2016.0
    )


def test_the_error_of_a_spin_from_a_uniform_sky():
    solution = solve(source_sums(quasars(4000)))
    np.testing.assert_allclose(np.diag(solution.covariance), 3.0 * (0.3 * MAS) ** 2 / (2.0 * 4000), rtol=1e-3)


def test_the_errors_of_vector_harmonics_from_a_uniform_sky():
    unknowns = parse_unknowns("vsh_motion:3")
    solution = solve(source_sums(quasars(4000, unknowns="vsh_motion:3")))
    whole = 4.0 * np.pi * (0.3 * MAS) ** 2 / 4000
    orders = np.array([term.order for part in unknowns.blocks[0].parts for term in terms(*part)])
    np.testing.assert_allclose(np.diag(solution.covariance), np.where(orders == 0, whole, 0.5 * whole), rtol=5e-3)


@pytest.mark.slow
def test_the_closed_loop():
    """Rows of every kind drawn as their covariances say: mean, scatter, Q and coverage are what the solution says."""
    rng = np.random.default_rng(11)
    problem = mixed(10)
    sums = source_sums(problem)
    solution = solve(sums)
    found, squares = [], []
    exact = replace(problem.rows, values=_model(problem))
    for _ in range(300):
        drawn = replace(
            problem,
            satellite=_with_noise(rng, problem.satellite),
            rows=_with_noise(rng, exact),
        )
        one = solve(source_sums(drawn))
        found.append(one.estimate)
        squares.append(one.squares)
    error = np.sqrt(np.diag(solution.covariance))
    pulls = np.array(found) / error
    assert np.abs(pulls.mean(axis=0)).max() < 4.5 / np.sqrt(300)
    np.testing.assert_allclose(np.cov(pulls.T), solution.covariance / np.outer(error, error), atol=0.3)
    assert np.mean(squares) == pytest.approx(solution.dof, abs=4.5 * np.sqrt(2.0 * solution.dof / 300))
    assert np.mean(np.abs(pulls) < 1.0) == pytest.approx(0.683, abs=0.05)


def _with_noise(rng, table):
    step = noise(rng, table)
    step[0] /= np.cos(np.nan_to_num(table.values[1]))  # the error is that of alpha*
    return replace(table, values=table.values + step)


def _model(problem):
    from linksweep.core.tie.astrometry import differences

    found = differences(problem.satellite, problem.rows, problem.source)
    values = problem.rows.values - found.values.T
    values[0] = problem.rows.values[0] - found.values[:, 0] / np.cos(problem.rows.values[1])
    return values


def test_the_normalised_separation_is_rayleigh():
    satellite = stars(3000, 5)
    rng = np.random.default_rng(5)
    errors = np.full((5, 3000), np.nan)
    errors[:2] = 0.4 * MAS
    rows = Astrometry(satellite.values, errors, satellite.epoch, random_correlations(rng, 3000))
    step = noise(rng, rows) + noise(rng, satellite)
    step[0] /= np.cos(satellite.values[1])
    rows = replace(rows, values=rows.values + step)
    normalised, plain = separation(Problem(satellite, rows, np.arange(3000), parse_unknowns("orientation"), 2016.0))
    assert kstest(normalised, "rayleigh").pvalue > 1e-3
    assert np.median(normalised) == pytest.approx(MEDIAN_RAYLEIGH, rel=0.05)
    assert np.all(plain > 0.0)


def with_outliers(offset=0.0, outliers=(3, 17, 40), n=80):
    problem = quasars(n, unknowns="orientation", where="position", sigma=0.1)
    unknowns = replace(problem, unknowns=parse_unknowns("orientation", corrections=False))
    values = problem.rows.values.copy()
    for size, i in enumerate(outliers, 1):
        values[1, i] += 2.0 * size * MAS
    k = unknowns.unknowns.matrix(*problem.objects(problem.satellite)) @ np.array([offset, -offset, 0.5 * offset]) * MAS
    values[0] += k[:, 0] / np.cos(problem.satellite.values[1])
    values[1] += k[:, 1]
    return replace(unknowns, rows=replace(problem.rows, values=values))


@pytest.mark.parametrize("clip", ["rayleigh", "median:5", "discrepancy", "discrepancy:3"])
def test_a_clip_drops_the_outliers(clip):
    problem = with_outliers()
    found = clipped(parse_clip(clip), sources_of(problem))
    dropped = set(np.flatnonzero(found.factors == 0.0))
    assert dropped >= {3, 17, 40}
    assert len(dropped) <= (5 if clip == "rayleigh" else 3)  # that clip drops one good source on average
    assert found.solution.squares / found.solution.dof < 1.5
    assert not found.notes


def test_a_clip_before_the_fit_of_frames_far_apart_is_said():
    problem = with_outliers(offset=1.0)
    found = clipped(parse_clip("rayleigh"), sources_of(problem))
    assert "frames differ by more than the errors" in found.notes[0]
    after = clipped(parse_clip("median:5"), sources_of(problem))
    np.testing.assert_allclose(after.solution.estimate / MAS, [1.0, -1.0, 0.5], atol=0.1)
    assert set(np.flatnonzero(after.factors == 0.0)) == {3, 17, 40}


@pytest.mark.parametrize("text", ["sigma", "median", "median:0", "none:3", "huber:x", "discrepancy:1.5", "rayleigh:2"])
def test_an_unknown_clip_is_refused(text):
    with pytest.raises(ValueError, match="clip"):
        parse_clip(text)


def test_sky_cells_follow_their_definition():
    rng = np.random.default_rng(33)
    ra, dec = rng.uniform(-10.0, 20.0, 20_000), np.arcsin(rng.uniform(-1.0, 1.0, 20_000))
    ra[:5] = 0.0, 2.0 * np.pi, np.nextafter(2.0 * np.pi, 0.0), -1e-20, 4.0 * np.pi
    dec[:4] = 0.5 * np.pi, -0.5 * np.pi, 0.0, -0.0
    for divisions in (1, 2, 6, 7):
        band = np.minimum(((np.sin(dec) + 1.0) * 0.5 * divisions).astype(int), divisions - 1)
        step = ((ra % (2.0 * np.pi)) * (divisions / np.pi)).astype(int) % (2 * divisions)
        np.testing.assert_array_equal(sky_cells(ra, dec, divisions), 2 * divisions * band + step)


def test_leaving_out_what_determines_an_unknown_is_found_among_many():
    """One singular matrix among regular ones: only its solution is missing."""
    sums = source_sums(mixed(30))
    normal, right = sums.normal.sum(axis=0), sums.right.sum(axis=0)
    alone = sums.taken(np.arange(3))
    alone.normal[1], alone.right[1] = normal, right
    found = leave_one_out(alone, normal, right)
    assert np.isnan(found).all(axis=1).tolist() == [False, True, False]
    np.testing.assert_array_equal(found[[0, 2]], leave_one_out(sums.taken(np.array([0, 2])), normal, right))


def forecast_sums(n=9, years=4.0):
    satellite = stars(n, 8, pm=50.0)
    rows = replace(satellite, correlations=None, epoch=satellite.epoch - 15.0)
    problem = Problem(satellite, rows, np.arange(n), parse_unknowns("orientation,spin"), 2016.0)
    return source_sums(problem), source_sums(with_new_rows(problem, [2016.0 + years], 0.05 * MAS)), problem


def choose_exhaustively(now, new, number, goal):
    """The best set of so many sources, all sets tried."""
    gain, total = new.normal - now.normal, now.normal.sum(axis=0)
    return min(combinations(range(len(gain)), number), key=lambda one: goal.value(total + gain[list(one)].sum(axis=0)))


@pytest.mark.parametrize("criterion", ["A", "D"])
@pytest.mark.parametrize("blocks", [(), ("spin",)])
def test_the_best_choice_is_found(criterion, blocks):
    now, new, problem = forecast_sums()
    goal = Goal(problem.unknowns, blocks, criterion)
    (greedy, _), best = choose(now, new, 1, goal), choose_exhaustively(now, new, 1, goal)
    assert greedy == list(best)  # one at a time is exact
    (_, normals), best = choose(now, new, 3, goal), choose_exhaustively(now, new, 3, goal)
    gain = (new.normal - now.normal)[list(best)].sum(axis=0)
    value = goal.value(normals[-1])
    assert goal.value(now.normal.sum(axis=0) + gain) - 1e-9 * abs(value) <= value < goal.value(now.normal.sum(axis=0))
    if criterion == "A":
        assert value < 1.05 * goal.value(now.normal.sum(axis=0) + gain)


def test_impossible_correlations_are_those_with_a_negative_eigenvalue():
    rng = np.random.default_rng(31)
    correlations = random_correlations(rng, 400) * rng.uniform(0.5, 2.0, 400)
    matrix = np.tile(np.eye(5), (400, 1, 1))
    for row, (i, j) in zip(correlations, PAIRS, strict=True):
        matrix[:, i, j] = matrix[:, j, i] = row
    expected = np.linalg.eigvalsh(matrix)[:, 0] > 0.0
    assert 50 < expected.sum() < 350
    np.testing.assert_array_equal(positive_definite(correlations), expected)
