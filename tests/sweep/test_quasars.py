"""The main job: `sweep run quasars` gives the paper's Table 1, out of a store that plain xarray opens."""

import astropy.units as u
import numpy as np
import pytest
import xarray as xr

from tests.conftest import run_sweep, runs_all

# Metz & Geffert 2004, Table 1, typed in from the paper: N_obj, AMEX and GAIA [mas/yr] for V_max = 14, 14.5, ..., 20
N_OBJ = [28, 49, 88, 163, 315, 624, 1156, 2056, 3453, 5542, 8095, 11442, 15533]
AMEX = [0.65, 0.63, 0.61, 0.60, 0.58, 0.58, 0.57, *[np.nan] * 6]
GAIA = [0.0017, 0.0015, 0.0012, 0.0011, 0.00094, 0.00083, 0.00074, 0.00068, 0.00063, 0.0006, 0.00058, 0.00057, 0.00057]


@pytest.fixture(scope="module")
def main_job(tmp_path_factory, pytestconfig):
    """Run the command once, of a tenth of the catalogues in the quick tier; give its folder and what it printed."""
    folder = tmp_path_factory.mktemp("main")
    less = [] if runs_all(pytestconfig) else ["--set", "n_cat=10"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "200")
        _, out, err = run_sweep("run", "quasars", *less, cwd=folder, code=0)
    return folder, out, err


@pytest.fixture(scope="module")
def dataset(main_job):
    return xr.open_zarr(main_job[0] / "results" / "quasars.zarr").load()


def test_every_cell_of_table_1_all_within_their_errors_of_the_prediction_and_units_that_astropy_parses(dataset):
    sigma, published = dataset["sigma_spin"], dataset["sigma_spin_published"]
    amex, gaia = (sigma.sel(model=model).values for model in ("amex", "gaia"))
    assert np.nanmax(np.abs(amex - AMEX)) < 0.02  # mas/yr
    assert np.abs(gaia / GAIA - 1).max() < 0.07
    assert dataset["v_max"].values.tolist() == np.linspace(14.0, 20.0, 13).tolist()
    for model, numbers in (("amex", AMEX), ("gaia", GAIA)):
        np.testing.assert_array_equal(dataset["n_obj"].sel(model=model), N_OBJ)
        np.testing.assert_array_equal(published.sel(model=model), numbers)
    n_sim, dof = dataset["n_sim_done"], 4 * dataset["n_obj"] - 6
    np.testing.assert_array_equal(dataset["dof"], dof)
    for name in ("sigma", "sigma_spin"):
        off = np.abs(dataset[name] - dataset[f"{name}_predicted"]) / dataset[f"{name}_mc_error"]
        assert off.max() < 4
    assert 0.5 < np.sqrt((off**2).mean()) < 1.5  # those of the spin are honest, neither too small nor too large
    assert (np.abs(dataset["bias"]) / (dataset["sigma"] / np.sqrt(n_sim))).max() < 4.5  # 156 values
    assert (np.abs(dataset["chi2"] - dof) / np.sqrt(2 * dof / n_sim)).max() < 4
    for name, variable in dataset.variables.items():
        u.Unit(variable.attrs.get("units", ""))
        assert variable.attrs.get("units") != ""
        assert 0 < len(variable.attrs["long_name"]) <= 90, name  # characters, three lines of xarray's labels
    assert u.Unit(dataset["sigma_spin"].attrs["units"]) == u.mas / u.yr
    assert u.Unit(dataset["v_max"].attrs["units"]) == u.mag
    each = u.Unit(dataset["sigma"].attrs["units"])
    assert [each[f] for f in each.field_names] == [u.Unit(t) for t in dataset["component_unit"].values]
    products = u.Unit(dataset["covariance"].attrs["units"])
    assert (products["f0"]["f5"], products["f3"]["f5"]) == (u.mas**2 / u.yr, u.mas**2 / u.yr**2)


def test_the_printed_table_shows_ours_the_prediction_and_the_papers_and_comes_back_from_the_store(main_job, sweep):
    folder, out, err = main_job
    line = next(row for row in out.splitlines() if row.split()[:2] == ["gaia", "20"])
    sigma, plus_minus, _, predicted, published, difference, percent, n_obj = line.split()[2:]
    assert (plus_minus, published, percent, n_obj) == ("±", "0.57", "%", "15533")  # published in uas/yr
    assert float(sigma) == pytest.approx(float(predicted), rel=0.02)
    assert float(difference) == pytest.approx(100 * (float(sigma) / 0.57 - 1), abs=0.1)
    assert sum(line.startswith((" amex", "amex", " gaia", "gaia")) for line in out.splitlines()) == 26
    assert "\x1b" not in out + err  # no colour, no bar: this is not a terminal
    store, table = folder / "results" / "quasars.zarr", out.partition("n_obj: all")[0]
    again = sweep("show", store)[1]
    assert again.startswith(table)
    assert "condition number" in again.removeprefix(table)
