"""The errors of the link's results cover: over independent copies (value - truth) / error scatters by one."""

import functools
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import linksweep
from tests.core.points import CALIBRATED, calibrate
from tests.sweep.test_coverage import assert_covers

pytestmark = pytest.mark.slow


@functools.cache
def copies(n_cat, n_sim, aberration=False):
    """Return results of copies that differ in nothing but their random numbers."""
    quasars = {"catalogue": "quasars", "v_max": 14.0, "model": "gaia", "method": "projected", "aberration": aberration}
    sampling = {"n_sim": n_sim, "n_cat": n_cat, "seed": 3}
    axes = {"error_scale": [1.0 + 1e-9 * k for k in range(150)]}
    study = {"title": "Copies", "axes": axes, "fixed": quasars, "sampling": sampling}
    with TemporaryDirectory() as folder:
        return linksweep.run(study, Path(folder) / "s.zarr", pool="serial")


@pytest.mark.parametrize(("n_cat", "n_sim"), [(12, 64), (2, 64)])
def test_the_error_of_sigma_holds_the_catalogues_fixed(n_cat, n_sim):
    dataset = copies(n_cat, n_sim)
    for name in ("sigma", "sigma_spin", "sigma_orientation"):
        assert_covers((dataset[name] - dataset[f"{name}_predicted"]) / dataset[f"{name}_mc_error"])


@pytest.mark.parametrize("n_cat", [5, 12])
def test_the_error_of_the_choice_of_catalogues(n_cat):
    dataset = copies(n_cat, 64)
    for name in ("sigma", "sigma_spin", "sigma_orientation"):
        predicted = dataset[f"{name}_predicted"]
        truth = np.sqrt(np.mean(copies(12, 64)[f"{name}_predicted"] ** 2, axis=0))
        assert_covers((predicted - truth) / dataset[f"{name}_catalogue_error"], dof=n_cat - 1)


@pytest.mark.parametrize(("n_cat", "n_sim"), [(5, 64), (12, 64), (12, 1024)])
def test_the_error_of_a_bias_that_catalogues_have(n_cat, n_sim):
    """Galactic aberration that is not corrected: every catalogue has a bias of its own, and 1024 are two blocks."""
    dataset = copies(n_cat, n_sim, aberration=True).sel(component=["omega_x", "omega_y", "omega_z"])
    truth = dataset["bias"].mean("error_scale")
    assert_covers((dataset["bias"] - truth) / dataset["bias_mc_error"], dof=n_cat - 1)


def test_the_error_of_a_bias_that_is_none():
    for n_cat, n_sim in ((1, 64), (1, 2048), (12, 64)):
        dataset = copies(n_cat, n_sim)
        assert_covers(dataset["bias"] / dataset["bias_mc_error"], dof=np.inf if n_cat == 1 else n_cat - 1)


@pytest.mark.parametrize("model", ["gaia", "amex"])
def test_the_errors_of_the_calibration(model):
    """Published numbers made from known constants with the errors that weigh them; chi2 above one only widens these."""
    copies, rng = 60, np.random.default_rng(7)
    numbers, skies = calibrate.published_numbers(model), calibrate.all_skies(model, n_cat=12)
    sigma, _ = calibrate.published_model(numbers, skies, CALIBRATED[model].curve)
    truth = np.log(calibrate.constants_of(model))
    relative_error = calibrate.fit(model, numbers, skies).relative_error
    pulls = []
    for _ in range(copies):
        made = sigma * np.exp(relative_error * rng.standard_normal(len(sigma)))
        # half a unit in the last digit of a number that scatters goes with it, so that its weight is that of the truth
        printed = numbers.assign(sigma=made, rounding=numbers["rounding"] * made / numbers["sigma"])
        found = calibrate.fit(model, printed, skies)
        widened = np.sqrt(max(1.0, found.chi2 / found.dof))
        pulls.append((np.log(found.constants) - truth) / np.sqrt(np.diag(found.log_covariance)) * widened)
    assert_covers(pulls)
