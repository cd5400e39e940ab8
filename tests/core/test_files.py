"""A catalogue from a table: what is read of it, and every way in which a table can be wrong."""

import warnings
from collections import ChainMap
from itertools import combinations

import numpy as np
import pytest
from astropy.table import Table

from tests.core.points import DEGREE, MAS, drawn, link, point, table_file

RA, DEC = np.array([10.0, 100.0, 200.0, 359.0]), np.array([60.0, -30.0, 0.5, -80.0])
PMRA, PMDEC = np.array([1.5, -20.25, 0.0, 7.0]), np.array([-3.0, 4.0, 100.5, 0.25])
MAG = np.array([9.5, 12.0, 14.0, 17.5])
NAMES = ("ra", "dec", "pmra", "pmdec")
ERRORS = {f"{name}_error": 0.1 * k + np.array([0.01, 0.02, 0.03, 0.04]) for k, name in enumerate(NAMES, 1)}
ANONYMOUS = {"ra": RA, "dec": DEC, "pmra": PMRA, "pmdec": PMDEC, "phot_g_mean_mag": MAG}
GAIA = ANONYMOUS | {"source_id": np.arange(4)}
UNITS = {"ra": "deg", "dec": "deg", "phot_g_mean_mag": "mag", "ra_error": "mas", "dec_error": "mas"}
UNITS |= dict.fromkeys(("pmra", "pmdec", "pmra_error", "pmdec_error"), "mas / yr")
FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits", ".vot": "votable", ".mrt": "ascii.mrt"}
FORMATS |= {".parquet": "parquet"}
EVEN, ALL = np.array([False, True, False, True]), GAIA | ERRORS
THREE = {f"{pair}_corr": EVEN * size for pair, size in (("ra_dec", 0.9), ("ra_pmra", 0.9), ("dec_pmra", -0.9))}
TWICE = {"reference_pmra_error": "pmra_error", "satellite_pmra_error": "pmra_error"}
FACTORS = {"": 1.0, "reference": 2.0, "satellite": 3.0}
WRONG = [
    (GAIA | {"pmra": np.where(EVEN, np.nan, PMRA)}, {}, "no pmra in row 2, 4"),
    (GAIA | {"pmra": np.where(EVEN, np.inf, PMRA)}, {}, "an infinite pmra in row 2, 4"),
    (ANONYMOUS, {}, "column 'pmra' may or may not include cos(dec): say pmra_cos_dec"),
    (GAIA, {"pmdec": "pm_dec"}, "no column 'pm_dec' for pmdec"),
    (GAIA, {"parallax": "plx"}, "columns: parallax is no quantity"),
    *(({k: v for k, v in GAIA.items() if k != name}, {}, f"no column '{name}'") for name in NAMES),
    *((ALL | {name: [0.1, 0.1, -0.1, 0.1]}, {}, f"a negative {name} in row 3 (-0.1)") for name in ERRORS),
    *((ALL | {"ra_dec_corr": EVEN * value}, {}, "impossible correlations") for value in (1.2, -1.0)),
    (ALL | THREE, {}, "impossible correlations"),  # each pair alone would do
    (GAIA | {"dec": [60.0, -30.0, 0.5, 90.0]}, {}, "a dec at a pole in row 4 (90)"),
    (GAIA | {"ra": [10.0, 360.5, -180.0, 400.0]}, {}, "a ra outside -180..360 deg in row 2 (360.5), 4 (400)"),
    (ALL, TWICE, "reference_pmra_error and satellite_pmra_error are both column 'pmra_error'"),
    (ALL, {"reference_pmra_error": "pmra_error"}, "needs reference_pmra_error and reference_pmdec_error"),
]


@pytest.fixture
def write(tmp_path):
    """A function that writes a table with astropy and opens it as the platform does."""

    def write(columns, suffix=".ecsv", units=UNITS):
        table, path = Table(columns), tmp_path / f"four{suffix}"
        for name in set(units) & set(columns):
            table[name].unit = units[name]
        with warnings.catch_warnings(action="ignore"):  # of astropy, about what a format cannot keep
            table.write(path, format=FORMATS[suffix], overwrite=True)
        return table_file(path)

    return write


def read(table, columns=None, **changes):
    changes |= {"columns": tuple((columns or {}).items())}
    return drawn(catalogue="file", file=table, **changes)


def problem(table, columns=None, **changes):
    changes |= {"columns": tuple((columns or {}).items()), "satellite_errors": "none"}
    return link.check(point(catalogue="file", file=table, n_obj=None, **changes)) or ""


def is_the_four(result, errors=False):
    np.testing.assert_allclose([result.ra, result.dec], np.array([RA, DEC]) * DEGREE, rtol=1e-14)
    np.testing.assert_allclose([result.pmra, result.pmdec], np.array([PMRA, PMDEC]) * MAS, rtol=1e-14)
    np.testing.assert_array_equal(result.v_mag, MAG)
    assert (result.errors is not None) == errors
    if errors:
        np.testing.assert_allclose(result.errors.sigma.T, np.array(list(ERRORS.values())) * MAS, rtol=1e-14)
    return True


@pytest.mark.parametrize("suffix", FORMATS)
def test_round_trip_through_every_format(suffix, write):
    assert is_the_four(read(write(GAIA | ERRORS, suffix)), errors=True)


def test_units_are_converted_a_map_of_names_comes_first_and_only_positions_are_needed(write):
    other = {"ra": np.radians(RA), "pmra": PMRA * 1e-3, "pmdec": PMDEC / 3600.0, "ra_error": ERRORS["ra_error"] / 3.6e6}
    units = UNITS | {"ra": "rad", "pmra": "arcsec / yr", "pmdec": "deg / kyr", "ra_error": "deg"}
    assert is_the_four(read(write(GAIA | ERRORS | other, units=units)), errors=True)
    assert is_the_four(read(write(GAIA | ERRORS, units={})), errors=True)
    assert is_the_four(read(write(GAIA | {"parallax": np.full(4, np.nan)})))  # unused columns may be anything
    assert "units: parallax is no quantity" in problem(write(GAIA), units=(("parallax", "mas"),))
    np.testing.assert_array_equal(read(write(GAIA | {"other": 2 * MAG}), {"v_mag": "other"}).v_mag, 2 * MAG)
    for name in ("vt_mag", "Vmag", "Gmag", "VTmag"):
        np.testing.assert_array_equal(read(write({"ra": RA, "dec": DEC, name: MAG})).v_mag, MAG)
    result = read(write({"ra": RA, "dec": DEC}))
    assert np.all(np.isnan(result.v_mag))
    assert not np.any([result.pmra, result.pmdec])
    assert result.errors is None


def test_pmra_with_and_without_cos_dec(write):
    table = write(ANONYMOUS)
    without = PMRA * np.cos(np.radians(DEC)) * MAS
    np.testing.assert_allclose(read(table, pmra_cos_dec=True).pmra, PMRA * MAS, rtol=1e-14)
    np.testing.assert_allclose(read(table, pmra_cos_dec=False).pmra, without, rtol=1e-14)
    np.testing.assert_allclose(read(write(GAIA), pmra_cos_dec=False).pmra, without, rtol=1e-14)  # as declared
    assert is_the_four(read(write(ANONYMOUS | {"designation": np.arange(4)})))
    renamed = {{"pmra": "pm_ra_cosdec"}.get(name, name): values for name, values in ANONYMOUS.items()}
    assert is_the_four(read(write(renamed), {"pmra": "pm_ra_cosdec"}))


def test_errors_of_both_motions_or_of_the_position_count_and_the_others_are_zero(write):
    every = np.array(list(ERRORS.values())).T * MAS
    for there, count in (*((one, one) for one in ("0011", "0111", "1100")), ("1000", ""), ("1110", ""), ("0001", "")):
        some = {name: values for (name, values), one in zip(ERRORS.items(), there, strict=True) if one == "1"}
        errors = read(write(GAIA | some)).errors
        assert (errors is None) == (not count)
        if count:
            np.testing.assert_allclose(errors.sigma, every * [float(one) for one in count], rtol=1e-14)


@pytest.mark.parametrize("of_side", ["", "reference_"])
def test_correlations_are_those_of_each_pair_and_of_their_side(of_side, write):
    some, expected = side("reference", 2.0) if of_side else {}, np.tile(np.eye(4), (4, 1, 1))
    for k, (i, j) in enumerate([*combinations(range(4), 2)][1:], start=1):
        expected[:, i, j] = expected[:, j, i] = 0.05 * k * np.array([1, -1, 2, 0])
        some[f"{of_side}{NAMES[i]}_{NAMES[j]}_corr"] = expected[:, i, j]
    result = read(write(GAIA | ERRORS | some))  # of the pair that is not there it is zero
    np.testing.assert_array_equal(result.own_errors("reference").correlation, expected)
    assert (result.errors.correlation is None) == bool(of_side)


@pytest.mark.parametrize(("columns", "names", "sentence"), WRONG)
def test_what_is_wrong_is_named(columns, names, sentence, write):
    assert sentence in problem(write(columns), names)


def test_a_file_is_taken_whole_by_magnitude_or_by_chance(write):
    table = write(GAIA | ERRORS)
    np.testing.assert_array_equal(read(table, v_max=14.0).v_mag, MAG[:3])
    np.testing.assert_array_equal(read(table, v_min=12.0, v_max=14.0).v_mag, MAG[1:3])
    pairs = [drawn(k, catalogue="file", file=table, n_obj=2, v_max=14.0).v_mag.tolist() for k in range(300)]
    counts = [pairs.count(pair) for pair in ([9.5, 12.0], [9.5, 14.0], [12.0, 14.0])]
    assert sum(counts) == 300  # no object twice, none beyond the limit
    assert np.all(np.abs(np.array(counts) - 100) < 4 * np.sqrt(300 * 2 / 9))  # binomial
    moved = read(table, positions="isotropic", zone_of_avoidance=10.0)
    np.testing.assert_allclose(moved.pmra, PMRA * MAS, rtol=1e-14)
    np.testing.assert_array_equal(moved.v_mag, MAG)
    assert not np.any(np.isin(moved.ra, RA * DEGREE))


def side(name, factor):
    return {f"{name}_{key}": factor * values for key, values in ERRORS.items()}


@pytest.mark.parametrize("there", [names for n in (1, 2, 3) for names in combinations(FACTORS, n)])
def test_each_side_has_its_own_errors_or_those_of_both(there, write):
    columns = [side(name, FACTORS[name]) if name else ERRORS for name in there]
    table = write(GAIA | dict(ChainMap(*columns)))
    result = read(table).take(np.array([2, 0]))
    for name in ("reference", "satellite"):
        if name in there or "" in there:
            expected = FACTORS[name if name in there else ""] * np.array(list(ERRORS.values())).T[[2, 0]] * MAS
            np.testing.assert_allclose(result.own_errors(name).sigma, expected, rtol=1e-14)
        else:
            asked = point(catalogue="file", file=table, n_obj=None) | {f"{name}_errors": "catalogue"}
            assert "has no errors of its own" in link.check(asked)
