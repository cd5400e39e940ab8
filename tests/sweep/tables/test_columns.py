"""Columns as numbers: units, sexagesimal angles and right ascensions, and one sentence for each that is wrong."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import Angle
from astropy.table import Table

from linksweep.sweep.tables.columns import column_values, in_time

ANGLES = ["12 34 56.7", "12:34:56.7", " 12h34m56.7s", "12 34.945", "00 00 00"]


@pytest.mark.parametrize("right_ascension", [True, False])
def test_sexagesimal_angles(right_ascension):
    texts = ANGLES if right_ascension else ["-00 00 01.5", "-12:34:56.7", "+89d59m59.99s", "−1 2 3", "45 30"]
    table = Table({"x": texts})
    unit = u.hourangle if right_ascension else u.deg
    expected = [Angle(text.strip().replace("−", "-"), unit).deg for text in texts]
    np.testing.assert_allclose(column_values(table, "x", "deg", None, right_ascension), expected, rtol=1e-14)


@pytest.mark.parametrize("text", ["24 00 00", "12 60 00", "12 34 61", "12", "twelve", "12 34 56 78", "1-2-3"])
def test_texts_that_are_no_right_ascension_are_named(text):
    with pytest.raises(ValueError, match=r"column 'x' is text that is no angle .* in row 2 \('" + text + r"'\)"):
        column_values(Table({"x": ["12 34 56", text]}), "x", "deg", None, True)


def test_degrees_marked_as_such_are_not_hours_and_hours_are_no_declination():
    assert column_values(Table({"x": ["187d30m00s"]}), "x", "deg", None, True)[0] == 187.5
    with pytest.raises(ValueError, match="in row 1"):
        column_values(Table({"x": ["12h30m00s"]}), "x", "deg")


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
    table = Table({name: values})
    with pytest.raises(ValueError, match=f"column '{name}' has no unit and .* units = {{ ra = \"deg\" }}"):
        column_values(table, name, "deg", None, True)
    np.testing.assert_array_equal(column_values(table, name, "deg", "deg", True), values)
    np.testing.assert_allclose(column_values(table, name, "deg", "hourangle", True), 15.0 * np.array(values))
    table[name].unit = "deg"
    np.testing.assert_array_equal(column_values(table, name, "deg", None, True), values)


def test_degrees_that_cannot_be_hours_are_not_asked_about():
    for name in ("ra", "ra_h", "RA_ICRS"):
        assert column_values(Table({name: [1.0, 24.1]}), name, "deg", None, True)[1] == 24.1
    assert column_values(Table({"dec": [1.0, -1.0]}), "dec", "deg")[0] == 1.0
    with pytest.raises(ValueError, match="has a name that suggests radians"):
        column_values(Table({"DErad": [1.0, -1.0]}), "DErad", "deg")


@pytest.mark.parametrize(
    ("unit", "degrees"), [("h", 15.0), ("hourangle", 15.0), ("min", 0.25), ("s", 1 / 240), ("rad", 180 / np.pi)]
)
def test_units_of_a_right_ascension_are_converted(unit, degrees):
    table = Table({"ra": [1.0, 2.0]}, units={"ra": unit})
    np.testing.assert_allclose(column_values(table, "ra", "deg", None, True), [degrees, 2 * degrees], rtol=1e-14)
    assert in_time(table, "ra") is (unit != "rad")


def test_an_error_in_seconds_of_time():
    table = Table({"e": [1e-6], "pm": [1e-3]}, units={"e": "s", "pm": "s / yr"})
    np.testing.assert_allclose(column_values(table, "e", "mas", None, True), 1.5e-2, rtol=1e-14)
    np.testing.assert_allclose(column_values(table, "pm", "mas / yr", None, True), 15.0, rtol=1e-14)
    assert in_time(table, "e")
    assert in_time(table, "pm")
    with pytest.raises(ValueError, match="column 'e' is in s, not convertible to mas"):
        column_values(table, "e", "mas")


def test_a_unit_that_contradicts_the_file_or_is_none():
    table = Table({"ra": [1.0]}, units={"ra": "deg"})
    with pytest.raises(ValueError, match="is in deg as its file says, but units say hourangle"):
        column_values(table, "ra", "deg", "hourangle", True)
    with pytest.raises(ValueError, match="'hurz' for column 'ra' is no unit"):
        column_values(table, "ra", "deg", "hurz", True)
