"""The solution against least squares of all parameters, also of two missions, and closed forms; clips and choices."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, lstsq

from linksweep.core.fields import terms
from linksweep.core.tie import solution as solutions
from linksweep.core.tie.astrometry import Astrometry, differences, positive_definite
from linksweep.core.tie.problem import Problem, source_sums
from linksweep.core.tie.solution import clipped, parse_clip, solve, sources_of
from linksweep.core.unknowns import parse_unknowns, require_mission_name
from tests.core.tie.made import MAS, PAIRS, missions, random_correlations, stars


@pytest.mark.parametrize("kind", ["motion", "position"])
def test_simple_rows_have_the_general_form(kind, monkeypatch):
    satellite = stars(30)
    errors = satellite.errors * 1.7
    errors[: 3 if kind == "motion" else 0] = np.nan
    errors[5 if kind == "motion" else 2 :] = np.nan
    rng = np.random.default_rng(6)
    values = np.where(np.isfinite(errors), satellite.values + rng.normal(0.0, MAS, (5, 30)), np.nan)
    rows = Astrometry(values, errors, satellite.epoch, random_correlations(rng, 30))
    unknowns = parse_unknowns("spin,glide" if kind == "motion" else "vsh_position:2")
    problem = Problem(satellite, rows, np.arange(30), unknowns, 2016.0)
    fast = source_sums(problem)
    calls = []

    def never(*arguments):
        calls.append(arguments)

    monkeypatch.setattr("linksweep.core.tie.problem.eliminate_simple", never)
    general = source_sums(problem)
    assert calls
    for name in ("normal", "right", "squares", "count"):
        a, b = getattr(fast, name), getattr(general, name)
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11 * np.abs(b).max())


# ---- two missions, each in a frame of its own


def all_parameters(problem):
    """Return the unknowns, their covariance and chi2 by least squares of all three tables, whose unknowns are also the
    five parameters of every star in the reference's frame: no table is before another.
    """
    own, rows, n = problem.satellite, problem.rows, len(problem.satellite)
    found = differences(own, rows, problem.source)
    single = parse_unknowns("orientation,spin").matrix(*problem.objects(own))  # of each star; (n, 5, 6)
    size = 5 * n + 12
    design, right, weight = [], [], []
    for i in range(n):
        line = np.zeros((5, size))
        line[:, 5 * i : 5 * i + 5] = np.eye(5)
        line[:, 5 * n : 5 * n + 6] = -single[i]  # a mission sees the star minus what its frame adds
        design.append(line)
        right.append(np.zeros(5))
        weight.append(own.covariance()[i])
    for r, i in enumerate(problem.source):
        line = np.zeros((5, size))
        line[:, 5 * i : 5 * i + 5] = found.partials[r]
        if rows.frame[r]:
            line[:, 5 * n + 6 :] = -found.partials[r] @ single[i]
        design.append(line)
        right.append(found.values[r])
        weight.append(found.covariance[r])
    half = np.linalg.inv(np.linalg.cholesky(block_diag(*weight) / MAS**2))
    a, y = half @ np.concatenate(design), half @ np.concatenate(right) / MAS
    x, *_ = lstsq(a, y)
    residual = y - a @ x
    return x[5 * n :] * MAS, np.linalg.inv(a.T @ a)[5 * n :, 5 * n :] * MAS**2, residual @ residual


def agree(solution, x, covariance, digits=1e-9):
    error = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(solution.estimate / error, x / error, atol=digits)
    np.testing.assert_allclose(
        solution.covariance / np.outer(error, error), covariance / np.outer(error, error), atol=digits
    )


def test_it_is_the_least_squares_of_all_tables_with_the_parameters_of_every_star():
    problem = missions()
    solution = solve(source_sums(problem))
    x, covariance, squares = all_parameters(problem)
    agree(solution, x, covariance)
    assert solution.squares == pytest.approx(squares, rel=1e-9)
    assert solution.dof == 5 * len(problem.rows) - 12


@pytest.mark.parametrize("name", ["spin", "2mass", "", "a b", "vsh_motion"])
def test_a_mission_has_a_name_of_its_own(name):
    with pytest.raises(ValueError, match="mission"):
        require_mission_name(name)


# ---- closed forms, clips and choices


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


def test_the_errors_of_vector_harmonics_from_a_uniform_sky():
    unknowns = parse_unknowns("vsh_motion:3")
    solution = solve(source_sums(quasars(4000, unknowns="vsh_motion:3")))
    whole = 4.0 * np.pi * (0.3 * MAS) ** 2 / 4000
    orders = np.array([term.order for part in unknowns.blocks[0].parts for term in terms(*part)])
    np.testing.assert_allclose(np.diag(solution.covariance), np.where(orders == 0, whole, 0.5 * whole), rtol=5e-3)


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
        np.testing.assert_array_equal(solutions.sky_cells(ra, dec, divisions), 2 * divisions * band + step)


def test_leaving_out_what_determines_an_unknown_is_found_among_many():
    """One singular matrix among regular ones: only its solution is missing."""
    sums = source_sums(missions(n=30))
    normal, right = sums.normal.sum(axis=0), sums.right.sum(axis=0)
    alone = sums.taken(np.arange(3))
    alone.normal[1], alone.right[1] = normal, right
    found = solutions.leave_one_out(alone, normal, right)
    assert np.isnan(found).all(axis=1).tolist() == [False, True, False]
    np.testing.assert_array_equal(found[[0, 2]], solutions.leave_one_out(sums.taken(np.array([0, 2])), normal, right))


def test_impossible_correlations_are_those_with_a_negative_eigenvalue():
    rng = np.random.default_rng(31)
    correlations = random_correlations(rng, 400) * rng.uniform(0.5, 2.0, 400)
    matrix = np.tile(np.eye(5), (400, 1, 1))
    for row, (i, j) in zip(correlations, PAIRS, strict=True):
        matrix[:, i, j] = matrix[:, j, i] = row
    expected = np.linalg.eigvalsh(matrix)[:, 0] > 0.0
    assert 50 < expected.sum() < 350
    np.testing.assert_array_equal(positive_definite(matrix), expected)
    np.testing.assert_array_equal(positive_definite(matrix[expected]), True)
