"""Every study of the paper, run as a user runs it, against what the paper found."""

import os
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from linksweep.core.experiment import link
from linksweep.core.missions import CALIBRATED
from linksweep.core.missions.calibrate import draw_skies, spin_variance
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.studies.reader import load_study
from tests.sweep.opening import run_study

SPIN = ["omega_x", "omega_y", "omega_z"]
SLOWEST_S = 1700  # a hang, not a speed limit

# Metz & Geffert 2004, Table 2: N, full VLBI errors, halved [mas/yr]
TABLE_2 = np.array(
    [
        *[(10, 0.076, 0.047), (20, 0.048, 0.031), (30, 0.038, 0.025), (40, 0.033, 0.022), (50, 0.029, 0.019)],
        *[(60, 0.026, 0.017), (70, 0.024, 0.016), (80, 0.022, 0.015), (90, 0.021, 0.014), (100, 0.020, 0.013)],
    ]
)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A function that gives the results of a built-in study, run once."""
    folder = tmp_path_factory.mktemp("paper")
    known = {}

    def result(name, *options):
        if name not in known:
            command = [sys.executable, "-m", "linksweep", "run", name, "-o", str(folder / f"{name}.zarr"), *options]
            run = subprocess.run(
                command, capture_output=True, check=False, text=True, timeout=SLOWEST_S, env=os.environ
            )
            assert run.returncode == 0, run.stderr
            known[name] = xr.open_zarr(folder / f"{name}.zarr").load()
        return known[name]

    return result


def slope(x, y):
    return np.polyfit(np.log(x), np.log(y), 1)[0]


@pytest.mark.slow
def test_radio_stars_give_table_2(results):
    dataset = results("radio-stars").transpose("n_obj", "reference_error_scale", ...)
    off = np.abs(dataset["sigma_spin"].values - TABLE_2[:, 1:])
    ours = 3.0 * dataset["sigma_spin_catalogue_error"].values  # 1200 catalogues that differ by a quarter
    assert np.all((off < 0.06 * TABLE_2[:, 1:] + ours) | (off < 0.0015))


@pytest.mark.slow
def test_the_worst_cell_of_table_2_is_the_constants_and_the_luck_of_the_seed(tmp_path):
    """Ten radio stars with halved errors: the closed form over 40 000 samples of the eleven is 5.2 % above the paper's
    0.047, and the 1200 of the shipped seed add 2.0 of their own errors, which makes 7.0 %.
    """
    published = 0.047
    skies = (draw_skies("radio-stars", 8000, seed=11 + k) for k in range(5))
    variance = np.concatenate(
        [spin_variance(some, CALIBRATED["amex"].curve, reference_error_scale=0.5)[0] for some in skies]
    )
    closed = np.sqrt(variance.mean())
    closed_error = variance.std() / (2.0 * closed * np.sqrt(len(variance)))
    assert closed_error < 0.002 * closed
    assert closed / published - 1.0 == pytest.approx(0.0524, abs=0.002)

    shipped = load_study("radio-stars", axes=["n_obj=10", "reference_error_scale=0.5"])
    found, _ = run_study(shipped, tmp_path / "ten.zarr", Resources(pool="serial"))
    sigma, error = found["sigma_spin"].item(), found["sigma_spin_catalogue_error"].item()
    assert sigma / published - 1.0 == pytest.approx(0.070, abs=0.0005)
    assert (sigma - closed) / np.hypot(error, found["sigma_spin_mc_error"].item()) == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
def test_ten_radio_stars_are_worse_than_one_over_root_n(results):
    sigma = results("radio-stars")["sigma_spin"].sel(reference_error_scale=1.0)
    excess = (sigma.sel(n_obj=10) * 10**0.5 / (sigma.sel(n_obj=100) * 100**0.5)).item()
    assert 1.1 < excess < 1.35  # the paper: 0.076 sqrt(10) / (0.020 sqrt(100)) = 1.20


@pytest.mark.slow
def test_galaxies_give_0_16(results):
    assert abs(results("galaxies")["sigma_spin"].item() - 0.16) < 0.02


@pytest.mark.slow
def test_the_error_falls_as_one_over_root_n(results):
    dataset = results("sqrt-n")
    n_obj, sigma = dataset["n_obj"].values, dataset["sigma_spin"].values
    error = dataset["sigma_spin_mc_error"].values / sigma
    fit, covariance = np.polyfit(np.log(n_obj), np.log(sigma), 1, w=1 / error, cov="unscaled")
    assert abs(fit[0] + 0.5) < 3 * np.sqrt(covariance[0, 0])


@pytest.mark.slow
def test_more_objects_and_a_longer_mission_help_as_the_paper_says(results):
    """N x 1.5 -> 1/sqrt(1.5); T x 1.5 -> 1/sqrt(1.5^3)."""
    dataset = results("mission-length").sel(model="gaia")
    sigma, error = dataset["sigma_spin"], dataset["sigma_spin_mc_error"] / dataset["sigma_spin"]
    catalogues = dataset["sigma_spin_catalogue_error"] / dataset["sigma_spin"]

    def check(of, to, law):
        ratio = (sigma.sel(of) / sigma.sel(to)).item()
        allowed = np.sqrt(sum((e.sel(p) ** 2).item() for e in (error, catalogues) for p in (of, to)))
        assert abs(ratio / law - 1) < 4 * allowed

    for n_obj in (60, 90, 135):
        check({"mission_length": 3, "n_obj": n_obj}, {"mission_length": 2, "n_obj": n_obj}, 1.5**-1.5)
    # few objects are a little worse than the law: sigma^2 ~ 1/(N - 2) for N isotropic ones
    law = (88 / 133) ** 0.5
    for length in (2, 4, 8):
        check({"mission_length": length, "n_obj": 135}, {"mission_length": length, "n_obj": 90}, law)


@pytest.mark.slow
@pytest.mark.parametrize(("variable", "law"), [("sigma_spin", -1.5), ("sigma_orientation", -0.5)])
def test_mission_length_slopes(results, variable, law):
    dataset = results("mission-length")
    for model in ("amex", "gaia"):
        one = dataset.sel(model=model, n_obj=90)
        relative = (one[f"{variable}_mc_error"] ** 2 + one[f"{variable}_catalogue_error"] ** 2) ** 0.5 / one[variable]
        x = np.log(one["mission_length"])
        error = relative.mean() / np.sqrt(((x - x.mean()) ** 2).sum())
        assert abs(slope(one["mission_length"], one[variable]) - law) < 4 * error


@pytest.mark.slow
def test_stored_angles_leave_a_floor_that_exact_differences_do_not_have(results):
    smallest = results("algorithm").isel(epsilon_size=0).sel(corrections=True)["sigma_orientation"]
    stored, exact = smallest.sel(arithmetic="stored"), smallest.sel(arithmetic="exact")
    assert stored.min() > 1e-9  # mas
    assert stored.max() < 1e-6
    assert (stored / exact).min() > 100


@pytest.mark.slow
def test_with_corrections_the_spin_does_not_depend_on_proper_motions(results):
    """At 1 mas and 1 mas/yr; RMS of 3 x 64 values: 5 % Monte-Carlo error each."""
    one = results("algorithm").isel(epsilon_size=3).sel(arithmetic="exact", n_obj=500)["sigma_spin"]
    with_a21, without = one.sel(corrections=True), one.sel(corrections=False)
    assert (with_a21 / with_a21.sel(mean_pm=0)).max() < 1.3
    assert (with_a21 / with_a21.sel(mean_pm=0)).min() > 0.7
    growth = (without.sel(mean_pm=500) / without.sel(mean_pm=50)).item()
    assert 3 < growth < 30  # 10, but the RMS is bumpy: the terms have 1/cos dec, whose variance has no limit
    # goes as the proper motion over the size of the sky; it scatters by a factor of two from draw to draw
    assert (without / with_a21).sel(mean_pm=500) > 50
    assert 0.7 < (without / with_a21).sel(mean_pm=0) < 1.4  # no proper motions: A21 is zero


def test_without_corrections_the_spin_errs_in_proportion_to_proper_motions():
    """The same catalogue without proper motions, with some, and with all of them ten times as large."""
    same = {"n_obj": 100, "satellite_errors": "none", "corrections": False}
    points = [link.defaults() | same | {"mean_pm": pm} for pm in (0.0, 50.0, 500.0)]
    none, some, ten_times = (
        link.evaluate([p], 1, np.random.default_rng(1), np.random.default_rng(2))["error"][0, 3:] for p in points
    )
    np.testing.assert_allclose(ten_times - none, 10 * (some - none), rtol=1e-6)


@pytest.mark.slow
def test_errors_of_the_algorithm_do_not_depend_on_the_number_of_objects(results):
    one = results("algorithm").isel(epsilon_size=4).sel(corrections=True, arithmetic="exact", mean_pm=0)
    ratio = one["sigma_orientation"].sel(n_obj=500) / one["sigma_orientation"].sel(n_obj=50)
    assert 0.7 < ratio < 1.4


@pytest.mark.slow
def test_the_error_surface_is_linear_at_its_edges_and_quadratic_inside(results):
    dataset = results("error-surface")
    reference, satellite = dataset["reference_error_scale"], dataset["satellite_error_scale"]
    per_unit = dataset["sigma_spin"].sel(reference_error_scale=1.0, satellite_error_scale=0.0).item()
    expected = per_unit * np.sqrt(reference**2 + satellite**2)
    off = (dataset["sigma_spin"] - expected).transpose("reference_error_scale", "satellite_error_scale")
    relative = 1 / np.sqrt(2 * 3 * 2000)  # of each of 80 values, and of the unit
    assert np.abs(off).max() < 4.5 * np.sqrt(2) * relative * expected.max()
    inside = expected > 0
    assert (np.abs(off) / expected).where(inside).max() < 4.5 * np.sqrt(2) * relative
    assert dataset["sigma_spin"].sel(reference_error_scale=0.0, satellite_error_scale=0.0) < 1e-6


@pytest.mark.slow
def test_the_scatter_has_no_bias_and_the_width_of_table_1(results):
    dataset = results("scatter").isel(model=0)
    estimate = dataset["estimate"].sel(component=SPIN)
    assert estimate.sizes == {"sample": 10_000, "component": 3}
    assert np.abs(estimate.mean("sample") - 1.0).max() < 4 * 0.7 / np.sqrt(10_000)
    assert estimate.std("sample").mean() == pytest.approx(0.61, abs=3 * 0.062 * 0.61)  # 6 % from catalogue to catalogue
    rms = np.sqrt(((estimate - 1.0) ** 2).mean("sample"))
    np.testing.assert_allclose(rms, dataset["sigma"].sel(component=SPIN), rtol=1e-10)


@pytest.mark.slow
def test_aberration_leaks_on_an_uneven_sky_and_not_when_it_is_solved_for(results):
    gaia = results("aberration").sel(model="gaia", component=SPIN)

    def bias(**at):
        one = gaia.sel(at)
        size = np.sqrt((one["bias"] ** 2).sum("component")).item()
        return size, np.sqrt((one["sigma"] ** 2 / one["n_sim_done"]).sum("component")).item()

    uniform, error = bias(v_max=20, aberration=True, sky_contrast=0.0, solve_glide=False)
    assert uniform < 0.03e-3 + 4 * error  # leaks of single catalogues are random: sigma grows, not the bias
    uneven, error = bias(v_max=20, aberration=True, sky_contrast=0.5, solve_glide=False)
    assert uneven > 0.5e-3  # mas/yr, of a glide of 4 uas/yr
    solved, error = bias(v_max=20, aberration=True, sky_contrast=0.5, solve_glide=True)
    assert solved < 4 * error


@pytest.mark.slow
def test_aberration_does_not_touch_amex(results):
    one = results("aberration").sel(model="amex", v_max=[14, 15, 16, 17], sky_contrast=0.0, solve_glide=False)
    with_it, without = one["sigma_spin"].sel(aberration=True), one["sigma_spin"].sel(aberration=False)
    assert np.abs(with_it / without - 1).max() < 4 * np.sqrt(2) / np.sqrt(2 * 3 * 1000) + 0.05


@pytest.mark.slow
def test_all_quasars_of_the_sky_would_help_gaia(results):
    predicted = results("completeness")["sigma_spin_predicted"]
    gain = predicted.sel(counts="catalogue") / predicted.sel(counts="completed")
    assert gain.sel(v_max=15) == pytest.approx(1.0, abs=0.1)
    assert 3.5 < gain.sel(v_max=20) < 4.5
    assert np.all(np.diff(gain) > -0.05)


@pytest.mark.slow
def test_more_objects_do_not_beat_zonal_errors(results):
    """sigma^2 of the spin levels out at 3 C_1 z^2/(8 pi), the variance of the rotation in the field."""
    predicted = results("zonal-errors")["sigma_spin_predicted"]
    for length in predicted["zonal_length"].values:
        degrees = np.arange(1, 200)
        power = np.exp(-degrees * (degrees + 1) * np.radians(length) ** 2 / 2)
        first = power[0] / np.sum((2 * degrees + 1) / (4 * np.pi) * power)
        own = 1.5 * 0.1**2 / 3000
        expected = np.sqrt(own + 3 * first / (8 * np.pi) * 0.01**2)
        assert predicted.sel(zonal_length=length, n_obj=3000) == pytest.approx(expected, rel=0.03)
        assert predicted.sel(zonal_length=length, n_obj=30) == pytest.approx(0.1 * np.sqrt(1.5 / 30), rel=0.2)


@pytest.mark.slow
def test_every_study_agrees_with_its_prediction(results):
    for name in ("radio-stars", "galaxies", "sqrt-n", "mission-length", "error-surface", "completeness"):
        dataset = results(name)
        error = dataset["sigma_spin_mc_error"].where(dataset["sigma_spin_predicted"] > 0)
        off = np.abs(dataset["sigma_spin"] - dataset["sigma_spin_predicted"]) / error
        # 4.5 of the errors; for the radio stars, whose catalogues differ much, sigma/sqrt(2 n) is a little small
        assert off.max() < (6 if name == "radio-stars" else 4.5), name


@pytest.mark.slow
def test_the_real_gaia_approaches_the_paper_and_goes_beyond(results):
    predicted = results("gaia-releases")["sigma_spin_predicted"].sel(v_max=20)
    dr3, dr4, dr5 = (predicted.sel(model=f"gaia-dr{n}").item() for n in (3, 4, 5))
    assert dr3 / dr4 == pytest.approx((60 / 34) ** 1.5, rel=0.1)  # proper motions go as T^-3/2
    assert dr4 / dr5 == pytest.approx((120 / 60) ** 1.5, rel=0.1)
    assert dr5 < predicted.sel(model="gaia") < dr3
