"""Epochs of a table, however they are written, and what is no epoch."""

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table
from astropy.time import Time

from linksweep.sweep.contract import SweepError
from linksweep.sweep.tie.tables import read_table

WHEN = Time([1991.25, 2016.0, 2030.4], format="jyear", scale="tdb")


def table_with(path, epoch, unit=None):
    table = Table({"ra": [10.0, 20.0, 30.0], "dec": [0.0] * 3, "ra_error": [1.0] * 3, "dec_error": [1.0] * 3})
    table["epoch"] = epoch
    if unit:
        table["epoch"].unit = unit
    table.write(path)
    return path


@pytest.mark.parametrize(
    ("epoch", "unit", "days"),
    [
        (WHEN.jyear, None, 1e-6),
        (WHEN.jyear, "yr", 1e-6),
        (WHEN.mjd, None, 1e-6),
        (WHEN.mjd, "d", 1e-6),
        (WHEN.jd, None, 1e-6),
        (WHEN.jd, "d", 1e-6),
        (WHEN, None, 1e-6),
        (WHEN.iso, None, 0.01),
        ([f"{text}Z" for text in WHEN.isot], None, 0.01),
        ([f"J{year}" for year in WHEN.jyear], None, 0.01),
        ([f"B{year:.6f}" for year in WHEN.byear], None, 0.01),
    ],
)
def test_epochs_in_every_form_are_those_of_astropy(tmp_path, epoch, unit, days):
    found = read_table(table_with(tmp_path / "t.ecsv", epoch, unit)).astrometry.epoch
    np.testing.assert_allclose(found, WHEN.jyear, rtol=0.0, atol=days / 365.25)


@pytest.mark.parametrize(
    ("epoch", "message"),
    [
        (["2015-06-01", "June 2015", "2016-01-01"], "no date like .* row 2 has 'June 2015'"),
        (["2015.5", "2016", "2017"], "no date like .* row 1 has '2015.5'"),
        ([15.5, 16.0, 17.0], "no Julian year, MJD or JD from 1700 to 2300 in row 1, 2, 3"),
        (MaskedColumn([2016.0, 0.0, 2016.0], mask=[False, True, False]), r"no epoch \(column 'epoch'\) in row 2"),
    ],
)
def test_what_is_no_epoch_is_refused_with_its_row_and_once(tmp_path, epoch, message):
    with pytest.raises(SweepError, match=message) as refused:
        read_table(table_with(tmp_path / "t.ecsv", epoch))
    assert len(refused.value.problems) == 1
