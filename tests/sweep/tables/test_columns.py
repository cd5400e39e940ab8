"""Columns as numbers: units, sexagesimal angles and right ascensions, and one sentence for each that is wrong."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import Angle
from astropy.table import Table

from linksweep import SweepError
from linksweep.sweep.tables.columns import Columns

ANGLES = ["12 34 56.7", "12:34:56.7", " 12h34m56.7s", "12 34.945", "00 00 00"]


def read(quantity, values, unit=None, name=None, stated=None, **further):
    """The values of one column, or the error that says what is wrong with it."""
    table = Table({name or quantity: values, **further})
    table[name or quantity].unit = unit
    columns = {} if name is None else {quantity: name}
    reader = Columns(table, "t", columns, {} if stated is None else {quantity: stated}, (quantity,))
    found = reader.quantity(quantity)
    reader.finish()
    return found


@pytest.mark.parametrize("quantity", ["ra", "dec"])
def test_sexagesimal_angles(quantity):
    texts = ANGLES if quantity == "ra" else ["-00 00 01.5", "-12:34:56.7", "+89d59m59.99s", "−1 2 3", "45 30"]
    unit = u.hourangle if quantity == "ra" else u.deg
    expected = [Angle(text.strip().replace("−", "-"), unit).deg for text in texts]
    np.testing.assert_allclose(read(quantity, texts), expected, rtol=1e-14)


@pytest.mark.parametrize("text", ["24 00 00", "12 60 00", "12 34 61", "12", "twelve", "12 34 56 78", "1-2-3"])
def test_texts_that_are_no_right_ascension_are_named(text):
    with pytest.raises(SweepError, match=r"column 'x' is text that is no angle .* in row 2 \('" + text + r"'\)"):
        read("ra", ["12 34 56", text], name="x")


def test_degrees_marked_as_such_are_not_hours_and_hours_are_no_declination():
    assert read("ra", ["187d30m00s"])[0] == 187.5
    with pytest.raises(SweepError, match="in row 1"):
        read("dec", ["12h30m00s"])


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("ra_h", [0.5, 23.9]),
        ("RAh", [0.0, 12.0]),
        ("ra", [0.0, 24.0]),
        ("ra", [-11.0, 11.0]),
        ("alpha", [0.1, 6.2]),
        ("ra", [10.0]),
        ("ra_s", [100.0, 300.0]),
        ("RAs", [1.0, 59.0]),
    ],
)
def test_a_right_ascension_that_may_be_in_hours_is_asked_about(name, values):
    with pytest.raises(SweepError, match=f"column '{name}' has no unit and .* units = {{ ra = \"deg\" }}"):
        read("ra", values, name=name)
    np.testing.assert_array_equal(read("ra", values, name=name, stated="deg"), values)
    np.testing.assert_allclose(read("ra", values, name=name, stated="hourangle"), 15.0 * np.array(values))
    np.testing.assert_array_equal(read("ra", values, "deg", name), values)


def test_degrees_that_cannot_be_hours_are_not_asked_about_and_names_may_say_radians():
    for name in ("ra", "ra_h", "RA_ICRS"):
        assert read("ra", [1.0, 24.1], name=name)[1] == 24.1
    assert read("dec", [1.0, -1.0])[0] == 1.0
    np.testing.assert_allclose(read("dec", [1.0, -1.0], name="DErad"), np.degrees([1.0, -1.0]))
    np.testing.assert_allclose(read("ra", [1.0, 6.2], name="RArad"), np.degrees([1.0, 6.2]))
    np.testing.assert_allclose(read("dec", [1.0, -60.0], name="dec_rad"), [1.0, -60.0])


@pytest.mark.parametrize(
    ("unit", "degrees"), [("h", 15.0), ("hourangle", 15.0), ("min", 0.25), ("s", 1 / 240), ("rad", 180 / np.pi)]
)
def test_units_of_a_right_ascension_are_converted(unit, degrees):
    np.testing.assert_allclose(read("ra", [1.0, 2.0], unit), [degrees, 2 * degrees], rtol=1e-14)
    table = Table({"ra": [1.0, 2.0]}, units={"ra": unit})
    assert Columns(table).in_time("ra") is (unit != "rad")


def test_errors_and_motions_in_seconds_of_time_get_the_factor_that_they_lack():
    np.testing.assert_allclose(read("ra_error", [1e-6], "s", dec=[60.0]), 0.75e-2, rtol=1e-14)
    np.testing.assert_allclose(read("pmra", [1e-3], "s / yr", dec=[60.0]), 7.5, rtol=1e-14)
    np.testing.assert_allclose(read("reference_pmra_error", [1e-3], "s / yr", dec=[60.0]), 7.5, rtol=1e-14)
    with pytest.raises(SweepError, match="column 'dec_error' is in s, not convertible to mas"):
        read("dec_error", [1e-6], "s")


def test_a_unit_that_contradicts_the_file_or_is_none():
    with pytest.raises(SweepError, match="units: ra in hourangle, but column 'ra' is in deg as its file says"):
        read("ra", [1.0], "deg", stated="hourangle")
    with pytest.raises(SweepError, match="units: ra in 'hurz', which is no unit"):
        read("ra", [100.0], stated="hurz")


def test_a_csv_of_the_gaia_archive_has_no_units_and_is_in_degrees():
    marks = {"source_id": [10**17, 10**17 + 1], "ref_epoch": [2016.0, 2016.0]}
    np.testing.assert_array_equal(read("ra", [10.5, 11.25], **marks), [10.5, 11.25])


def test_what_a_table_is_said_to_include_holds_for_units_of_time_too():
    table = Table({"pmra": [1e-3], "dec": [60.0]}, units={"pmra": "s / yr"})
    by_default, stated, without = (Columns(table).quantity("pmra", cos_dec=said)[0] for said in (None, True, False))
    assert (by_default, stated, without) == pytest.approx((7.5, 15.0, 7.5), rel=1e-14)
