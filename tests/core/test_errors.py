"""The error models, as values and as they come out of a simulation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from linksweep.core.catalogues import radio_stars, synthetic
from linksweep.core.errors import NO_ERRORS, CatalogueErrors, MagnitudeErrors, NormalErrors
from linksweep.core.experiment import link, scenario
from linksweep.core.frames import MAS
from linksweep.core.missions import MISSIONS, PyGaia
from linksweep.core.setup import Noise, Prefixes
from linksweep.core.simulate import simulate

CATALOGUE = synthetic(np.random.default_rng(1), 50, 5.0, 15.0)


def with_own_errors(n_obj=50, correlated=True):
    """The synthetic catalogue with different errors for each observable and random correlations for each object."""
    rng = np.random.default_rng(2)
    factor = rng.standard_normal((n_obj, 4, 5))
    covariance = factor @ np.swapaxes(factor, 1, 2)
    deviation = np.sqrt(np.einsum("nii->ni", covariance))
    correlation = covariance / (deviation[:, :, None] * deviation[:, None, :]) if correlated else None
    return replace(
        CATALOGUE.take(np.arange(n_obj)), sigma=rng.uniform(0.2, 3.0, (4, n_obj)) * MAS, correlation=correlation
    )


@pytest.mark.parametrize("name", [n for n, m in MISSIONS.items() if not isinstance(m.curve_pm_mas_yr, PyGaia)])
@pytest.mark.parametrize("length_yr", [None, 7.0])
def test_magnitude_errors_follow_the_curve_of_the_mission(name, length_yr):
    mission = MISSIONS[name]
    sigma = MagnitudeErrors(mission, length_yr, 3.0).standard_errors(CATALOGUE)
    pos, pm = mission.sigma_pos_mas(CATALOGUE.v_mag, length_yr), mission.sigma_pm_mas_yr(CATALOGUE.v_mag, length_yr)
    np.testing.assert_allclose(sigma, 3.0 * MAS * np.stack([pos, pos, pm, pm]), rtol=1e-14)


def test_catalogue_errors_are_those_of_the_objects():
    catalogue = with_own_errors()
    np.testing.assert_allclose(CatalogueErrors(2.0).standard_errors(catalogue), 2.0 * catalogue.sigma, rtol=1e-15)
    assert CatalogueErrors(2.0).correlation(catalogue) is catalogue.correlation  # a scale does not correlate
    stars = radio_stars()
    np.testing.assert_array_equal(CatalogueErrors().standard_errors(stars), stars.sigma)
    assert CatalogueErrors().correlation(stars) is None
    with pytest.raises(ValueError, match="has no errors of its own"):
        CatalogueErrors().standard_errors(CATALOGUE)


@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize(
    "model", [NO_ERRORS, NormalErrors(2.0, 3.0, 0.5), MagnitudeErrors(MISSIONS["gaia"], 3.0), CatalogueErrors(0.7)]
)
def test_drawn_noise_has_the_covariance_that_is_asked_for(model, correlated):
    n_obj, n_draws = 4, 40_000
    catalogue = with_own_errors(n_obj, correlated)
    sigma = model.standard_errors(catalogue)
    drawn = Noise.of(model, catalogue, Prefixes())
    normals = np.random.default_rng(3).standard_normal((n_obj, 4, n_draws))
    noise = (drawn.standardised(normals, 0) * drawn.sigma[..., None]).transpose(2, 1, 0)
    own = correlated and isinstance(model, CatalogueErrors)
    asked = np.zeros((4, n_obj, 4, n_obj))
    for k in range(n_obj):  # different objects are independent
        asked[:, k, :, k] = np.outer(sigma[:, k], sigma[:, k]) * (catalogue.correlation[k] if own else np.eye(4))
    asked, flat = asked.reshape(4 * n_obj, -1), noise.reshape(n_draws, -1)
    variance = np.diag(asked)
    mc_error = np.sqrt((np.outer(variance, variance) + asked**2) / n_draws)  # of a covariance of normal errors
    assert np.all(np.abs(flat.T @ flat / n_draws - asked) <= 4.5 * mc_error)
    assert np.all(np.abs(flat.mean(axis=0)) <= 4.5 * np.sqrt(variance / n_draws))
    if np.any(sigma):
        assert stats.kstest(noise[:, 2, 1] / sigma[2, 1], "norm").pvalue > 1e-3


def test_scales_multiply():
    point = link.defaults() | {"n_obj": 50, "satellite_errors": "normal", "reference_errors": "normal"}
    point |= {"error_scale": 2.0, "satellite_error_scale": 5.0, "reference_error_scale": 7.0}
    point |= {"satellite_sigma_pm": 0.5, "reference_sigma_pos": 3.0}
    satellite = scenario(point).satellite_errors.standard_errors(CATALOGUE)
    reference = scenario(point).reference_errors.standard_errors(CATALOGUE)
    np.testing.assert_allclose(satellite[[0, 2], 0], np.array([10.0, 5.0]) * MAS, rtol=1e-14)
    np.testing.assert_allclose(reference[[0, 2], 0], np.array([42.0, 14.0]) * MAS, rtol=1e-14)
    point |= {"reference_errors": "catalogue", "satellite_errors": "catalogue"}
    assert scenario(point).reference_errors == CatalogueErrors(14.0, "reference")
    assert scenario(point).satellite_errors == CatalogueErrors(10.0, "satellite")


@pytest.mark.slow
@pytest.mark.parametrize("side", ["reference", "satellite"])
def test_simulated_errors_are_normal_around_zero(side):
    """Equal weights on a fixed sky, one realisation after the other: the errors of the link are sums of single ones."""
    n_sim = 1000
    other = "satellite" if side == "reference" else "reference"
    point = link.defaults() | {"n_obj": 3, "satellite_errors": "normal", "reference_errors": "normal"}
    point |= {f"{other}_error_scale": 1e-6, f"{side}_sigma_pos": 5.0, f"{side}_sigma_pm": 0.3}
    rng = np.random.default_rng(2)
    blocks = [simulate([scenario(point)], 1, rng, np.random.default_rng(3))[0] for _ in range(n_sim)]
    error = np.array([block["error"] for block in blocks]) / np.sqrt(blocks[0]["predicted_variance"])
    assert np.all(np.abs(error.mean(axis=0)) < 4 / np.sqrt(n_sim))
    assert np.all(np.abs(error.std(axis=0) - 1.0) < 4 / np.sqrt(2 * n_sim))
    assert all(stats.kstest(component, "norm").pvalue > 1e-3 for component in error.T)
    chi2 = np.array([block["chi2"] for block in blocks])
    assert stats.kstest(chi2, stats.chi2(4 * 3 - 6).cdf).pvalue > 1e-3


@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
@pytest.mark.parametrize("sides", ["satellite", "reference", "both"])
def test_correlated_errors_come_out_as_predicted(sides, weighting):
    n_sim = 4000
    own, small = CatalogueErrors(), NormalErrors(0.3, 0.3)
    errors = {"satellite": (NO_ERRORS, own), "reference": (own, small), "both": (own, CatalogueErrors(0.5))}[sides]
    catalogue = with_own_errors(3)
    point = scenario(link.defaults() | {"weighting": weighting})
    point = replace(point, draw_catalogue=lambda _: catalogue, reference_errors=errors[0], satellite_errors=errors[1])
    (sums,) = simulate([point], n_sim, np.random.default_rng(4), np.random.default_rng(5))
    predicted = sums["predicted_variance"] / n_sim
    realised = np.diag(sums["error_products"]) / n_sim
    assert np.all(np.abs(realised / predicted - 1.0) < 4 * np.sqrt(2 / n_sim))
    assert np.all(np.abs(sums["error"] / n_sim) < 4 * np.sqrt(predicted / n_sim))
    alone = replace(point, draw_catalogue=lambda _: replace(catalogue, correlation=None))
    without = simulate([alone], 1, np.random.default_rng(4), np.random.default_rng(5))[0]["predicted_variance"]
    assert np.any(np.abs(without / predicted - 1.0) > 0.1)  # so the correlations have been there
