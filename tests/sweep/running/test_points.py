"""Tables of points from a study to a store: once each, the bits of a grid, growth, reproduction, labels of rows."""

import json
from itertools import permutations
from typing import Literal

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from astropy.table import Table
from hypothesis import example, given, settings, strategies as st

import linksweep
from tests.sweep.opening import POINT, POINT_TABLE, OpenStore, forge, merge, same
from tests.tiers import examples, few, slow

LINK = {"experiment": "linksweep.core.experiment:link", "sampling": {"n_sim": 60, "n_cat": 3, "seed": 8}}
STARS = {"x": [1.0, 2.0, 2.0], "star": ["Sirius", None, "Vega"], "hd": [48915, 2**62, 172167]}
CELLS = st.one_of(st.none(), st.text("ab", max_size=2), st.integers(0, 3), st.floats(0, 2))
TABLES = st.lists(st.tuples(st.sampled_from([1.0, 2.0, 3.0]), CELLS), min_size=1, max_size=5)
FILE = 'def model(x: float = 1.0, k: int = 1):\n    if k == 3:\n        raise ValueError("three")\n'
FILE += '    return {"y": x * k}\n'


def run(study, store, points=None, labels=None, **options):
    return linksweep.run(study, store, points=points, labels=labels, pool="serial", **options)


def counting():
    calls = []

    def model(x: float = 1.0, k: int = 1):
        calls.append((x, k))
        return {"y": 0.1 * x + k, "name": f"{x:g}"}

    return model, calls


def test_repeated_rows_are_computed_once_and_stand_in_the_table_as_often(tmp_path):
    model, calls = counting()
    ds = run(model, tmp_path / "s.zarr", points={"x": [1.0, 2.0, 1.0, 3.0, 2.0]}, axes={"k": [1, 2]})
    assert calls == [(1.0, 1), (1.0, 1), (1.0, 2), (2.0, 1), (2.0, 2), (3.0, 1), (3.0, 2)]  # the first one twice
    assert (ds.y.dims, ds.x.dims, ds.point.values.tolist()) == ((POINT, "k"), (POINT,), [0, 1, 2, 3, 4])
    expected = [[0.1 * x + k for k in (1, 2)] for x in (1.0, 2.0, 1.0, 3.0, 2.0)]
    assert (ds.y.values.tolist(), ds.name.values[:, 0].tolist()) == (expected, ["1", "2", "1", "3", "2"])
    assert (ds.attrs["points"], ds.attrs["points_done"], ds.attrs["complete"]) == (10, 10, 1)
    assert np.all(ds.status == 1)
    assert xr.open_zarr(tmp_path / "s.zarr").load().y.values.tolist() == expected
    run(model, tmp_path / "s.zarr", points={"k": [1, 3, 4]}, axes={"x": [1.0]})  # joins the table with the column x
    assert linksweep.open(tmp_path / "s.zarr").attrs["points"] == 12


def test_a_table_grows_at_its_end_and_is_refused_where_old_rows_change(tmp_path, monkeypatch):
    (model, calls), store = counting(), tmp_path / "s.zarr"
    run(model, store, points={"x": [1.0, 2.0]})
    more = run(model, store, points={"x": [1.0, 2.0, 3.0]})
    before = OpenStore(store).attributes["generation"]
    with pytest.raises(linksweep.SweepError, match=r"row 2, x: 2.0 in the store, 2.5 in the study"):
        run(model, store, points={"x": [1.0, 2.5, 3.0, 4.0]})
    with pytest.raises(linksweep.SweepError, match=r"row 1, k: 1 in the store, 4 in the study"):
        run(model, store, points={"x": [1.0, 2.0, 3.0, 4.0], "k": [4, 1, 1, 1]})
    assert OpenStore(store).attributes["generation"] == before
    monkeypatch.setattr("platform.python_version", lambda: "4.0")
    one = run(model, store, points={"x": [1.0]})
    assert (one.y.values.tolist(), one.versions, one.code) == (more.y.values[:1].tolist(), more.versions, more.code)
    assert run(model, store, points={"x": [1.0, 2.0, 3.0]}).attrs == more.attrs  # what computed it, not this process
    forge(store, lambda attributes: attributes.update(error_convention=2))
    run(model, store, points={"x": [1.0]})  # derives the errors of all points anew
    assert OpenStore(store).attributes["error_convention"] == more.error_convention
    same = run(model, store, points={"x": [1.0, 2.0, 3.0], "k": [1, 1, 1]})
    assert (same.y.values.tolist(), calls[-3:]) == (more.y.values.tolist(), [(1.0, 1), (2.0, 1), (3.0, 1)])
    assert run(model, store, points={"x": [9.0]}, fresh=True).y.values.tolist() == [1.9]
    for rows in ({"x": [1.0], "k": [2]}, {"k": [2], "x": [1.0]}, {"k": [2, 1], "x": [1.0, 3.0]}):  # in another order
        run(model, tmp_path / "t.zarr", points=rows)
    assert linksweep.open(tmp_path / "t.zarr").y.values.tolist() == [0.1 * 1.0 + 2, 0.1 * 3.0 + 1]


@pytest.mark.parametrize("design", ["sobol", *map(slow, ["halton", "random", "saltelli", "morris"])])
def test_a_larger_design_keeps_the_old_points_and_their_bits(design, tmp_path):
    model, calls = counting()
    points = {"design": design, "n": 8, "seed": 5, "ranges": {"x": [0.5, 2.0], "k": [1, 1000]}}
    few = run(model, tmp_path / "s.zarr", points=points)
    assert json.loads(few.attrs[POINT_TABLE]) == {"parameters": ["x", "k"], **points}
    before, size = len(calls), few.sizes[POINT]
    many = run(model, tmp_path / "s.zarr", points=points | {"n": 16})
    assert len(calls) <= len(set(calls)) + 1  # what was there is not computed again; a first point is called twice
    assert len(set(calls)) == len(set(zip(many.x.values.tolist(), many.k.values.tolist(), strict=True)))
    assert (many.sizes[POINT], before < len(calls)) == (2 * size, True)
    same(many.isel(point=slice(size)), few)


def test_a_point_of_a_table_has_the_bits_of_the_same_point_in_a_grid(tmp_path):
    grid = run(LINK | {"axes": {"n_obj": [20, 40], "model": ["amex", "gaia"]}}, tmp_path / "g.zarr")
    rows = [(40, "gaia"), (20, "amex"), (40, "amex"), (40, "gaia")]
    columns = {"n_obj": [n for n, _ in rows], "model": [model for _, model in rows]}
    table = run(LINK | {"points": {"columns": columns}}, tmp_path / "t.zarr")
    for name in set(grid.data_vars) - {"status", "wall_time"}:
        for row, (n, model) in enumerate(rows):
            expected = grid[name].sel(n_obj=n, model=model).values
            assert np.array_equal(table[name].isel(point=row).values, expected, equal_nan=True), name
    on = run(LINK | {"points": {"columns": columns}}, tmp_path / "g.zarr")  # the store of the grid has them all
    assert on.sigma_spin.equals(table.sigma_spin)
    run(LINK | {"axes": {"n_obj": [20]}, "sampling": LINK["sampling"] | {"n_cat": 2}}, tmp_path / "g.zarr")
    assert {*linksweep.open(tmp_path / "g.zarr").n_sim_done.values.flat} == {180}  # nothing is taken away


def test_the_command_line_runs_grows_fails_retries_and_reproduces_points(tmp_path, sweep):
    def asked(*command, code=0):
        _, out, err = sweep(*command, "--json", cwd=tmp_path, code=code)
        return json.loads(out or "null"), err

    study, table = ("model.py:model", "--points", "t.csv", "-o", "s.zarr"), "x,k\n0.5,2\n0.25,3\n0.5,2\n"
    (tmp_path / "model.py").write_text(FILE)
    (tmp_path / "t.csv").write_text(table)
    report, err = asked("run", *study, code=1)
    assert (err[:14], "1 point failed: ValueError: three, at x=0.25,k=3" in err) == ("2 points to do", True)
    rows = [(row["point"], row["y"], row["status"]) for row in report["rows"]]
    assert rows == [(0, 1.0, "done"), (1, None, "failed"), (2, 1.0, "done")]
    (tmp_path / "t.csv").write_text(table + "2.0,7\n")
    report, _ = asked("plan", *study)
    assert (report["grid"], report["blocks_pending"]) == ("point 4", 1)
    asked("run", *study, code=1)
    (tmp_path / "t.csv").unlink()
    for at in ("point=3", "x=2.0", "x=0.5,k=2"):
        assert sweep("reproduce", "s.zarr", "--at", at, cwd=tmp_path)[::2] == (0, "every bit as in s.zarr\n")
    _, _, err = sweep("reproduce", "s.zarr", "--at", "point=4", cwd=tmp_path, code=2)
    assert "point = 4 is not in the grid, which has 0, 1, 2, 3" in err
    (tmp_path / "model.py").write_text(FILE.replace("k == 3", "k == 300"))
    asked("run", "--retry", "s.zarr", code=2)
    report, _ = asked("run", "--retry", "s.zarr", "--accept-code")
    assert [row["y"] for row in report["rows"]] == [1.0, 0.75, 1.0, 14.0]


def noisy(x: float, k: int = 1, *, rng):
    return {"y": k * x + rng.normal()}


@pytest.mark.parametrize("form", few(2, ["levels", "file", "mapping", "frame", "index", "table"]))
def test_labels_are_coordinates_along_points_and_change_no_number(tmp_path, form):
    store, rows, labels = tmp_path / "s.zarr", STARS, ["star", "hd"]
    if form in ("frame", "index", "levels"):
        index = {"frame": [], "index": ["star"], "levels": ["star", "hd"]}[form]
        rows = pd.DataFrame(STARS).set_index(index) if index else pd.DataFrame(STARS)
        labels = [name for name in labels if name not in index]
    elif form != "mapping":
        rows = Table({**STARS, "star": ["Sirius", "", "Vega"]})
        rows.write(tmp_path / "t.ecsv")
        rows = rows if form == "table" else str(tmp_path / "t.ecsv")
    ds = run(noisy, store, rows, labels)
    assert ds.y_mean.values.tobytes() == run(noisy, tmp_path / "plain.zarr", {"x": STARS["x"]}).y_mean.values.tobytes()
    for found_there in (ds, linksweep.open(store), xr.open_zarr(store).load()):
        assert found_there.star.dims == found_there.hd.dims == (POINT,)
        assert found_there.star.values.tolist() == ["Sirius", "", "Vega"]
        assert found_there.hd.values.tolist() == STARS["hd"]
    numbered = run(noisy, tmp_path / "n.zarr", pd.DataFrame({"x": [1.0, 2.0]}, index=[7, 9]))
    assert numbered["index"].values.tolist() == [7, 9]


def test_a_name_of_digits_in_a_file_stays_what_is_written(tmp_path):
    def of_text(name: str, x: float = 1.0):
        return {"name_back": name}

    def of_any(name, x: float = 1.0):
        return {"name_back": str(name)}

    def of_choice(name: Literal["NA", True, 2]):
        return {"name_back": repr(name)}

    (tmp_path / "t.csv").write_text("name,x,hip,field,mag\n0071,1,7,007,1\n12,2,8,,2.5\n")
    for k, function in enumerate((of_text, of_any)):
        ds = run(function, tmp_path / f"{k}.zarr", str(tmp_path / "t.csv"), ["hip", "field", "mag"])
        assert ds.name.values.tolist() == ds.name_back.values.tolist() == ["0071", "12"]
        assert [ds[name].values.tolist() for name in ("hip", "field", "mag")] == [[7, 8], ["007", ""], [1.0, 2.5]]
    (tmp_path / "t.csv").write_text("name\nNA\nTrue\n2\n")
    ds = run(of_choice, tmp_path / "2.zarr", str(tmp_path / "t.csv"))
    assert [*ds.name_back.values] == ["'NA'", "True", "2"]
    assert [*run(of_text, tmp_path / "3.zarr", str(tmp_path / "t.csv")).name_back.values] == ["NA", "True", "2"]


def test_what_is_no_label_is_refused_by_name(tmp_path):
    frame = pd.DataFrame({"x": [1.0], "star": ["a"]})
    for rows, labels, words in (
        (frame, None, r'unknown parameter .star.; .*labels = \["star"\]'),
        (frame, "starr", "no column; did you mean 'star'"),
        (frame.set_index("x"), "star", "'x': is a parameter or a result"),
        (frame.rename(columns={"star": "status"}), "status", "'status': the platform gives this name"),
        (frame.rename(columns={"star": "a/b"}), "a/b", "a name begins with a letter"),
        ({"x": [1.0, 2.0], "star": ["a"]}, "star", "x has 2, star has 1"),
        (frame, 3, "labels.0: input should be a valid string"),
        (None, "star", "points = None"),
        (frame.rename(columns={"star": "y_std"}), "y_std", "y_std is a label and the name of a result"),
    ):
        with pytest.raises(linksweep.SweepError, match=words):
            run(noisy, tmp_path / "s.zarr", rows, labels)
        with pytest.raises(linksweep.SweepError, match=r"figure.log.0: 'z' is neither"):
            run({"experiment": noisy, "figure": {"log": ["z"]}, "axes": {"x": [1.0]}}, tmp_path / "s.zarr")
        assert not (tmp_path / "s.zarr").exists()


@settings(max_examples=examples(12, quick=2))
@given(table=TABLES, first=st.integers(1, 4), number=st.integers(1, 3))
@example(table=[(1.0, 2**53 + 1), (2.0, 0.5)], first=1, number=1)
def test_rows_of_any_labels_grow_are_corrected_and_come_together_from_parts(tmp_path_factory, table, first, number):
    folder = tmp_path_factory.mktemp("labels")
    columns = {"x": [x for x, _ in table], "label": [label for _, label in table]}
    whole = run(noisy, folder / "s.zarr", columns, "label")
    expected = ["" if cell is None else str(cell) for cell in columns["label"]]
    texts = whole.label.dtype.kind not in "if"
    got = whole.label.values.tolist()
    assert got == expected if texts else [c for c in columns["label"] if c is not None] == [c for c in got if c == c]  # noqa: PLR0124
    for rows in ({"x": columns["x"][:first], "label": ["another"] * len(table[:first])}, columns):
        run(noisy, folder / "grown.zarr", rows, "label")
    for k in range(1, number + 1):
        run(noisy, folder / "parts.zarr", columns, "label", part=f"{k}/{number}")
    merge(sorted(folder.glob("parts.zarr.part-*")), folder / "parts.zarr")
    for store in ("grown.zarr", "parts.zarr"):
        again = linksweep.open(folder / store)
        assert again.y_mean.values.tobytes() == whole.y_mean.values.tobytes()
        assert (again.x.values.tolist(), str(again.label.values.tolist())) == (columns["x"], str(got))


@pytest.mark.parametrize("wells", [("AB", "CD"), ("AB", "AB"), ("", "CD")])
def test_labels_are_those_of_the_points_of_their_tables(tmp_path, wells):
    expected, x = {}, [1.0, 3.0]
    for temp, names in zip((1.0, 2.0), wells, strict=True):
        asked = {"points": {"x": x, "well": [*names]}, "labels": "well"} if names else {"axes": {"x": x}}
        expected |= dict(zip([(1.0, temp), (3.0, temp)], names or ("", ""), strict=True))
        run(lambda x, temp=0.0: x * temp, tmp_path / "s", fixed={"temp": temp}, keep=True, **asked)
    frame = linksweep.open(tmp_path / "s").to_dataframe().reset_index()
    assert dict(zip(zip(frame.x, frame.temp, strict=True), frame.well, strict=True)) == expected


@pytest.mark.parametrize("order", few(2, [*map("".join, permutations("acbd"))]))
def test_labels_do_not_depend_on_the_order_in_which_stores_are_merged(tmp_path, order):
    runs = {"a": {"points": {"x": [1.0, 5.0], "well": ["A", "B"]}, "labels": "well"}, "c": {"axes": {"x": [1.0, 9.0]}}}
    runs |= {"b": {"points": {"x": [1.0, 5.0], "y": [7.0, 7.0], "well": ["C", "D"]}, "labels": "well"}}
    runs |= {"d": {"axes": {"y": [3.0, 7.0]}, "fixed": {"x": 1.0}}}
    for name in order:
        linksweep.run(lambda x=0.0, y=2.0: x * y, tmp_path / name, pool="serial", **runs[name])
    merge([tmp_path / name for name in order], tmp_path / "m")
    frame = linksweep.open(tmp_path / "m").to_dataframe().dropna()
    labels = dict(zip(zip(frame.x, frame.y, strict=True), frame.well, strict=True))
    expected = {(1.0, 2.0): "A", (5.0, 2.0): "B", (1.0, 7.0): "C", (5.0, 7.0): "D", (9.0, 2.0): "", (1.0, 3.0): ""}
    assert labels == expected
