"""Synthetic skies and the quasar counts."""

import re

import numpy as np
import pytest
from scipy import stats

from core.catalogue import (
    QUASAR_BRIGHTEST_MAG,
    QUASAR_COUNT,
    QUASAR_V_MAX,
    isotropic_positions,
    quasar_count,
    quasars,
    synthetic,
)
from core.constants import DEGREE, MAS
from core.experiment import link, scenario
from core.frames import triad

TABLE_1 = {
    14.0: 28, 14.5: 49, 15.0: 88, 15.5: 163, 16.0: 315, 16.5: 624, 17.0: 1156, 17.5: 2056, 18.0: 3453, 18.5: 5542,
    19.0: 8095, 19.5: 11442, 20.0: 15533,
}  # fmt: skip
P_VALUE = 1e-3  # of a Kolmogorov-Smirnov test with a fixed seed


def columns(catalogue):
    return np.stack([catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec, catalogue.v_mag])


@pytest.mark.parametrize(("v_max", "n_obj"), TABLE_1.items())
def test_quasar_counts_are_those_of_table_1(v_max, n_obj):
    assert quasar_count(v_max) == n_obj
    catalogue = quasars(np.random.default_rng(1), v_max)
    assert len(catalogue) == n_obj
    assert QUASAR_BRIGHTEST_MAG <= catalogue.v_mag.min() <= catalogue.v_mag.max() <= v_max
    assert not np.any([catalogue.pmra, catalogue.pmdec])


def test_quasar_count_is_log_linear_between_and_below_the_half_magnitudes():
    assert quasar_count(16.25) == round(np.sqrt(315 * 624))
    assert quasar_count(13.5) == round(28 * 28 / 49)
    assert quasar_count(QUASAR_BRIGHTEST_MAG) == round(28 * (28 / 49) ** 2.4)
    counts = [quasar_count(v) for v in np.linspace(12.8, 20.0, 200)]
    assert np.all(np.diff(counts) >= 0)


@pytest.mark.parametrize("v_max", [12.7, 20.01, np.nan, np.inf])
@pytest.mark.parametrize("function", [quasar_count, lambda v_max: quasars(np.random.default_rng(1), v_max)])
def test_v_max_outside_the_counts(function, v_max):
    with pytest.raises(ValueError, match=re.escape(f"v_max = {v_max:g} mag is outside the quasar counts")):
        function(v_max)


@pytest.mark.parametrize("fainter", [14.5, 16.3, 20.0])
def test_quasar_catalogues_are_nested(fainter):
    long = columns(quasars(np.random.default_rng(2), fainter))
    for brighter in filter(fainter.__gt__, QUASAR_V_MAX):
        short = columns(quasars(np.random.default_rng(2), brighter))
        np.testing.assert_array_equal(long[:, : short.shape[1]], short)
        assert long[4, short.shape[1] :].min() >= brighter


def test_magnitudes_follow_the_counts_within_each_bin():
    catalogue = quasars(np.random.default_rng(3), 20.0)
    for k in range(1, len(QUASAR_COUNT)):
        low, high = QUASAR_COUNT[k - 1], QUASAR_COUNT[k]
        rank = low * (high / low) ** ((catalogue.v_mag[low:high] - QUASAR_V_MAX[k - 1]) / 0.5)  # log N linear in V
        assert stats.kstest((rank - low) / (high - low), "uniform").pvalue > P_VALUE
    assert stats.kstest((catalogue.v_mag[5542:8095] - 18.5) / 0.5, "uniform").pvalue < P_VALUE  # not uniform in V


def test_magnitudes_of_the_brightest_bin_are_clipped():
    v_mag = np.concatenate([quasars(np.random.default_rng(seed), 14.0).v_mag for seed in range(200)])
    expected = (28 / 49) ** 2.4  # the share that the first slope puts above 12.8
    clipped = np.mean(v_mag == QUASAR_BRIGHTEST_MAG)
    assert abs(clipped - expected) < 4 * np.sqrt(expected * (1 - expected) / len(v_mag))  # binomial
    share = (49 / 28) ** ((v_mag[v_mag > QUASAR_BRIGHTEST_MAG] - 14.0) / 0.5)
    assert stats.kstest((share - expected) / (1 - expected), "uniform").pvalue > P_VALUE


def test_v_max_between_half_magnitudes_cuts_the_last_bin():
    v_mag = quasars(np.random.default_rng(4), 18.3).v_mag
    last = v_mag[3453:]
    assert len(v_mag) == round(3453 * (5542 / 3453) ** 0.6)
    rank = 3453 * (5542 / 3453) ** ((last - 18.0) / 0.5)
    assert stats.kstest((rank - 3453) / (len(v_mag) - 3453), "uniform").pvalue > P_VALUE


def test_no_quasar_is_fainter_than_the_limit_where_the_count_is_rounded_up():
    assert quasar_count(13.3) == 13  # of 12.8
    assert max(quasars(np.random.default_rng(seed), 13.3).v_mag.max() for seed in range(50)) == 13.3


def test_n_obj_draws_that_many_different_quasars():
    point = link.defaults() | {"catalogue": "quasars", "v_max": 17.0, "n_obj": 400}
    drawn = columns(scenario(point).draw_catalogue(np.random.default_rng(5)))
    everything = columns(quasars(np.random.default_rng(5), 17.0))
    index = np.flatnonzero(np.isin(everything[0], drawn[0]))
    assert len(index) == 400
    np.testing.assert_array_equal(drawn, everything[:, index])
    assert stats.kstest(index / 1156, "uniform").pvalue > P_VALUE  # from all of them, not the brightest


def test_n_obj_of_all_quasars_is_the_whole_catalogue():
    point = link.defaults() | {"catalogue": "quasars", "v_max": 15.0}
    whole, drawn = (scenario(point | {"n_obj": n}).draw_catalogue(np.random.default_rng(6)) for n in (None, 88))
    np.testing.assert_array_equal(columns(whole), columns(drawn))


@pytest.mark.parametrize("draw", [lambda rng: quasars(rng, 20.0), lambda rng: synthetic(rng, 15_000, 5.0, 15.0)])
def test_positions_are_isotropic(draw):
    catalogue = draw(np.random.default_rng(7))
    assert np.all((catalogue.ra >= 0.0) & (catalogue.ra < 2.0 * np.pi))
    assert stats.kstest(catalogue.ra / (2.0 * np.pi), "uniform").pvalue > P_VALUE
    assert stats.kstest((np.sin(catalogue.dec) + 1.0) / 2.0, "uniform").pvalue > P_VALUE
    r = triad(catalogue.ra, catalogue.dec).r
    n = len(catalogue)
    assert np.all(np.abs(r.mean(axis=1)) < 4 / np.sqrt(3 * n))  # each component has variance 1/3
    assert np.all(np.abs(r @ r.T / n - np.eye(3) / 3) < 4 * np.sqrt(4 / 45 / n))  # variance of r_x^2


def test_synthetic_magnitudes_and_proper_motions():
    n_obj, mean = 20_000, 500.0 * MAS
    catalogue = synthetic(np.random.default_rng(8), n_obj, 6.0, 13.0, mean)
    assert stats.kstest((catalogue.v_mag - 6.0) / 7.0, "uniform").pvalue > P_VALUE
    modulus = np.hypot(catalogue.pmra, catalogue.pmdec)
    assert stats.kstest(modulus / (2.0 * mean), "uniform").pvalue > P_VALUE
    assert abs(modulus.mean() - mean) < 4 * mean / np.sqrt(3 * n_obj)  # uniform between 0 and twice the mean
    direction = np.arctan2(catalogue.pmra, catalogue.pmdec) % (2.0 * np.pi)
    assert stats.kstest(direction / (2.0 * np.pi), "uniform").pvalue > P_VALUE
    assert abs(stats.spearmanr(modulus, catalogue.dec).statistic) < 4 / np.sqrt(n_obj)


def test_synthetic_objects_stand_still_by_default():
    catalogue = synthetic(np.random.default_rng(9), 10, 5.0, 15.0)
    assert not np.any([catalogue.pmra, catalogue.pmdec])


def test_zone_of_avoidance_reaches_the_synthetic_catalogue():
    catalogue = synthetic(np.random.default_rng(10), 100, 5.0, 15.0, zone_of_avoidance=0.5)
    ra, dec = isotropic_positions(np.random.default_rng(10), 100, 0.5)
    np.testing.assert_array_equal([catalogue.ra, catalogue.dec], [ra, dec])
    point = link.defaults() | {"n_obj": 100, "zone_of_avoidance": 0.5 / DEGREE}
    np.testing.assert_allclose(scenario(point).draw_catalogue(np.random.default_rng(10)).dec, dec, rtol=1e-9)


def test_take_keeps_the_columns_of_an_object_together():
    catalogue = synthetic(np.random.default_rng(11), 10, 5.0, 15.0, MAS)
    index = np.array([7, 0, 7])
    np.testing.assert_array_equal(columns(catalogue.take(index)), columns(catalogue)[:, index])
    assert len(catalogue.take(index)) == 3
