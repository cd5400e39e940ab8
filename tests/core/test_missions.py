"""The accuracy curves against numbers that did not make them."""

import numpy as np
import pytest

from linksweep.core.catalogue import Sky
from linksweep.core.catalogues import quasars
from linksweep.core.frames import triad
from linksweep.core.missions import MISSIONS, Exponentials, LogLinear, PyGaia

TABLE_1_AMEX = {14: 0.65, 14.5: 0.63, 15: 0.61, 15.5: 0.60, 16: 0.58, 16.5: 0.58, 17: 0.57}
TABLE_1_GAIA = {
    14: 1.7e-3, 14.5: 1.5e-3, 15: 1.2e-3, 15.5: 1.1e-3, 16: 9.4e-4, 16.5: 8.3e-4, 17: 7.4e-4, 17.5: 6.8e-4,
    18: 6.3e-4, 18.5: 6.0e-4, 19: 5.8e-4, 19.5: 5.7e-4, 20: 5.7e-4,
}  # fmt: skip
GAIA_2001_PM_UAS = [3, 3, 3, 4, 5, 8, 13, 20, 34, 60, 120, 380]
GAIA_2001_POS_UAS = [3, 3, 3, 4, 6, 9, 15, 23, 39, 70, 140, 440]


def predicted_spin_error(mission, v_max):
    """The RMS over 100 catalogues of quasars of the closed-form error of one component of the spin."""
    variances = []
    for seed in range(100):
        catalogue = quasars(np.random.default_rng(seed), v_max, Sky())
        p, q, _ = triad(catalogue.ra, catalogue.dec)
        weight = MISSIONS[mission].sigma_pm_mas_yr(catalogue.v_mag) ** -2.0
        variances.append(np.trace(np.linalg.inv((p * weight) @ p.T + (q * weight) @ q.T)) / 3.0)
    return np.sqrt(np.mean(variances))


@pytest.mark.parametrize(("v_max", "published"), TABLE_1_AMEX.items())
def test_amex_reproduces_table_1(v_max, published):
    assert abs(predicted_spin_error("amex", v_max) - published) < 0.02  # residual of the fit that made the curve


@pytest.mark.parametrize(("v_max", "published"), TABLE_1_GAIA.items())
def test_gaia_reproduces_table_1(v_max, published):
    assert predicted_spin_error("gaia", v_max) == pytest.approx(
        published, rel=0.065
    )  # the fit leaves 6 %, the sample 0.3 %


def test_amex_is_a_quarter_better_than_the_published_accuracy_of_diva():
    """DIVA: 0.25 mas/yr and 0.15 mas at V = 9; the fitted curve gives 0.18 and 0.11, as docs/calibration.md says."""
    amex = MISSIONS["amex"]
    assert amex.sigma_pm_mas_yr(np.array(9.0)) / 0.25 == pytest.approx(0.72, abs=0.01)
    assert amex.sigma_pos_mas(np.array(9.0)) / 0.15 == pytest.approx(0.72, abs=0.01)


def test_values_of_the_exponential_curves():
    v_mag = np.array([9.0, 15.0])
    amex = [0.139 + 14.2 * np.exp(-0.973 * 6), 0.139 * np.exp(0.215 * 6) + 14.2]
    np.testing.assert_allclose(MISSIONS["amex"].sigma_pm_mas_yr(v_mag), amex, rtol=1e-12)
    gaia = [0.003, 0.01496]  # the floor, and the curve
    np.testing.assert_allclose(MISSIONS["gaia"].sigma_pm_mas_yr(v_mag), gaia, rtol=1e-12)


@pytest.mark.parametrize(("name", "ratio_yr"), [("amex", 0.60), ("gaia", 1.15)])
def test_positions_are_a_fixed_time_of_the_motions(name, ratio_yr):
    v_mag = np.linspace(12.0, 20.0, 31)
    mission = MISSIONS[name]
    np.testing.assert_allclose(mission.sigma_pos_mas(v_mag), ratio_yr * mission.sigma_pm_mas_yr(v_mag), rtol=1e-12)


def test_gaia_2001_table_at_whole_magnitudes():
    g_mag = np.arange(10.0, 22.0)
    mission = MISSIONS["gaia-2001"]
    np.testing.assert_allclose(1000.0 * mission.sigma_pm_mas_yr(g_mag), GAIA_2001_PM_UAS, rtol=1e-12)
    np.testing.assert_allclose(1000.0 * mission.sigma_pos_mas(g_mag), GAIA_2001_POS_UAS, rtol=1e-12)


def test_gaia_2001_is_log_linear_between_and_constant_above():
    mission = MISSIONS["gaia-2001"]
    halfway = 1000.0 * mission.sigma_pm_mas_yr(np.array([19.5, 20.5]))
    np.testing.assert_allclose(halfway, np.sqrt([60 * 120, 120 * 380]), rtol=1e-12)
    assert 1000.0 * mission.sigma_pm_mas_yr(np.array(6.0)) == pytest.approx(3.0)
    assert mission.faint_limit_mag == 21.0


@pytest.mark.parametrize("name", [n for n, m in MISSIONS.items() if not isinstance(m.curve_pm_mas_yr, PyGaia)])
def test_mission_length(name):
    mission, v_mag = MISSIONS[name], np.array([10.0, 14.0, 19.0])
    length = 1.5 * mission.nominal_length_yr
    pos, pm = mission.sigma_pos_mas(v_mag), mission.sigma_pm_mas_yr(v_mag)
    np.testing.assert_allclose(mission.sigma_pos_mas(v_mag, length), pos / np.sqrt(1.5), rtol=1e-12)
    np.testing.assert_allclose(mission.sigma_pm_mas_yr(v_mag, length), pm / np.sqrt(1.5**3), rtol=1e-12)
    np.testing.assert_allclose(mission.sigma_pm_mas_yr(v_mag, mission.nominal_length_yr), pm, rtol=1e-15)


def test_nominal_lengths():
    months = {"amex": 24, "gaia": 60, "gaia-2001": 60, "gaia-dr3": 34, "gaia-dr4": 60, "gaia-dr5": 120}
    lengths = {name: 12 * mission.nominal_length_yr for name, mission in MISSIONS.items()}
    assert lengths == pytest.approx(months, rel=1e-12)


@pytest.mark.parametrize("curve", [Exponentials(((2.0, 0.0, 9.0),)), LogLinear((5.0, 6.0), (2.0, 2.0))])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_curves_keep_the_shape(curve, shape):
    np.testing.assert_allclose(curve(np.full(shape, 5.5)), np.full(shape, 2.0), rtol=1e-15)


def test_every_mission_says_where_it_comes_from():
    assert all(mission.source for mission in MISSIONS.values())
    with pytest.raises(TypeError):
        MISSIONS["another"] = MISSIONS["amex"]


def test_curves_side_by_side_include_the_faint_limit_and_nothing_beyond():
    mission = MISSIONS["gaia-2001"]
    pos, pm = mission.sigmas_to_limit(np.array([20.9, 21.0, np.nextafter(21.0, 30.0)]))
    np.testing.assert_array_equal(np.isnan(pm), [False, False, True])
    assert pos[1] == mission.sigma_pos_mas(np.array([21.0]))[0]
