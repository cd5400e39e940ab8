"""The parts of a prediction, the correlations and the condition, against independent linear algebra; and what kept a
wrong program from being noticed.
"""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units

from linksweep.core.catalogue import Catalogue
from linksweep.core.errors import NO_ERRORS, CatalogueErrors, NormalErrors
from linksweep.core.experiment import evaluate, link, scenario, summarise
from linksweep.core.fixed_design import fixed_designs, neglected
from linksweep.core.frames import ARCSEC, DEGREE, MAS, MICROARCSEC
from linksweep.core.link import inverse_and_condition
from linksweep.core.missions.calibrate import (
    IN_CODE,
    PublishedSigma,
    curve_of,
    draw_skies,
    fit,
    published_model,
    spin_variance,
)
from linksweep.core.setup import Draw, Prefixes, prepare
from tests.core.reference import design_matrix, solve


def point(**changes):
    return link.defaults() | {"n_obj": 40} | changes


def results(n_cat, n_sim=1, **changes):
    total = {}
    for k in range(n_cat):
        found = evaluate([point(**changes)], n_sim, np.random.default_rng(100 + k), np.random.default_rng(k))
        total = {name: total.get(name, 0.0) + values for name, values in found.items()}
    n = np.array([float(n_cat * n_sim)])
    return {name: values[0] for name, values in summarise(total, n, np.array([float(n_cat)])).items()}


def scattered(n=30, seed=3, **columns):
    rng = np.random.default_rng(seed)
    zero = np.zeros(n)
    where = {"ra": rng.uniform(0, 2 * np.pi, n), "dec": np.arcsin(rng.uniform(-0.9, 0.9, n))}
    return Catalogue(**(where | {"pmra": zero, "pmdec": zero, "v_mag": zero + 15.0} | columns))


def setup_of(catalogue, **changes):
    names = ("satellite", "reference")
    models = {f"{name}_errors": changes.pop(name, NO_ERRORS) for name in names}
    physics = replace(scenario(point(**changes)), **models)
    return prepare(physics, Draw.of(physics, catalogue, np.random.default_rng(0)), Prefixes())


def test_a_known_bias_is_part_of_the_prediction_and_named_beside_it():
    """Uncorrected aberration on an uneven sky: sigma, the RMS of estimate - truth, is the total."""
    uneven = {"catalogue": "quasars", "model": "gaia", "v_max": 15.0, "n_obj": None, "sky_contrast": 0.8}
    found = results(40, 50, aberration=True, **uneven)
    sigma, error = found["sigma_spin"], np.hypot(found["sigma_spin_mc_error"], found["sigma_spin_catalogue_error"])
    assert found["sigma_spin_predicted"] < sigma - 4 * error  # what was called the prediction
    assert abs(found["sigma_spin_rms_predicted"] - sigma) < 4 * error
    of_bias = found["sigma_rms_predicted"] ** 2 - found["sigma_predicted"] ** 2
    assert np.all(of_bias >= found["bias_predicted"] ** 2 * (1 - 1e-9))  # a mean of squares, a square of means
    np.testing.assert_allclose(found["bias_predicted"], found["bias"], atol=5 * found["bias_mc_error"].max())
    assert np.abs(found["bias_predicted"][3:]).max() > 10 * np.abs(found["bias_mc_error"][3:]).max()


def test_the_predicted_bias_is_what_a_link_without_errors_returns():
    catalogue, glide = scattered(), np.array([1.0, -2.0, 3.0]) * MAS
    setup = setup_of(catalogue, satellite=NormalErrors(1.0, 1.0), aberration=True, glide=(1000.0, -2000.0, 3000.0))
    design = design_matrix(catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec)
    solution = solve(design, setup.differences.T, np.full((4, 30), MAS))
    expected = solution.estimate - setup.truth
    assert np.abs(expected[3:]).max() > 0.01 * np.abs(glide).max()
    found = fixed_designs([setup], Prefixes())[0].bias
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_without_a_bias_both_predictions_agree():
    found = results(2, 5)
    for name in ("sigma_spin", "sigma_orientation", "sigma"):
        np.testing.assert_allclose(found[f"{name}_rms_predicted"], found[f"{name}_predicted"], rtol=1e-9)


def test_correlation_and_condition_number_of_a_clustered_sky():
    """Twelve masers on a patch of the sky: NumPy's own condition of the scaled design, squared."""
    patch = scattered(12, ra=np.linspace(4.0, 4.1, 12), dec=np.linspace(-0.5, -0.4, 12))
    setup = setup_of(patch, satellite=NormalErrors(1.0, 1.0))
    columns = design_matrix(patch.ra, patch.dec, patch.pmra, patch.pmdec).reshape(-1, 6)
    expected = np.linalg.cond(columns / np.linalg.norm(columns, axis=0)) ** 2
    found = fixed_designs([setup], Prefixes())[0].condition_number
    assert found == pytest.approx(expected, rel=1e-6)
    assert found > 100.0
    assert inverse_and_condition(np.diag([1.0, 1e9]))[1] == pytest.approx(1.0, rel=1e-12)
    simulated = results(1, 500)
    np.testing.assert_allclose(np.diag(simulated["correlation"]), 1.0, rtol=1e-12)
    sigma = np.sqrt(np.diag(simulated["covariance"]))
    np.testing.assert_allclose(simulated["correlation"] * np.outer(sigma, sigma), simulated["covariance"], rtol=1e-9)


def test_the_predicted_variance_of_correlated_errors_is_that_of_the_whole_covariance_matrix():
    """G Sigma G^T with a block of Sigma an object, formed without factors: its triangle is not symmetric."""
    rng = np.random.default_rng(8)
    mixing = np.tril(rng.normal(size=(30, 4, 4))) + 2.0 * np.eye(4)
    blocks = mixing @ np.swapaxes(mixing, 1, 2)
    sigma = np.sqrt(np.einsum("nii->ni", blocks))
    correlation = blocks / (sigma[:, :, None] * sigma[:, None, :])
    catalogue = scattered(sigma=sigma.T * MAS, correlation=correlation)
    found = fixed_designs([setup_of(catalogue, satellite=CatalogueErrors())], Prefixes())[0].predicted_variance()
    design = np.moveaxis(design_matrix(catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec), 0, 1)
    a, weights = design.reshape(-1, 6), (sigma.ravel() * MAS) ** -2.0
    gain = np.linalg.inv(a.T @ (weights[:, None] * a)) @ (a * weights[:, None]).T
    whole = np.zeros((120, 120))
    for k, block in enumerate(blocks):
        whole[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] = block * MAS**2
    np.testing.assert_allclose(found, np.diag(gain @ whole @ gain.T), rtol=1e-9)


@pytest.mark.parametrize(
    ("common", "one", "other"),
    [
        ({"mean_pm": 500.0, "epsilon_size": 1e6}, {"corrections": True}, {"corrections": False}),
        ({"satellite_errors": "none"}, {"arithmetic": "exact"}, {"arithmetic": "stored"}),
        ({}, {"weighting": "equal"}, {"weighting": "inverse-variance"}),
        ({}, {"weighting": "inverse-variance"}, {"weighting": "equal"}),
        ({"satellite_errors": "normal"}, {"satellite_error_ratio": 1.0}, {"satellite_error_ratio": 2.0}),
        ({"satellite_errors": "normal"}, {"satellite_sigma_pos": 1.0}, {"satellite_sigma_pos": 0.0}),  # not measured
        ({"satellite_errors": "normal"}, {"satellite_sigma_pm": 0.0}, {"satellite_sigma_pm": 1.0}),
        ({}, {"epsilon_size": 1.0}, {"epsilon_size": 1e5}),
        ({"catalogue": "quasars", "n_obj": None}, {"v_max": 17.0}, {"v_max": 16.3}),
        ({"catalogue": "quasars", "n_obj": None, "v_max": 17.0}, {"v_min": 14.0}, {"v_min": 14.2}),
    ],
)
def test_points_that_share_a_draw_keep_what_is_their_own(common, one, other):
    points = [point(**common, **one), point(**common, **other)]
    together = evaluate(points, 3, np.random.default_rng(1), np.random.default_rng(2))
    for k, single in enumerate(points):
        alone = evaluate([single], 3, np.random.default_rng(1), np.random.default_rng(2))
        for name, values in alone.items():
            np.testing.assert_array_equal(together[name][k], values[0], err_msg=name)
    assert not np.array_equal(together["error"][0], together["error"][1])


def test_columns_of_another_truth_are_others_though_the_differences_are_the_same():
    setup, shared = setup_of(scattered(), satellite=NormalErrors(1.0, 1.0)), Prefixes()
    one = fixed_designs([setup], shared)[0]
    other = fixed_designs([replace(setup, truth=2.0 * setup.truth)], shared)[0]
    np.testing.assert_allclose(one.bias - other.bias, setup.truth, rtol=1e-9)


def test_the_bound_of_what_is_projected_contains_the_mean_change():
    """All objects in one quarter: the means of q's turn with the errors of ra add up, their scatter does not."""
    rng = np.random.default_rng(5)
    n, sigma = 80_000, 200.0
    one_quarter = scattered(n, ra=rng.uniform(0.0, 0.5 * np.pi, n), dec=rng.uniform(0.3, 0.7, n))
    errors = {"satellite": NormalErrors(1.0, 1.0), "reference": NormalErrors(sigma, sigma)}
    design = fixed_designs([setup_of(one_quarter, **errors)], Prefixes())[0]
    variance = (sigma**2 + 1.0) * MAS**2
    size = np.tan(one_quarter.dec) * (sigma * MAS) ** 2 / variance
    mean = np.array([np.sum(size * np.sin(one_quarter.ra)), -np.sum(size * np.cos(one_quarter.ra)), 0.0, 0.0, 0.0, 0.0])
    a = np.moveaxis(design_matrix(one_quarter.ra, one_quarter.dec, one_quarter.pmra, one_quarter.pmdec), 0, 1).reshape(
        -1, 6
    )
    covariance = variance * np.linalg.inv(a.T @ a)
    shift = np.abs(covariance @ mean) / np.sqrt(np.diag(covariance))
    bound = neglected(design)
    assert np.all(bound >= shift * (1 - 1e-9))
    assert np.all(bound[:2] < 1.5 * shift[:2])  # so that the mean decides here


def test_units_are_astropys():
    for ours, theirs in ((MAS, units.mas), (MICROARCSEC, units.uas), (DEGREE, units.deg), (ARCSEC, units.arcsec)):
        assert ours == pytest.approx(theirs.to(units.rad), rel=1e-14)


def test_errors_of_a_calibration_grow_with_a_misfit():
    """The covariance of the constants is that of least squares, times chi2/dof where the numbers do not fit."""
    skies = {"quasars": draw_skies("quasars", 4, seed=4, faintest=17.0)}
    counts = skies["quasars"].counts
    exact = [PublishedSigma("quasars", n, 1.0, 1e-5) for n in counts]
    sigma, _ = published_model(exact, skies, IN_CODE["gaia"], "inverse-variance")
    wrong = sigma * np.where(np.arange(len(sigma)) % 2, 0.8, 1.25)
    found = fit("gaia", [PublishedSigma("quasars", n, s, 1e-5) for n, s in zip(counts, wrong, strict=True)], skies)
    assert found.chi2 / found.dof > 10.0

    def misfit(log_constants):
        values, _ = published_model(exact, skies, curve_of("gaia", np.exp(log_constants)), "inverse-variance")
        return np.log(values / wrong) / found.relative_error

    at, step = np.log(found.constants), 1e-5
    jacobian = np.stack([(misfit(at + d) - misfit(at - d)) / (2 * step) for d in step * np.eye(2)], axis=1)
    expected = np.linalg.inv(jacobian.T @ jacobian) * found.chi2 / found.dof
    np.testing.assert_allclose(found.log_covariance, expected, rtol=1e-3)
    np.testing.assert_allclose(found.standard_error, found.constants * np.sqrt(np.diag(expected)), rtol=1e-3)


def test_the_scale_of_the_reference_errors_in_a_calibration():
    """A satellite without errors: the spin's variance is that of the radio stars, times the scale squared."""
    stars = draw_skies("radio-stars", 6, seed=3)

    def exact(v_mag):
        return np.zeros_like(v_mag)

    whole, half = (spin_variance(stars, exact, reference_error_scale=scale) for scale in (1.0, 0.5))
    np.testing.assert_allclose(half, whole / 4.0, rtol=1e-9)
