"""Components, the largest correlation and the condition stand beside the mean over components."""

import numpy as np
import pytest
import xarray as xr

from linksweep.sweep.result import Result

NAMES = ["omega_x", "omega_y", "omega_z"]


@pytest.fixture
def masers():
    """The twelve masers: the mean 1.05 hides 0.11, 1.59 and 0.89, of which two have a correlation of 0.999."""
    sigma, correlation = np.array([0.11, 1.59, 0.89]), np.eye(3)
    correlation[1, 2] = correlation[2, 1] = -0.999
    pair = ("n_obj", "component", "component_other")
    return xr.Dataset(
        {
            "sigma": (("n_obj", "component"), [sigma]),
            "sigma_mc_error": (("n_obj", "component"), [0.01 * sigma]),
            "correlation": (pair, [correlation]),
            "condition_number": ("n_obj", [1999.0]),
            "n_sim_done": ("n_obj", [1000]),
            "status": ("n_obj", np.array([1], dtype=np.int8)),
        },
        {
            "n_obj": [12],
            "component": NAMES,
            "component_other": NAMES,
            "component_unit": ("component", ["mas / yr"] * 3),
        },
    )


def test_each_component_and_the_largest_correlation_are_shown_in_80_columns(masers):
    text = Result(masers).written("text")
    assert [line.split() for line in text.splitlines() if line.startswith("omega_") and "yr" in line] == [
        ["omega_x", "0.11", "mas/yr"],
        ["omega_y", "1.59", "mas/yr"],
        ["omega_z", "0.89", "mas/yr"],
    ]
    words = "sigma, n_obj=12: condition number 2e+03, largest correlation -0.999 (omega_y, omega_z)"
    assert words in " ".join(text.split())
    assert max(map(len, text.splitlines()[:4])) <= 80


def test_a_bad_condition_is_warned_of_and_a_good_one_is_not(masers):
    warned = "at 1 point the condition number is up to 2e+03"
    assert warned in Result(masers).written("text")
    assert warned not in Result(masers.assign(condition_number=("n_obj", [3.0]))).written("text")
    assert "omega_x" not in Result(masers.drop_vars(["sigma_mc_error"])).written("text")
