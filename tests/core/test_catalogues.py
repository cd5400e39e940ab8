"""Skies and the catalogues that laws and lists give: synthetic objects, quasars, galaxies, radio stars."""

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from scipy import stats

from tests.core.points import DEGREE, MAS, drawn, triad
from tests.tiers import slow

P_VALUE = 1e-3  # of a Kolmogorov-Smirnov or chi-square test with a fixed seed
COUNTS = 28, 49, 88, 163, 315, 624, 1156, 2056, 3453, 5542, 8095, 11442, 15533
TABLE_1 = {14.0 + 0.5 * k: n for k, n in enumerate(COUNTS)}
BRIGHTEST = 12.8
LAWS = {"uniform": stats.uniform(0.0, 2.0), "rayleigh": stats.rayleigh(scale=np.sqrt(2.0 / np.pi))}
BETWEEN = [(None, 16.25, round(np.sqrt(315 * 624))), (None, 13.5, round(28 * 28 / 49)), (None, None, 15533)]
BETWEEN += [(14.0, 15.0, 88 - 28), (14.5, 15.0, 88 - 49), (5.0, 15.0, 88)]


def columns(catalogue):
    return np.stack([catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec, catalogue.v_mag])


def rows(catalogue):
    return np.column_stack([columns(catalogue)[2:].T, catalogue.errors.sigma])


@pytest.mark.parametrize("kind", ["synthetic", "quasars", "galaxies", "radio-stars"])
def test_positions_are_isotropic(kind):
    catalogue = drawn(7, catalogue=kind, n_obj=15_000)
    ra, r = catalogue.ra, triad(catalogue.ra, catalogue.dec).r
    assert np.all((ra >= 0.0) & (ra < 2.0 * np.pi))
    assert stats.kstest(ra / (2.0 * np.pi), "uniform").pvalue > P_VALUE
    assert stats.kstest((r[2] + 1.0) / 2.0, "uniform").pvalue > P_VALUE
    assert np.all(np.abs(r.mean(axis=1)) < 4 / np.sqrt(3 * 15_000))  # each component has variance 1/3
    assert np.all(np.abs(r @ r.T / 15_000 - np.eye(3) / 3) < 4 * np.sqrt(4 / 45 / 15_000))  # variance of r_x^2


@pytest.mark.parametrize(("zone_deg", "contrast"), [(0.0, 0.5), (20.0, 0.0), (20.0, -0.8), (60.0, 0.3)])
def test_uneven_skies_have_their_fractions_and_are_uniform_on_each_side(zone_deg, contrast):
    n_obj, edge = 20_000, np.sin(zone_deg * DEGREE)
    objects = drawn(9, n_obj=n_obj, zone_of_avoidance=zone_deg, sky_contrast=contrast)
    galactic = SkyCoord(objects.ra, objects.dec, unit="rad").galactic
    sin_b = np.sin(galactic.b.rad)
    share = (1.0 + contrast) / 2.0
    assert abs(np.mean(sin_b > 0.0) - share) < 4 * np.sqrt(share * (1.0 - share) / n_obj)  # binomial
    for side in (sin_b > 0.0, sin_b < 0.0):
        assert stats.kstest((np.abs(sin_b[side]) - edge) / (1.0 - edge), "uniform").pvalue > P_VALUE
        assert stats.kstest(galactic.l.rad[side] / (2.0 * np.pi), "uniform").pvalue > P_VALUE


@pytest.mark.parametrize(("distribution", "law"), LAWS.items())
def test_synthetic_magnitudes_and_proper_motions(distribution, law):
    n_obj, mean = 20_000, 500.0
    sky = drawn(8, n_obj=n_obj, v_min=6.0, v_max=13.0, mean_pm=mean, pm_distribution=distribution)
    assert stats.kstest((sky.v_mag - 6.0) / 7.0, "uniform").pvalue > P_VALUE
    modulus = np.hypot(sky.pmra, sky.pmdec) / (mean * MAS)
    assert law.mean() == pytest.approx(1.0)
    assert stats.kstest(modulus, law.cdf).pvalue > P_VALUE
    assert abs(modulus.mean() - 1.0) < 4 * law.std() / np.sqrt(n_obj)
    direction = np.arctan2(sky.pmra, sky.pmdec) % (2.0 * np.pi)
    assert stats.kstest(direction / (2.0 * np.pi), "uniform").pvalue > P_VALUE
    assert abs(stats.spearmanr(modulus, sky.dec).statistic) < 4 / np.sqrt(n_obj)


@pytest.mark.parametrize(("v_min", "v_max"), [(None, 11.5), (None, 13.5), (12.5, 13.0)])
def test_galaxy_magnitudes_are_a_truncated_normal(v_min, v_max):
    sky = drawn(11, catalogue="galaxies", n_obj=20_000, v_min=v_min, v_max=v_max)
    low = -np.inf if v_min is None else (v_min - 12.5) / 0.5
    assert stats.kstest(sky.v_mag, stats.truncnorm(low, (v_max - 12.5) / 0.5, 12.5, 0.5).cdf).pvalue > P_VALUE
    assert sky.v_mag.max() <= v_max
    assert not np.any([sky.pmra, sky.pmdec])
    assert len(drawn(5, catalogue="galaxies", v_min=v_min)) == 116


def test_radio_stars_are_those_of_the_table_drawn_with_replacement_and_whole():
    stars = drawn(catalogue="radio-stars", n_obj=22_000, positions="own")
    corona = int(np.argmin(stars.pmra))
    expected = [243.6711 * DEGREE, 33.8589 * DEGREE, -267.048 * MAS, -86.66 * MAS, 5.23]
    np.testing.assert_allclose(columns(stars)[:, corona], expected, rtol=1e-14)
    np.testing.assert_allclose(stars.errors.sigma[corona], np.array([0.0, 0.0, 0.037, 0.05]) * MAS, rtol=1e-14)
    assert stars.v_mag.min() == 2.12  # Algol
    each, which = np.unique(rows(stars), axis=0, return_inverse=True)
    assert len(each) == len(drawn(catalogue="radio-stars")) == 11
    assert stats.chisquare(np.bincount(which.ravel())).pvalue > P_VALUE
    assert abs(stats.spearmanr(which.ravel()[1:], which.ravel()[:-1]).statistic) < 4 / np.sqrt(22_000)
    elsewhere = drawn(catalogue="radio-stars", n_obj=1000)  # at random positions, each still as a whole
    np.testing.assert_array_equal(np.unique(rows(elsewhere), axis=0), each)


def quasars(seed, v_max, **changes):
    return drawn(seed, catalogue="quasars", v_max=v_max, **changes)


def is_log_linear(v_mag, bright, faint, low, high):
    """Whether ranks between low and high at the magnitudes between bright and faint are uniform: log N linear in V."""
    rank = low * (high / low) ** ((v_mag - bright) / (faint - bright))
    return stats.kstest((rank - low) / (high - low), "uniform").pvalue > P_VALUE


@pytest.mark.parametrize(("v_min", "v_max", "n_obj"), [*((None, v_max, n) for v_max, n in TABLE_1.items()), *BETWEEN])
def test_counts_are_those_of_table_1_and_log_linear_between(v_min, v_max, n_obj):
    sky = quasars(1, v_max, v_min=v_min)
    assert len(sky) == n_obj
    assert max(BRIGHTEST, v_min or 0.0) <= sky.v_mag.min() <= sky.v_mag.max() <= (v_max or 20.0)
    assert not np.any([sky.pmra, sky.pmdec])


@pytest.mark.parametrize("sky", [{}, {"zone_of_avoidance": 17.0, "sky_contrast": 0.5}])
@pytest.mark.parametrize("counts", ["catalogue", "completed"])
@pytest.mark.parametrize("fainter", [16.3, slow(20.0)])
def test_catalogues_are_nested(fainter, counts, sky):
    long = columns(quasars(2, fainter, counts=counts, **sky))
    for brighter in filter(fainter.__gt__, TABLE_1):
        short = columns(quasars(2, brighter, counts=counts, **sky))
        np.testing.assert_array_equal(long[:, : short.shape[1]], short)
        assert long[4, short.shape[1] :].min() >= brighter


def test_magnitudes_follow_the_counts_within_each_bin_and_seven_stand_at_the_brightest():
    v_mag, limits, counts = quasars(3, 20.0).v_mag, list(TABLE_1), list(TABLE_1.values())
    for k in range(1, len(counts)):
        low, high = counts[k - 1], counts[k]
        assert is_log_linear(v_mag[low:high], limits[k - 1], limits[k], low, high)
    above = np.concatenate([quasars(seed, 14.5, v_min=14.2).v_mag for seed in range(400)])  # a limit inside a bin
    assert is_log_linear(above, 14.2, 14.5, 28 * (49 / 28) ** ((14.2 - 14.0) / 0.5), 49)
    assert stats.kstest((v_mag[5542:8095] - 18.5) / 0.5, "uniform").pvalue < P_VALUE  # not uniform in V
    v_mag = np.stack([quasars(seed, 14.0).v_mag for seed in range(200)])
    assert np.all(np.sum(v_mag == BRIGHTEST, axis=1) == 7)  # 28 (28/49)^2.4 is 7.3
    np.testing.assert_array_equal(quasars(1, BRIGHTEST).v_mag, np.full(7, BRIGHTEST))
    assert is_log_linear(v_mag[v_mag > BRIGHTEST], BRIGHTEST, 14.0, 7, 28)


@pytest.mark.parametrize(("v_max", "fraction"), [(16.5, 0.57), (19.0, 0.054), (17.5, None)])
def test_completed_counts_are_those_of_the_paper_over_its_completeness(v_max, fraction):
    """Log-linear through the two values of the paper, and 1 at the bright end."""
    slope = np.log(0.054 / 0.57) / (19.0 - 16.5)
    whole = fraction or 0.57 * np.exp(slope * (v_max - 16.5))
    assert len(quasars(1, v_max, counts="completed")) == round(TABLE_1[v_max] / whole)
    assert len(quasars(1, 15.5, counts="completed")) == TABLE_1[15.5]


def test_n_obj_draws_that_many_different_quasars():
    chosen, everything = columns(quasars(5, 17.0, n_obj=400)), columns(quasars(5, 17.0))
    index = np.flatnonzero(np.isin(everything[0], chosen[0]))
    assert len(index) == 400
    np.testing.assert_array_equal(chosen, everything[:, index])
    assert stats.kstest(index / 1156, "uniform").pvalue > P_VALUE  # from all of them, not the brightest
