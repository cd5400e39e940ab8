"""The galaxy search from files to files: tables, options, both formats, summary, map, and every bad table."""

import json
import shlex
from functools import partial

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from astropy.io import ascii as text_tables
from astropy.table import MaskedColumn, Table
from click.testing import CliRunner

import linksweep
from linksweep.sweep.cli import main
from linksweep.sweep.plots.figure import draw_figure
from linksweep.sweep.search.search import LETTERS, galaxy_table
from tests.documents import commands

ARCSEC = 1.0 / 3600.0
read_matches = partial(Table.read, format="ascii.ecsv")
ARGUMENTS = ["stars.fits", "wide.csv", "sharp.ecsv", "--error", "wide=1", "--error", "sharp=0.3"]
WITH_SUPPLEMENT = [*ARGUMENTS, "--supplement", "extra.ecsv"]
NO_NUMBERS = {"TYC1": None, "TYC2": None, "TYC3": None}
TWICE = {"TYC1": [1, 2, 3, 5], "TYC2": [6] * 4, "TYC3": [1] * 4}  # the last one is in the supplement, too
NO_MOTION = "no proper motion (--missing-pm zero takes it as zero) in row 1, 2, 3, 4"
REFUSED = [({}, ["-o", "wide.csv"], "wide.csv is one of the tables that are read")]
REFUSED += [({}, ["-o", "m.txt"], "m.txt must end in .ecsv"), ({}, ["sub/wide.fits"], "two tables are called 'wide'")]
REFUSED += [({}, ["-o", "m.ecsv", "--table", "m.ecsv"], "m.ecsv is named for two outputs")]
REFUSED += [({}, ["--table", "wide.csv/t.dat"], "is not a directory that can be written")]
REFUSED += [({}, ["--radius", "wied=3"], "radius: no table 'wied'; did you mean 'wide'?")]
REFUSED += [({}, ["--radius", "wide=3", "--radius", "wide=4"], "radius: wide=3, wide=4: one is named twice")]
REFUSED += [({}, ["--column", "ra", "--k-sigma", "-1"], "columns = 'ra': must be [NAME:]KEY=COLUMN")]
REFUSED += [({}, ["--k-sigma", "-1"], "k_sigma = -1: must be a finite number > 0")]
REFUSED += [(NO_NUMBERS, ["--table", "t.dat"], "needs columns TYC1, TYC2 and TYC3, or TYC with strings")]
REFUSED += [({"dec": MaskedColumn([1.0] * 4, mask=[0, 0, 1, 0])}, [], "no dec in row 3")]
REFUSED += [({"ra_error": None}, ["--figure", "m.jpg"], "cannot draw there")]  # before the tables are read
REFUSED += [({"ra_error": None}, [], "give its error in arcsec with --error"), ({"pmdec": [np.nan] * 4}, [], NO_MOTION)]
REFUSED += [({"ra_error": [0.0, 1.0, 1.0, 1.0]}, [], "a ra_error that is not above 0 in row 1 (0)")]
REFUSED += [({"ref_epoch": None}, [], "motions need the epoch"), ({"pmra": [2e4] * 4}, [], "no star has")]
REFUSED += [({"TYC3": [1, 4, 1, 0]}, [], "a TYC3 outside 1..3 in row 2, 4")]
REFUSED += [({"source_id": [4e18, 1.0, 2.0, 2.5]}, [], "a source_id that is no integer in row 1, 4")]  # rounded
REFUSED += [({"TYC1": [1] * 4, "TYC2": [13] * 4, "TYC3": [1, 2, 1, 3]}, [], "the Tycho identifier of an earlier row")]
REFUSED += [(TWICE, ["--supplement", "extra.ecsv"], "TYC 5-6-1: in the star table and again in the supplement")]
REFUSED += [(NO_NUMBERS | {"TYC": ["1-13-1", "1-13", "TYC 1-14-1", ""]}, [], "like '1-13-1' in row 2, 4")]


def read_galaxy_table(path):
    starts, ends = (0, 5, 11, 13, 19, 32, 45), (3, 9, 11, 17, 30, 43, 45)
    names = ("TYC1", "TYC2", "TYC3", "PGC", "RAdeg", "DEdeg", "class")
    return text_tables.read(path, format="fixed_width_no_header", names=names, col_starts=starts, col_ends=ends)


def star_table(**changes):
    """Four stars: a plain galaxy, one 4 sigma off, a star alone, and one that moves onto its galaxy in 8.75 yr."""
    names = ["TYC1", "TYC2", "TYC3", "ra", "dec", "ra_error", "dec_error", "pmra", "pmdec", "vt_mag", "ref_epoch"]
    rows = [
        (1, 13, 1, 10.0, 20.0, 100.0, 110.0, 0.0, 0.0, 12.0, 1991.25),
        (1234, 567, 2, 50.0, -30.0, 120.0, 130.0, 0.0, 0.0, 12.5, 1991.25),
        (9537, 12121, 3, 90.0, 0.0, 50.0, 60.0, 0.0, 0.0, 9.0, 1991.25),
        (4012, 1, 1, 359.99999, 0.0, 140.0, 150.0, 6000.0, 0.0, 13.0, 1991.25),
    ]
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)) | changes
    return Table({name: values for name, values in columns.items() if values is not None})


@pytest.fixture
def folder(here):
    star_table().write("stars.fits")
    supplement = {"TYC1": [5], "TYC2": [6], "TYC3": [1], "ra": [200.0], "dec": [0.0]}
    supplement |= {"ra_error": [200.0], "dec_error": [210.0], "vt_mag": [13.5]}
    Table(supplement).write("extra.ecsv")
    ra, dec = [10.0, 50.0, 359.99999 + 52.5 * ARCSEC - 360.0, 200.0], [20.0 + ARCSEC, -30.0 + 4.1 * ARCSEC, 0.0, 0.0]
    Table({"ra": ra, "dec": dec, "PGC": [7223, 11404, 65866, 99999]}).write("wide.csv")
    Table({"ra": [10.0], "dec": [20.0 + 0.2 * ARCSEC]}, units={"ra": "deg"}).write("sharp.ecsv")  # else: hours?
    return here


@pytest.mark.slow
def test_the_command_of_the_document_runs(folder):
    star_table().write("tycho2.fits")
    Table.read("extra.ecsv").write("tycho2_suppl1.fits")
    Table.read("wide.csv").write("pgc.fits")
    Table.read("sharp.ecsv").write("uzc.csv", format="ascii.ecsv")
    command, _ = commands("galaxy-search.md")
    result = run(*shlex.split(command)[2:])
    assert result.exit_code == 0, result.output
    assert (len(read_matches(folder / "galaxies.ecsv")), (folder / "galaxies.png").stat().st_size > 10_000) == (4, True)


def run(*arguments):
    return CliRunner().invoke(main, ["match", *arguments])


def test_the_search_from_files_to_files_and_to_the_catalogue_of_a_study(folder):
    where = ("--where", "stars: vt_mag > 10")  # without the third, which matches nothing
    result = run(*WITH_SUPPLEMENT, *where, "-o", "out.ecsv", "--table", "out.dat", "--figure", "out.png")
    assert result.exit_code == 0, result.output
    assert all(words in result.output for words in ("certain", " 120 ± 28 ", " 130 ± 28 ", " 12.5 ± 0.7"))
    table = read_matches(folder / "out.ecsv")
    rows = [  # in order of the star's ra at the epoch
        ("certain", "none", "wide", "wide", 3, "stars", 4, 65866),
        ("certain", "none", "wide,sharp", "sharp", 1, "stars", 1, 7223),
        ("uncertain", "offset", "wide", "wide", 2, "stars", 2, 11404),
        ("supplement", "none", "wide", "wide", 4, "extra", 1, 99999),
    ]
    names = ["class", "reason", "found_in", "galaxy_table", "galaxy_row", "star_table", "star_row", "PGC"]
    assert [tuple(row) for row in table[names]] == rows
    np.testing.assert_allclose(table["offset"], [0.0, 0.2, 4.1, 0.0], atol=1e-5)
    assert table["ra"][0] == 359.99999  # the star's own row, at its own epoch
    assert table["star_pmra"].mask.tolist() == [False, False, False, True]  # the supplement has none
    assert str(table["offset"].unit) == "arcsec"
    assert table.meta["classes"]["certain"]["n"] == 2
    galaxies = read_galaxy_table(folder / "out.dat")
    assert galaxies["PGC"].tolist() == table["PGC"].tolist()
    assert [list(row)[:3] for row in galaxies] == [[4012, 1, 1], [1, 13, 1], [1234, 567, 2], [5, 6, 1]]
    assert (folder / "out.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(folder.iterdir())) == 4 + 3  # tables that are read and outputs, no more
    fixed = {"catalogue": "file", "file": "out.ecsv", "model": "amex"}
    study = {"title": "Found galaxies", "fixed": fixed, "sampling": {"n_sim": 10, "n_cat": 1, "seed": 1}}
    assert linksweep.run(study, "s.zarr", pool="serial")["n_obj"] == 4


def test_json_is_the_summary(folder):
    options = ("--second-epoch-error", "50", "--radius", "3", "--radius", "wide=5", "--json")
    report = json.loads(run(*WITH_SUPPLEMENT, *options).stdout)
    numbers = {"certain": 2, "uncertain": 1, "supplement": 1, "all": 4}
    assert {name: row["n"] for name, row in report["classes"].items()} == numbers
    certain, wide = report["classes"]["certain"], report["catalogues"]["wide"]
    assert certain["ra_error_mas"] == pytest.approx({"mean": 120.0, "scatter": np.std([100, 140], ddof=1)})
    motions = {"ra": np.hypot(120.0, 50.0) / 20.0, "dec": np.hypot(130.0, 50.0) / 20.0}
    assert (certain["pm_error_mas_yr"], certain["magnitude"]["mean"]) == (pytest.approx(motions), pytest.approx(12.5))
    assert (wide["matches"], report["catalogues"]["sharp"]["matches"], report["galaxies"]) == (4, 1, 4)
    assert wide["chance_pairs_local_error"] == pytest.approx(1.0 / (10.0**2 - 5.0**2))  # as of one pair in the ring
    for name, n, radius in (("wide", 4, 5.0), ("sharp", 1, 3.0)):  # by its name, and that of all others
        pairs = 5 * n * np.sin(np.radians(0.5 * radius * ARCSEC)) ** 2
        assert report["catalogues"][name]["chance_pairs_uniform"] == pytest.approx(pairs)
    assert report["notes"] == ["extra has no proper motions: its positions were taken as they are"]


def test_no_match_still_makes_every_output_and_replaces_none_without_overwrite(folder):
    (folder / "mine.ecsv").write_text("mine")
    (folder / "a.ecsv").symlink_to("mine.ecsv")
    options = "--error 1 --radius 0.00001 --epoch 1800 -o a.ecsv --table a.dat --figure a.svg"
    result = run(*ARGUMENTS[:2], *options.split())
    assert (result.exit_code, result.output) == (2, "error: a.ecsv exists; --overwrite replaces it\n")
    assert ((folder / "a.ecsv").read_text(), len(list(folder.iterdir()))) == ("mine", 6)
    assert run(*ARGUMENTS[:2], *options.split(), "--overwrite").exit_code == 0
    assert (len(read_matches(folder / "mine.ecsv")), (folder / "a.dat").read_text()) == (0, "")  # through the link


def test_gaia_identifiers_are_carried_and_missing_proper_motions_may_be_zero(folder):
    ids, pm = np.array([0, *(2**62 + k for k in range(3))]), MaskedColumn([0.0, 0.0, 0.0, 6000.0], mask=[1, 0, 0, 0])
    table = star_table(source_id=ids, pmra=pm, phot_g_mean_mag=[1.0, 2.0, 3.0, 4.0], vt_mag=None, **NO_NUMBERS)
    table.write("stars.fits", overwrite=True)
    said = json.loads(run(*ARGUMENTS, "--missing-pm", "zero", "--json").stdout)["notes"]
    assert said == ["stars of stars without a proper motion, which was taken as zero: 1"]
    actual = read_matches(folder / "results" / "matches.ecsv")
    assert (actual["source_id"].tolist(), "phot_g_mean_mag" in actual.colnames) == ([ids[3], ids[0], ids[1]], True)
    assert actual["star_pmra"].mask.tolist() == [False, True, False]


@pytest.mark.slow
def test_matches_in_a_store_are_looked_at_as_other_results(folder, sweep):
    (folder / "wide.csv").write_text((folder / "wide.csv").read_text().replace(",11404", ","))
    for output in ("m.zarr", "m.ecsv"):
        shown = sweep("match", *WITH_SUPPLEMENT, "-o", output, code=0)[1]
    assert sweep("show", "m.zarr")[1] == shown
    rows, table = json.loads(sweep("show", "m.zarr", "--json")[1])["rows"], read_matches("m.ecsv")
    assert [list(row) for row in rows] == 4 * [table.colnames]
    cells = [[None if cell is np.ma.masked else cell for cell in row] for row in table]
    assert ([list(row.values()) for row in rows], table["PGC"].dtype.kind) == (cells, "i")
    assert sweep("show", "m.zarr", "--format", "ecsv")[1] == (folder / "m.ecsv").read_text()
    assert sweep("report", "m.zarr")[0] == sweep("plot", "m.zarr")[0] == 0
    sentence = "4 of 5 stars are at a galaxy: 2 certain, 1 uncertain, 1 supplement."
    assert sentence in (folder / "m-report.html").read_text()
    for more in ("plot m.zarr --kind lines", "show m.zarr --at x=1", f"match {' '.join(ARGUMENTS)} -o m.zarr"):
        assert sweep(*more.split())[0] == 2


def test_the_map_shows_every_class_with_longitude_to_the_left():
    classes = ["certain", "certain", "uncertain", "supplement"]
    sky = {"ra": ("match", np.full(4, 200.0)), "dec": ("match", np.zeros(4)), "class": ("match", classes)}
    sky |= {"entry_ra": ("entry", np.linspace(0.0, 300.0, 5)), "entry_dec": ("entry", np.zeros(5))}
    axes = draw_figure(xr.Dataset(sky, attrs={"result": "match", "title": "sky", "entries": 10})).axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    shown = ["certain (2)", "uncertain (1)", "supplement (1)", "galaxy catalogues (10, 1 in 2 drawn)"]
    styles = [(lines[k].get_marker(), lines[k].get_markerfacecolor()) for k in shown]
    assert all(len(set(each)) == 3 for each in zip(*styles[:3], strict=True))  # each class has a marker and a colour
    x = lines["supplement (1)"].get_xdata()  # ra 200 dec 0: l = 314 deg, right of the centre
    assert 0.0 < x[0] < np.pi / 2
    tick = {text.get_text(): text.get_position()[0] for text in axes.texts}
    assert tick["60°"] < tick["0°"] < tick["300°"]


@pytest.mark.parametrize(("stars", "arguments", "message"), REFUSED)
def test_what_is_wrong_is_refused_and_nothing_is_written(folder, stars, arguments, message):
    star_table(**stars).write("stars.fits", overwrite=True)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    result = run(*ARGUMENTS, *arguments, "--overwrite")
    assert (result.exit_code, message in result.output) == (2, True), result.output
    assert arguments or "stars.fits" in result.output
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_problems_of_all_tables_come_at_once_and_a_radius_that_pairs_everything_is_bad_input(folder):
    star_table(ra=[np.nan] * 4, TYC1=[0] * 4).write("stars.fits", overwrite=True)
    Table({"ra": [100.0], "dec": [2.0], "PGC": [-1]}).write("bad.ecsv")
    said = run("stars.fits", "bad.ecsv", "--error", "1", "--supplement", "none.fits").output
    messages = "no ra in row 1, 2, 3, 4", "a TYC1 outside 1..9537", "none.fits: no such file"
    assert all(words in said for words in (*messages, "bad.ecsv: a negative PGC number in row 1 (-1)")), said
    rng = np.random.default_rng(1)
    n = 200_000
    for name in ("many", "more"):
        Table({"ra": rng.uniform(0, 360, n), "dec": rng.uniform(-90, 90, n)}).write(f"{name}.fits")
    result = run("many.fits", "more.fits", "--error", "many=1", "--error", "1", "--radius", "3600")
    words = "chance pairs of 200000 and 200000 objects, more than 2e+06; take a smaller one"
    assert (result.exit_code, words in result.output) == (2, True)


def table_of(rows):
    return galaxy_table(pd.DataFrame(rows, columns=["TYC1", "TYC2", "TYC3", "PGC", "ra", "dec", "class"]))


def test_the_table_is_read_back_as_it_was_written_and_refused_where_a_number_does_not_fit(tmp_path):
    rng, n = np.random.default_rng(1), 500
    columns = [rng.integers(1, limit + 1, n) for limit in (9537, 12121, 3, 99999)]
    columns += [rng.integers(0, 36_000_000_000, n) / 1e8, rng.integers(-9_000_000_000, 9_000_000_001, n) / 1e8]
    turned = columns[4] - 360.0 * (columns[4] > 200.0)  # as some catalogues have them
    classes = rng.choice(list(LETTERS), n)
    (tmp_path / "t.dat").write_text(table_of(list(zip(*columns[:4], turned, columns[5], classes, strict=True))))
    back = read_galaxy_table(tmp_path / "t.dat")
    for name, values in zip(back.colnames, (*columns, [LETTERS[name] for name in classes]), strict=True):
        np.testing.assert_array_equal(back[name], values)
    with pytest.raises(linksweep.SweepError) as error:
        table_of([(1, 13, 1, 0, 0.0, 0.0, "certain"), (1, 14, 1, 100_000, 0.0, 0.0, "certain")])
    words = "TYC 1-13-1 has no PGC number\nTYC 1-14-1: PGC = 100000 does not fit bytes"
    assert str(error.value).startswith(words)
