"""Matching by name and by position, and what is said about doubtful matches."""

import numpy as np
import pytest
from astropy.table import Table, vstack

from linksweep.sweep.contract import SweepError
from linksweep.sweep.tie.link import tie
from linksweep.sweep.tie.matching import match
from linksweep.sweep.tie.tables import read_table
from tests.core.tie.made import stars
from tests.sweep.tie.test_tables import gaia


def test_several_sources_within_the_radius_are_said(tmp_path):
    made = stars(6)
    path = gaia(tmp_path / "rows.ecsv", made)
    table, other = Table.read(path), Table.read(path)[1:3]
    other["source_id"] += 1000
    other["dec"] += 3.0 / 3600.0
    vstack([table, other]).write(tmp_path / "sources.ecsv")
    satellite, rows = read_table(tmp_path / "sources.ecsv"), read_table(path)
    wide = match(satellite, rows, "position:5")
    assert wide.source.tolist() == list(range(6))
    assert wide.ambiguous.tolist() == [1, 2]
    assert not len(match(satellite, rows, "position:1").ambiguous)
    notes = tie(tmp_path / "sources.ecsv", path, "orientation", by="position:5").attrs["notes"]
    assert "row 2, 3 of rows.ecsv: several sources are within the radius; the nearest is taken" in notes


def test_far_rows_that_were_matched_by_position_have_no_name(tmp_path):
    made = stars(6)
    path = gaia(tmp_path / "rows.ecsv", made)
    table = Table.read(path)
    table["dec"] += 20.0 / 3600.0
    table.write(tmp_path / "far.ecsv")
    notes = tie(path, tmp_path / "far.ecsv", "orientation", by="position:60", accept_misfit=True).attrs["notes"]
    assert any("up to 20 arcsec from their source" in note for note in notes)


def test_rows_that_repeat_another_are_said(tmp_path):
    path = gaia(tmp_path / "rows.ecsv", stars(6))
    table = Table.read(path)
    later = table[:2].copy()
    later["ref_epoch"] += 1.0
    vstack([table, table[4:6], later], metadata_conflicts="silent").write(tmp_path / "twice.ecsv")
    notes = tie(path, tmp_path / "twice.ecsv", "orientation", accept_misfit=True).attrs["notes"]
    repeated = [note for note in notes if "the same numbers" in note]
    assert repeated == ["row 7, 8 of twice.ecsv: the same numbers as another row of the source; all are used"]


def test_no_name_in_both_tables_shows_names_that_are_none_of_the_missing(tmp_path):
    made = stars(3)
    a = gaia(tmp_path / "a.ecsv", made, name=["", "HR 1", "HR 2"])
    b = gaia(tmp_path / "b.ecsv", made, name=["HIP 1", "", "HIP 2"], source_id=[7, 8, 9])
    with pytest.raises(SweepError, match=r"a.ecsv has name like 'HR 1', .*b.ecsv has name like 'HIP 1'$"):
        match(read_table(a), read_table(b), "name")


def test_one_source_alone_can_be_matched_by_position(tmp_path):
    path = gaia(tmp_path / "one.ecsv", stars(1))
    found = match(read_table(path), read_table(path), "position")
    np.testing.assert_array_equal(found.source, [0])


def test_a_column_of_text_that_repeats_itself_holds_no_names(tmp_path):
    made = stars(6)
    of_table = {"spectral_type": ["K0", "G2", "K0", "M1", "F5", "A0"]}
    a = gaia(tmp_path / "a.ecsv", made, name=[f"HR {k}" for k in range(6)], **of_table)
    b = gaia(tmp_path / "b.ecsv", made, name=[f"HD {k}" for k in range(6)], source_id=np.arange(6), **of_table)
    satellite, rows = read_table(a), read_table(b)
    assert match(satellite, rows).by == "position within 1 arcsec"
    with pytest.raises(SweepError, match="spectral_type K0 occurs more than once"):
        match(satellite, rows, "spectral_type")


def test_a_satellite_without_positions_is_refused(tmp_path):
    path = gaia(tmp_path / "a.ecsv", stars(6))
    table = Table.read(path)
    table.rename_columns(["ra", "dec"], ["_RA.icrs", "_DE.icrs"])
    table.remove_columns(["ra_error", "dec_error"])
    table.write(tmp_path / "b.ecsv")
    with pytest.raises(
        SweepError, match=r"each source needs a position, .* no ra and dec in row 1, 2, 3, 4, 5 and 1 more"
    ):
        tie(tmp_path / "b.ecsv", path)
    with pytest.raises(SweepError, match=r"nothing in the tables determines .*rows: 6 three-parameter"):
        tie(path, tmp_path / "b.ecsv", "orientation")
