"""A block of realisations: what it recovers, how large its errors are, and that it is the plain loop made fast."""

import tracemalloc
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from linksweep.core.catalogues import synthetic
from linksweep.core.errors import NO_ERRORS, CatalogueErrors, MagnitudeErrors, NormalErrors
from linksweep.core.frames import MAS, exact_differences, triad
from linksweep.core.link import LinkError, combined_error
from linksweep.core.missions import MISSIONS
from linksweep.core.noise import ROWS, TILE
from linksweep.core.scenario import Scenario, TrueVector
from linksweep.core.simulate import simulate
from tests.core.reference import design_matrix, solve
from tests.tiers import slow

EPSILON, OMEGA = np.array([1.0, -0.7, 0.4]) * MAS, np.array([-0.5, 0.9, 1.2]) * MAS
TRUTH_MAS = np.concatenate([EPSILON, OMEGA]) / MAS
GLIDE = np.array([0.3, -0.2, 0.5]) * MAS


def scenario(n_obj, mean_pm_mas_yr=0.0, **changes):
    draw = partial(synthetic, n_obj=n_obj, v_min=5.0, v_max=15.0, mean_pm=mean_pm_mas_yr * MAS)
    amex = MagnitudeErrors(MISSIONS["amex"])
    return replace(Scenario(draw, NO_ERRORS, amex, TrueVector(tuple(EPSILON)), TrueVector(tuple(OMEGA))), **changes)


def run(scenario, n_sim, seed=1, catalogue_seed=2):
    return simulate([scenario], n_sim, np.random.default_rng(seed), np.random.default_rng(catalogue_seed))[0]


def sample(scenario, n_sim, rng, catalogue_rng):
    return simulate([scenario], n_sim, rng, catalogue_rng, keep_estimates=True)[0]["estimate"]


def summed_by_plain_loop(scenario, n_sim, seed=1, catalogue_seed=2):
    """Solve one realisation after the other with `core.link.solve`, drawing normals in the order of `simulate`."""
    rng, catalogue = np.random.default_rng(seed), scenario.draw_catalogue(np.random.default_rng(catalogue_seed))
    true = np.stack([catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec])
    sides = scenario.reference_errors, scenario.satellite_errors
    sigma_ref, sigma_sat = (e.standard_errors(catalogue) for e in sides)
    sigma = combined_error(sigma_ref, sigma_sat)
    y = exact_differences(*true, EPSILON, OMEGA)
    p, q, _ = triad(catalogue.ra, catalogue.dec)
    y[2:] -= np.stack([p.T @ scenario.aberration, q.T @ scenario.aberration])
    truth = np.concatenate([TRUTH_MAS, -np.array(scenario.aberration)[: 3 * scenario.solve_glide] / MAS])
    solutions = []
    for normals in both_sides(rng, n_sim, len(catalogue)):
        shift, satellite = (errors(*side) for side in zip(sides, normals, [catalogue] * 2, strict=True))
        seen = true + shift / np.stack([np.cos(catalogue.dec), *np.ones((3, len(catalogue)))])
        design = design_matrix(*seen, corrections=scenario.corrections, glide=scenario.solve_glide)
        solutions.append(solve(design, y + shift - satellite, sigma, scenario.weighting))
    error = np.array([s.estimate for s in solutions]) / MAS - truth
    return error.sum(axis=0), error.T @ error, sum(s.chi2 for s in solutions), solutions[0]


def assert_sums(sums, error, products, sigma, n_sim):
    """What is summed of the six unknowns, and of a glide, is as good as equal to ``error`` and ``products``."""
    near = 1e-9 * n_sim * sigma
    assert np.all(np.abs(sums["error"] - error[:6]) < near[:6])
    assert np.all(np.abs(sums["error_products"] - products[:6, :6]) < np.outer(near, sigma)[:6, :6])
    if len(error) > 6:
        assert np.all(np.abs(sums["glide_error"] - error[6:]) < near[6:])
        assert np.all(np.abs(sums["glide_squares"] - np.diag(products)[6:]) < (near * sigma)[6:])


def errors(model, normals, catalogue):
    """Turn unit normals (4, N) into errors, with each object's own covariance."""
    sigma, correlation = model.standard_errors(catalogue), model.correlation(catalogue)
    if correlation is None:
        return sigma * normals
    covariances = sigma.T[:, :, None] * correlation * sigma.T[:, None, :]
    return np.stack([np.linalg.cholesky(c) @ n for c, n in zip(covariances, normals.T, strict=True)], axis=1)


def both_sides(rng, n_sim, n_obj):
    """Yield the normals (4, N) of the reference and of the satellite: a stream of each for every chunk of realisations,
    object by object.
    """
    for start in range(0, n_sim, ROWS):
        shape = n_obj, 4, min(ROWS, n_sim - start)
        satellite, reference = (stream.standard_normal(shape) for stream in rng.spawn(2))
        yield from zip(reference.transpose(2, 1, 0), satellite.transpose(2, 1, 0), strict=True)


@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
@pytest.mark.parametrize("reference_errors", [NO_ERRORS, NormalErrors(0.4, 0.7)])
@pytest.mark.parametrize(("n_obj", "n_sim"), [(20, 520), (1500, 20), slow(20, 1000)])
@pytest.mark.parametrize(("corrections", "solve_glide"), [(False, False), (True, True), slow(True, False)])
def test_equals_the_plain_loop(weighting, reference_errors, n_obj, n_sim, corrections, solve_glide):
    point = scenario(n_obj, 100.0, reference_errors=reference_errors, weighting=weighting, corrections=corrections)
    point = replace(point, aberration=tuple(GLIDE), solve_glide=solve_glide)
    assert n_sim > ROWS or 4 * n_obj * n_sim > TILE  # several chunks or several tiles
    sums = run(point, n_sim)
    error, products, chi2, solution = summed_by_plain_loop(point, n_sim)
    sigma = solution.formal_error / MAS
    assert_sums(sums, error, products, sigma, n_sim)
    assert sums["chi2"] == pytest.approx(chi2, rel=1e-9)
    if not np.any(reference_errors.standard_errors(point.draw_catalogue(np.random.default_rng(2)))):
        np.testing.assert_allclose(sums["predicted_variance"], n_sim * sigma[:6] ** 2, rtol=1e-9)
        means = [np.mean(sigma[:3] ** 2), np.mean(sigma[3:6] ** 2)]
        squares = n_sim * np.square([*sigma[:6] ** 2, *means])
        np.testing.assert_allclose(sums["predicted_variance_squared"], squares, rtol=1e-9)
    assert sums["n_obj"] == n_sim * n_obj


@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
@pytest.mark.parametrize("reference_errors", [CatalogueErrors(), slow(NormalErrors(0.4, 0.7)), slow(NO_ERRORS)])
def test_correlated_errors_equal_the_plain_loop(weighting, reference_errors):
    n_obj, n_sim = 20, 500
    factor = np.tril(np.random.default_rng(3).uniform(0.3, 1.0, (n_obj, 4, 4)))
    factor /= np.linalg.norm(factor, axis=2, keepdims=True)
    sigma = np.random.default_rng(4).uniform(0.2, 3.0, (4, n_obj)) * MAS
    plain = scenario(n_obj, 100.0).draw_catalogue(np.random.default_rng(2))
    catalogue = replace(plain, sigma=sigma, correlation=factor @ np.swapaxes(factor, 1, 2))
    point = scenario(n_obj, reference_errors=reference_errors, satellite_errors=CatalogueErrors(0.5))
    point = replace(point, draw_catalogue=lambda _: catalogue, weighting=weighting)
    sums = run(point, n_sim)
    error, products, chi2, solution = summed_by_plain_loop(point, n_sim)
    scale = solution.formal_error / MAS
    assert_sums(sums, error, products, scale, n_sim)
    assert sums["chi2"] == pytest.approx(chi2, rel=1e-9)


@pytest.mark.parametrize("mean_pm_mas_yr", [0.0, 500.0])
@pytest.mark.parametrize("n_obj", [2, 50])
@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
def test_error_free_data_return_the_truth(mean_pm_mas_yr, n_obj, weighting):
    sums = run(scenario(n_obj, mean_pm_mas_yr, satellite_errors=NO_ERRORS, weighting=weighting), 3)
    assert np.all(np.abs(sums["error"] / 3) < 1e-6 * np.abs(TRUTH_MAS))  # epsilon^2 mu is 1e-8 of omega
    np.testing.assert_array_equal(sums["predicted_variance"], 0.0)


def test_without_corrections_the_spin_is_hundreds_of_times_worse():
    def spin_error(corrections):
        point = scenario(300, 500.0, satellite_errors=NO_ERRORS, corrections=corrections)
        return np.linalg.norm([run(point, 1, catalogue_seed=k)["error"][3:] for k in range(10)])

    assert spin_error(corrections=False) > 100 * spin_error(corrections=True)


def test_corrections_do_not_matter_for_objects_without_motion():
    with_terms, without = (run(scenario(20, corrections=c), 100) for c in (True, False))
    np.testing.assert_array_equal(with_terms["error_products"], without["error_products"])


def test_stored_angles_leave_the_floor_of_double_precision():
    stored, exact = (
        np.abs([run(scenario(100, satellite_errors=NO_ERRORS, arithmetic=a), 1, 1, k)["error"][:3] for k in range(20)])
        for a in ("stored", "exact")
    )
    tiny = scenario(100, satellite_errors=NO_ERRORS, epsilon=TrueVector(tuple(1e-3 * EPSILON)))
    tiny = replace(tiny, omega=TrueVector(tuple(1e-3 * OMEGA)))
    floor = np.abs([run(replace(tiny, arithmetic="stored"), 1, 1, k)["error"][:3] for k in range(20)])
    below = np.abs([run(tiny, 1, 1, k)["error"][:3] for k in range(20)])
    assert 1e-9 < np.sqrt(np.mean(floor**2)) < 1e-6  # mas; the last bit of an angle is 4e-7 mas at most
    assert np.sqrt(np.mean(stored**2)) > 1e-9
    assert below.max() < 1e-3 * np.sqrt(np.mean(floor**2))
    assert exact.max() < 1e-7  # epsilon^2 is 5e-9 mas


@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
@pytest.mark.parametrize(
    ("reference_errors", "n_sim"), [(NO_ERRORS, 20_000), (NormalErrors(0.8, 1.2), 5000)], ids=["fixed", "noisy"]
)
@pytest.mark.parametrize("solve_glide", [False, True])
def test_realised_errors_are_the_predicted_ones(weighting, reference_errors, n_sim, solve_glide):
    point = scenario(40, 50.0, reference_errors=reference_errors, weighting=weighting, solve_glide=solve_glide)
    sums = run(point, n_sim)
    sigma = np.sqrt(np.diag(sums["error_products"]) / n_sim)
    predicted = np.sqrt(sums["predicted_variance"] / n_sim)
    assert np.all(np.abs(sigma - predicted) < 4 * predicted / np.sqrt(2 * n_sim))
    assert np.all(np.abs(sums["error"] / n_sim) < 4 * predicted / np.sqrt(n_sim))
    dof = 4 * 40 - (9 if solve_glide else 6)
    if weighting == "inverse-variance":
        assert abs(sums["chi2"] / n_sim - dof) < 4 * np.sqrt(2 * dof / n_sim)  # the variance of chi2 is 2 dof


@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
def test_both_paths_agree_for_a_tiny_noise_of_the_reference(weighting):
    """The satellite's normals are a stream of their own, so they do not change."""
    point = scenario(30, 100.0, weighting=weighting)
    fixed = run(point, 1000)
    noisy = run(replace(point, reference_errors=NormalErrors(1e-12, 1e-12)), 1000)
    sigma = np.sqrt(fixed["predicted_variance"])
    assert np.all(np.abs(noisy["error"] - fixed["error"]) < 1e-9 * np.sqrt(1000) * sigma)
    assert noisy["chi2"] == pytest.approx(fixed["chi2"], rel=1e-9)


def test_the_two_generators_decide_different_things():
    point = scenario(30)
    first = run(point, 10)
    other_errors, other_catalogue = run(point, 10, seed=3), run(point, 10, catalogue_seed=3)
    np.testing.assert_array_equal(first["predicted_variance"], other_errors["predicted_variance"])
    assert np.all(first["error"] != other_errors["error"])
    assert np.all(first["predicted_variance"] != other_catalogue["predicted_variance"])
    np.testing.assert_array_equal(first["error"], run(point, 10)["error"])


@pytest.mark.parametrize(
    ("reference_errors", "few", "many"),
    [(NO_ERRORS, 2 * ROWS, 8 * ROWS), (NormalErrors(1.0, 1.0), 2 * ROWS, 4 * ROWS)],
    ids=["fixed", "noisy"],
)
def test_memory_does_not_grow_with_the_number_of_realisations(reference_errors, few, many):
    point = scenario(200, reference_errors=reference_errors)

    def peak(n_sim):
        run(point, 1)
        tracemalloc.start()
        run(point, n_sim)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    assert peak(many) < 1.05 * peak(few)


def test_errors_that_cannot_be_weighed():
    with pytest.raises(LinkError, match=r"negative standard error"):
        run(scenario(10, satellite_errors=NormalErrors(-1.0, 1.0)), 1)


def test_a_sky_that_does_not_determine_the_link():
    def one_place(rng):
        return synthetic(rng, 1, 5.0, 15.0).take(np.zeros(10, dtype=np.intp))

    with pytest.raises(LinkError, match="rank deficient"):
        run(scenario(10, draw_catalogue=one_place), 1)


@pytest.mark.parametrize("solve_glide", [False, True])
@pytest.mark.parametrize("reference_errors", [NO_ERRORS, NormalErrors(0.8, 1.2)])
@pytest.mark.parametrize("n_sim", [1, 2000])
def test_samples_are_the_estimates_that_are_added_up(solve_glide, reference_errors, n_sim):
    point = scenario(30, 100.0, reference_errors=reference_errors, aberration=tuple(GLIDE), solve_glide=solve_glide)
    sums = run(point, n_sim)
    estimates = sample(point, n_sim, np.random.default_rng(1), np.random.default_rng(2))
    error = estimates - [*TRUTH_MAS, *(-GLIDE / MAS)][: estimates.shape[1]]
    assert estimates.shape == (n_sim, 9 if solve_glide else 6)
    assert_sums(sums, error.sum(axis=0), error.T @ error, np.ones(9), n_sim)


def test_random_directions_are_the_catalogues_and_the_link_finds_them():
    point = scenario(30, satellite_errors=NO_ERRORS)
    point = replace(point, epsilon=TrueVector(tuple(EPSILON), True), omega=TrueVector(tuple(OMEGA), True))
    found = np.array(
        [sample(point, 2, np.random.default_rng(k), np.random.default_rng(j)) for j in range(5) for k in range(2)]
    ).reshape(5, 4, 6)  # catalogue, realisation of either error generator, unknown
    np.testing.assert_array_equal(found, np.repeat(found[:, :1], 4, axis=1))
    for part, vector in ((slice(0, 3), EPSILON), (slice(3, 6), OMEGA)):
        np.testing.assert_allclose(np.linalg.norm(found[:, 0, part], axis=1), np.linalg.norm(vector) / MAS, rtol=1e-7)
        assert np.abs(np.diff(found[:, 0, part], axis=0)).max(axis=1).min() > 0.1  # another one for each catalogue
    assert np.all(np.abs(run(point, 1)["error"]) < 1e-7)  # and the truth that is subtracted is the one drawn
