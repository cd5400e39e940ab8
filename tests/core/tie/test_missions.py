"""Two missions combined through their stars, each in a frame of its own, against least squares of all data."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, lstsq

from linksweep.core.frames import MAS
from linksweep.core.tie.astrometry import differences, joined, propagated
from linksweep.core.tie.forecast import Simulation
from linksweep.core.tie.problem import Problem, source_sums
from linksweep.core.tie.solution import solve
from linksweep.core.unknowns import parse_unknowns, require_mission_name
from tests.core.tie.made import noise, seen_by_satellite, stars

GAIA, HIPPARCOS = 2016.0, 1991.25
EPSILON = np.array([[0.4, -0.3, 0.9], [-1.1, 0.7, 0.2]]) * MAS
OMEGA = np.array([[0.02, -0.1, 0.06], [0.3, -0.2, 0.15]]) * MAS
UNKNOWNS = parse_unknowns("orientation,spin,hipparcos:orientation,hipparcos:spin", missions=("hipparcos",))


def missions(n=14, n_reference=6, noisy=True, seed=5):
    """Return the problem of two missions, and of a reference that has a few of their stars, at three epochs.

    Each mission's orientation is that of 2016.0, the epoch of the unknowns.
    """
    rng = np.random.default_rng(seed)
    truth = stars(n, seed, pm=60.0)
    gaia = replace(truth, values=seen_by_satellite(truth, EPSILON[0], OMEGA[0]))
    then = np.full(n, HIPPARCOS)
    there = propagated(truth.values, truth.radial_velocity, truth.epoch, then)
    there = replace(truth, values=there, epoch=then, errors=8.0 * truth.errors)
    turned = EPSILON[1] + (HIPPARCOS - GAIA) * OMEGA[1]
    hipparcos = replace(there, values=seen_by_satellite(there, turned, OMEGA[1]), frame=np.ones(n, dtype=int))
    chosen = np.arange(n_reference)
    vlbi = truth.taken(chosen)
    vlbi = replace(vlbi, values=propagated(vlbi.values, vlbi.radial_velocity, vlbi.epoch, vlbi.epoch - 9.0))
    vlbi = replace(vlbi, epoch=vlbi.epoch - 9.0)
    if noisy:
        gaia, hipparcos, vlbi = (replace(one, values=one.values + noise(rng, one)) for one in (gaia, hipparcos, vlbi))
    source = np.concatenate([np.arange(n), chosen])
    return Problem(gaia, joined(hipparcos, vlbi), source, UNKNOWNS, GAIA)


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


@pytest.mark.slow
def test_draws_scatter_about_the_frames():
    problem = missions(n=8)
    truth = np.concatenate([EPSILON[0], OMEGA[0], EPSILON[1], OMEGA[1]])
    simulation = Simulation(problem, truth)
    solution = solve(simulation.normals)
    x = np.array(
        [solution.inverse @ d.sums.right.sum(axis=0) for d in simulation.draws(3000, np.random.default_rng(1))]
    )
    scaled = (x - truth) / np.sqrt(np.diag(solution.covariance))
    assert np.all(np.abs(scaled.mean(axis=0)) < 4.5 / np.sqrt(3000))
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=4.5 / np.sqrt(6000))


@pytest.mark.parametrize("name", ["spin", "2mass", "", "a b", "vsh_motion"])
def test_a_mission_has_a_name_of_its_own(name):
    with pytest.raises(ValueError, match="mission"):
        require_mission_name(name)
