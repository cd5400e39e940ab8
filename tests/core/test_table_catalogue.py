"""A catalogue from a table: in every format that is read, and every way in which a table can be wrong."""

import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

from linksweep.core.experiment import link, scenario
from linksweep.core.frames import DEGREE, MAS
from linksweep.core.table_catalogue import CORRELATIONS, catalogue_from_table
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.columns import Columns
from linksweep.sweep.tables.file import table_file

RA, DEC = np.array([10.0, 100.0, 200.0, 359.0]), np.array([60.0, -30.0, 0.5, -80.0])
PMRA, PMDEC, MAG = (
    np.array([1.5, -20.25, 0.0, 7.0]),
    np.array([-3.0, 4.0, 100.5, 0.25]),
    np.array([9.5, 12.0, 14.0, 17.5]),
)
ERRORS = {
    f"{name}_error": 0.1 * k + np.array([0.01, 0.02, 0.03, 0.04])
    for k, name in enumerate(("ra", "dec", "pmra", "pmdec"), 1)
}
GAIA = {"source_id": np.arange(4), "ra": RA, "dec": DEC, "pmra": PMRA, "pmdec": PMDEC, "phot_g_mean_mag": MAG}
UNITS = {"ra": "deg", "dec": "deg", "pmra": "mas / yr", "pmdec": "mas / yr", "phot_g_mean_mag": "mag",
         "ra_error": "mas", "dec_error": "mas", "pmra_error": "mas / yr", "pmdec_error": "mas / yr"}  # fmt: skip
TABLE_FORMATS = {".ecsv": "ascii.ecsv", ".csv": "ascii.csv", ".fits": "fits", ".vot": "votable", ".mrt": "ascii.mrt"}
if importlib.util.find_spec("pyarrow"):
    TABLE_FORMATS[".parquet"] = "parquet"

DAT = """\
 10.0  60.0    1.50   -3.00  9.5
100.0 -30.0  -20.25    4.00 12.0
200.0   0.5    0.00  100.50 14.0
359.0 -80.0    7.00    0.25 17.5
"""
README = """\
J/A+A/413/771                Four objects                         (Nobody, 2004)
================================================================================
File Summary:
--------------------------------------------------------------------------------
 FileName   Lrecl  Records   Explanations
--------------------------------------------------------------------------------
ReadMe         80        .   This file
four.dat       32        4   Four objects
--------------------------------------------------------------------------------

Byte-by-byte Description of file: four.dat
--------------------------------------------------------------------------------
   Bytes Format Units   Label     Explanations
--------------------------------------------------------------------------------
   1-  5  F5.1  deg     RAdeg     Right ascension
   7- 11  F5.1  deg     DEdeg     Declination
  13- 19  F7.2  mas/yr  pmRA      Proper motion in RA*cos(dec)
  21- 27  F7.2  mas/yr  pmDE      Proper motion in declination
  29- 32  F4.1  mag     Vmag      Magnitude
--------------------------------------------------------------------------------
"""
CDS_COLUMNS = {"ra": "RAdeg", "dec": "DEdeg", "pmra": "pmRA", "pmdec": "pmDE", "v_mag": "Vmag"}


class InMemory:
    """A table without a file: what `catalogue_from_table` asks for and nothing else."""

    def __init__(self, columns):
        self.table = Table(columns)

    def columns(self, columns, units, known):
        return Columns(self.table, "", columns, units, known)


def catalogue(columns, names=None, pmra_cos_dec=None):
    return catalogue_from_table(InMemory(columns), names or {}, pmra_cos_dec)


def written(tmp_path, columns, suffix=".ecsv", units=UNITS):
    """Write a table with astropy and open it as the platform does."""
    table = Table(columns)
    for name in set(units) & set(columns):
        table[name].unit = units[name]
    path = tmp_path / f"four{suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of astropy, about what a format cannot keep
        table.write(path, format=TABLE_FORMATS[suffix])
    return table_file(path)


def fixed_width(tmp_path):
    (tmp_path / "ReadMe").write_text(README)
    (tmp_path / "four.dat").write_text(DAT)
    return table_file(tmp_path / "four.dat")


def is_the_four(found, errors=False):
    np.testing.assert_allclose([found.ra, found.dec], np.array([RA, DEC]) * DEGREE, rtol=1e-14)
    np.testing.assert_allclose([found.pmra, found.pmdec], np.array([PMRA, PMDEC]) * MAS, rtol=1e-14)
    np.testing.assert_array_equal(found.v_mag, MAG)
    assert (found.sigma is not None) == errors
    if errors:
        np.testing.assert_allclose(found.sigma, np.array(list(ERRORS.values())) * MAS, rtol=1e-14)
    return True


@pytest.mark.parametrize("suffix", TABLE_FORMATS)
def test_round_trip_through_every_format(suffix, tmp_path):
    table = written(tmp_path, GAIA | ERRORS, suffix)
    assert is_the_four(catalogue_from_table(table, {}, None), errors=True)


@pytest.mark.parametrize("suffix", [".ecsv", ".csv", ".fits", ".vot"])
def test_packed_tables(suffix, tmp_path):
    import gzip

    written(tmp_path, GAIA, suffix)
    plain = tmp_path / f"four{suffix}"
    packed = tmp_path / f"packed{suffix}.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert is_the_four(catalogue_from_table(table_file(packed), {}, None))


def test_fixed_width_table_with_its_readme(tmp_path):
    assert is_the_four(catalogue_from_table(fixed_width(tmp_path), CDS_COLUMNS, True))
    (tmp_path / "ReadMe").unlink()
    with pytest.raises(SweepError, match="needs its ReadMe"):
        table_file(tmp_path / "four.dat")


def test_a_parquet_file_that_cannot_be_read_or_has_no_reader(tmp_path):
    (tmp_path / "four.parquet").write_bytes(b"PAR1")
    with pytest.raises(SweepError, match="cannot be read as Parquet"):
        table_file(tmp_path / "four.parquet")


def test_units_are_converted(tmp_path):
    other = GAIA | ERRORS
    other |= {
        "ra": np.radians(RA),
        "pmra": PMRA * 1e-3,
        "pmdec": PMDEC / 3600.0,
        "ra_error": ERRORS["ra_error"] / 3.6e6,
    }
    units = UNITS | {"ra": "rad", "pmra": "arcsec / yr", "pmdec": "deg / kyr", "ra_error": "deg"}
    assert is_the_four(catalogue_from_table(written(tmp_path, other, units=units), {}, None), errors=True)


def test_a_table_without_units_has_the_usual_ones(tmp_path):
    assert is_the_four(catalogue_from_table(written(tmp_path, GAIA | ERRORS, units={}), {}, None), errors=True)


@pytest.mark.parametrize(("name", "unit"), [("ra", "mas / yr"), ("pmra", "km / s"), ("phot_g_mean_mag", "deg")])
def test_another_kind_of_unit_is_an_error(name, unit, tmp_path):
    table = written(tmp_path, GAIA, units=UNITS | {name: unit})
    with pytest.raises(SweepError, match=f"column '{name}' is in {unit}, not convertible to {UNITS[name]}"):
        catalogue_from_table(table, {}, None)


@pytest.mark.parametrize("missing", [np.nan, np.inf, None])
@pytest.mark.parametrize("suffix", [".ecsv", ".csv", ".vot"])
def test_missing_values_are_named_by_their_rows(missing, suffix, tmp_path):
    mask = np.array([False, True, False, True])
    column = MaskedColumn(PMRA, mask=mask) if missing is None else np.where(mask, missing, PMRA)
    with pytest.raises(SweepError, match=r"(no|an infinite) pmra in row 2, 4$"):
        catalogue_from_table(written(tmp_path, GAIA | {"pmra": column}, suffix), {}, None)


def test_many_missing_rows_are_counted(tmp_path):
    long = {name: np.tile(values, 3) for name, values in GAIA.items()} | {"dec": np.full(12, np.nan)}
    with pytest.raises(SweepError, match=r"in row 1, 2, 3, 4, 5 and 7 more$"):
        catalogue_from_table(written(tmp_path, long), {}, None)


def test_unused_columns_may_be_anything(tmp_path):
    table = written(tmp_path, GAIA | {"name": list("abcd"), "parallax": np.full(4, np.nan)})
    assert is_the_four(catalogue_from_table(table, {}, None))


def test_text_is_no_number(tmp_path):
    table = written(tmp_path, GAIA | {"dec": ["60", "-30", "0.5", "-80"]})
    with pytest.raises(SweepError, match=r"column .dec. is text that is no angle .* in row 1 \(.60.\)"):
        catalogue_from_table(table, {}, None)


def test_a_column_map_and_a_column_that_is_not_there(tmp_path):
    renamed = dict(zip(("alpha", "delta", "mu_a", "mu_d", "V"), (RA, DEC, PMRA, PMDEC, MAG), strict=True))
    names = dict(zip(("ra", "dec", "pmra", "pmdec", "v_mag"), renamed, strict=True))
    table = written(tmp_path, renamed)
    assert is_the_four(catalogue_from_table(table, names, True))
    with pytest.raises(SweepError, match="no column 'pm_dec' for pmdec; known are V, alpha, delta"):
        catalogue_from_table(table, names | {"pmdec": "pm_dec"}, True)
    with pytest.raises(SweepError, match="columns: parallax is no quantity"):
        catalogue_from_table(table, names | {"parallax": "plx"}, True)


def test_the_map_comes_before_gaias_names():
    found = catalogue(GAIA | {"other": 2 * MAG}, {"v_mag": "other"})
    np.testing.assert_array_equal(found.v_mag, 2 * MAG)


@pytest.mark.parametrize("name", ["v_mag", "phot_g_mean_mag", "vt_mag"])
def test_names_of_a_magnitude(name):
    assert is_the_four(catalogue({k: v for k, v in GAIA.items() if k != "phot_g_mean_mag"} | {name: MAG}))


def test_without_magnitudes_and_motions():
    found = catalogue({"ra": RA, "dec": DEC})
    assert np.all(np.isnan(found.v_mag))
    assert not np.any([found.pmra, found.pmdec])
    assert found.sigma is None


@pytest.mark.parametrize("missing", ["ra", "dec", "pmra", "pmdec"])
def test_positions_are_needed_and_motions_come_in_pairs(missing, tmp_path):
    table = written(tmp_path, {name: values for name, values in GAIA.items() if name != missing})
    with pytest.raises(SweepError, match=f"no column '{missing}'"):
        catalogue_from_table(table, {}, None)


def test_pmra_with_and_without_cos_dec():
    anonymous = {name: values for name, values in GAIA.items() if name != "source_id"}
    with_factor, without = (catalogue(anonymous, pmra_cos_dec=declared).pmra for declared in (True, False))
    np.testing.assert_allclose(with_factor, PMRA * MAS, rtol=1e-14)
    np.testing.assert_allclose(without, PMRA * np.cos(np.radians(DEC)) * MAS, rtol=1e-14)
    np.testing.assert_array_equal(catalogue(GAIA, pmra_cos_dec=False).pmra, without)  # what is declared holds


@pytest.mark.parametrize("mark", ["source_id", "designation", "solution_id"])
def test_pmra_of_an_unknown_table_is_ambiguous(mark):
    anonymous = {name: values for name, values in GAIA.items() if name != "source_id"}
    with pytest.raises(SweepError, match=r"column 'pmra' may or may not include cos\(dec\): say pmra_cos_dec"):
        catalogue(anonymous)
    assert is_the_four(catalogue(anonymous | {mark: np.arange(4)}))
    renamed = {{"pmra": "pm_ra_cosdec"}.get(name, name): values for name, values in anonymous.items()}
    assert is_the_four(catalogue(renamed, {"pmra": "pm_ra_cosdec"}))


@pytest.mark.parametrize(("given", "exact"), [(("pmra", "pmdec"), (0, 1)), (("dec", "pmra", "pmdec"), (0,))])
def test_a_position_without_errors_is_exact(given, exact):
    found = catalogue(GAIA | {f"{name}_error": ERRORS[f"{name}_error"] for name in given})
    expected = np.array(list(ERRORS.values())) * MAS
    expected[list(exact)] = 0.0
    np.testing.assert_allclose(found.sigma, expected, rtol=1e-14)


@pytest.mark.parametrize("given", [("ra",), ("ra", "dec", "pmra"), ("pmdec",)])
def test_without_both_errors_of_the_motions_or_the_position_there_are_none(given):
    assert catalogue(GAIA | {f"{name}_error": ERRORS[f"{name}_error"] for name in given}).sigma is None


@pytest.mark.parametrize("name", ERRORS)
def test_a_negative_error_is_named(name):
    bad = ERRORS | {name: np.array([0.1, 0.1, -0.1, 0.1])}
    with pytest.raises(SweepError, match=rf"^a negative {name} in row 3 \(-0.1\)$"):
        catalogue(GAIA | bad)


def test_correlations_are_those_of_each_pair():
    given = {name: 0.05 * (k + 1) * np.array([1, -1, 2, 0]) for k, name in enumerate(CORRELATIONS)}
    found = catalogue(GAIA | ERRORS | given).correlation
    names = ("ra", "dec", "pmra", "pmdec")
    assert len(given) == 6
    for k, matrix in enumerate(found):
        np.testing.assert_array_equal(matrix, matrix.T)
        np.testing.assert_array_equal(np.diag(matrix), 1.0)
        for name, values in given.items():
            i, j = (names.index(part) for part in name.removesuffix("_corr").split("_"))
            assert matrix[i, j] == values[k]
    assert catalogue(GAIA | ERRORS).correlation is None


def test_some_correlations_leave_the_others_zero():
    found = catalogue(GAIA | ERRORS | {"pmra_pmdec_corr": np.full(4, 0.9)}).correlation
    expected = np.eye(4)
    expected[2, 3] = expected[3, 2] = 0.9
    np.testing.assert_array_equal(found, np.tile(expected, (4, 1, 1)))


@pytest.mark.parametrize(
    "impossible",
    [
        {"ra_dec_corr": 1.2},
        {"ra_dec_corr": -1.0},
        {"ra_dec_corr": 0.9, "ra_pmra_corr": 0.9, "dec_pmra_corr": -0.9},  # each pair alone would do
    ],
)
def test_impossible_correlations_are_named(impossible):
    columns = {name: np.array([0.0, value, 0.0, value]) for name, value in impossible.items()}
    with pytest.raises(SweepError, match=r"^impossible correlations .* in row 2, 4$"):
        catalogue(GAIA | ERRORS | columns)


@pytest.mark.parametrize("dec", [90.0, -90.0, 90.5, 200.0])
def test_poles_and_beyond_are_named(dec):
    with pytest.raises(
        SweepError, match=rf"^a dec that is not between -90 and 90 deg, poles excluded, in row 4 \({dec:g}\)$"
    ):
        catalogue(GAIA | {"dec": np.array([60.0, -30.0, 0.5, dec])})


def test_many_bad_rows_are_cut_short():
    with pytest.raises(SweepError, match=r"in row 1 \(95\), .*, 5 \(95\) and 2 more; are ra and dec swapped\?"):
        catalogue({"ra": np.full(7, 80.0), "dec": np.full(7, 95.0)})


def test_the_same_content_is_the_same_file_wherever_it_lies(tmp_path):
    first = written(tmp_path, GAIA)
    elsewhere = tmp_path / "copy.ecsv"
    elsewhere.write_bytes(Path(first.path).read_bytes())
    assert table_file(elsewhere).digest == first.digest
    elsewhere.write_bytes(Path(first.path).read_bytes().replace(b"17.5", b"17.6"))
    assert table_file(elsewhere).digest != first.digest


def drawn(table, seed=1, **changes):
    point = link.defaults() | {"catalogue": "file", "file": table} | changes
    return scenario(point).draw_catalogue(np.random.default_rng(seed))


def test_a_file_is_taken_whole_by_magnitude_or_by_chance(tmp_path):
    table = written(tmp_path, GAIA | ERRORS)
    assert is_the_four(drawn(table), errors=True)
    np.testing.assert_array_equal(drawn(table, v_max=14.0).v_mag, MAG[:3])
    pairs = [tuple(drawn(table, seed, n_obj=2, v_max=14.0).v_mag) for seed in range(300)]
    counts = [pairs.count(pair) for pair in ((9.5, 12.0), (9.5, 14.0), (12.0, 14.0))]
    assert sum(counts) == 300  # no object twice, none beyond the limit
    assert np.all(np.abs(np.array(counts) - 100) < 4 * np.sqrt(300 * 2 / 9))  # binomial


def test_objects_of_a_file_at_random_positions(tmp_path):
    found = drawn(written(tmp_path, GAIA | ERRORS), positions="isotropic", zone_of_avoidance=10.0)
    np.testing.assert_allclose(found.pmra, PMRA * MAS, rtol=1e-14)
    np.testing.assert_array_equal(found.v_mag, MAG)
    assert not np.any(np.isin(found.ra, RA * DEGREE))


# ---- units, hours, ranges and the errors of two sides


@pytest.mark.parametrize(
    ("ra", "rows"),
    [((-180.1, 0.0, 360.0, 10.0), r"1 \(-180.1\)"), ((10.0, 360.5, -180.0, 400.0), r"2 \(360.5\), 4 \(400\)")],
)
def test_the_range_of_right_ascensions(ra, rows):
    with pytest.raises(SweepError, match=rf"^an ra that is not between -180 and 360 deg in row {rows}$"):
        catalogue(GAIA | {"ra": np.array(ra)})


def test_hours_are_refused_until_they_are_said_to_be(tmp_path):
    hours = GAIA | {"ra": RA / 15.0}
    table = written(tmp_path, hours, ".csv")
    with pytest.raises(
        SweepError, match=r"column 'ra' has no unit and lies within 0.666667 to 23.9333: hours, degrees"
    ):
        catalogue_from_table(table, {}, None)
    assert is_the_four(catalogue_from_table(table, {}, None, {"ra": "hourangle"}))
    small = catalogue_from_table(table, {}, None, {"ra": "deg"})
    np.testing.assert_allclose(small.ra, RA / 15.0 * DEGREE, rtol=1e-14)
    assert is_the_four(catalogue_from_table(written(tmp_path, hours, units={"ra": "h"}), {}, None))


@pytest.mark.parametrize("name", ["parallax", "ra_dec_corr", "rah"])
def test_units_are_those_of_quantities(name):
    with pytest.raises(SweepError, match=f"units: {name} is no quantity"):
        catalogue_from_table(InMemory(GAIA), {}, None, {name: "deg"})


def test_errors_and_motions_in_seconds_of_time_get_their_cos_dec(tmp_path):
    cos_dec = np.cos(np.radians(DEC))
    other = GAIA | ERRORS | {"pmra": PMRA / 15e3 / cos_dec, "ra_error": ERRORS["ra_error"] / 15e3 / cos_dec}
    other |= {"pmra_error": ERRORS["pmra_error"] / 15e3 / cos_dec}
    units = UNITS | {"pmra": "s / yr", "pmra_error": "s / yr", "ra_error": "s"}
    del other["source_id"]  # of no table of Gaia's: seconds of time say enough
    assert is_the_four(catalogue_from_table(written(tmp_path, other, units=units), {}, None), errors=True)


def test_sexagesimal_positions_of_a_file(tmp_path):
    text = "ra,dec\n00:40:00,+60:00:00\n6 40 00,-30 00 00\n13h20m00s,+00 30 00\n23 56 00,-80 0 0\n"
    (tmp_path / "t.csv").write_text(text)
    found = catalogue_from_table(table_file(tmp_path / "t.csv"), {}, None)
    np.testing.assert_allclose([found.ra, found.dec], np.array([RA, DEC]) * DEGREE, rtol=1e-14)


def side(name, factor):
    return {f"{name}_{key}": factor * values for key, values in ERRORS.items()}


@pytest.mark.parametrize(
    ("given", "reference", "satellite"),
    [
        (ERRORS, 1.0, 1.0),
        (side("reference", 2.0) | side("satellite", 3.0), 2.0, 3.0),
        (side("reference", 2.0) | side("satellite", 3.0) | ERRORS, 2.0, 3.0),
        (side("reference", 2.0) | ERRORS, 2.0, 1.0),
        (side("satellite", 3.0) | ERRORS, 1.0, 3.0),
        (side("reference", 2.0), 2.0, None),
        (side("satellite", 3.0), None, 3.0),
    ],
)
def test_each_side_has_its_own_errors_or_those_of_both(given, reference, satellite):
    found = catalogue(GAIA | given).take(np.array([2, 0]))
    for name, factor in (("reference", reference), ("satellite", satellite)):
        own = found.own_errors(name)
        if name == "reference" and reference is None:
            assert own is None or factor is None
            continue
        assert (own is None) == (factor is None)
        if own is not None:
            expected = factor * np.array(list(ERRORS.values()))[:, [2, 0]] * MAS
            np.testing.assert_allclose(own.sigma, expected, rtol=1e-14)


def test_correlations_are_those_of_their_side():
    columns = side("reference", 2.0) | ERRORS | {"reference_pmra_pmdec_corr": np.full(4, 0.5)}
    found = catalogue(GAIA | columns)
    assert found.own_errors("satellite").correlation is None
    assert np.all(found.own_errors("reference").correlation[:, 2, 3] == 0.5)


def test_one_column_is_not_both_sides():
    names = {"reference_pmra_error": "pmra_error", "satellite_pmra_error": "pmra_error"}
    with pytest.raises(SweepError, match="reference_pmra_error and satellite_pmra_error are both column 'pmra_error'"):
        catalogue(GAIA | ERRORS, names)
    with pytest.raises(SweepError, match="reference_pmra_error needs reference_pmra_error and reference_pmdec_error"):
        catalogue(GAIA | ERRORS, {"reference_pmra_error": "pmra_error"})


def test_names_of_archives_in_any_case(tmp_path):
    names = {"ra": "RA_ICRS", "dec": "DE_ICRS", "pmra": "pmRA", "pmdec": "pmDE", "phot_g_mean_mag": "Phot_G_mean_mag"}
    names |= {"ra_error": "e_RA_ICRS", "dec_error": "e_DE_ICRS", "pmra_error": "e_pmRA", "pmdec_error": "e_pmDE"}
    columns = {names.get(name, name): values for name, values in (GAIA | ERRORS).items()}
    assert is_the_four(catalogue(columns), errors=True)
    renamed = {{"ra": "alpha"}.get(name, name): values for name, values in (GAIA | ERRORS).items()}
    assert is_the_four(catalogue(renamed, {"ra": "alpha"}), errors=True)  # ra_error is still that of ra
