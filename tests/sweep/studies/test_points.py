"""The table [points]: files, designs and columns become the same points, and what is wrong is told by name and row."""

import datetime
import re
import sys
from typing import Annotated, Literal

import astropy.units as u
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from astropy.table import MaskedColumn, QTable, Table
from astropy.utils.masked import Masked
from scipy.stats import binomtest

from linksweep import Parameter, SweepError, experiment, run
from tests.tiers import few

Beta = Annotated[float, Parameter("rate", unit="1/d", above=0)]
Distance = Annotated[float, Parameter("distance", unit="m")]
COLUMNS = {"beta": [0.5, 0.25, 0.5], "k": [1, 3, 1], "solver": ["a", "none", "a"]}
FRAME = pd.DataFrame(COLUMNS)
RANGES = {"beta": {"low": 0.01, "high": 1.0, "spacing": "log"}, "k": {"low": 1, "high": 9, "spacing": "log"}}
GROWS = {"sobol": True, "latin-hypercube": False, "halton": True, "random": True, "saltelli": True, "morris": True}
CELLS = [("beta\n2.5\noops\n1.5\n", "row 2: beta = 'oops': must be a number > 0 [1/d]")]
CELLS += [('beta,k\n2.5,1\n"1,200",1\n', "row 2: beta = '1,200': must be a number > 0 [1/d]")]
CELLS += [("k\n1\n1_0\n", "row 2: k = '1_0': must be an integer")]
CELLS += [("k,beta\n" + "y,x\n" + "y,1\n" * 30, "row 1: beta = 'x': must be a number > 0 [1/d]")]
OBJECT = "an object that is no number, text or truth value, such as 2024-06-01 or 2024-06-01T12:30:00"
CELLS += [("distance [km]\n1\noops\n", f"row 2: distance = 'oops': must be {OBJECT}")]
CELLS += [("k\n1\n99999999999999999999\n", "row 2: k = 99999999999999999999: must be an integer, below 2**63 in size")]
DERIVED = """
def rates(row):
    return {"k": int(10 * row["beta"]), "solver": "b" if row["beta"] > 0.4 else "a"}
wrong, again = lambda row: [1], lambda row: {"beta": 1.0}
fails, bad = lambda row: {"k": 1 / (row["beta"] - 0.2)}, lambda row: {"k": -0.5}
crossed, daily = lambda row: {"solver": "ab"[row["k"]]}, lambda row: {"k": round(row["beta"])}
"""


@experiment()
def f(beta: Beta = 0.3, k: int = 2, solver: Literal["a", "b", "none"] = "a"):
    return beta * k


def far(distance: Distance, n: int = 1):
    return distance * n


def measured(distance: u.Quantity):
    return distance.to_value(u.m)


def perhaps_far(distance: Annotated[float | None, Parameter("distance", unit="m")] = None, n: int = 1):
    return n


@pytest.fixture
def read(tmp_path):
    def read(points, function=f, **more):
        ds = run(function, tmp_path / "s.zarr", points=points, pool="serial", fresh=True, **more)
        return {str(c): ds[c].values.tolist() for c in ds.coords if ds[c].dims == ("point",) and c != "point"}

    return read


@pytest.fixture
def problems_of(read):
    def problems_of(points, function=f, **more):
        with pytest.raises(SweepError) as refused:
            read(points, function, **more)
        return refused.value.problems

    return problems_of


@pytest.mark.parametrize("kind", few(3, ["csv", "frame", "arrays", "parquet", "ecsv", "table"]))
def test_a_table_is_the_same_whatever_holds_it(kind, tmp_path, read):
    path, hourly = tmp_path / f"t.{kind}", Table.from_pandas(FRAME)
    hourly["beta"] = hourly["beta"] / 24 * u.Unit("1/h")
    for name, write in (("csv", FRAME.to_csv), ("parquet", FRAME.to_parquet)):
        write(tmp_path / f"t.{name}", index=False)
    hourly.write(tmp_path / "t.ecsv")
    kept = {"frame": FRAME, "table": Table(COLUMNS, units={"beta": "1/d"})}
    kept["arrays"] = {name: np.array(values) for name, values in COLUMNS.items()}
    columns = read(kept.get(kind, path))
    assert columns == COLUMNS | {"beta": pytest.approx(COLUMNS["beta"], rel=1e-15)}  # of hours into days


def sobol(**more):
    return {"design": "sobol", "n": 4, "ranges": {"beta": [1, 2]}} | more


POLARS = type("DataFrame", (), {"columns": ["k"], "to_dict": lambda self: {"k": [1]}})()  # of polars
WRONG = [
    ({"beta": [1.0, 2.0], "kk": [1, 2]}, "points.columns.kk: unknown parameter 'kk'; did you mean 'k'?"),
    (Table({"k": MaskedColumn([1, 2], mask=[True, False])}), "points.columns.k: has no value in row 1"),
    ({"beta": [1.0, np.nan]}, "points.columns.beta: row 2: beta = nan: must be a number > 0"),
    ({"beta": [1.0, 2.0], "k": [1]}, "number of values, from 1 to 1,000,000; beta has 2, k has 1"),
    (Table({"beta": [1.0] * u.m}), "points.columns.beta: is in m, and the parameter is in 1/d"),
    *(("nowhere.csv", "no such file"), ("/", "Is a directory"), ("/dev/zero", "is a device")),
    *((one, "must be a DataFrame, a Table, a mapping of columns") for one in (pd.Series([1]), POLARS)),
    (sobol(design="sobl"), "points.design: input should be 'sobol',"),
    (sobol(n=None), "n = None, ranges = {'beta': [1, 2]}: needs both (--design"),
    (sobol(ranges={"beta": [0, 2]}), "points.ranges.beta: beta = 0: must be a number > 0"),
    (sobol(ranges={"k": [1, 2**63]}), "points.ranges.k: k = 9223372036854775808: must be"),
    (sobol(ranges={"beta": [2, 1]}), "low = 2 must be less than high = 1"),
    (sobol(ranges={"solver": ["a", "b"]}), "write { values = [...] }"),
    (sobol(ranges={"k": {"values": [1, 2, 1]}}), "values = [1, 2, 1]: must be a list of different values"),
    (sobol(ranges={"k": {"low": 0, "high": 9, "spacing": "log"}}), "log spacing needs numbers above 0, not 0"),
    (sobol(design="saltelli", n=10**6), "makes 3,000,000 points"),
    ({"file": "t.csv", "n": 3}, "points: n: does not go with file"),
    *(({"columns": {"k": [1]}} | one, "exactly one of file") for one in ({"design": "sobol"}, {"file": ""})),
]
LONG = 86.85482395804122
HERE, GIVE = xr.DataArray([1.0, 2.0], dims="d", attrs={"units": "km"}), "declare its unit, or annotate it with Quantity"
idle = experiment(when={"k": {"beta": [3.0]}})(lambda beta=1.0, k=1: beta)
ALL_WRONG = [
    *((f, {"points": points}, problem) for points, problem in WRONG),
    *((far, {"axes": {"distance": [1], "n": some}}, GIVE) for some in (HERE, HERE.values * u.s)),
    (far, {"points": {"distance": [1], "n": [1 * u.km]}}, "points.columns.n: row 1: is in km, and the parameter"),
    (far, {"points": {"design": "random", "n": 1, "ranges": {"distance": HERE}}}, "distance: is in km; give numbers"),
    (perhaps_far, {"points": sobol(design="morris", ranges={"distance": {"values": [None, 1, 2, 3]}})}, "4 numbers"),
    (far, {"axes": {"distance": [1.0] * u.s}}, "axes.distance: is in s, and the parameter is in m"),
    (far, {"points": {"columns": {"distance [cm]": [1.0]}, "units": {"distance": "m"}}}, "is in cm, and not in m"),
    (far, {"points": {"columns": {"distance": [1.0]}, "units": {"distanc": "m"}}}, "units.distanc: is no column of"),
    (far, {"points": QTable({"distance": Masked([1.0, 2.0] * u.km, mask=[0, 1])})}, "distance: has no value in row 2"),
    # which parameters a wrong table has is not known: those without a default are not asked for
    (far, {"points": sobol(n="4")}, "points.n: input should be a valid integer, not '4'"),
    (f, {"points": {"beta": [1.0]}, "axes": {"beta": [1.0, 2.0]}}, "beta: is an axis too"),
    (f, {"points": {"k": [1]}, "fixed": {"k": 2}}, "k: is fixed too"),
    (f, {"points": {"k": [1], "w": [object()]}, "labels": "w"}, "points.labels: 'w': <object object at"),
    (lambda point=1.0, k=1: k, {"points": {"k": [1, 2]}, "fixed": {"point": 1.0}}, "has a 'point' of its own"),
]


@pytest.mark.parametrize(("function", "tables", "problem"), ALL_WRONG)
def test_what_is_wrong_or_in_two_places_is_told_by_name_and_row(function, tables, problem, problems_of):
    [actual] = problems_of(tables.pop("points", None), function, **tables)
    assert problem in actual


@pytest.mark.parametrize(("text", "problem"), CELLS)
def test_of_a_column_of_a_file_only_the_wrong_cells_are_named(text, problem, tmp_path, problems_of):
    (tmp_path / "t.csv").write_text(text)
    *others, sentence = problems_of(tmp_path / "t.csv", measured if "[km]" in text else f)
    assert (len(others), sentence) == (6 * ("y" in text), f"points.file.{problem.split()[2]}: {problem}")


def design(name, n, seed=0):
    ranges = {} if name == "morris" else {"solver": {"values": ["a", "b"]}}
    return {"design": name, "n": n, "seed": seed, "ranges": RANGES | ranges}


@pytest.mark.parametrize("name", few(2, GROWS))
def test_designs_are_spread_over_their_ranges_and_larger_ones_begin_alike_where_they_say_so(name, read):
    few, columns = read(design(name, 32)), read(design(name, 64))
    assert all(columns[key][: len(values)] == values for key, values in few.items()) == GROWS[name]
    assert read(design(name, 32)) == few != read(design(name, 32, seed=1))
    beta, k = np.array(columns["beta"]), np.array(columns["k"])
    assert 0.01 <= beta.min() < beta.max() <= 1.0
    assert np.median(beta) == pytest.approx(0.1, rel=0.6)  # the middle of a logarithmic range
    # an integer k has the part of the scale from k to k + 1, also the last one
    assert set(columns["k"]) == ({1, 2, 4, 9} if name == "morris" else set(range(1, 10)))
    assert np.mean(k <= 2) == pytest.approx(np.log10(3.0) if name != "morris" else 0.5, abs=0.12)
    assert name == "morris" or binomtest(columns["solver"].count("a"), len(beta)).pvalue > 1e-3


@pytest.mark.parametrize(("function", "n", "k"), [("f", 64, 2), ("f", 100, 3), ("idle", 64, 2)])
def test_a_design_of_no_power_of_two_and_conditions_of_nothing_are_warned_of(sweep, tmp_path, function, n, k):
    options = ["--design", f"sobol:{n}", "--range", "beta=1:2", "--axis", "k=1,2", "--exclude", f"k={k}"]
    code, out, err = sweep("plan", f"{__file__}:{function}", *options, cwd=tmp_path)
    warnings = f"points.n = {n} is not a power of two", "such a value of k: 3\n", "when.k: no point has such"
    assert (code, [words in out + err for words in warnings]) == (0, [n == 100, k == 3, function == "idle"]), err


KM = HERE.values * u.km
ITEMS = {"units": "km", "to": None, "__iter__": lambda some: (some[k : k + 1].reshape(()) for k in range(len(some)))}
FOREIGN = HERE.values.view(type("Foreign", (np.ndarray,), ITEMS))  # as of unyt
CARRIED = [(far, "axes", one) for one in (Table({"d": KM})["d"], {"start": KM[0], "stop": KM[1], "num": 2})]
CARRIED += [(far, key, some) for key in ("axes", "points") for some in (HERE, [*HERE], FOREIGN)]
CARRIED += [(function, "fixed", some) for function, some in ((far, HERE[1]), (far, KM[1]), (measured, KM[1]))]
CARRIED += [(far, key, HERE.values * u.Unit("kJ s2 / (kg m)")) for key in ("axes", "points")]
CARRIED += [(f, *one) for f in (far, measured) for key in ("axes", "points") for one in ((key, KM), (key, [*KM]))]


@pytest.mark.parametrize(("function", "key", "some"), CARRIED)
def test_whatever_carries_a_unit_becomes_numbers_in_that_of_the_parameter(function, key, some, tmp_path):
    for _ in range(2):  # what the store has is the same study
        ds = run(function, tmp_path / "s", pool="serial", **{key: {"distance": some}})
    assert ds[function.__name__].values.tolist() == (2000.0 if key == "fixed" else [1000.0, 2000.0])


@pytest.mark.parametrize("kind", ["row", "name", "columns", "nan", "masked", "array"])
def test_a_column_in_another_unit_has_gaps_and_the_numbers_of_the_parameter(kind, tmp_path, read):
    names = "distance [cm],n\n" if kind == "name" else "distance,n\ncm,\n"
    (tmp_path / "t.csv").write_text(f"{names}1.1,1\n,2\n{LONG},3\n")
    kept = {
        "columns": {"columns": {"distance": [1.1, None, LONG], "n": [1, 2, 3]}, "units": {"distance": "cm"}},
        "nan": QTable({"distance": [1.1, np.nan, LONG] * u.cm, "n": [1, 2, 3]}),
        "array": {"distance": [1.1, np.nan, LONG] * u.cm, "n": [1, 2, 3]},
        "masked": Table({"distance": MaskedColumn([1.1, 2, LONG], mask=[0, 1, 0], unit="cm"), "n": [1, 2, 3]}),
    }.get(kind, tmp_path / "t.csv")
    actual = read(kept, perhaps_far, when={"distance": {"n": [*map(u.Quantity, (1, 2, 3))]}})["distance"]
    assert actual == ["0.011", "nan" if kind == "array" else "None", "0.8685482395804122"]


def dated(day: datetime.date, k: list):
    return f"{day.month} {sum(k)}"


def test_where_a_parameter_takes_objects_a_text_in_a_file_is_what_it_writes(tmp_path):
    (tmp_path / "t.csv").write_text("day;k\n2020-01-31;[1, 2]\n2020-12-01;[3]\n")
    ds = run(dated, tmp_path / "s", points=tmp_path / "t.csv", pool="serial")
    assert ds.dated.values.tolist() == ["1 3", "12 3"]
    pd.DataFrame({"k": [[1], [3]], "t": pd.to_datetime(["2026-02", "2026-03"])}).to_parquet(tmp_path / "t.parquet")
    ds = run(lambda k, t: k[0] + t.month, tmp_path / "t", points=tmp_path / "t.parquet")  # which has lists and times
    assert ds.result.values.tolist() == [3, 6]


def test_a_function_derives_further_columns(tmp_path, read, problems_of):
    (tmp_path / "own.py").write_text(DERIVED)
    points = {"columns": {"beta": [0.5, 0.2]}, "derive": f"{tmp_path}/own.py:rates"}
    assert read(points) == {"beta": [0.5, 0.2], "k": [5, 2], "solver": ["b", "a"]}
    said = {"wrong": "wrong returns [1], not a mapping of parameters", "fails": "raises ZeroDivisionError"}
    said |= {"bad": "row 1: k = -0.5: must be an integer", "again": "again returns {'beta': 1.0}", "none": "none"}
    for name, problem in said.items():
        assert problem in problems_of(points | {"derive": f"{tmp_path}/own.py:{name}"})[0]
    hourly = {"columns": {"solver": ["a"]}, "derive": f"{tmp_path}/own.py:daily"}
    assert read(hourly, fixed={"beta": 2.0 / u.h})["k"] == [48]
    points["derive"] = f"{tmp_path}/own.py:crossed"  # what is an axis differs from point to point
    assert "crossed raises KeyError: 'k'" in problems_of(points, axes={"k": [1, 2]})[0]


def test_without_salib_the_design_says_what_to_install(monkeypatch, problems_of):
    monkeypatch.setitem(sys.modules, "SALib.sample.sobol", None)
    assert re.search(r"saltelli: needs SALib.*linksweep\[sensitivity\]", problems_of(design("saltelli", 4))[0])
