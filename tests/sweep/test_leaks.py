"""The studies of systematics, run short: what they find is what their closed form says."""

import numpy as np
import pytest

from tests.tiers import slow

SPIN = ["omega_x", "omega_y", "omega_z"]
LEAKS = ("degree-two", "zonal-errors", "magnitude-equation", "error-budget")


def deviations(dataset):
    """Second moments of the estimates minus their prediction, in their Monte-Carlo error: errors s and a bias b have a
    variance of (2 s^4 + 4 s^2 b^2)/n.
    """
    errors = dataset["sigma_predicted"] ** 2
    bias = dataset["sigma_rms_predicted"] ** 2 - errors
    variance = (2 * errors**2 + 4 * errors * bias) / dataset["n_sim_done"]
    return (dataset["sigma"] ** 2 - errors - bias) / np.sqrt(variance)


@pytest.mark.parametrize("name", [LEAKS[0], *map(slow, LEAKS[1:])])
def test_the_prediction_of_a_leak_study_holds(name, dataset_of):
    found = np.abs(deviations(dataset_of(name))).values
    assert np.nanmax(found) < 5.0
    assert np.nanmean(found) < 1.3  # 0.8 for normal deviates


def test_an_uneven_sky_leaks_more(dataset_of):
    leak = np.sqrt((dataset_of("degree-two")["bias_predicted"].sel(component=SPIN) ** 2).sum("component"))
    field = leak.sel(motion_field="t_2_0", n_obj=100)
    assert field.sel(sky_contrast=0.5) > field.sel(sky_contrast=0.0)


def test_a_magnitude_equation_and_a_slope_bias_the_spin_about_the_pole(dataset_of):
    bias = dataset_of("magnitude-equation")["bias_predicted"].sel(v_max=16.0, weighting="equal")
    both, neither = bias.sel(magnitude_equation_pmra=0.001), bias.sel(magnitude_equation_pmra=0.0)
    slope = (neither.sel(omega_slope_size=0.001) - neither.sel(omega_slope_size=0.0)).sel(component="omega_z")
    equation = (both - neither).sel(omega_slope_size=0.0, component="omega_z")
    assert equation / slope == pytest.approx(-3.0 * np.pi / 8.0, rel=0.1)  # both go as <V - 15>


def test_underestimated_errors_show_in_chi2(dataset_of):
    dataset = dataset_of("error-budget")
    over = (dataset["chi2"] / dataset["dof"]).mean("v_max")
    np.testing.assert_allclose(over.sel(satellite_error_ratio=1.0), 1.0, atol=0.05)
    np.testing.assert_allclose(over.sel(satellite_error_ratio=1.5), 2.25, atol=0.12)
