"""Numbers, units and names of columns, and what is refused with its value and row."""

import numpy as np
import pytest
from astropy.table import Table

from linksweep.core.constants import MAS
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tie.link import tie
from linksweep.sweep.tie.options import TableOptions
from linksweep.sweep.tie.tables import read_table
from tests.core.tie.made import stars
from tests.sweep.tie.test_tables import gaia


@pytest.mark.parametrize("unit", ["s", "ms", "hourangle", "min"])
def test_errors_of_ra_in_units_of_time_lack_cos_dec(tmp_path, unit):
    made, seconds = stars(4), {"s": 1.0, "ms": 1e-3, "hourangle": 3600.0, "min": 60.0}[unit]
    errors = made.errors[0] / MAS / 15000.0 / np.cos(made.values[1]) / seconds
    path = gaia(tmp_path / "g.ecsv", made, ra_error=errors)
    table = Table.read(path)
    table["ra_error"].unit = unit
    table.write(path, overwrite=True)
    np.testing.assert_allclose(read_table(path).astrometry.errors[0], made.errors[0], rtol=1e-12)


def test_proper_motions_in_seconds_of_time_a_year_and_ra_in_hours(tmp_path):
    made = stars(4)
    path = gaia(tmp_path / "g.ecsv", made)
    table = Table.read(path)
    for name in ("pmra", "pmra_error"):
        table[name] /= 15000.0 * np.cos(made.values[1])
        table[name].unit = "s/yr"
    table["ra"] /= 15.0
    table["ra"].unit = "h"
    table.write(path, overwrite=True)
    found = read_table(path).astrometry
    np.testing.assert_allclose(found.values, made.values, rtol=1e-12)
    np.testing.assert_allclose(found.errors, made.errors, rtol=1e-12)


def test_an_error_without_a_unit_beside_a_value_in_another_unit_is_refused(tmp_path):
    path = gaia(tmp_path / "g.ecsv", stars(4))
    table = Table.read(path)
    table["parallax"].unit = "arcsec"
    table.write(path, overwrite=True)
    with pytest.raises(SweepError, match=r"'parallax' is in arcsec, and 'parallax_error' has no unit; say --unit"):
        read_table(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parallax": ["1.0", "2.0", "-", "3.0"]}, "'parallax' does not hold numbers: row 3 has the text '-'"),
        ({"parallax": [1.0, np.inf, 1.0, 1.0]}, "an infinite parallax in row 2"),
        (
            {"ra": np.array([100.0] * 4, np.float32)},
            r"positions in single precision .* too coarse .* in row 1, 2, 3, 4",
        ),
    ],
)
def test_values_that_would_ruin_a_link_are_refused(tmp_path, changes, message):
    with pytest.raises(SweepError, match=message):
        read_table(gaia(tmp_path / "g.fits", stars(4), **changes))


def test_single_precision_is_good_enough_for_large_errors(tmp_path):
    made = stars(4)
    path = gaia(tmp_path / "g.fits", made, ra=np.rad2deg(made.values[0]).astype(np.float32), ra_error=[1e4] * 4)
    np.testing.assert_allclose(read_table(path).astrometry.values[0], made.values[0], rtol=1e-7)


def test_radial_velocities_that_no_star_has_count_as_missing(tmp_path):
    codes = gaia(tmp_path / "codes.ecsv", stars(5), radial_velocity=[20.0, -9999.0, np.inf, 2e5, np.nan])
    found = read_table(codes)
    np.testing.assert_array_equal(found.astrometry.radial_velocity, [20.0, *[np.nan] * 4])
    assert found.named_notes() == [
        "codes.ecsv: radial_velocity beyond 5000 km/s, which no star has, is not used: row 2, 3, 4"
    ]


def test_names_are_the_same_however_they_are_stored(tmp_path):
    made = stars(3)
    for number, names in enumerate(([71, 72, 73], [71.0, 72.0, 73.0], ["71 ", " 72", "73"], [b"71", b"72", b"73"])):
        path = gaia(tmp_path / f"{number}.parquet", made, hip=names)
        assert read_table(path).names["hip"].tolist() == ["71", "72", "73"]
    gapped = gaia(tmp_path / "gap.fits", made, hip=[71.0, np.nan, 73.0])
    assert read_table(gapped).names["hip"].tolist() == ["71", "--", "73"]


def test_values_without_errors_are_said(tmp_path):
    path = gaia(tmp_path / "g.ecsv", stars(9))
    table = Table.read(path)
    table.remove_column("parallax_error")
    table.write(tmp_path / "without.ecsv")
    link = tie(path, tmp_path / "without.ecsv", by="source_id")
    assert "without.ecsv: no errors of parallax, which counts as not measured" in link.attrs["notes"]


def test_a_correlation_without_a_column_is_said_where_the_others_are_impossible(tmp_path):
    made = stars(4)
    path = gaia(tmp_path / "g.ecsv", made, ra_pmra_corr=[0.9] * 4, dec_pmra_corr=[0.9] * 4)
    table = Table.read(path)
    table.remove_column("ra_dec_corr")
    table.write(path, overwrite=True)
    with pytest.raises(SweepError, match=r"impossible .*; there is no column ra_dec_corr, which counts as 0: in row 1"):
        read_table(path)


@pytest.mark.parametrize(("name", "unit"), [("ra", "s"), ("dec", "arcsec")])
def test_the_unit_of_an_error_beside_a_sexagesimal_angle_is_said(tmp_path, name, unit):
    path = gaia(tmp_path / "g.ecsv", stars(3), **{name: ["12:00:00.0", "01:00:00.0", "03:00:00.0"]})
    wanted = (
        f"'{name}' is sexagesimal; '{name}_error' has no unit and is taken as mas; else say --unit {name}_error={unit}"
    )
    assert read_table(path).notes == [wanted]
    assert not read_table(path, TableOptions(units={f"{name}_error": unit})).notes


def test_a_folder_is_no_table(tmp_path):
    with pytest.raises(SweepError, match="is a folder, not a table"):
        read_table(tmp_path)
