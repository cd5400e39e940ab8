"""The elimination against full generalised least squares, least squares with all parameters, and other forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, lstsq

from linksweep.core.frames import MAS
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Astrometry, differences
from linksweep.core.tie.problem import Problem, group_sums, source_counts, source_discrepancies, source_sums
from linksweep.core.tie.solution import discrepancies, expected_discrepancies, solve
from linksweep.core.unknowns import parse_unknowns
from tests.core.tie.made import noise, random_correlations, stars

UNKNOWNS = parse_unknowns("orientation,spin,parallax")
KINDS = {
    "five": [0, 1, 2, 3, 4],
    "three": [2, 3, 4],
    "motion": [3, 4],
    "position": [0, 1],
    "four": [0, 1, 3, 4],
}


def mixed(n=12, seed=4, per_source=3):
    """Return a satellite and rows of every kind at their own epochs, several of a source."""
    rng = np.random.default_rng(seed)
    satellite = stars(n, seed)
    source = np.sort(np.concatenate([np.arange(n), rng.integers(0, n, n * (per_source - 1))]))
    rows = len(source)
    epoch = rng.uniform(1990.0, 2020.0, rows)
    own = satellite.taken(source)
    from linksweep.core.tie.astrometry import propagated

    values = propagated(own.values, own.radial_velocity, own.epoch, epoch)
    errors = rng.uniform(0.1, 1.0, (5, rows)) * MAS
    kind = rng.integers(0, 6, rows)
    for row in range(rows):
        name = [*KINDS, "position"][kind[row]]
        absent = np.setdiff1d(np.arange(5), KINDS[name])
        values[absent, row] = errors[absent, row] = np.nan
    table = Astrometry(values, errors, epoch, random_correlations(rng, rows), apparent=kind == 5)
    table = replace(table, values=table.values + noise(rng, table))
    return Problem(satellite, table, source, UNKNOWNS, 2012.0)


def stacked(problem):
    """Return f, M, V and K of all rows and sources as full matrices, rows that are absent left out."""
    own = problem.satellite
    found = differences(own, problem.rows, problem.source)
    keep = found.present.ravel()
    n = len(own)
    partials = np.zeros((len(problem.rows), 5, n, 5))
    partials[np.arange(len(problem.rows)), :, problem.source] = found.partials
    f = found.values.ravel()[keep]
    m = partials.reshape(-1, 5 * n)[keep]
    v = block_diag(*found.covariance)[np.ix_(keep, keep)]
    k = problem.unknowns.matrix(*problem.objects(own)).reshape(5 * n, -1)
    return f, m, v, k


def test_it_is_the_least_squares_with_five_parameters_a_source():
    problem = mixed()
    f, m, v, k = stacked(problem)
    c = block_diag(*problem.satellite.covariance())
    left = np.linalg.cholesky(np.linalg.inv(v / MAS**2)).T
    prior = np.linalg.cholesky(np.linalg.inv(c / MAS**2)).T
    design = np.block([[left @ m @ k, left @ m], [np.zeros((len(c), k.shape[1])), prior]])
    found, *_ = lstsq(design, np.concatenate([left @ f / MAS, np.zeros(len(c))]))
    solution = solve(source_sums(problem))
    error = np.sqrt(np.diag(solution.covariance)) / MAS
    np.testing.assert_allclose(solution.estimate / MAS / error, found[: len(UNKNOWNS)] / error, atol=1e-10)
    residual = np.concatenate([left @ f / MAS, np.zeros(len(c))]) - design @ found
    assert solution.squares == pytest.approx(residual @ residual, rel=1e-10)


def test_what_the_satellite_lacks_is_free():
    problem = mixed()
    errors = problem.satellite.errors.copy()
    values = problem.satellite.values.copy()
    lacking = np.zeros((5, 12), dtype=bool)
    lacking[2:, :4] = True
    lacking[3:, 4:6] = True
    errors[lacking] = values[lacking] = np.nan
    lacks = replace(problem, satellite=replace(problem.satellite, errors=errors, values=values))
    zeros = replace(problem.satellite, values=np.where(lacking, 0.0, values))
    solution = solve(source_sums(lacks))
    f, m, v, k = stacked(replace(problem, satellite=zeros))
    known = np.where(lacking.T[:, :, None] | lacking.T[:, None, :], 0.0, zeros.covariance())
    whole = (v + m @ block_diag(*known) @ m.T) / MAS**2
    design = np.concatenate([m @ k, m[:, lacking.T.ravel()]], axis=1)  # what lacks is an unknown of its own
    left = np.linalg.inv(np.linalg.cholesky(whole))
    found, _, rank, _ = lstsq(left @ design, left @ f / MAS, lapack_driver="gelsd", cond=1e-10)
    error = np.sqrt(np.diag(solution.covariance))
    np.testing.assert_allclose(solution.estimate / error, found[: len(UNKNOWNS)] * MAS / error, atol=1e-8)
    residual = left @ (f / MAS - design @ found)
    assert solution.squares == pytest.approx(residual @ residual, rel=1e-9)
    assert solution.dof == len(f) - rank
    other = replace(lacks, satellite=replace(lacks.satellite, values=np.where(lacking, 5.0 * MAS, values)))
    moved = solve(source_sums(other))  # with whatever value stands where there is no error
    np.testing.assert_allclose(moved.estimate / error, solution.estimate / error, atol=2e-3)  # second order
    assert moved.dof == solution.dof


def test_differences_without_any_error_are_refused_by_name():
    satellite = stars(4)
    exact = replace(satellite, errors=np.zeros((5, 4)), correlations=None, names=np.array(["a", "b", "c", "d"]))
    rows = replace(exact, names=None)
    with pytest.raises(LinkError, match="source 'a'"):
        source_sums(Problem(exact, rows, np.arange(4), UNKNOWNS, 2016.0))


def test_groups_add_up_to_the_sources_in_blocks_of_any_size(monkeypatch):
    problem = mixed()
    sums = source_sums(problem)
    group = np.arange(12) % 3
    monkeypatch.setattr("linksweep.core.tie.problem.BLOCK", 2)
    monkeypatch.setattr("linksweep.core.tie.problem.GATHERED", 5)
    grouped = group_sums(problem, group, 3)
    for one in range(3):
        np.testing.assert_allclose(grouped.normal[one], sums.normal[group == one].sum(axis=0), rtol=1e-10)
        np.testing.assert_allclose(grouped.right[one], sums.right[group == one].sum(axis=0), rtol=1e-9)
    solution = solve(sums)
    squares = source_discrepancies(problem, solution.estimate)
    np.testing.assert_allclose(squares, discrepancies(sums, solution.estimate), rtol=1e-8)
    np.testing.assert_array_equal(source_counts(problem), sums.count)
    assert np.sum(squares) == pytest.approx(solution.squares, rel=1e-10)
    assert np.sum(expected_discrepancies(sums, solution)) == pytest.approx(solution.dof)


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
