"""Skies, and the catalogues that simple laws give: synthetic objects, galaxies, radio stars."""

import numpy as np
import pytest
from scipy import stats

from linksweep.core.catalogue import Catalogue, Sky
from linksweep.core.catalogues import galaxies, quasars, radio_stars, resample, synthetic
from linksweep.core.experiment import link, scenario
from linksweep.core.frames import DEGREE, GALACTIC_AXES, MAS, triad
from linksweep.core.table_catalogue import OBSERVABLES

P_VALUE = 1e-3  # of a Kolmogorov-Smirnov or chi-square test with a fixed seed
ALL_SKY = Sky()
UNEVEN = [(0.0, 0.5), (20.0, 0.0), (20.0, -0.8), (60.0, 0.3)]  # zone of avoidance in deg, contrast


def columns(catalogue):
    return np.stack([catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec, catalogue.v_mag])


def rows(catalogue):
    """What stays with an object wherever it is put: pmra, pmdec, magnitude and errors."""
    return np.vstack([columns(catalogue)[2:], catalogue.sigma]).T


def drawn(seed=1, **point):
    return scenario(link.defaults() | point).draw_catalogue(np.random.default_rng(seed))


def is_isotropic(ra, dec):
    n = len(ra)
    r = triad(ra, dec).r
    return (
        np.all((ra >= 0.0) & (ra < 2.0 * np.pi))
        and stats.kstest(ra / (2.0 * np.pi), "uniform").pvalue > P_VALUE
        and stats.kstest((np.sin(dec) + 1.0) / 2.0, "uniform").pvalue > P_VALUE
        and np.all(np.abs(r.mean(axis=1)) < 4 / np.sqrt(3 * n))  # each component has variance 1/3
        and np.all(np.abs(r @ r.T / n - np.eye(3) / 3) < 4 * np.sqrt(4 / 45 / n))  # variance of r_x^2
    )


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng: quasars(rng, 20.0, ALL_SKY),
        lambda rng: synthetic(rng, 15_000, 5.0, 15.0),
        lambda rng: galaxies(rng, 15_000, 13.5),
        lambda rng: resample(rng, radio_stars(), 15_000, ALL_SKY),
    ],
    ids=["quasars", "synthetic", "galaxies", "radio-stars"],
)
def test_positions_are_isotropic(draw):
    catalogue = draw(np.random.default_rng(7))
    assert is_isotropic(catalogue.ra, catalogue.dec)


@pytest.mark.parametrize(("zone_deg", "contrast"), UNEVEN)
def test_uneven_skies_have_their_fractions_and_are_uniform_on_each_side(zone_deg, contrast):
    n_obj = 20_000
    r = GALACTIC_AXES @ triad(*Sky(zone_deg * DEGREE, contrast).positions(np.random.default_rng(9), n_obj)).r
    north, edge = r[2] > 0.0, np.sin(zone_deg * DEGREE)
    share = (1.0 + contrast) / 2.0
    assert abs(north.mean() - share) < 4 * np.sqrt(share * (1.0 - share) / n_obj)  # binomial
    for side in (north, ~north):
        assert stats.kstest((np.abs(r[2, side]) - edge) / (1.0 - edge), "uniform").pvalue > P_VALUE
        longitude = np.arctan2(r[1, side], r[0, side]) % (2.0 * np.pi)
        assert stats.kstest(longitude / (2.0 * np.pi), "uniform").pvalue > P_VALUE


@pytest.mark.parametrize("kind", ["synthetic", "quasars", "galaxies", "radio-stars"])
def test_the_sky_reaches_every_catalogue_of_random_positions(kind):
    catalogue = drawn(10, catalogue=kind, n_obj=100, zone_of_avoidance=30.0, sky_contrast=0.9)
    sin_b = GALACTIC_AXES[2] @ triad(catalogue.ra, catalogue.dec).r
    assert np.abs(sin_b).min() > 0.5
    assert np.sum(sin_b > 0.0) > 95 - 4 * np.sqrt(95 * 0.05)  # binomial


def test_synthetic_magnitudes_and_proper_motions():
    n_obj, mean = 20_000, 500.0 * MAS
    catalogue = synthetic(np.random.default_rng(8), n_obj, 6.0, 13.0, ALL_SKY, mean)
    assert stats.kstest((catalogue.v_mag - 6.0) / 7.0, "uniform").pvalue > P_VALUE
    modulus = np.hypot(catalogue.pmra, catalogue.pmdec)
    assert stats.kstest(modulus / (2.0 * mean), "uniform").pvalue > P_VALUE
    direction = np.arctan2(catalogue.pmra, catalogue.pmdec) % (2.0 * np.pi)
    assert stats.kstest(direction / (2.0 * np.pi), "uniform").pvalue > P_VALUE
    assert abs(stats.spearmanr(modulus, catalogue.dec).statistic) < 4 / np.sqrt(n_obj)


@pytest.mark.parametrize(
    ("distribution", "law"),
    [("uniform", stats.uniform(0.0, 2.0)), ("rayleigh", stats.rayleigh(scale=np.sqrt(2.0 / np.pi)))],
)
def test_moduli_of_proper_motions_have_their_law_and_mean(distribution, law):
    n_obj, mean = 20_000, 500.0 * MAS
    catalogue = synthetic(np.random.default_rng(9), n_obj, 6.0, 13.0, ALL_SKY, mean, distribution)
    modulus = np.hypot(catalogue.pmra, catalogue.pmdec) / mean
    assert law.mean() == pytest.approx(1.0)
    assert stats.kstest(modulus, law.cdf).pvalue > P_VALUE
    assert abs(modulus.mean() - 1.0) < 4 * law.std() / np.sqrt(n_obj)


@pytest.mark.parametrize("limit", [11.5, 12.5, 13.5])
def test_galaxy_magnitudes_are_a_truncated_normal(limit):
    catalogue = galaxies(np.random.default_rng(11), 20_000, limit)
    law = stats.truncnorm(-np.inf, (limit - 12.5) / 0.5, 12.5, 0.5)
    assert stats.kstest(catalogue.v_mag, law.cdf).pvalue > P_VALUE
    assert catalogue.v_mag.max() <= limit
    assert not np.any([catalogue.pmra, catalogue.pmdec])


def test_radio_stars_are_those_of_the_table():
    stars = radio_stars()
    assert len(stars) == len(drawn(catalogue="radio-stars")) == 11
    corona = int(np.argmin(stars.pmra))
    expected = [243.6711 * DEGREE, 33.8589 * DEGREE, -267.048 * MAS, -86.66 * MAS, 5.23]
    np.testing.assert_allclose(columns(stars)[:, corona], expected, rtol=1e-14)
    np.testing.assert_allclose(stars.sigma[:, corona], np.array([0.0, 0.0, 0.037, 0.05]) * MAS, rtol=1e-14)
    assert stars.v_mag.min() == 2.12  # Algol


def test_radio_stars_are_drawn_with_replacement_and_stay_whole():
    n_obj, stars = 22_000, radio_stars()
    catalogue = resample(np.random.default_rng(12), stars, n_obj, ALL_SKY)
    which = np.argmax(catalogue.v_mag[:, None] == stars.v_mag, axis=1)
    np.testing.assert_array_equal(rows(catalogue), rows(stars)[which])
    assert stats.chisquare(np.bincount(which, minlength=11)).pvalue > P_VALUE
    assert abs(stats.spearmanr(which[1:], which[:-1]).statistic) < 4 / np.sqrt(n_obj)  # one after the other


def test_take_and_moved_to_keep_the_columns_of_an_object_together():
    plain = synthetic(np.random.default_rng(11), 10, 5.0, 15.0, ALL_SKY, MAS)
    index = np.array([7, 0, 7])
    np.testing.assert_array_equal(columns(plain.take(index)), columns(plain)[:, index])
    assert len(plain.take(index)) == 3
    number = np.arange(10.0)
    full = Catalogue(*np.tile(number, (5, 1)), np.tile(number, (4, 1)), np.tile(number[:, None, None], (4, 4)))
    taken = full.take(index)
    assert taken.sigma.shape == (len(OBSERVABLES), 3)
    np.testing.assert_array_equal(taken.sigma[3], index)
    np.testing.assert_array_equal(taken.correlation[:, 1, 2], index)
    moved = full.moved_to(-number, 2 * number)
    np.testing.assert_array_equal(columns(moved), np.stack([-number, 2 * number, number, number, number]))
    assert moved.sigma is full.sigma
