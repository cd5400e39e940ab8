"""The elimination against full generalised least squares, least squares with all parameters, and other forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, lstsq

from linksweep.core.frames import MAS
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Astrometry, differences
from linksweep.core.tie.problem import Problem, eliminate, group_sums, source_counts, source_discrepancies, source_sums
from linksweep.core.tie.solution import bootstrap, discrepancies, expected_discrepancies, solve
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


def generalised(problem, covariance=None):
    f, m, v, k = stacked(problem)
    c = block_diag(*problem.satellite.covariance()) if covariance is None else covariance
    whole = (v + m @ c @ m.T) / MAS**2
    a, y = m @ k, f / MAS
    inverse = np.linalg.inv(whole)
    normal = a.T @ inverse @ a
    x = np.linalg.solve(normal, a.T @ inverse @ y)
    residual = y - a @ x
    return x * MAS, np.linalg.inv(normal) * MAS**2, residual @ inverse @ residual


def test_it_is_the_full_generalised_least_squares():
    problem = mixed()
    solution = solve(source_sums(problem))
    x, covariance, squares = generalised(problem)
    error = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(solution.estimate / error, x / error, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(
        solution.covariance / np.outer(error, error), covariance / np.outer(error, error), atol=1e-12
    )
    assert solution.squares == pytest.approx(squares, rel=1e-11)
    assert solution.dof == np.sum(problem.rows.present) - len(UNKNOWNS)


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


def test_it_is_the_form_with_j():
    problem = mixed()
    found = differences(problem.satellite, problem.rows, problem.source)
    free = ~problem.satellite.present.T
    covariance = problem.satellite.covariance()
    left = eliminate(found, problem.source, covariance, free)
    for i in range(len(problem.satellite)):
        j, g, yy = np.zeros((5, 5)), np.zeros(5), 0.0
        for r in np.flatnonzero(problem.source == i):
            here = found.present[r]
            v = np.linalg.inv(found.covariance[r][np.ix_(here, here)])
            m, f = found.partials[r][here], found.values[r][here]
            j, g, yy = j + m.T @ v @ m, g + m.T @ v @ f, yy + f @ v @ f
        a = np.eye(5) + j @ covariance[i]
        w = np.linalg.solve(a, g)
        scale = np.abs(left.normal[i]).max()
        np.testing.assert_allclose(left.normal[i] / scale, np.linalg.solve(a, j) / scale, atol=1e-10)
        np.testing.assert_allclose(left.right[i] / np.abs(w).max(), w / np.abs(w).max(), atol=1e-10)
        assert left.squares[i] == pytest.approx(yy - g @ covariance[i] @ w, rel=1e-9)


def test_neither_covariance_need_be_regular():
    problem = mixed()
    exact = replace(problem.satellite, errors=np.where(np.arange(5)[:, None] == 2, 0.0, problem.satellite.errors))
    problem = replace(problem, satellite=exact)
    solution = solve(source_sums(problem))
    x, covariance, squares = generalised(problem)
    np.testing.assert_allclose(solution.estimate, x, atol=1e-10 * np.sqrt(covariance.max()))
    assert solution.squares == pytest.approx(squares, rel=1e-10)
    motion = Astrometry(
        np.where(np.arange(5)[:, None] >= 3, problem.satellite.values + 0.1 * MAS, np.nan),
        np.where(np.arange(5)[:, None] >= 3, 0.0, np.full((5, 12), np.nan)),
        np.full(12, np.nan),
    )
    spin = Problem(problem.satellite, motion, np.arange(12), parse_unknowns("spin"), 2016.0)
    solution = solve(source_sums(spin))  # rows without errors: quasars that do not move
    x, _, squares = generalised(spin)
    np.testing.assert_allclose(solution.estimate, x, rtol=1e-10)
    assert solution.squares == pytest.approx(squares, rel=1e-10)


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


def test_a_position_at_another_epoch_says_nothing_of_a_source_without_motion():
    satellite = stars(6)
    values, errors = satellite.values.copy(), satellite.errors.copy()
    values[2:] = errors[2:] = np.nan
    satellite = replace(satellite, values=values, errors=errors)
    later = replace(satellite, epoch=satellite.epoch + 5.0, correlations=None, radial_velocity=None)
    problem = Problem(satellite, later, np.arange(6), parse_unknowns("orientation"), 2016.0)
    with pytest.raises(LinkError, match="determines epsilon_x"):
        solve(source_sums(problem), problem.unknowns.labels)
    same = Problem(
        satellite, replace(later, epoch=satellite.epoch), np.arange(6), parse_unknowns("orientation"), 2016.0
    )
    assert solve(source_sums(same)).dof == 12 - 3


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


def test_the_bootstrap_solves_resamples():
    sums = source_sums(mixed(20))
    covariance, estimates = bootstrap(sums, 50, np.random.default_rng(7))
    times = np.random.default_rng(7).multinomial(20, np.full(20, 0.05), size=50)
    again = solve(sums.taken(np.repeat(np.arange(20), times[3])))
    np.testing.assert_allclose(estimates[3], again.estimate, rtol=1e-8)
    good = estimates[np.isfinite(estimates[:, 0])]
    np.testing.assert_allclose(covariance, np.cov(good.T), rtol=1e-12)


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
