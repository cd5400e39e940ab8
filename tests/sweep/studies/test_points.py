"""The table [points]: files, designs and columns become the same points, and what is wrong is told by name and row."""

from typing import Annotated, Literal

import astropy.units as u
import numpy as np
import pandas as pd
import pytest
from astropy.table import MaskedColumn, QTable, Table
from astropy.utils.masked import Masked

from linksweep import Parameter, SweepError, experiment
from linksweep.sweep.contract import Parameter as Declared
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.studies.points import DESIGNS, Range
from linksweep.sweep.studies.reader import study_of_function


@experiment()
def f(
    beta: Annotated[float, Parameter("rate", unit="1/d", above=0)] = 0.3,
    k: int = 2,
    solver: Literal["a", "b"] = "a",
):
    return beta * k


COLUMNS = {"beta": [0.5, 0.25, 0.5], "k": [1, 3, 1], "solver": ["a", "b", "a"]}
FRAME = pd.DataFrame(COLUMNS)


def read(points, **more):
    study = study_of_function(f, points=points, **more)
    return {name: list(study.axes[name]) for name in study.points.names}


def written(folder, name):
    path = folder / name
    if name.endswith(".csv"):
        FRAME.to_csv(path, index=False)
    elif name.endswith(".parquet"):
        FRAME.to_parquet(path)
    else:
        table = Table.from_pandas(FRAME)
        table["beta"] = table["beta"] / 24 * u.Unit("1/h")
        table.write(path, format="ascii.ecsv")
    return path


@pytest.mark.parametrize("kind", ["t.csv", "t.parquet", "t.ecsv", "frame", "arrays", "table"])
def test_a_table_is_the_same_whatever_holds_it(kind, tmp_path):
    given = {
        "frame": FRAME,
        "arrays": {name: np.array(values) for name, values in COLUMNS.items()},
        "table": Table(COLUMNS, units={"beta": "1/d"}),
    }
    found = read(given[kind] if kind in given else written(tmp_path, kind))
    assert found.keys() == COLUMNS.keys()
    assert found["beta"] == pytest.approx(COLUMNS["beta"], rel=1e-15)  # of hours into days
    assert (found["k"], found["solver"]) == (COLUMNS["k"], COLUMNS["solver"])
    assert {type(value) for value in found["k"]} == {int}


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        ({"beta": [1.0, 2.0], "kk": [1, 2]}, r"points.columns.kk: unknown parameter 'kk'; did you mean 'k'\?"),
        ({"beta": [1.0, np.nan]}, "points.columns.beta: has no value in row 2"),
        (pd.DataFrame({"k": pd.array([1, None, 2], dtype="Int64")}), "points.columns.k: has no value in row 2"),
        (Table({"k": MaskedColumn([1, 2], mask=[True, False])}), "points.columns.k: has no value in row 1"),
        ({"beta": [1.0, -2.0]}, "points.columns.beta: row 2: beta = -2.0: must be a finite number > 0"),
        ({"k": [1, 2.5]}, "points.columns.k: row 2: k = 2.5: must be an integer"),
        ({"solver": ["a", "c"]}, "points.columns.solver: row 2: solver = 'c': must be one of 'a', 'b'"),
        ({"beta": ["x", "y"]}, "points.columns.beta: row 1: beta = 'x': must be a finite number"),
        ({"beta": [1.0, 2.0], "k": [1]}, "the same number of values; beta has 2, k has 1"),
        ({"beta": []}, "beta has 0"),
        (Table({"beta": [1.0] * u.m}), "its column is in m, and the parameter is in 1/d"),
        (Table({"k": [1] * u.m}), "its column is in m, and the parameter has no unit"),
        ("nowhere.csv", "no such file"),
        (3, "must be a DataFrame, a Table, a mapping of columns, a file or a design"),
        (
            {"design": "sobl", "n": 4, "ranges": {"beta": [1, 2]}},
            "points.design: input should be 'sobol', .* not 'sobl'",
        ),
        ({"design": "sobol", "ranges": {"beta": [1, 2]}}, "n = None, ranges = .*: a design needs both"),
        ({"design": "sobol", "n": 4}, "ranges = {}: a design needs both"),
        ({"design": "sobol", "n": 4, "ranges": {"beta": [0, 2]}}, "points.ranges.beta: beta = 0: must be .* > 0"),
        ({"design": "sobol", "n": 4, "ranges": {"beta": [2, 1]}}, "low = 2 must be less than high = 1"),
        ({"design": "sobol", "n": 4, "ranges": {"beta": 2}}, r"write \[low, high\]"),
        ({"design": "sobol", "n": 4, "ranges": {"solver": ["a", "b"]}}, r"write { values = \[...\] }"),
        ({"design": "sobol", "n": 4, "ranges": {"q": [1, 2]}}, "unknown parameter 'q'"),
        (
            {"design": "sobol", "n": 4, "ranges": {"k": {"low": 0, "high": 9, "spacing": "log"}}},
            "log spacing needs numbers above 0, not 0 and 9",
        ),
        ({"design": "morris", "n": 4, "ranges": {"solver": {"values": ["a", "b"]}}}, "steps between 4 numbers"),
        ({"design": "morris", "n": 4, "ranges": {"k": [1, 3]}}, "steps between 4 numbers"),
        ({"design": "saltelli", "n": 10**6, "ranges": {"beta": [1, 2]}}, "makes 3,000,000 points"),
        ({"file": "t.csv", "n": 3}, "points: n: does not go with file"),
        ({"columns": {"k": [1]}, "design": "sobol"}, "exactly one of file, design and columns"),
    ],
)
def test_what_is_wrong_is_told_by_name_and_row(points, problem):
    with pytest.raises(SweepError, match=problem):
        read(points)


@pytest.mark.parametrize(
    ("bad", "problem"),
    [
        ({"beta": "oops"}, "points.file.beta: row 7: beta = 'oops': must be a finite number > 0"),
        ({"beta": "-2"}, "points.file.beta: row 7: beta = -2.0: must be a finite number > 0"),
        ({"beta": "1,200"}, "points.file.beta: row 7: beta = '1,200': must be a finite number > 0"),
        ({"k": "1_0"}, "points.file.k: row 7: k = '1_0': must be an integer"),
        ({"flag": "maybe"}, "points.file.flag: row 7: flag = 'maybe': must be true or false"),
    ],
)
def test_of_a_column_of_a_file_only_the_wrong_cells_are_named(bad, problem, tmp_path):
    def g(beta: Annotated[float, Declared("rate", above=0)], k: int, flag: bool):
        return beta * k * flag

    rows = [{"beta": "2.5", "k": "1", "flag": "True"} | (bad if row == 7 else {}) for row in range(1, 10)]
    pd.DataFrame(rows).to_csv(tmp_path / "t.csv", index=False)
    with pytest.raises(SweepError) as caught:
        study_of_function(g, points=tmp_path / "t.csv")
    assert caught.value.problems == [problem]


def test_wrong_cells_are_named_beside_decimal_commas_and_large_integers(tmp_path):
    (tmp_path / "t.csv").write_text("beta;k\n2,5;1\nx;1\n1,5;1\n")
    with pytest.raises(SweepError) as caught:
        read(tmp_path / "t.csv")
    assert caught.value.problems == ["points.file.beta: row 2: beta = 'x': must be a finite number > 0 [1/d]"]
    (tmp_path / "t.csv").write_text("beta,k\n0.1,1\n0.2,99999999999999999999\n")
    with pytest.raises(SweepError, match="row 2: k") as caught:
        read(tmp_path / "t.csv")
    assert "row 1" not in str(caught.value)


def far(distance: Annotated[float, Declared("distance", unit="m")], n: int = 1):
    return distance * n


@pytest.mark.parametrize("kind", [dict, QTable], ids=["a mapping", "a QTable"])
def test_quantities_as_columns_are_converted_to_the_unit_of_the_parameter(kind):
    columns = study_of_function(far, points=kind({"distance": [1.0, 2.5] * u.km, "n": [1, 2]})).axes
    assert columns == {"distance": (1000.0, 2500.0), "n": (1, 2)}


ELSEWHERE = "is a quantity in km; give numbers in the unit of the parameter, .to_value('km')"


@pytest.mark.parametrize(
    ("tables", "problem"),
    [
        ({"axes": {"distance": [1.0, 2.0] * u.km}}, f"axes.distance: {ELSEWHERE}"),
        ({"axes": {"distance": [1.0 * u.km, 2.0 * u.km]}}, f"axes.distance: {ELSEWHERE}"),
        ({"fixed": {"distance": 3.0 * u.km}}, f"fixed.distance: {ELSEWHERE}"),
        ({"points": {"distance": [1.0 * u.km, 2.0 * u.km]}}, f"points.distance: {ELSEWHERE}"),
        (
            {"points": QTable({"distance": Masked([1.0, 2.0] * u.km, mask=[False, True])})},
            "points.columns.distance: has no value in row 2",
        ),
        (
            {"points": QTable({"distance": [1.0, 2.0] * u.s})},
            "points.columns.distance: its column is in s, and the parameter is in m",
        ),
        # which parameters a wrong table has is not known: those without a default are not asked for
        (
            {"points": {"design": "random", "n": "4", "ranges": {"distance": [1.0, 2.0]}}},
            "points.n: input should be a valid integer, not '4'",
        ),
        (
            {"points": {"distance": [1.0], "m": [1]}},
            "points.columns.m: unknown parameter 'm'; known are distance, n",
        ),
    ],
)
def test_quantities_elsewhere_and_wrong_tables_are_one_problem(tables, problem):
    with pytest.raises(SweepError) as caught:
        study_of_function(far, **tables)
    assert caught.value.problems == [problem]


def test_a_parameter_is_in_one_place_only():
    with pytest.raises(SweepError, match="beta: is an axis too"):
        read({"beta": [1.0]}, axes={"beta": [1.0, 2.0]})
    with pytest.raises(SweepError, match="k: is fixed too"):
        read({"k": [1]}, fixed={"k": 2})


def test_an_experiment_with_a_point_of_its_own_has_no_table():
    def pointed(point: float, k: int = 1):
        return point * k

    with pytest.raises(SweepError, match="has a 'point' of its own"):
        study_of_function(pointed, points={"k": [1, 2]}, fixed={"point": 1.0})


RANGES = {
    "beta": {"low": 0.01, "high": 1.0, "spacing": "log"},
    "k": [1, 9],
    "solver": {"values": ["a", "b"]},
}


def design(name, n, seed=0):
    ranges = {key: RANGES[key] for key in ("beta", "k")} if name == "morris" else RANGES
    return read({"design": name, "n": n, "seed": seed, "ranges": ranges})


@pytest.mark.parametrize("name", DESIGNS)
def test_a_larger_design_begins_with_the_same_points_bitwise_where_it_says_so(name):
    few, many = design(name, 8), design(name, 16)
    same = all(many[key][: len(values)] == values for key, values in few.items())
    assert same == DESIGNS[name].grows
    assert design(name, 8) == few
    assert design(name, 8, seed=1) != few


@pytest.mark.parametrize("name", DESIGNS)
def test_the_values_of_a_design_are_within_their_ranges_and_spread_over_them(name):
    found = design(name, 64)
    beta, k = np.array(found["beta"]), np.array(found["k"])
    assert beta.min() >= 0.01
    assert beta.max() <= 1.0
    assert np.median(beta) == pytest.approx(0.1, rel=0.6)  # the middle of a logarithmic range
    assert set(found["k"]) <= set(range(1, 10))
    assert len(set(found["k"])) == (4 if name == "morris" else 9)
    assert np.mean(k) == pytest.approx(5.0, abs=1.0)
    if name != "morris":
        assert found["solver"].count("a") == pytest.approx(len(beta) / 2, rel=0.4)


def test_ranges_go_back_to_the_unit_interval():
    unit = np.linspace(0.0, 1.0, 11)
    for one in (Range("x", 2.0, 5.0), Range("x", 0.1, 50.0, log=True)):
        assert one.places(np.array(one(unit))) == pytest.approx(unit)
    counts = np.bincount(Range("k", 1, 4, whole=True)(np.linspace(0.0, 1.0, 4001)))
    assert counts[1:].tolist() == [1000, 1000, 1000, 1001]


def test_a_sobol_design_that_is_not_a_power_of_two_is_warned_of_once():
    def warnings(n):
        points = {"design": "sobol", "n": n, "ranges": {"beta": [1, 2]}}
        return make_grid(study_of_function(f, points=points)).warnings

    assert warnings(64) == []
    [sentence] = warnings(100)
    assert sentence.startswith("points.n = 100 is not a power of two")
    assert "64 or 128" in sentence


def test_a_function_derives_further_columns(tmp_path):
    (tmp_path / "own.py").write_text(
        "def rates(row):\n    return {'k': int(10 * row['beta']), 'solver': 'b' if row['beta'] > 0.4 else 'a'}\n"
        "def wrong(row):\n    return [1]\n"
        "def fails(row):\n    return {'k': 1 / (row['beta'] - 0.2)}\n"
        "def bad(row):\n    return {'k': -0.5}\n"
        "def again(row):\n    return {'beta': 1.0}\n"
    )
    points = {"columns": {"beta": [0.5, 0.2]}, "derive": f"{tmp_path}/own.py:rates"}
    assert read(points) == {"beta": [0.5, 0.2], "k": [5, 2], "solver": ["b", "a"]}
    study = study_of_function(f, points=points)
    assert "derive" not in study.document["points"]  # the store has its values, and runs nothing
    for name, problem in {
        "wrong": r"row 1: .*:wrong returns \[1\], not a mapping of parameters",
        "fails": "row 2: .* raises ZeroDivisionError",
        "bad": "row 1: k = -0.5: must be an integer",
        "again": "again returns .*no columns",
        "none": "none",
    }.items():
        with pytest.raises(SweepError, match=problem):
            read(points | {"derive": f"{tmp_path}/own.py:{name}"})


def test_a_store_knows_the_values_not_the_file(tmp_path):
    path = written(tmp_path, "t.csv")
    study = study_of_function(f, points=path)
    path.unlink()
    assert study.document["points"] == {"columns": COLUMNS, "origin": {"file": "t.csv"}}
    again = study_of_function(f, points=study.document["points"])
    assert (again.digest(), again.points) == (study.digest(), study.points)
    assert study_of_function(f, points=COLUMNS).digest() == study.digest()


def test_without_salib_the_design_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "SALib", None)
    with pytest.raises(SweepError, match=r"saltelli: needs SALib.*linksweep\[sensitivity\]"):
        design("saltelli", 4)
