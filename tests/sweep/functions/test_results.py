"""Results of every allowed type come back to the last bit; all others fail their point by name; lengths may differ."""

import dataclasses
import datetime
import json
from collections import namedtuple
from decimal import Decimal

import astropy.units as u
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from astropy.table import Column, MaskedColumn, Table as AstropyTable
from astropy.time import Time
from astropy.utils.masked import Masked

import linksweep
from linksweep import Output, experiment, run
from linksweep.sweep.report.page import report_page
from linksweep.sweep.result import Result
from tests.sweep.opening import check

KEPT = {"a_float": 0.1 + 0.2, "negative_zero": -0.0, "denormal": 5e-324, "zero_d": np.array(2.5), "a_bool": True}
KEPT |= {"numpy_float": np.float64(1 / 3), "single": np.float32(0.1), "an_int": 2**63 - 1, "least_int": -(2**63)}
KEPT |= {"numpy_int": np.int32(-7), "unsigned": np.uint8(255), "numpy_bool": np.bool_(False), "zero_d_int": np.array(3)}
ZONED = pd.Series([1.0, 2.0], index=pd.date_range("2020-06-01", periods=2, tz="Europe/Berlin"))
TOGETHER = [("[*x, 1]", "values, expected an array, one for each"), ("x.sum()", "is one"), ("(x > 0).any()", "is one")]
GROWING = [((), [2, 3], "declare Output(NAME, ragged=True)")]
GROWING += [([Output("a", ragged=True)], [2, 3], "ragged='DIMENSION'")]
GROWING += [([Output("b", ragged=True)], [2], "'b' has the dimensions (b_dim_0, b_dim_1): declare which of them is")]
GROWING += [([Output("a", ragged=True)], [4], "'a' is ragged, and 'a_length' is the name of its length; take another")]
GROWING += [([Output("a", dims="p", ragged=True), Output("b", dims=("q", "p"))], [2, 0], "")]
GROWING += [([Output("a", dims="p", ragged=True), Output("b", dims=("p", "q"), ragged="q")], [2], "several ragged")]
GROWING += [([Output("b", dims=("q", "p"), ragged="q")], [0], "'a' has no values")]


def results_of(results, folder, outputs=(), **options):
    @experiment(outputs=outputs)
    def f(case: str):
        return results[case]

    return run(f, folder / "s.zarr", axes={"case": list(results)}, pool="serial", **options)


def check_refused(expected, good, folder, outputs=()):
    """Refuse that a good result fails its point, or that one of those expected does not, with its sentence."""
    dataset = results_of({"good": good} | {case: result for case, (result, _) in expected.items()}, folder, outputs)
    reasons = {key.removeprefix("case="): why for key, why in json.loads(dataset.attrs["failures"]).items()}
    assert reasons.keys() == expected.keys()
    assert not {case: reasons[case] for case, (_, sentence) in expected.items() if sentence not in reasons[case]}


@pytest.mark.parametrize("more", [{}, {"array": [1.0, 2.0]}], ids=["the quick way", "the other"])
def test_scalars_to_the_last_bit_with_their_type(more, tmp_path):
    ds = results_of({"a": KEPT | more, "b": KEPT | more}, tmp_path)
    for name, value in KEPT.items():
        expected = np.asarray(value, {"f": "f8", "i": "i8", "u": "i8", "b": bool}[np.asarray(value).dtype.kind])
        for stored in (ds, xr.open_zarr(tmp_path / "s.zarr", mask_and_scale=False)):
            assert stored[name].dtype == expected.dtype, name
            assert stored[name].values[1].tobytes() == expected.tobytes(), name


def test_texts_and_times_to_the_nanosecond(tmp_path):
    texts = {"empty": "", "zero": "a\x00b", "long": "x" * 10_000, "of_numpy": np.str_("ü")}
    texts["of_type"] = np.array("Größe ☃ \x00𝔸", dtype=np.dtypes.StringDType())
    now = "2024-02-29T12:34:56.123456789"
    times = {"numpy": np.datetime64(now), "pandas": pd.Timestamp(now), "date": datetime.date(2024, 2, 29)}
    times |= {"moment": datetime.datetime(2024, 2, 29, 12, 0, 0, 1)}
    ds = results_of({"a": texts | times}, tmp_path)
    assert {name: ds[name].item() for name in texts} == texts
    said = [now, now, "2024-02-29", "2024-02-29T12:00:00.000001"]
    assert [ds[name].item() for name in times] == [np.datetime64(value, "ns").astype(int) for value in said]


def test_what_holds_results_and_xarray_keeps_dimensions_coordinates_units_and_what_stands_beside(tmp_path):
    kinds = {"dict": dict, "class": dataclasses.make_dataclass("Result", "yz"), "tuple": namedtuple("pair", "y z")}
    ds = results_of({name: kind(y=1.0, z="a") for name, kind in kinds.items()}, tmp_path)
    assert (ds.y.values.tolist(), ds.z.values.tolist()) == ([1.0] * 3, ["a"] * 3)
    assert results_of({"a": [1.0, 2.0], "b": (3.0, 4.0)}, tmp_path, fresh=True).f.dims == ("case", "f_dim_0")
    ds = results_of({"a": 3.5 * u.Unit("J s / m")}, tmp_path, [Output("y", unit="kg m / s")], fresh=True)
    assert (ds.y.item(), ds.y.units) == (3.5, "kg m / s")  # as it is declared
    results_of({"a": np.arange(1e5)}, tmp_path, fresh=True)
    assert (tmp_path / "s.zarr" / "zarr.json").stat().st_size < 20_000  # which counts them
    ds = results_of({"a": pd.Series([1.0, 2.0], pd.Index([10, 20], name="hour"), name="power")}, tmp_path, fresh=True)
    assert (ds.power.values.tolist(), ds.hour.values.tolist()) == ([[1.0, 2.0]], [10, 20])
    kinds = [Column, MaskedColumn, lambda y, unit: Masked(y * u.km)]
    kinds += [lambda y, unit: np.array(y).view(type("Q", (np.ndarray,), {"units": unit}))]  # as of pint and unyt
    for kind in (*kinds, lambda y, unit: xr.Variable("x", y, {"units": unit})):
        ds = results_of({"a": {"y": kind([1.0, 2.0], unit="km")}}, tmp_path, fresh=True)
        assert (ds.y.values.tolist(), ds.y.units) == ([[1.0, 2.0]], "km")
    assert ds.y.dims == ("case", "x")  # of the last
    about = {"units": "days", "long_name": "epoch"}
    coords = {"time": ("time", [0.0, 1.5], about), "who": ["a", "b"], "case": "nearest", "year": 1999}
    attrs = {"units": "kg", "long_name": "mass"}
    array = xr.DataArray([[1.0, 2.0], [3.0, 4.0]], coords, ("time", "who"), "n", attrs)
    for result in (array, array.to_dataset()):
        ds = results_of({"a": result}, tmp_path, fresh=True)
        assert ds.n.isel(case=0).values.tolist() == [[1.0, 2.0], [3.0, 4.0]]
        assert ds.year.item() == 1999  # case is the parameter
        assert (ds.n.dims, ds.n.units, ds.n.long_name) == (("case", "time", "who"), "kg", "mass")
        assert (ds.time.values.tolist(), ds.time.attrs, ds.who.values.tolist()) == ([0.0, 1.5], about, ["a", "b"])
    cube = xr.DataArray(np.arange(24.0).reshape(2, 3, 4), {"p": [5, 6]}, ("p", "q", "r"))
    both = {"bare": cube[:, 0, 0], "n": cube.assign_coords(p=("p", [5, 6], about))}
    turned = results_of({"a": both}, tmp_path, [Output("n", dims=("r", "p", "q"))], fresh=True).isel(case=0)
    assert (turned.n.values.tolist(), turned.p.attrs) == (cube.values.transpose(2, 0, 1).tolist(), about)


def at_k(value, dim="k", **more):
    return {"y": xr.DataArray(np.ones(len(value)), dims=dim, coords={dim: (dim, value, more)})}


REFUSED = {
    **{"nothing": (None, "f returns nothing (None)"), "an empty dict": ({}, "f returns no results")},
    "None in it": ({"y": None}, "'y' is of type NoneType"),
    "complex array": ({"y": np.array([1j])}, "'y' is of type complex128"),
    "more than 64 bits": ({"y": np.longdouble(1)}, "'y' is of type float128"),
    "ragged": ({"y": [[1.0], [1.0, 2.0]]}, "'y' has parts of different lengths"),
    "nested": ({"y": {"z": 1.0}}, "'y' is a dict; results are not nested"),
    "decimal": ({"y": Decimal(1)}, "'y' is of type Decimal; results are numbers (dur"),
    "objects": ({"y": np.array([1.0, None], dtype=object)}, "'y' is of type NoneType, float"),
    "a large int": ({"y": 2**63}, "'y' is 9223372036854775808; integers are below 2**63 in size"),
    "a large unsigned": ({"y": np.uint64(2**63)}, "integers are below 2**63 in size"),
    "an integer that would be rounded": ({"y": [2**53 + 1, 0.5]}, "9007199254740993, an integer beyond 2**53, beside"),
    "a zone": ({"y": datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)}, "'y' is a time with the zone UTC"),
    "a coordinate with a zone": ({"y": ZONED}, "'y' has a coordinate 'index' of times with the zone Europe/Berlin"),
    "far times": ({"y": np.datetime64("9999-01-01")}, "beyond the years 1678 to 2261"),
    "a duration": ({"y": np.timedelta64(3, "s")}, "type timedelta64[s]; results are numbers (durations: seconds), "),
    "a surrogate": ({"y": "\ud800"}, "'y' is '\\ud800', which has a lone surrogate"),
    **{"no values": ({"y": []}, "'y' has no values"), "mixed": ({"y": [1, "a"]}, "'y' is of type int, str")},
    "a truth value among numbers": ({"y": [np.True_, 2.5]}, "'y' is of type bool, float"),
    "masked": ({"y": np.ma.array([1.0, 2.0], mask=[0, 1])}, "'y' has 1 masked values"),
    "masked quantity": ({"y": Masked([1.0, 2.0] * u.km, mask=[False, True])}, "'y' has 1 masked values"),
    "quantities": ({"y": [1.0 * u.km, 2.0 * u.m]}, "'y' is a list of quantities; make one of them"),
    "a time of astropy": ({"y": Time(2020.0, format="jyear")}, "'y' is of type Time"),
    "a coordinate of durations": (at_k(pd.to_timedelta([1], "h")), "a coordinate 'k' that is of type timedelta64"),
    "a coordinate that is NaN": (at_k([np.nan]), "'y' has a coordinate 'k' that has values that are not finite"),
    "two levels": (pd.DataFrame({"y": [1.0, 2.0]}, [["p", "q"], [1, 2]]), "nan=True"),
    "like a parameter": ({"case": 1.0}, "output 'case': is the name of another parameter"),
    "a name of ours": ({"status": 1.0}, "output 'status': the platform gives this name"),
    "no name": ({1: 1.0}, "the name 1 of an output is no text"),
    "a bad name": ({"a/b": 1.0}, "output 'a/b': a name begins with a letter"),
    "dates for CF": (Column([1.0], unit="days since 2000-01-01"), "'f' has the unit 'days since 2000-01-01': return"),
    "dates along k": (at_k([1], units="days since explosion"), "has a coordinate 'k' that has the unit 'days since ex"),
    "a dimension of ours": (at_k([1], "point"), "dimension 'point': the platform gives this name"),
    "a parameter's name": (xr.DataArray([1.0], {"case": ("k", ["b"])}, ("k",)), "output 'case': is the name of a"),
    "two units": (at_k([1], units="h") | {"z": at_k([1], units="s")["y"]}, "'z' has a coordinate 'k' in s, expected h"),
    **{"NaN": ({"y": np.nan}, "y is NaN"), "infinity": ({"y": -np.inf}, "y is infinite")},
    "NaN in an array": ({"y": [1.0, np.nan]}, "y has 1 NaN of 2 values"),
    "no time": ({"y": np.datetime64("NaT", "s")}, "NaT"),
}


@pytest.mark.filterwarnings("ignore:Duplicate dimension names")
def test_what_is_no_result_is_refused_by_name(tmp_path):
    twice = {"y": xr.DataArray([[1.0]], dims=("k", "k"))}, "'y' has the dimensions (k, k), one of them twice"
    check_refused(REFUSED | {"twice": twice}, {"y": 1.0}, tmp_path)


def test_what_is_declared_is_held_to_and_a_tuple_has_the_outputs_in_their_order(tmp_path):
    t = np.array([0.0, 1.0, 2.0])
    outputs = [Output("n", dims=("time",), coords={"time": (t, "d")}, unit="kg"), Output("m", dims=("time",))]
    good = {"n": [1, 2, 3], "m": t}
    wrong = {
        "length": ({"n": [1.0], "m": t}, "'n' has 1 values along 'time', expected 3"),
        "dimensions": ({"n": [[1.0]], "m": t}, "'n' has the shape (1, 1), expected the dimensions (time)"),
        "misspelt": ({"n": t, "mm": t}, "does not return the output 'm'; did you mean 'mm'?"),
        "unit": ({"n": Column(t, unit="g")}, "does not return the output 'm'; 'n' is in g, expected kg"),
        "hours": ({"n": t, "m": at_k(t, "time", units="h")["y"]}, "'m' has a coordinate 'time' in h, expected d"),
        "coordinate": ({"n": xr.DataArray(t, {"time": t + 1.0}, ("time",)), "m": t}, "'n' has other values along 'tim"),
    }
    check_refused(wrong, good, tmp_path, outputs)
    ds = xr.open_zarr(tmp_path / "s.zarr")
    assert (ds.time.values.tolist(), ds.time.units, ds.n.units) == (t.tolist(), "d", "kg")
    outputs = [Output("curve", dims=("time",), coords={"time": [0.0, 1.0]}), Output("peak")]
    short, folder = {"short": ((1.0,), "a tuple of 1 values, expected one for")}, tmp_path / "tuple"
    check_refused(short, ([1.0, 2.0], 2.0), folder, outputs)
    ds = xr.open_zarr(folder / "s.zarr").isel(case=0).load()
    assert (ds.curve.values.tolist(), ds.peak.item()) == ([1.0, 2.0], 2.0)


def test_later_points_are_compared_by_name_with_the_first(tmp_path):
    def along(values, x, unit="m", of_x=""):
        return {"t": xr.DataArray(values, {"x": ("x", x, {"units": of_x})}, ("x",), attrs={"units": unit})}

    first = {"y": 1.0, "n": 3, **along([1.0, 2.0], [0.0, 0.5])}
    wrong = {
        "bool": (first | {"n": True}, "the type of 'n' is 'bool', expected 'number'"),
        "text": (first | {"y": "a"}, "the type of 'y' is 'text', expected 'number'"),
        "array": (first | {"y": [1.0]}, "the dims of 'y' is ('y_dim_0',), expected ()"),
        "more": (first | {"more": 1}, "'more' was not returned by the first point"),
        "less": ({"yy": 1.0} | {key: first[key] for key in "nt"}, "'y' is missing; did you mean 'yy'?"),
        "value": (first | along([1.0, 2.0], [0.0, 0.6]), "value 1 of the coordinate 'x' is 0.6, expected 0.5"),
        "length": (first | along([1.0], [0.0]), "the length of 'x' is 1, expected 2"),
        "unit": (first | along([1.0, 2.0], [0.0, 0.5], "km"), "the unit of 't' is 'km', expected 'm'"),
        "unit of x": (first | along([1.0, 2.0], [0.0, 0.5], "m", "s"), "the unit of the coordinate 'x' is 's'"),
        "type of x": (first | along([1.0, 2.0], [False, True]), "the type of the coordinate 'x' is 'bool'"),
    }
    check_refused(wrong, first, tmp_path)
    others = {"a": first, "b": first | {"y": 2, "n": 3.5}, "c": dict(reversed(first.items()))}
    joined = results_of(others, tmp_path, fresh=True)
    assert joined.n.values.tolist() == [3.0, 3.5, 3.0]  # integers and floats are joined, in any order
    check_refused({"large": ({"n": 2**53 + 1}, "740993, which is beyond 2**53, and")}, {"n": 0.5}, tmp_path / "large")
    texts = results_of({k: {"y": "\ud800" if k == "d" else k} for k in "abcde"}, tmp_path / "texts")  # the last one
    assert "which has a lone surrogate: no file can hold it" in texts.attrs["failures"]
    whole = {"whole": ({"n": np.arange(2**19 + 1)}, "the type of 'n' is 'int', expected 'float'")}
    check_refused(whole, {"n": np.zeros(2**19 + 1)}, tmp_path / "arrays")  # chunks are not converted


def test_a_vectorised_function_gets_an_axis_as_what_it_is_and_returns_a_value_for_each_point(tmp_path):
    lengths = (lambda x=1 * u.m: np.array([one.to_value(u.m) for one in x])), [2 * u.km, 3 * u.m], [2000.0, 3.0]
    numbers = (lambda x: np.where(x == 1, 10.0, 20.0)), [*"abcdefghij", 1], [20.0] * 10 + [10.0]
    mixed = (lambda x: np.full(len(x), x.dtype != object)), [*range(9), 0.25], [True] * 10
    for f, axis, expected in (lengths, numbers, mixed):
        ds = run(experiment(vectorised=True)(f), tmp_path / "s", axes={"x": axis}, pool="serial", fresh=True)
        assert ds.result.values.tolist() == expected
    for returned, why in TOGETHER:
        f = experiment(vectorised=True)(eval(f"lambda x=1.0: {returned}"))
        ds = run(f, tmp_path / "s", axes={"x": [1.0, 2.0, 3.0]}, pool="serial", fresh=True)
        assert {why in reason for reason in json.loads(ds.attrs["failures"]).values()} == {True}


@pytest.mark.slow
def test_tables_pages_and_laws_know_the_lengths(tmp_path):
    kinds = {
        "number": lambda k, n: k / 3.0 + np.arange(n),
        "count": lambda k, n: [2**60 + k + j for j in range(n)],
        "word": lambda k, n: np.array([f"é{k}" * j for j in range(n)], dtype=object),
        "time": lambda k, n: np.datetime64("2020-01-01T00:00:00.000000001") + np.arange(n),
        "table": lambda k, n: np.outer([1.0, k], np.arange(n)),
    }
    dims = dict.fromkeys(kinds, "step") | {"table": ("state", "step")}
    declared = experiment(outputs=[Output(name, dims=dims[name], ragged="step") for name in kinds])
    walk = declared(lambda k, n: {name: make(k, n) for name, make in kinds.items()})
    store = tmp_path / "s.zarr"
    linksweep.run(walk, store, axes={"k": [1, 2], "n": [3]}, pool="serial")
    ds = linksweep.run(walk, store, axes={"k": [1, 2], "n": [3, 5]}, pool="serial")
    assert check(store).remarks == []  # no file is left of rows that were shorter
    assert (ds.number.attrs["ragged"], ds.sizes["step"]) == ("step", 5)
    result = Result(ds)
    assert "<svg" in report_page([("walk", ds)])
    rows = json.loads(result.written("json"))["rows"]
    assert [len(row["number"]) for row in rows] == [3, 5, 3, 5] == [len(row["table"][1]) for row in rows]
    (tmp_path / "t.ecsv").write_text(result.written("ecsv"))
    assert [part.shape for part in AstropyTable.read(tmp_path / "t.ecsv")["table"]] == [(2, 3), (2, 5)] * 2
    law = linksweep.fit_power_law(ds.isel(step=slice(1, None)), "number", over="step")  # each line to its own end
    assert bool((law.exponent > 0.0).all())
    assert not linksweep.find(ds, "number < 1", over="step").to_dataframe().empty


def grows(n: int):
    return {"a": list(range(n)), "a_length": n} if n == 4 else {"a": list(range(n)), "b": np.ones((2, n))}


@pytest.mark.parametrize(("outputs", "n", "problem"), GROWING)
def test_results_that_are_not_as_declared_are_refused_by_name(tmp_path, outputs, n, problem):
    declared = experiment(outputs=outputs)(grows) if outputs else grows
    ds = linksweep.run(declared, tmp_path / "s", axes={"n": n}, pool="serial", max_failures="100%")
    assert (problem or "{}") in ds.attrs["failures"]
