"""Results of every allowed type come back to the last bit; all others are refused by name."""

import dataclasses
import datetime
import sys
from collections import namedtuple
from decimal import Decimal
from types import ModuleType

import astropy.units as u
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from astropy.time import Time
from astropy.utils.masked import Masked

from linksweep.sweep.contract import NotFiniteError, Output, ResultError
from linksweep.sweep.functions.results import Declared, as_row, differences, flatten, joined, split_points

PLAIN = Declared("f", "f", (), ("beta",))


def back(result, declared=PLAIN):
    """What a result is after a row has held it: values by name."""
    outcome = flatten(result, declared)
    row = np.array([outcome.row], dtype=outcome.layout.dtype)
    values = {}
    for field in outcome.layout.fields:
        array = row[field.name][0]
        values[field.name] = np.reshape(array, -1).tolist() if field.type == "text" else array
    return values, outcome.layout


SCALARS = {
    "float": 0.1 + 0.2,
    "negative zero": -0.0,
    "denormal": 5e-324,
    "numpy float": np.float64(1 / 3),
    "single": np.float32(0.1),
    "int": 2**63 - 1,
    "least int": -(2**63),
    "minus one": -1,
    "numpy int": np.int32(-7),
    "unsigned": np.uint8(255),
    "bool": True,
    "numpy bool": np.bool_(False),
    "0-d": np.array(2.5),
    "0-d int": np.array(3),
}


@pytest.mark.parametrize("what", SCALARS)
def test_scalars_to_the_last_bit_with_their_type(what):
    value = SCALARS[what]
    expected = np.asarray(value)
    expected = expected.astype({"f": "f8", "i": "i8", "u": "i8", "b": bool}[expected.dtype.kind])
    for result in ({"y": value}, {"y": value, "other": [1.0, 2.0]}):  # the quick way and the other
        (found, _) = back(result)
        assert found["y"].dtype == expected.dtype
        assert found["y"].tobytes() == expected.tobytes()


@pytest.mark.parametrize("text", ["", "wave", "Größe ☃ 𝔸", "a\x00b", "x" * 10_000])
def test_texts(text):
    assert back({"y": text})[0]["y"] == [text]
    assert back({"y": np.str_(text.strip("\x00"))})[0]["y"] == [text.strip("\x00")]


TIMES = {
    "datetime": (datetime.datetime(2024, 2, 29, 12, 0, 0, 1), "2024-02-29T12:00:00.000001"),
    "date": (datetime.date(2024, 2, 29), "2024-02-29"),
    "numpy": (np.datetime64("2024-01-01T00:00:00.123456789"), "2024-01-01T00:00:00.123456789"),
    "pandas": (pd.Timestamp("2024-01-01T00:00:00.000000001"), "2024-01-01T00:00:00.000000001"),
}


@pytest.mark.parametrize("what", TIMES)
def test_times_to_the_nanosecond(what):
    given, expected = TIMES[what]
    found = back({"y": given})[0]["y"]
    assert found == np.datetime64(expected, "ns")
    assert found.dtype == "M8[ns]"


@dataclasses.dataclass
class Result:
    y: float
    z: str


def test_what_holds_results():
    pair = namedtuple("pair", "y z")
    for result in ({"y": 1.0, "z": "a"}, Result(1.0, "a"), pair(1.0, "a")):
        found, layout = back(result)
        assert (float(found["y"]), found["z"]) == (1.0, ["a"])
        assert [field.type for field in layout.fields] == ["float", "text"]
    assert float(back(3.5)[0]["f"]) == 3.5
    assert back([1.0, 2.0])[1].fields[0].dims == ("f_dim_0",)
    one = Declared("f", "y", (Output("y", unit="m"),), ())
    assert back(3.5, one)[1].fields[0].unit == "m"


def test_masked_quantities_without_a_masked_value_are_quantities():
    found, layout = back({"y": Masked([1.0, 2.0] * u.km, mask=[False, False])})
    assert found["y"].tolist() == [1.0, 2.0]
    assert layout.fields[0].unit == "km"


def test_xarray_keeps_dimensions_coordinates_units_and_what_stands_beside():
    time = xr.DataArray([0.0, 1.5], dims="time", attrs={"units": "d"})
    array = xr.DataArray(
        [[1.0, 2.0], [3.0, 4.0]],
        {"time": time, "who": ["a", "b"], "beta": 0.1, "year": 1999},
        ("time", "who"),
        "n",
        {"units": "kg", "long_name": "mass"},
    )
    found, layout = back(array)
    assert found["n"].tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert found["year"] == 1999  # beta is the parameter
    field = layout.fields[0]
    assert (field.name, field.dims, field.unit, field.meaning) == ("n", ("time", "who"), "kg", "mass")
    assert [(c.name, c.type, c.values, c.unit) for c in layout.coordinates] == [
        ("time", "float", (0.0, 1.5), "d"),
        ("who", "text", ("a", "b"), ""),
    ]
    assert back(array.to_dataset())[1].fields[0] == field
    assert back({"n": array.drop_vars(["beta", "year"])})[1].fields[0] == field
    turned = Declared("f", "f", (Output("n", dims=("who", "time")),), ("beta",))
    assert back(array, turned)[0]["n"].tolist() == [[1.0, 3.0], [2.0, 4.0]]


def test_pandas_series_are_arrays_with_their_index():
    series = pd.Series([1.0, 2.0], index=pd.Index([10, 20], name="hour"), name="power")
    found, layout = back(series)
    assert found["power"].tolist() == [1.0, 2.0]
    assert layout.coordinates[0].values == (10, 20)


REFUSED = {
    "nothing": (None, "f returns nothing (None)"),
    "an empty dict": ({}, "f returns no results"),
    "None in it": ({"y": None}, "'y' is of type NoneType"),
    "complex": ({"y": 1j}, "'y' is of type complex"),
    "complex array": ({"y": np.array([1j])}, "'y' is of type complex128"),
    "ragged": ({"y": [[1.0], [1.0, 2.0]]}, "'y' has parts of different lengths"),
    "nested": ({"y": {"z": 1.0}}, "'y' is a dict; results are not nested"),
    "an object": ({"y": object()}, "'y' is of type object"),
    "decimal": ({"y": Decimal(1)}, "'y' is of type Decimal"),
    "bytes": ({"y": b"x"}, "'y' is of type bytes"),
    "objects": ({"y": np.array([1.0, None], dtype=object)}, "'y' is of type NoneType, float"),
    "a large int": ({"y": 2**63}, "integers have 64 bits at most"),
    "large ints": ({"y": [2**64]}, "'y' is 18446744073709551616; integers have 64 bits at most"),
    "a large unsigned": ({"y": np.uint64(2**63)}, "'y' is 9223372036854775808; integers have 64 bits at most"),
    "a zone": (
        {"y": datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)},
        "'y' is a time with the zone UTC; results are in UTC without one",
    ),
    "far times": ({"y": np.datetime64("9999-01-01")}, "beyond the years 1678 to 2261"),
    "a duration": ({"y": np.timedelta64(3, "s")}, "'y' is of type timedelta64[s]"),
    "a surrogate": ({"y": "\ud800"}, "'y' is '\\ud800', which has a lone surrogate"),
    "no values": ({"y": []}, "'y' has no values"),
    "mixed": ({"y": [1, "a"]}, "'y' is of type int, str"),
    "masked": ({"y": np.ma.array([1.0, 2.0], mask=[0, 1])}, "'y' has 1 masked values"),
    "masked quantity": ({"y": Masked([1.0, 2.0] * u.km, mask=[False, True])}, "'y' has 1 masked values"),
    "masked array of astropy": ({"y": Masked([1.0, 2.0], mask=[True, True])}, "'y' has 2 masked values"),
    "quantities": ({"y": [1.0 * u.km, 2.0 * u.m]}, "'y' is a list of quantities; make one of them"),
    "a truth value of NumPy among numbers": ({"y": [np.True_, 2.5]}, "'y' is of type bool, float"),
    "a time of astropy": ({"y": Time(2020.0, format="jyear")}, "'y' is of type Time"),
    "a coordinate of durations": (
        {"y": xr.DataArray([1.0], dims="k", coords={"k": pd.to_timedelta([1], "h")})},
        "'y' has a coordinate 'k' that is of type timedelta64",
    ),
    "a coordinate that is NaN": (
        {"y": xr.DataArray([1.0], dims="k", coords={"k": [np.nan]})},
        "'y' has a coordinate 'k' that has values that are not finite",
    ),
    "like a parameter": ({"beta": 1.0}, "the output 'beta' has the name of a parameter"),
    "a name of ours": ({"status": 1.0}, "the output 'status': the platform gives this name"),
    "no name": ({1: 1.0}, "the name 1 of an output is no text"),
    "a bad name": ({"a/b": 1.0}, "the output 'a/b': a name begins with a letter"),
    "a generator": ((x for x in "ab"), "'f' is of type generator"),
    "a set": ({"y": {1, 2}}, "'y' is of type set"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_result_is_refused_by_name(what):
    result, sentence = REFUSED[what]
    with pytest.raises(ResultError) as caught:
        flatten(result, PLAIN)
    assert sentence in str(caught.value)


@pytest.mark.filterwarnings("ignore:Duplicate dimension names")
def test_a_dimension_that_is_there_twice_is_refused():
    with pytest.raises(ResultError, match=r"'y' has the dimensions .k, k., one of them twice"):
        flatten({"y": xr.DataArray([[1.0]], dims=("k", "k"))}, PLAIN)


def test_what_is_not_finite_is_refused_by_name_unless_it_is_declared():
    for value, words in ((np.nan, "y is NaN"), (-np.inf, "y is infinite"), ([1.0, np.nan], "y has 1 NaN of 2 values")):
        with pytest.raises(NotFiniteError, match=words):
            flatten({"y": value}, PLAIN)
        allowed = Declared("f", "f", (Output("y", nan=True),), ())
        assert not np.isfinite(back({"y": value}, allowed)[0]["y"]).all()
    with pytest.raises(NotFiniteError, match="NaT"):
        flatten({"y": np.datetime64("NaT", "s")}, PLAIN)


def test_what_is_declared_is_held_to():
    t = np.array([0.0, 1.0, 2.0])
    outputs = (Output("n", dims=("time",), coords={"time": (t, "d")}, unit="kg"), Output("m", dims=("time",)))
    declared = Declared("f", "f", outputs, ())
    _, layout = back({"n": [1, 2, 3], "m": [1.0, 2.0, 3.0], "rest": "x"}, declared)
    assert layout.coordinates[0].values == (0.0, 1.0, 2.0)
    assert layout.coordinates[0].unit == "d"
    assert [field.unit for field in layout.fields] == ["kg", "", ""]
    for result, sentence in {
        "length": ({"n": [1.0], "m": [1.0, 2.0, 3.0]}, "'n' has 1 values along 'time', expected 3"),
        "dimensions": ({"n": [[1.0]], "m": t}, "'n' has the shape (1, 1), expected the dimensions (time)"),
        "misspelt": ({"n": t, "mm": t}, "does not return the output 'm'; did you mean 'mm'?"),
        "unit": (
            {"n": xr.DataArray(t, dims="time", attrs={"units": "g"}), "m": t},
            "'n' is in g, expected kg",
        ),
        "coordinate": (
            {"n": xr.DataArray(t, {"time": t + 1.0}, ("time",)), "m": t},
            "'n' has other values along 'time' than are declared",
        ),
    }.values():
        with pytest.raises(ResultError) as caught:
            flatten(result, declared)
        assert sentence in str(caught.value)


def layout_of(result):
    return flatten(result, PLAIN).layout


def test_later_points_are_compared_by_name_with_what_is_expected_and_found():
    first = {"y": 1.0, "n": 3, "t": xr.DataArray([1.0, 2.0], {"x": [0.0, 0.5]}, ("x",), attrs={"units": "m"})}
    expected = layout_of(first)
    assert not differences(expected, layout_of(dict(reversed(first.items()))))
    assert not differences(expected, layout_of(first | {"y": 2, "n": 3.0}))  # integers and floats are joined
    for changed, sentence in (
        ({"n": True}, "the type of 'n' is 'bool', expected 'number'"),
        ({"y": "a"}, "the type of 'y' is 'text', expected 'number'"),
        ({"y": [1.0]}, "the dims of 'y' is ('y_dim_0',), expected ()"),
        ({"more": 1}, "'more' was not returned by the first point"),
        (
            {"t": xr.DataArray([1.0, 2.0], {"x": [0.0, 0.6]}, ("x",), attrs={"units": "m"})},
            "value 1 of the coordinate 'x' is 0.6, expected 0.5",
        ),
        (
            {"t": xr.DataArray([1.0], {"x": [0.0]}, ("x",), attrs={"units": "m"})},
            "the length of 'x' is 1, expected 2",
        ),
        (
            {"t": xr.DataArray([1.0, 2.0], {"x": [0.0, 0.5]}, ("x",), attrs={"units": "km"})},
            "the unit of 't' is 'km', expected 'm'",
        ),
        (
            {"t": xr.DataArray([1.0, 2.0], {"x": ("x", [0.0, 0.5], {"units": "s"})}, ("x",), attrs={"units": "m"})},
            "the unit of the coordinate 'x' is 's', expected ''",
        ),
        (
            {"t": xr.DataArray([1.0, 2.0], {"x": [False, True]}, ("x",), attrs={"units": "m"})},
            "the type of the coordinate 'x' is 'bool', expected 'float'",
        ),
    ):
        assert sentence in differences(expected, layout_of(first | changed))
    assert "'y' is missing; did you mean 'yy'?" in differences(
        expected, layout_of({"yy": 1.0, "n": 3, "t": first["t"]})
    )


def test_rows_are_brought_into_the_order_of_the_first():
    expected = layout_of({"a": 1.0, "b": 2}).with_floats("b")
    other = flatten({"b": 7, "a": 3.5}, PLAIN)
    assert as_row(other, expected) == (3.5, 7)


def test_results_are_floats_where_one_has_floats_unless_that_would_round_an_integer():
    whole, broken, large = (flatten({"a": value, "b": 1}, PLAIN) for value in (2, 2.5, 2**53 + 1))
    layout = joined(whole.layout, broken.layout)
    assert layout == joined(broken.layout, whole.layout)
    assert [field.type for field in layout.fields] == ["float", "int"]
    assert as_row(whole, layout) == (2, 1)
    with pytest.raises(ResultError, match="'a' is 9007199254740993, which is beyond 2\\*\\*53, and other points have"):
        as_row(large, layout)


def test_a_list_does_not_round_integers():
    with pytest.raises(ResultError, match="has 9007199254740993, an integer beyond 2\\*\\*53, beside floats"):
        flatten([2**53 + 1, 0.5], PLAIN)
    assert flatten([2**53, 0.5], PLAIN).layout.fields[0].type == "float"


def test_points_of_a_vectorised_result_are_those_of_single_calls():
    together = {
        "a": np.arange(3.0),
        "n": np.arange(3),
        "v": np.arange(6.0).reshape(3, 2),
        "s": ["x", "y", "x"],
        "c": "all",
    }
    for i, flat in enumerate(split_points(together, 3, PLAIN, "points")):
        single = flatten({k: v if k == "c" else v[i] for k, v in together.items()}, PLAIN)
        assert flat.layout == single.layout
        assert all(map(np.array_equal, flat.row, single.row))
    with pytest.raises(ResultError, match="'a' has 2 values, expected an array, one for each of 3 points"):
        split_points({"a": [1.0, 2.0]}, 3, PLAIN, "points")


@pytest.mark.parametrize("noun", ["points", "realisations"])
@pytest.mark.parametrize("n", [1, 3])
def test_one_number_for_all_is_refused_and_a_text_is_that_of_each(noun, n):
    with pytest.raises(ResultError, match=f"'a' is one number, expected an array, one for each of {n} {noun}"):
        split_points({"a": 1.0}, n, PLAIN, noun)
    assert len(split_points({"a": np.arange(n), "s": "x"}, n, PLAIN, noun)) == n


def test_a_tuple_has_the_declared_outputs_in_order():
    declared = Declared("both", "both", (Output("curve", dims=("time",), coords={"time": [0.0, 1.0]}), Output("peak")))
    by_name = flatten({"curve": np.array([1.0, 2.0]), "peak": 2.0}, declared)
    in_order = flatten((np.array([1.0, 2.0]), 2.0), declared)
    assert in_order.layout == by_name.layout
    assert all(map(np.array_equal, in_order.row, by_name.row))
    with pytest.raises(ResultError, match="a tuple of 1 values, expected one for each declared output: curve, peak"):
        flatten((1.0,), declared)
    pairs = Declared("both", "both", (Output("total"), Output("difference")))
    rows = split_points((np.array([3.0, 5.0]), np.array([1.0, 1.0])), 2, pairs, "points")
    assert [row.row for row in rows] == [flatten((total, 1.0), pairs).row for total in (3.0, 5.0)]
    assert flatten((1.0, 2.0), Declared("pair", "pair")).layout.fields[0].dims == ("pair_dim_0",)


def test_while_another_thread_imports_xarray(monkeypatch):
    """It is in ``sys.modules`` before it has any classes."""
    monkeypatch.setitem(sys.modules, "xarray", ModuleType("xarray"))
    values, _ = back({"x": 1.5})
    assert values["x"] == 1.5
