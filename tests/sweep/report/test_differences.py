"""Differences between simulation and prediction, in units of their errors."""

import numpy as np

from linksweep.sweep.analysis.quantity import standard_error
from linksweep.sweep.analysis.readable_units import in_readable_units
from linksweep.sweep.report.figures import differences


def test_differences_are_in_errors_and_have_no_unit(dataset_of):
    dataset = dataset_of("quasars")
    for given in (dataset, in_readable_units(dataset)):
        found = differences(given, "sigma_spin")["sigma_spin_from_prediction"]
        assert "units" not in found.attrs
        assert found["v_max"].attrs["units"] == "mag"
        expected = (given["sigma_spin"] - given["sigma_spin_rms_predicted"]) / standard_error(given, "sigma_spin")
        np.testing.assert_allclose(found.values, expected.transpose(*found.dims).values, rtol=1e-12)


def test_without_a_prediction_there_are_none(dataset_of):
    dataset = dataset_of("quasars")
    assert (
        differences(dataset.drop_vars("sigma_spin_rms_predicted").drop_vars("sigma_spin_predicted"), "sigma_spin")
        is None
    )
