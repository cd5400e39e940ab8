"""The error models: what a study chooses, and what comes out of a simulation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from tests.core.points import MAS, MISSIONS, OwnErrors, drawn, evaluated, point, random_covariances, scenario, set_up

FLAT = {"satellite_errors": "normal", "reference_errors": "normal"}


def with_own_errors(n_obj=50, correlated=True):
    """Synthetic objects with different errors for each observable and random correlations for each object."""
    sigma, correlation = random_covariances(n_obj)
    return replace(drawn(1, n_obj=n_obj), errors=OwnErrors(sigma * MAS, correlation if correlated else None))


@pytest.mark.parametrize("model", ["amex", "gaia", "gaia-2001"])
@pytest.mark.parametrize("length", [None, 7.0])
def test_errors_follow_the_curve_of_the_mission_with_scale_and_floor(model, length):
    mission, objects = MISSIONS[model], drawn(1, n_obj=50)
    physics = scenario(point(model=model, mission_length=length, error_scale=1.5, satellite_error_scale=2.0))
    pos, pm = mission.sigma_pos_mas(objects.v_mag, length), mission.sigma_pm_mas_yr(objects.v_mag, length)
    plain = 3.0 * MAS * np.stack([pos, pos, pm, pm], axis=1)
    np.testing.assert_allclose(physics.satellite_errors.standard_errors(objects), plain, rtol=1e-14)
    floored = replace(physics, satellite_errors=replace(physics.satellite_errors, floor=(0.3, 0.4)))
    setup, expected = set_up(objects, floored), np.hypot(plain, np.array([0.3, 0.3, 0.4, 0.4]) * MAS)
    np.testing.assert_allclose(setup.sigma, expected, rtol=1e-14)  # a floor has no scale, and weighs
    np.testing.assert_array_equal(setup.satellite.sigma, setup.sigma)


def test_scales_multiply():
    here = point(**FLAT, error_scale=2.0, satellite_error_scale=5.0, reference_error_scale=7.0)
    here |= {"satellite_sigma_pm": 0.5, "reference_sigma_pos": 3.0}
    objects = with_own_errors()
    satellite, reference = scenario(here).satellite_errors, scenario(here).reference_errors
    np.testing.assert_allclose(satellite.standard_errors(objects)[0, [0, 2]], np.array([10.0, 5.0]) * MAS, rtol=1e-14)
    np.testing.assert_allclose(reference.standard_errors(objects)[0, [0, 2]], np.array([42.0, 14.0]) * MAS, rtol=1e-14)
    own = scenario(here | {"reference_errors": "catalogue"}).reference_errors
    np.testing.assert_allclose(own.standard_errors(objects), 14.0 * objects.errors.sigma, rtol=1e-15)
    assert own.correlation(objects) is objects.errors.correlation  # a scale does not correlate
    with pytest.raises(ValueError, match="has no errors of its own"):
        own.standard_errors(drawn(1, n_obj=3))


def test_a_floor_dilutes_the_correlations_of_an_object():
    """Covariances add: D R D + floor^2."""
    objects = with_own_errors(9)
    errors = scenario(point(satellite_errors="catalogue", satellite_floor_pos=1.0, satellite_floor_pm=2.0))
    total = errors.satellite_errors.standard_errors(objects)
    found = errors.satellite_errors.correlation(objects) * total[:, :, None] * total[:, None, :]
    sigma, correlation = objects.errors
    expected = correlation * sigma[:, :, None] * sigma[:, None, :] + np.diag([1.0, 1.0, 4.0, 4.0]) * MAS**2
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("reference_errors", ["none", "normal"])
@pytest.mark.parametrize("weighting", ["inverse-variance", "equal"])
def test_underestimated_errors_scatter_more_with_the_same_weights(weighting, reference_errors):
    """Of both sides: the same normals give three times the deviation, and chi2 is nine times its expectation."""
    both = {"satellite_errors": "normal", "reference_errors": reference_errors, "weighting": weighting}
    honest = point(n_obj=60, epsilon_size=0.0, **both)
    ratios = {"satellite_error_ratio": 3.0} | ({"reference_error_ratio": 3.0} if reference_errors == "normal" else {})
    one, other = (evaluated(300, p) for p in (honest, honest | ratios))
    np.testing.assert_allclose(other["error_products"], 9.0 * one["error_products"], rtol=2e-5, atol=1e-5)
    np.testing.assert_allclose(other["predicted_variance"], 9.0 * one["predicted_variance"], rtol=1e-9)
    np.testing.assert_allclose(other["chi2"], 9.0 * one["chi2"], rtol=1e-5)


def test_one_side_underestimated_is_predicted():
    """The sandwich G Sigma G' with the true Sigma, and its Monte Carlo."""
    honest, n_sim = point(n_obj=60, **FLAT), 1000
    found = evaluated(n_sim, honest | {"satellite_error_ratio": 3.0})
    ratio = found["predicted_variance"] / n_sim / evaluated(1, honest)["predicted_variance"]
    np.testing.assert_allclose(ratio, 5.0, rtol=1e-9)  # (9 + 1)/(1 + 1)
    squares = n_sim * np.einsum("pii->pi", found["error_products"]) / found["predicted_variance"]
    assert stats.chi2(n_sim).sf(squares).min() > 1e-4
    assert stats.chi2(n_sim).cdf(squares).min() > 1e-4
