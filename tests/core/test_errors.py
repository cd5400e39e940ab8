"""The error models, as values and as they come out of a simulation."""

import numpy as np
import pytest
from scipy import stats

from core.catalogue import synthetic
from core.constants import MAS
from core.errors import MagnitudeErrors, NoErrors, NormalErrors
from core.experiment import link, scenario
from core.missions import MISSIONS
from core.simulate import simulate

CATALOGUE = synthetic(np.random.default_rng(1), 50, 5.0, 15.0)


def test_no_errors():
    np.testing.assert_array_equal(NoErrors().standard_errors(CATALOGUE), np.zeros((4, 50)))


def test_normal_errors():
    expected = np.repeat([[2.0], [2.0], [3.0], [3.0]], 50, axis=1) * MAS
    np.testing.assert_allclose(NormalErrors(2.0, 3.0).standard_errors(CATALOGUE), expected, rtol=1e-15)
    np.testing.assert_allclose(NormalErrors(2.0, 3.0, 0.5).standard_errors(CATALOGUE), expected / 2, rtol=1e-15)


@pytest.mark.parametrize("name", MISSIONS)
@pytest.mark.parametrize("length_yr", [None, 7.0])
def test_magnitude_errors_follow_the_curve_of_the_mission(name, length_yr):
    mission = MISSIONS[name]
    sigma = MagnitudeErrors(mission, length_yr, 3.0).standard_errors(CATALOGUE)
    pos, pm = mission.sigma_pos_mas(CATALOGUE.v_mag, length_yr), mission.sigma_pm_mas_yr(CATALOGUE.v_mag, length_yr)
    np.testing.assert_allclose(sigma, 3.0 * MAS * np.stack([pos, pos, pm, pm]), rtol=1e-14)


def test_scales_multiply():
    point = link.defaults() | {"n_obj": 50, "satellite_errors": "normal", "reference_errors": "normal"}
    point |= {"error_scale": 2.0, "satellite_error_scale": 5.0, "reference_error_scale": 7.0}
    point |= {"satellite_sigma_pm": 0.5, "reference_sigma_pos": 3.0}
    satellite = scenario(point).satellite_errors.standard_errors(CATALOGUE)
    reference = scenario(point).reference_errors.standard_errors(CATALOGUE)
    np.testing.assert_allclose(satellite[[0, 2], 0], np.array([10.0, 5.0]) * MAS, rtol=1e-14)
    np.testing.assert_allclose(reference[[0, 2], 0], np.array([42.0, 14.0]) * MAS, rtol=1e-14)


def test_mission_length_and_model_reach_the_satellite():
    point = link.defaults() | {"n_obj": 50, "model": "gaia", "mission_length": 10.0, "error_scale": 2.0}
    expected = MagnitudeErrors(MISSIONS["gaia"], 10.0, 2.0)
    assert scenario(point).satellite_errors == expected
    assert scenario(point).reference_errors == NoErrors()


@pytest.mark.parametrize("side", ["reference", "satellite"])
def test_simulated_errors_are_normal_around_zero(side):
    """Equal weights on a fixed sky, one realisation after the other: the errors of the link are sums of single ones."""
    n_sim = 1000
    other = "satellite" if side == "reference" else "reference"
    point = link.defaults() | {"n_obj": 3, "satellite_errors": "normal", "reference_errors": "normal"}
    point |= {f"{other}_error_scale": 1e-6, f"{side}_sigma_pos": 5.0, f"{side}_sigma_pm": 0.3}
    rng = np.random.default_rng(2)
    blocks = [simulate(scenario(point), 1, rng, np.random.default_rng(3)) for _ in range(n_sim)]
    error = np.array([block.error for block in blocks]) / np.sqrt(blocks[0].predicted_variance)
    assert np.all(np.abs(error.mean(axis=0)) < 4 / np.sqrt(n_sim))
    assert np.all(np.abs(error.std(axis=0) - 1.0) < 4 / np.sqrt(2 * n_sim))
    assert all(stats.kstest(component, "norm").pvalue > 1e-3 for component in error.T)
    chi2 = np.array([block.chi2 for block in blocks])
    assert stats.kstest(chi2, stats.chi2(4 * 3 - 6).cdf).pvalue > 1e-3
