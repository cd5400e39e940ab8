"""The quasar counts, their completeness, and catalogues drawn from them."""

import re

import numpy as np
import pytest
from scipy import stats

from linksweep.core.catalogue import Sky
from linksweep.core.catalogues import BRIGHTEST_MAG, COUNT, V_MAX, completeness, quasar_count, quasars
from linksweep.core.experiment import link, scenario

TABLE_1 = {
    14.0: 28, 14.5: 49, 15.0: 88, 15.5: 163, 16.0: 315, 16.5: 624, 17.0: 1156, 17.5: 2056, 18.0: 3453, 18.5: 5542,
    19.0: 8095, 19.5: 11442, 20.0: 15533,
}  # fmt: skip
ALL_SKY = Sky()
P_VALUE = 1e-3  # of a Kolmogorov-Smirnov test with a fixed seed


def drawn(seed, v_max, completed=False, sky=ALL_SKY):
    return quasars(np.random.default_rng(seed), v_max, sky, completed)


def columns(catalogue):
    return np.stack([catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec, catalogue.v_mag])


def is_log_linear(v_mag, bright, faint, low, high):
    """Whether ranks between low and high at the magnitudes between bright and faint are uniform: log N linear in V."""
    rank = low * (high / low) ** ((v_mag - bright) / (faint - bright))
    return stats.kstest((rank - low) / (high - low), "uniform").pvalue > P_VALUE


@pytest.mark.parametrize(("v_max", "n_obj"), TABLE_1.items())
def test_counts_are_those_of_table_1(v_max, n_obj):
    assert quasar_count(v_max) == n_obj
    catalogue = drawn(1, v_max)
    assert len(catalogue) == n_obj
    assert BRIGHTEST_MAG <= catalogue.v_mag.min() <= catalogue.v_mag.max() <= v_max
    assert not np.any([catalogue.pmra, catalogue.pmdec])


def test_count_is_log_linear_between_and_below_the_half_magnitudes():
    assert quasar_count(16.25) == round(np.sqrt(315 * 624))
    assert quasar_count(13.5) == round(28 * 28 / 49)
    assert quasar_count(BRIGHTEST_MAG) == round(28 * (28 / 49) ** 2.4)
    counts = [quasar_count(v) for v in np.linspace(12.8, 20.0, 200)]
    assert np.all(np.diff(counts) >= 0)


@pytest.mark.parametrize("v_max", [12.7, 20.01, np.nan, np.inf])
@pytest.mark.parametrize("completed", [False, True])
@pytest.mark.parametrize(
    "function", [quasar_count, lambda *of: quasars(np.random.default_rng(1), of[0], ALL_SKY, of[1])]
)
def test_v_max_outside_the_counts(function, v_max, completed):
    with pytest.raises(ValueError, match=re.escape(f"v_max = {v_max:g} mag is outside the quasar counts")):
        function(v_max, completed)


@pytest.mark.parametrize("sky", [ALL_SKY, Sky(0.3, 0.5)])
@pytest.mark.parametrize("completed", [False, True])
@pytest.mark.parametrize("fainter", [14.5, 16.3, 18.0, 20.0])
def test_catalogues_are_nested(fainter, completed, sky):
    long = columns(drawn(2, fainter, completed, sky))
    for brighter in filter(fainter.__gt__, V_MAX):
        short = columns(drawn(2, brighter, completed, sky))
        np.testing.assert_array_equal(long[:, : short.shape[1]], short)
        assert long[4, short.shape[1] :].min() >= brighter


def test_magnitudes_follow_the_counts_within_each_bin():
    v_mag = drawn(3, 20.0).v_mag
    for k in range(1, len(COUNT)):
        low, high = COUNT[k - 1], COUNT[k]
        assert is_log_linear(v_mag[low:high], V_MAX[k - 1], V_MAX[k], low, high)
    assert stats.kstest((v_mag[5542:8095] - 18.5) / 0.5, "uniform").pvalue < P_VALUE  # not uniform in V


def test_seven_stand_at_the_brightest_magnitude_and_the_others_follow_the_first_slope():
    v_mag = np.stack([drawn(seed, 14.0).v_mag for seed in range(200)])
    assert np.all(np.sum(v_mag == BRIGHTEST_MAG, axis=1) == 7)  # 28 (28/49)^2.4 is 7.3
    np.testing.assert_array_equal(drawn(1, BRIGHTEST_MAG).v_mag, np.full(7, BRIGHTEST_MAG))
    assert is_log_linear(v_mag[v_mag > BRIGHTEST_MAG], BRIGHTEST_MAG, 14.0, 7, 28)


@pytest.mark.parametrize(("v_max", "fraction"), [(16.5, 0.57), (19.0, 0.054)])
def test_completed_counts_are_those_of_the_paper_over_its_completeness(v_max, fraction):
    assert completeness(v_max) == pytest.approx(fraction, rel=1e-12)
    assert quasar_count(v_max, completed=True) == round(TABLE_1[v_max] / fraction)
    assert len(drawn(1, v_max, completed=True)) == round(TABLE_1[v_max] / fraction)


def test_completeness_is_log_linear_and_one_at_the_bright_end():
    assert completeness(17.75) == pytest.approx(np.sqrt(0.57 * 0.054), rel=1e-12)
    v_mag = np.linspace(12.8, 20.0, 500)
    fraction = np.array([completeness(v) for v in v_mag])
    knee = 16.5 - 2.5 * np.log(0.57) / np.log(0.054 / 0.57)
    assert np.all(fraction[v_mag < knee] == 1.0)
    assert np.all(np.diff(fraction[v_mag > knee]) < 0.0)
    assert knee == pytest.approx(15.9, abs=0.01)


def test_n_obj_draws_that_many_different_quasars():
    point = link.defaults() | {"catalogue": "quasars", "v_max": 17.0, "n_obj": 400}
    chosen = columns(scenario(point).draw_catalogue(np.random.default_rng(5)))
    everything = columns(drawn(5, 17.0))
    index = np.flatnonzero(np.isin(everything[0], chosen[0]))
    assert len(index) == 400
    np.testing.assert_array_equal(chosen, everything[:, index])
    assert stats.kstest(index / 1156, "uniform").pvalue > P_VALUE  # from all of them, not the brightest


def test_default_limit_is_the_end_of_the_counts():
    point = link.defaults() | {"catalogue": "quasars"}
    assert len(scenario(point).draw_catalogue(np.random.default_rng(6))) == 15533
