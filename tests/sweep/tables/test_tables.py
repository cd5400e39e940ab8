# ruff: noqa: E101, W291
"""Tables as strangers have them: every format, units, gaps and angles, what is wrong; and conditions on rows."""

import gzip
from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from astropy import units as u
from astropy.coordinates import Angle, SkyCoord
from astropy.io import fits
from astropy.table import MaskedColumn, Table
from astropy.time import Time
from hypothesis import given, settings, strategies as st
from pyarrow import parquet

from linksweep import SweepError
from linksweep.sweep.tables.columns import Columns, conditions, rows_where, table_file
from linksweep.sweep.tables.reader import read_row_group, read_table, row_groups
from tests.tiers import examples

VIZIER = """\
#
#Table	I_311_hip2:
#	HIP	(I6)	Hipparcos identifier
HIP	RAJ2000	DEJ2000	RArad	e_RArad	Name
 	"h:m:s"	"d:m:s"	rad	mas	
------	-----------	-----------	-------------	------	----
     1	00 00 00.22	+01 05 20.4	 0.0000159148	  1.28	A
     2	00 00 00.91	-00 29 55.8	             	  1.28	B #2

"""
HIP2 = """\
Byte-by-byte Description of file: hip2.dat
--------------------------------------------------------------------------------
   Bytes Format Units    Label   Explanations
--------------------------------------------------------------------------------
   1-  6  I6    ---      HIP     Hipparcos identifier
  16- 28 F13.10 rad      RArad   Right Ascension in ICRS, Ep=1991.25
  30- 42 F13.10 rad      DErad   Declination in ICRS, Ep=1991.25
  52- 59  F8.2  mas/yr   pmRA    Proper motion in Right Ascension
--------------------------------------------------------------------------------
"""
HIP2_ROWS = """\
     1   5 0 1  0.0000159148  0.0190068680    4.55    -4.55    -1.29
     2   5 0 1  0.0000662654 -0.3403239102   20.85   179.70     1.40
"""
ODD_UNITS = {"dec": "Angle[deg]", "pmra": "mas.yr**-1", "parallax": "MAS", "pmdec": "MAS/YR"}
UNITS = {"h": 15.0, "hourangle": 15.0, "min": 0.25, "s": 1 / 240, "rad": 180 / np.pi}
MAY_BE_HOURS = {"ra_h": [0.5, 23.9], "ra": [0.0, 24.0], "alpha": [0.1, 6.2], "ra_s": [100.0, 300.0]}
NO_ANGLES = ("24 00 00", "12 60 00", "12 34 61", "12", "twelve", "12 34 56 78", "1-2-3")
NO_ANGLE, NO_UNIT = "column 'x' is text that is no angle .* in row 2 ", 'has no unit and .* units = { ra = "deg" }'
AT_60 = {"dec": [60.0]}  # where a column that lacks the factor cos(dec) gets it
UNREAD = [*(("ra", ["12 34 56", text], {"name": "x"}, rf"{NO_ANGLE}\('{text}'\)") for text in NO_ANGLES)]
UNREAD += [("dec", ["12h30m00s"], {}, "in row 1"), ("pmra", ["1.5"], {}, "'pmra' does not hold numbers")]
UNREAD += [*(("ra", values, {}, "'ra' does not hold numbers") for values in ([[1.0, 2.0]], [1j]))]
UNREAD += [*(("ra", values, {"name": name}, f"column '{name}' {NO_UNIT}") for name, values in MAY_BE_HOURS.items())]
UNREAD += [*(("dec_error", [1.0], {"unit": u}, rf"is in {u[:3]}.*, not convertible") for u in ("s", "dex(mas)"))]
UNREAD += [("ra", [1.0], {"unit": "deg", "stated": "hourangle"}, "ra in hourangle, but column 'ra' is in deg as its")]
UNREAD += [("ra", [100.0], {"stated": "hurz"}, "units: ra: the unit 'hurz' is none")]
UNCLEAR = [("ra", ["187d30m00s"], [187.5], {}), ("ra", [1.0, 6.2], np.degrees([1.0, 6.2]), {"name": "RArad"})]
UNCLEAR += [*(("ra", [1.0, 2.0], [degrees, 2 * degrees], {"unit": unit}) for unit, degrees in UNITS.items())]
UNCLEAR += [*(("ra", values, values, {"name": name, "unit": "deg"}) for name, values in MAY_BE_HOURS.items())]
UNCLEAR += [*(("ra", values, values, {"name": name, "stated": "deg"}) for name, values in MAY_BE_HOURS.items())]
UNCLEAR += [*(("ra", [1.0], [15.0], {"name": name, "stated": "hourangle"}) for name in MAY_BE_HOURS)]
UNCLEAR += [*(("ra", [1.0, 24.1], [1.0, 24.1], {"name": name}) for name in ("ra", "ra_h", "RA_ICRS"))]
UNCLEAR += [("dec", [1.0, -1.0], [1.0, -1.0], {}), ("dec", [1.0, -1.0], np.degrees([1.0, -1.0]), {"name": "DErad"})]
UNCLEAR += [("dec", [1.0, -60.0], [1.0, -60.0], {"name": "dec_rad"})]
HOURS = "12 34 56.7", "12:34:56.7", " 12h34m56.7s", "12 34.945", "00 00 00"
DEGREES = "-00 00 01.5", "-12:34:56.7", "+89d59m59.99s", "−1 2 3", "45 30"
UNCLEAR += [("ra", HOURS, [Angle(text.strip(), "hourangle").deg for text in HOURS], {})]
UNCLEAR += [("dec", DEGREES, [Angle(text.replace("−", "-"), "deg").deg for text in DEGREES], {})]
UNCLEAR += [("ra_error", [1e-6], [0.75e-2], {"unit": "s", **AT_60})]
UNCLEAR += [*((name, [1e-3], [7.5], {"unit": "s / yr", **AT_60}) for name in ("pmra", "reference_pmra_error"))]
FRAME = pd.DataFrame({"flag": [True, False, True, True, False, False, True, False]})
FRAME["a"], FRAME["b"] = [0.5, 1.4, 2.0, -3.0, 7.25, 1e9, 0.0, -0.5], [1.0, 1.4, -2.0, 3.0, 8.0, 1e-9, 0.0, 4.0]
FRAME["n"] = np.array([0, 1, 2, 3, 2**53 + 1, -7, 10**17, 5])
FRAME["s"] = ["S1", "S2", "x", "y", "S1", "z", "x", "long name"]
TABLE = Table.from_pandas(FRAME)
COLUMN = st.sampled_from("abn")
NUMBER = st.sampled_from(["1.4", "-3", "0", "2", "1e9", "-0.5", str(2**53 + 1), str(10**17)])
TEXT = st.sampled_from(["'S1'", '"x"', "'none'"])
COMPARED = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
IN = st.sampled_from(["in", "not in"])
IN_LISTS = (COLUMN, IN, NUMBER, NUMBER), (st.just("s"), IN, TEXT, TEXT)
COMPARISONS = st.one_of(
    st.builds("{} {} {}".format, COLUMN, COMPARED, NUMBER),
    st.builds("{} {} {} < {}".format, NUMBER, st.sampled_from(["<", "<="]), COLUMN, NUMBER),
    st.builds("s {} {}".format, st.sampled_from(["==", "!="]), TEXT),
    *(st.builds("{} {} [{}, {}]".format, *one) for one in IN_LISTS),
    *(st.builds("a {} b".format, COMPARED), st.just("flag")),
)
JOINED = [(2, "({}) & ({})"), (2, "{} | {}"), (2, "{} and {}"), (1, "~({})"), (1, "not ({})")]
MISSING = [("ruwe >= 1.4", [1, 2]), ("ruwe != 1.4", [0, 2]), ("~(ruwe < 1.4)", [1, 2, 3]), ("ruwe == ruwe", [0, 1, 2])]
MISSING += [("~duplicated_source & ~good", [1, 3]), ("name in ['A', 'C']", [0, 2]), ("`B-V` < 0.6 & `lambda` > 1", [2])]
MISSING += [("name == 'A & B' | g > 14.5", [3]), ("`B-V` != 0.5", [0, 3]), ("0.5 < ruwe", [0, 1, 2])]
REFUSED = [("ruwee < 1.4", "no column 'ruwee'; did you mean 'ruwe'"), ("ruwe < ", "at the end"), ("", "where")]
REFUSED += [("ruwe < 1.4 & (g < 13", r"at '\(g < 13'"), ("ruwe.real < 1", "not allowed")]
REFUSED += [("__import__('os').system('true')", "not allowed"), ("ruwe", "numbers without a comparison")]
REFUSED += [("ruwe < 1.4 & name < 3", "text cannot be compared with numbers in this way .*, name < 3")]
REFUSED += [("ruwe + 1 < 2", "not allowed"), ("ruwe in 3", "not a list"), ("pair < 1", "neither numbers nor text")]
REFUSED += [("ruwe < 0.1", "keeps none of 4 rows"), ("not " * 5000 + "good", "where")]
BELOW = ["x,m", "\nx,1", "# by hand\nx,m", "B,1\nA,2", "B,\n3C273,2", "3C273,1\n4C4,2", "-,1\n+,2"]
DELIMITED = [
    ("# made by hand\n# on a Monday\nra,dec,id\n10.5,20,1\n200,-3,2\n", ["ra", "dec", "id"]),
    ("ra;dec;id\n10,5;20;1\n200,0;-3;2\n", ["ra", "dec", "id"]),  # a spreadsheet with decimal commas
    ("ra\tdec\tid\r\n10.5\t20\t1\r\n200\t-3\t2\r\n", ["ra", "dec", "id"]),
    ("\ufeffra, dec, id\n10.5, 20, 1\n200, -3, 2\n", ["ra", "dec", "id"]),
    ("ra dec id\n10.5 20 1\n# a comment\n200 -3 2", ["ra", "dec", "id"]),
    ("ra,dec,id\ndegrees,deg,\n10.5,20,1\n200,-3,2\n", ["ra", "dec", "id"]),
    ("ra [deg],dec (deg),id\n10.5,20,1\n200,-3,2\n", ["ra [deg]", "dec (deg)", "id"]),
    ('ra [deg] "dec (deg)" id\n10.5 20 1\n200 -3 2\n', ["ra [deg]", "dec (deg)", "id"]),
    ("# ra [deg] dec (deg) id\n10.5 20 1\n200 -3 2\n", ["ra [deg]", "dec (deg)", "id"]),
    ("#ra;dec;id\n#(deg);(deg);\n10.5;20;1\n200;-3;2\n", ["ra", "dec", "id"]),  # as psrcat writes it
    ("# ra dec id\n# deg deg -\n10.5 20 1\n200 -3 2\n", ["ra", "dec", "id"]),
]
NO_TABLES = [
    *((b"", "has no rows"), ("10,20\n30,40\n", "its first line, '10,20', is not one of column names")),
    *(("ra,dec,ra\n1,2,3\n", "two columns are called 'ra'"), ("ra,dec\n1,2\n3\n", "row 2 has 1 columns, not 2")),
    (b"\x00\x01\x02\x03" * 10, "neither a table format that is known nor text"),
    (b"\x1f\x8b\x08\x00bad", "is compressed, but incomplete"),
    ("<!DOCTYPE html><html><body>404</body></html>", "is a web page"),
    ("<VOTABLE version='1.3'><RESOURCE/></VOTABLE>", "has no table in it"),
    (b"PAR1nonsense", "cannot be read as Parquet"),
]


def written(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize(("text", "names"), DELIMITED)
def test_delimited_text(text, names, tmp_path):
    for name, content in (("t.csv", text.encode()), ("t.txt.gz", gzip.compress(text.encode()))):
        table = read_table(written(tmp_path, name, content))
        assert table.colnames == names
        np.testing.assert_array_equal([table[n] for n in names], [[10.5, 200.0], [20.0, -3.0], [1, 2]])
    if "deg" in text:
        assert [table[n].unit for n in names] == [u.deg, u.deg, None]
    spaced = "ra name\n1 NGC\u00a0224\n"
    assert read_table(written(tmp_path, "spaced.txt", spaced))["name"].tolist() == ["NGC\u00a0224"]


@pytest.mark.parametrize("below", BELOW)
@pytest.mark.parametrize("first", ["V", "g", "foo", "+"])
def test_rows_of_texts_are_no_units(first, below, tmp_path):
    text = f"{first},\n{below}\n,1"
    table = read_table(written(tmp_path, "t.csv", "name,n\n" + text))
    assert table["name"].tolist() == [row.split(",")[0] or None for row in text.split("\n") if row and row[0] != "#"]


def test_units_in_names_and_errors_of_parts_are_found(tmp_path):
    text = "Name (old),RA [deg],Dec (J2016.0),RA_err (uas),e_DE,pmRA [arcsec/century]\nA,10.5,20,3,4,1\n"
    read = Columns(read_table(written(tmp_path, "t.csv", text)))
    result = [read.quantity(name)[0] for name in ("ra", "dec", "ra_error", "dec_error", "pmra")]
    np.testing.assert_allclose(result, [10.5, 20.0, 0.003, 4.0, np.nan])
    said = "not convertible to mas / yr; say it like --unit"
    assert read.problems == [f"column 'pmRA [arcsec/century]' is in arcsec/century, {said} pmra=mas/yr"]
    columns = "".join(f"# - {{name: {name}, unit: '{unit}', datatype: float64}}\n" for name, unit in ODD_UNITS.items())
    text = f"# %ECSV 1.0\n# ---\n# datatype:\n{columns}{' '.join(ODD_UNITS)}\n30 1 2 3\n"
    read = Columns(read_table(written(tmp_path, "t.ecsv", text)), "", {}, {"parallax": "mas"}, ("parallax",))
    assert [read.quantity(name)[0] for name in ODD_UNITS][:3] == [30.0, 1.0, 2.0]
    assert read.problems == [f"column 'pmdec' is in MAS/YR, {said} pmdec=mas/yr"]
    text = "Name RAh RAm RAs DE- DEd DEm DEs e_RAs e_DEs\nA 01 00 00.0 - 30 15 36.0 0.001 0.02\n"
    read = Columns(read_table(written(tmp_path, "t.txt", text)))
    result = [read.quantity(name)[0] for name in ("ra", "dec", "ra_error", "dec_error")]
    np.testing.assert_allclose(result, [15.0, -30.26, 15.0 * np.cos(np.radians(30.26)), 20.0])
    with pytest.raises(SweepError, match="no column DE- of signs"):
        read_table(written(tmp_path, "t.txt", text.replace("DE- ", "").replace("- ", "")))
    Table({"at": SkyCoord([15.0], [-30.0], unit="deg").galactic}).write(tmp_path / "sky.ecsv")
    read = Columns(read_table(tmp_path / "sky.ecsv"))
    np.testing.assert_allclose([read.quantity(name)[0] for name in ("ra", "dec")], [15.0, -30.0])


def test_a_table_of_vizier_and_hipparcos_2_with_its_readme(tmp_path):
    table = read_table(written(tmp_path, "asu.tsv", VIZIER))
    assert table["HIP"].tolist() == [1, 2]
    assert list(table["Name"]) == ["A", "B #2"]
    assert table["e_RArad"].unit == u.mas
    names = {"ra": "RAJ2000", "dec": "DEJ2000"}
    ra, dec = (Columns(table, "", {key: name}, {}, (key,)).quantity(key) for key, name in names.items())
    np.testing.assert_allclose(ra, Angle(["0h0m0.22s", "0h0m0.91s"]).deg, rtol=1e-14)
    np.testing.assert_allclose(dec, Angle(["1d5m20.4s", "-0d29m55.8s"]).deg, rtol=1e-14)
    np.testing.assert_allclose(Columns(table).quantity("ra"), [np.degrees(0.0000159148), np.nan])
    written(tmp_path, "ReadMe", HIP2)
    dec = np.degrees([0.0190068680, -0.3403239102])
    for name, content in (("hip2.dat", HIP2_ROWS.encode()), ("hip2.dat.gz", gzip.compress(HIP2_ROWS.encode()))):
        table = read_table(written(tmp_path, name, content))
        assert (table["HIP"].tolist(), table["pmRA"].tolist()) == ([1, 2], [-4.55, 179.7])
        np.testing.assert_allclose(Columns(table).quantity("dec"), dec, rtol=1e-14)
    before = table_file(tmp_path / "hip2.dat")
    written(tmp_path, "ReadMe", f"{HIP2}\n")
    assert table_file(tmp_path / "hip2.dat").digest != before.digest  # which says what the numbers mean
    with pytest.raises(SweepError, match="was changed"):  # as a worker that begins later finds it
        type(before)(before.path, "").columns({}, {}, ())
    with pytest.raises(SweepError, match="a table of CDS needs its ReadMe"):
        read_table(written(tmp_path, "tyc2.dat", HIP2_ROWS))


def test_floats_are_read_to_the_last_bit_and_ecsv_is_what_astropy_reads(tmp_path):
    values = np.random.default_rng(1).normal(size=2000) * 10.0 ** np.arange(-30, 30).repeat(34)[:2000]
    for name, form in (("t.csv", "ascii.csv"), ("t.ecsv", "ascii.ecsv")):
        Table({"x": values}).write(tmp_path / name, format=form)
        np.testing.assert_array_equal(read_table(tmp_path / name)["x"], values)
    table = Table({"id": np.array([2**62 + 1, 2]), "ra": [1.5, np.nan], "name": ["a b", "#2"], "ok": [True, False]})
    table["ra"].unit, table["ra"].description, table.meta["by"] = u.deg, "right", "hand"
    table.write(tmp_path / "of_kinds.ecsv")
    result = read_table(tmp_path / "of_kinds.ecsv")
    assert [result[n].dtype for n in result.colnames] == [table[n].dtype for n in table.colnames]
    assert (result["id"].tolist(), list(result["name"])) == ([2**62 + 1, 2], ["a b", "#2"])
    assert (result["ra"].unit, result["ra"].description, result.meta["by"]) == (u.deg, "right", "hand")


GAIA = "# %ECSV 1.0\n# ---\n# delimiter: ','\n# datatype:\n# - {name: ra, unit: deg, datatype: float64}\n"
GAIA += "# - {name: n, datatype: int16}\nra,n\n1.5,null\nnull,3\n"
BIG = 4295806720123456789, 4295806720123456787
GAPS = [(f"source_id,ra\n{BIG[0]},1.0\n,2.0\n{BIG[1]},\n", {"source_id": [BIG[0], None, BIG[1]], "ra": [1, 2, None]})]
GAPS += [("ra,ok,ok,n\n1,t,t,\n2,,,3\n", {"ra": [1, 2], "ok": ["t", None], "n": [None, 3]})]  # one is there twice
GAPS += [(GAIA, {"ra": [1.5, None], "n": [None, 3]}), ("city\nNew York\nBonn\n", {"city": ["New York", "Bonn"]})]


@pytest.mark.parametrize(("text", "columns"), GAPS)
def test_gaps_are_kept_and_large_identifiers_beside_them(text, columns, tmp_path):
    result = read_table(written(tmp_path, "GaiaSource.csv.gz", gzip.compress(text.encode())))
    assert {name: result[name].tolist() for name in result.colnames} == columns


def test_parquet_has_its_gaps_and_that_of_astropy_its_masks_and_times(tmp_path):
    columns = {"id": [2**62 + 1, None], "ra": [None, 2.5], "name": ["a", None], "ok": [True, None]}
    columns["plx"] = [Decimal("1.25"), None]
    parquet.write_table(pa.table(columns), tmp_path / "gaps.parquet")
    result = read_table(tmp_path / "gaps.parquet")
    assert {name: result[name].tolist() for name in result.colnames} == columns
    table = Table({"id": [2**62 + 1, 7], "ra": [99.0, 2.5], "name": ["x", "b"]}, masked=True)
    table["ra"].unit = u.deg
    table["id"].mask[1] = table["ra"].mask[0] = table["name"].mask[0] = True
    table["t"] = Time([2016.0, 2017.0], format="jyear")
    table.write(tmp_path / "t.parquet")
    names = row_groups(tmp_path / "t.parquet")[1].colnames
    for result in (read_table(tmp_path / "t.parquet"), read_row_group(tmp_path / "t.parquet", 0, names)):
        assert result.colnames == ["id", "ra", "name", "t"]
        assert [result[n].tolist() for n in names[:3]] == [[2**62 + 1, None], [None, 2.5], [None, "b"]]
        assert (result["ra"].unit, result["t"].jyear.tolist()) == (u.deg, [2016.0, 2017.0])
    assert read_row_group(tmp_path / "t.parquet", 0, ["ra"])["ra"].tolist() == [None, 2.5]
    arrow = parquet.read_table(tmp_path / "t.parquet")
    twice = pa.concat_tables([arrow, arrow.select(["ra"])], promote_options="default")
    parquet.write_table(twice, tmp_path / "nulls.parquet")
    with pytest.raises(SweepError, match="has nulls in id, "):  # astropy would read rounded numbers
        read_table(tmp_path / "nulls.parquet")


@pytest.mark.parametrize(("content", "problem"), NO_TABLES)
def test_what_is_no_table_is_a_sentence(content, problem, tmp_path):
    path = written(tmp_path, "t.csv", content)
    with pytest.raises(SweepError, match="(?s)" + problem.replace("(", r"\(")) as error:
        read_table(path)
    assert error.value.where == str(path)


def test_two_tables_in_one_file_or_two_columns_of_one_name(tmp_path):
    Table({"ra": [1.0], "rb": [2.0]}).write(tmp_path / "a.vot", format="votable")
    text = (tmp_path / "a.vot").read_text()
    parquet.write_table(pa.table([[1.0], [2.0]], ["ra", "ra"]), tmp_path / "p.parquet")
    Table({"ra": [1], "rb": [2]}).write(tmp_path / "a.ecsv")
    ecsv = written(tmp_path, "b.ecsv", (tmp_path / "a.ecsv").read_text().replace("rb", "ra"))
    for path in (tmp_path / "p.parquet", written(tmp_path, "b.vot", text.replace('"rb"', '"ra"')), ecsv):
        with pytest.raises(SweepError, match="two columns are called 'ra'"):
            read_table(path)
    body = text[text.index("<TABLE") : text.index("</TABLE>") + 8]
    named = body.replace("<TABLE", '<TABLE name="second"', 1)
    with pytest.raises(SweepError, match=r"has 2 tables in it: table \(1\), second \(2\); leave one"):
        read_table(written(tmp_path, "t.vot", text.replace(body, body + named)))
    assert read_table(written(tmp_path, "t.vot", text.replace(body, f"<TABLE/>{body}")))["rb"].tolist() == [2.0]
    first, second = (fits.BinTableHDU(Table({"ra": [x]}), name=name) for x, name in ((1.0, "A"), (2.0, "B")))
    fits.HDUList([fits.PrimaryHDU(), first, second]).writeto(tmp_path / "two.fits")
    with pytest.raises(SweepError, match=r"has 2 tables in it: A \(1\), B \(2\); leave one"):
        read_table(tmp_path / "two.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.zeros((2, 2))), second]).writeto(tmp_path / "one.fits")
    assert read_table(tmp_path / "one.fits")["ra"].tolist() == [2.0]


def read(quantity, values, unit=None, name=None, stated=None, **further):
    table = Table({name or quantity: values, **further})
    table[name or quantity].unit = unit
    columns = {} if name is None else {quantity: name}
    reader = Columns(table, "t", columns, {} if stated is None else {quantity: stated}, (quantity,))
    result = reader.quantity(quantity)
    reader.finish()
    return result


@pytest.mark.parametrize(("quantity", "values", "expected", "how"), UNCLEAR)
def test_values_are_in_degrees_mas_and_mas_per_year(quantity, values, expected, how):
    np.testing.assert_allclose(read(quantity, values, **how), expected, rtol=1e-14)


@pytest.mark.parametrize(("quantity", "values", "how", "words"), UNREAD)
def test_columns_that_cannot_be_understood_are_named(quantity, values, how, words):
    with pytest.raises(SweepError, match=words):
        read(quantity, values, **how)


def test_what_a_table_is_said_to_include_holds_for_units_of_time_too():
    table = Table({"pmra": [1e-3], "dec": [60.0]}, units={"pmra": "s / yr"})
    by_default, stated, without = (Columns(table).quantity("pmra", cos_dec=said)[0] for said in (None, True, False))
    assert (by_default, stated, without) == pytest.approx((7.5, 15.0, 7.5), rel=1e-14)
    for unit in (None, *UNITS):
        assert Columns(Table({"ra": [1.0]}, units={"ra": unit})).in_time("ra") is (unit not in (None, "rad"))


def joined(inner):
    return st.one_of(st.builds(words.format, *[inner] * number) for number, words in JOINED)


@settings(max_examples=examples(100))
@given(st.recursive(COMPARISONS, joined, max_leaves=6))
def test_rows_are_those_of_pandas(condition):
    wanted = FRAME.eval(condition, engine="python").to_numpy(dtype=bool)
    if wanted.any():
        np.testing.assert_array_equal(rows_where(TABLE, condition), wanted)
    else:
        with pytest.raises(SweepError, match="keeps none of 8 rows"):
            rows_where(TABLE, condition)


@settings(max_examples=examples(300))
@given(st.text(alphabet="ab ns<>=!&|~()[]{}'\"`.,:0123eE+-*/%^@#lambdinotrue_\\\n\té", max_size=30))
def test_any_text_gives_rows_or_is_refused(condition):
    try:
        rows = rows_where(TABLE, condition)
    except SweepError:
        return
    assert (rows.dtype, rows.shape, rows.any()) == (bool, (8,), True)


@pytest.mark.parametrize(("condition", "words"), REFUSED)
def test_what_is_refused_names_the_piece_and_the_cause(condition, words):
    with pytest.raises(SweepError, match=words):
        rows_where(stars(), condition)


def stars():
    table = Table({"name": ["A", "B", "C", ""], "g": np.float32([12.0, 13.0, 14.0, 15.0])})
    table["ruwe"] = MaskedColumn([0.9, 1.4, 2.0, 1.0], mask=[False, False, False, True])
    table["good"] = [1, 0, 1, 0]
    table["duplicated_source"] = MaskedColumn([True, False, False, True], mask=[False] * 3 + [True])
    table["pair"] = np.zeros((4, 2))
    table["B-V"] = [0.1, np.nan, 0.5, 0.7]
    table["lambda"] = [1, 2, 3, 4]
    return table


@pytest.mark.parametrize(("condition", "rows"), MISSING)
def test_missing_values_truth_values_and_quoted_names(condition, rows):
    assert np.flatnonzero(rows_where(stars(), condition)).tolist() == rows
    several = conditions([f"g < 12.5 | {condition}", "g > 12.5"], (), ["stars"])["stars"]
    assert np.flatnonzero(rows_where(stars(), several)).tolist() == [row for row in rows if row]
