"""The solution against least squares of all parameters, also of two missions, and closed forms."""

import numpy as np
import pytest
from scipy.linalg import block_diag, lstsq

from linksweep.core.fields import terms
from linksweep.core.tie import problem as solutions
from linksweep.core.tie.astrometry import Astrometry, differences
from linksweep.core.tie.problem import Problem, solve, source_sums
from linksweep.core.unknowns import parse_unknowns
from tests.core.tie.made import MAS, missions

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


# ---- closed forms


def quasars(n, sigma, unknowns):
    """Return motions of quasars on a uniform grid of the sky, all with one error."""
    golden = np.arange(n) + 0.5
    ra, dec = (golden * np.pi * (1.0 + np.sqrt(5.0))) % (2.0 * np.pi), np.arcsin(1.0 - 2.0 * golden / n)
    errors, nan = np.full((5, n), np.nan), np.full(n, np.nan)
    errors[3:] = sigma * MAS
    values = np.array([ra, dec, *np.zeros((3, n))])
    rows = np.where(np.isfinite(errors), values, np.nan)
    satellite = Astrometry(values, np.zeros((5, n)), nan)
    return Problem(satellite, Astrometry(rows, errors, nan), np.arange(n), parse_unknowns(unknowns), 2016.0)


def test_the_errors_of_vector_harmonics_from_a_uniform_sky():
    unknowns = parse_unknowns("vsh_motion:3")
    solution = solve(source_sums(quasars(4000, 0.3, "vsh_motion:3")))
    whole = 4.0 * np.pi * (0.3 * MAS) ** 2 / 4000
    orders = np.array([term.order for part in unknowns.blocks[0].parts for term in terms(*part)])
    np.testing.assert_allclose(np.diag(solution.covariance), np.where(orders == 0, whole, 0.5 * whole), rtol=5e-3)


def test_leaving_out_what_determines_an_unknown_is_found_among_many():
    """One singular matrix among regular ones: only its solution is missing."""
    sums = source_sums(missions(n=30))
    normal, right = sums.normal.sum(axis=0), sums.right.sum(axis=0)
    alone = sums.taken(np.arange(3))
    alone.normal[1], alone.right[1] = normal, right
    found = solutions.leave_one_out(alone, normal, right)
    assert np.isnan(found).all(axis=1).tolist() == [False, True, False]
    np.testing.assert_array_equal(found[[0, 2]], solutions.leave_one_out(sums.taken(np.array([0, 2])), normal, right))
