"""Results in other units are the same results."""

import numpy as np
import pytest

from linksweep.sweep.analysis.laws import fit_power_law
from linksweep.sweep.analysis.quantity import in_readable_units


@pytest.mark.slow
def test_all_that_belongs_to_a_quantity_is_in_one_unit(dataset_of):
    stored = dataset_of("quasars")
    shown = in_readable_units(stored)
    for suffix in ("", "_mc_error", "_catalogue_error", "_rms_predicted", "_published", "_published_rounding"):
        name = f"sigma_spin{suffix}"
        assert shown[name].units == "uas / yr"
        np.testing.assert_allclose(shown[name].values, 1000.0 * stored[name].values, rtol=1e-15)
    assert stored["sigma_spin"].units == "mas / yr"
    assert shown["n_obj"].identical(stored["n_obj"])
    assert in_readable_units(stored.sel(model="amex"))["sigma_spin"].units == "mas / yr"


def test_a_component_has_the_unit_that_suits_it(dataset_of):
    one = dataset_of("quasars").sel(component="omega_x", model="gaia")
    shown = in_readable_units(one)
    assert shown["component_unit"].item() == "uas / yr"
    np.testing.assert_allclose(shown["sigma"].values, 1000.0 * one["sigma"].values)
    np.testing.assert_array_equal(shown["covariance"].values, one["covariance"].values)


@pytest.mark.slow
def test_a_law_is_the_same_in_any_unit(dataset_of):
    stored = dataset_of("sqrt-n")
    law, again = (fit_power_law(ds, "sigma_spin", "n_obj") for ds in (stored, in_readable_units(stored)))
    for name in ("exponent", "exponent_error", "chi2"):
        assert float(again[name]) == pytest.approx(float(law[name]), rel=1e-9)
    assert float(again["amplitude"]) == pytest.approx(1000.0 * float(law["amplitude"]), rel=1e-9)
