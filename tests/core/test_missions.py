"""The accuracy curves against numbers that did not make them."""

import numpy as np
import pytest

from linksweep.core.catalogue import Sky
from linksweep.core.catalogues import quasars
from linksweep.core.frames import triad
from linksweep.core.missions import MISSIONS, PyGaia

TABLE_1_AMEX = {14: 0.65, 14.5: 0.63, 15: 0.61, 15.5: 0.60, 16: 0.58, 16.5: 0.58, 17: 0.57}
TABLE_1_GAIA = {
    14: 1.7e-3, 14.5: 1.5e-3, 15: 1.2e-3, 15.5: 1.1e-3, 16: 9.4e-4, 16.5: 8.3e-4, 17: 7.4e-4, 17.5: 6.8e-4,
    18: 6.3e-4, 18.5: 6.0e-4, 19: 5.8e-4, 19.5: 5.7e-4, 20: 5.7e-4,
}  # fmt: skip


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


@pytest.mark.parametrize("name", [n for n, m in MISSIONS.items() if not isinstance(m.curve_pm_mas_yr, PyGaia)])
def test_mission_length(name):
    mission, v_mag = MISSIONS[name], np.array([10.0, 14.0, 19.0])
    length = 1.5 * mission.nominal_length_yr
    pos, pm = mission.sigma_pos_mas(v_mag), mission.sigma_pm_mas_yr(v_mag)
    np.testing.assert_allclose(mission.sigma_pos_mas(v_mag, length), pos / np.sqrt(1.5), rtol=1e-12)
    np.testing.assert_allclose(mission.sigma_pm_mas_yr(v_mag, length), pm / np.sqrt(1.5**3), rtol=1e-12)
    np.testing.assert_allclose(mission.sigma_pm_mas_yr(v_mag, mission.nominal_length_yr), pm, rtol=1e-15)
