"""The cross-match: against astropy, at poles and wrap, one-to-one, merging, chance matches and every class rule."""

import astropy.units as u
import numpy as np
import pandas as pd
import pytest
from astropy.coordinates import SkyCoord, search_around_sky
from astropy.time import Time
from hypothesis import given, settings, strategies as st

from linksweep.core.frames import ARCSEC, DEGREE, MAS, MICROARCSEC
from linksweep.sweep.search import search as crossmatch
from linksweep.sweep.search.options import SearchOptions
from linksweep.sweep.search.search import GalaxyCatalogue, Positions, cross_match, pairs_within, sky_tree
from tests.tiers import examples

grid_sky = st.lists(st.tuples(st.integers(0, 12), st.integers(0, 3), st.integers(0, 4)), min_size=1, max_size=12)
MERGED = [
    # an identifier decides before the position
    ([([10.0, 10.001], 3.0, [5, 6]), ([10.001, 70.0], 3.0, [5, 6])], None, [[0, 1], [0, 1]], [5, 6]),
    ([([10.0], 3.0, [5]), ([10.0], 3.0, [6])], None, [[0], [1]], [5, 6]),
    # entries within 3" + 2" are one galaxy and share the identifier, unless a smaller radius is named
    ([([10.0, 50.0], 3.0, [0, 0]), ([50.0 + 4 / 3600, 90.0], 2.0, [7, 8])], None, [[0, 1], [1, 2]], [0, 7, 8]),
    ([([10.0, 50.0], 3.0, [0, 0]), ([50.0 + 4 / 3600, 90.0], 2.0, [7, 8])], 3.9, [[0, 1], [2, 3]], [0, 0, 7, 8]),
    # an entry gives its identifier to the galaxy at its place, and others have it too
    ([([10.0], 3.0, [0]), ([10.0 + 1 / 3600, 50.0], 3.0, [7, 7])], None, [[0], [0, 0]], [7]),
    # one without identifier links the third catalogue too
    ([([10.0], 1.0, [0]), ([10.0 + 1.5 / 3600], 1.0, [0]), ([10.0 + 3 / 3600], 1.0, [9])], None, [[0]] * 3, [9]),
]


def positions(ra_deg, dec_deg, error_arcsec=1.0):
    ra, dec = np.asarray(ra_deg, dtype=float) * DEGREE, np.asarray(dec_deg, dtype=float) * DEGREE
    error = np.full(len(ra), error_arcsec * ARCSEC)
    return Positions(ra, dec, error, error)


def sky(rng, n, error_arcsec=1.0, sines=(-1, 1)):
    return positions(rng.uniform(0, 360, n), np.degrees(np.arcsin(rng.uniform(*sines, n))), error_arcsec)


def near(rng, where, sigma_arcsec):
    """The same objects as seen with errors, by rotating each along its own triad (safe at poles)."""
    n = len(where.ra)
    none = np.zeros(n)
    east, north = (rng.normal(0.0, sigma_arcsec * ARCSEC, n) for _ in "en")
    return crossmatch.at_epoch(where, east, north, none, none, np.ones(n))


def catalogue(where, radius_arcsec, identifier=None):
    names = np.zeros(len(where.ra), dtype=np.int64) if identifier is None else np.asarray(identifier, dtype=np.int64)
    return GalaxyCatalogue(where, names, radius_arcsec * ARCSEC)


def coordinates(where):
    return SkyCoord(where.ra * u.rad, where.dec * u.rad)


def concatenated(*parts):
    return Positions(*map(np.concatenate, zip(*parts, strict=True)))


@pytest.mark.parametrize("radius_arcsec", [0.5, 60.0, 3600.0])
def test_pairs_are_those_of_astropy(radius_arcsec):
    rng = np.random.default_rng(1)
    first = sky(rng, 4000)
    second = concatenated(near(rng, first.take(slice(0, 1500)), 40.0), sky(rng, 3000))
    a, b, offset = pairs_within(sky_tree(first), sky_tree(second), radius_arcsec * ARCSEC)
    i, j, separation, _ = search_around_sky(coordinates(first), coordinates(second), radius_arcsec * u.arcsec)
    order, expected = np.lexsort((b, a)), np.lexsort((j, i))
    np.testing.assert_array_equal(a[order], i[expected])
    np.testing.assert_array_equal(b[order], j[expected])
    # unit vectors hold an angle to 2e-16 rad = 0.05 microarcsec; astropy's haversine is no better
    np.testing.assert_allclose(offset[order], separation.rad[expected], atol=0.5 * MICROARCSEC, rtol=1e-12)


def test_positions_at_another_epoch_are_those_of_astropy():
    rng = np.random.default_rng(4)
    n = 500
    where = sky(rng, n, 0.1)
    pmra, pmdec = rng.normal(0, 300, (2, n))
    pmra[0], pmdec[0] = 801.551, 10362.394  # Barnard's star
    here = crossmatch.at_epoch(where, pmra * MAS, pmdec * MAS, np.full(n, 3.0 * MAS), 0 * pmra, np.full(n, 8.75))
    there = where.ra * u.rad, where.dec * u.rad, np.full(n, 0.1) * u.pc  # so near that light time changes nothing
    motions = {"pm_ra_cosdec": pmra * u.mas / u.yr, "pm_dec": pmdec * u.mas / u.yr}
    motions["radial_velocity"] = np.zeros(n) * u.km / u.s
    coords = SkyCoord(*there, **motions, obstime=Time(1991.25, format="jyear", scale="tdb"))
    moved = coords.apply_space_motion(Time(2000.0, format="jyear", scale="tdb"))
    assert coordinates(here).separation(moved).uas.max() < 1.0
    np.testing.assert_allclose(here.ra_error / MAS, np.hypot(100.0, 3.0 * 8.75))
    np.testing.assert_allclose(here.dec_error / MAS, 100.0)


def on_grid(points, radius=0.0):
    x, y, names = np.array(points).T
    return catalogue(positions((x - 6) / 3600.0 % 360.0, y / 3600.0), radius, names)


def matched(stars, catalogues):
    """The matches as positions, which do not depend on the order of rows; nothing is matched twice."""
    matches = cross_match(stars, np.zeros(len(stars.ra), dtype=bool), catalogues, SearchOptions())
    for column in (matches["star"], matches["galaxy"], matches["identifier"][matches["identifier"] > 0]):
        assert len(set(column.tolist())) == len(column)
    assert matches.found_in[np.arange(len(matches.table)), matches["catalogue"]].all()
    there = [catalogues[c].positions.take(e) for c, e in zip(matches["catalogue"], matches["entry"], strict=True)]
    here = stars.take(matches["star"])
    return sorted(zip(here.ra, here.dec, [g.ra for g in there], [g.dec for g in there], matches["class"], strict=True))


@pytest.mark.slow
@settings(max_examples=examples(150), derandomize=True)
@given(grid_sky, grid_sky, grid_sky, st.randoms(use_true_random=False))
def test_nothing_is_matched_twice_and_the_order_of_rows_does_not_matter(a, b, c, random):
    tables = list({point[:2]: point for point in a}.values()), b, c
    both = tables, [random.sample(table, len(table)) for table in tables]
    result, again = (matched(on_grid(s).positions, [on_grid(one, 2.5), on_grid(other, 1.2)]) for s, one, other in both)
    assert result == again


@pytest.mark.parametrize(("catalogues", "merge", "labels", "identifiers"), MERGED)
def test_entries_of_several_catalogues_are_one_galaxy(catalogues, merge, labels, identifiers):
    listed = [catalogue(positions(ra, np.zeros(len(ra))), radius, names) for ra, radius, names in catalogues]
    result, names = crossmatch.merge_galaxies(listed, None if merge is None else merge * ARCSEC)
    assert ([label.tolist() for label in result], names.tolist()) == (labels, identifiers)


def test_each_rule_of_the_classes_in_a_search():
    """Five stars: 2.9 sigma off, with three others within 120", 4 sigma off, with a second star, supplement."""
    ra = np.array([10.0, 50.0, 90.0, 130.0, 170.0])
    crowd = positions(np.array([50.0, 50.0, 50.0]), np.array([60.0, 90.0, -110.0]) / 3600.0, 0.1)
    second = positions([130.0], [4.0 / 3600.0], 0.1)
    stars = concatenated(positions(ra, np.zeros(5), 0.3), crowd, second)
    galaxies = positions(ra, np.array([1.45, 0.0, 2.0, 0.0, 0.0]) / 3600.0, 0.4)._replace(ra_error=np.full(5, ARCSEC))
    supplement = np.arange(len(stars.ra)) == 4
    matches = cross_match(stars, supplement, [catalogue(galaxies, 5.0)], SearchOptions())
    assert matches["star"].tolist() == [0, 1, 2, 3, 4]
    assert matches["class"].tolist() == ["certain", "uncertain", "uncertain", "uncertain", "supplement"]
    doubts = pd.DataFrame({"crowded": [0, 1, 0, 0, 0], "offset": [0, 0, 1, 0, 0], "rival": [0, 0, 0, 1, 0]}, dtype=bool)
    pd.testing.assert_frame_equal(matches.reasons, doubts)
    assert matches["n_near"].tolist() == [0, 3, 0, 1, 0]
    np.testing.assert_allclose(matches["n_sigma"], [2.9, 0, 4, 0, 0], atol=1e-6)
    np.testing.assert_allclose(matches["d_dec"] / ARCSEC, [1.45, 0, 2, 0, 0], atol=1e-6)  # galaxy - star
    kinder = SearchOptions(k_sigma=4.5, crowding_radius=100.0)
    kinder = cross_match(stars, supplement, [catalogue(galaxies, 5.0)], kinder)
    assert kinder["class"].tolist() == ["certain", "certain", "certain", "uncertain", "supplement"]
    # the first star is taken when the second galaxy is looked at, which is then left to the second star
    stars, two = (positions([10.0, 10.0], np.array(north) / 3600.0) for north in ([1.0, 5.5], [0.0, 3.0]))
    assert cross_match(stars, supplement[:2], [catalogue(two, 5.0)], SearchOptions())["entry"].tolist() == [0, 1]
    same = [catalogue(galaxies.take([0]), 5.0, [name]) for name in (9, 5)]  # at one place: the first catalogue decides
    assert cross_match(galaxies.take([0]), supplement[:1], same, SearchOptions())["identifier"].tolist() == [9]


def test_local_chance_pairs_follow_the_crowding():
    rng = np.random.default_rng(7)
    stars, galaxies = (sky(rng, 20_000, sines=(0.0, 0.2)) for _ in "sg")
    chance = cross_match(stars, np.zeros(20_000, dtype=bool), [catalogue(galaxies, 30.0)], SearchOptions()).chance[0]
    np.testing.assert_allclose(chance["chance_pairs_uniform"], 4e8 * np.sin(15.0 * ARCSEC) ** 2)
    local, error = chance["chance_pairs_local"], chance["chance_pairs_local_error"]
    assert abs(local - 10.0 * chance["chance_pairs_uniform"]) < 5.0 * error
    assert abs(chance["pairs"] - local) < 4.0 * np.sqrt(local)
