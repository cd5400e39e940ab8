"""Tables of points from a study to a store: once each, the bits of a grid, growth at the end, reproduction."""

import json
from typing import Any

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep import SweepError
from tests.sweep.opening import POINT, POINT_TABLE, OpenStore, same
from tests.tiers import slow


def run(study, store, **given):
    return linksweep.run(study, store=store, pool="serial", **given)


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
    assert ds.y.dims == (POINT, "k")
    assert ds.x.dims == (POINT,)
    assert ds.point.values.tolist() == [0, 1, 2, 3, 4]
    expected = [[0.1 * x + k for k in (1, 2)] for x in (1.0, 2.0, 1.0, 3.0, 2.0)]
    assert ds.y.values.tolist() == expected
    assert ds.name.values[:, 0].tolist() == ["1", "2", "1", "3", "2"]
    assert (ds.attrs["points"], ds.attrs["points_done"], ds.attrs["complete"]) == (10, 10, 1)
    assert np.all(ds.status == 1)
    assert xr.open_zarr(tmp_path / "s.zarr").load().y.values.tolist() == expected


def test_true_is_another_point_than_one(tmp_path):
    def seen(flag: Any = 1):
        return repr(flag)

    assert run(seen, tmp_path / "a.zarr", axes={"flag": [1, True]}).seen.values.tolist() == ["1", "True"]
    table = run(seen, tmp_path / "t.zarr", points={"flag": [1, True, 1]})
    assert table.seen.values.tolist() == ["1", "True", "1"]


def test_a_table_grows_at_its_end_and_is_refused_where_old_rows_change(tmp_path):
    model, calls = counting()
    store = tmp_path / "s.zarr"
    run(model, store, points={"x": [1.0, 2.0]})
    more = run(model, store, points={"x": [1.0, 2.0, 3.0]})
    assert calls == [(1.0, 1), (2.0, 1), (3.0, 1)]
    before = OpenStore(store).attributes["generation"]
    with pytest.raises(SweepError, match=r"row 2, x: 2.0 in the store, 2.5 in the study"):
        run(model, store, points={"x": [1.0, 2.5, 3.0, 4.0]})
    with pytest.raises(SweepError, match=r"row 1, k: 1 in the store, 4 in the study"):
        run(model, store, points={"x": [1.0, 2.0, 3.0, 4.0], "k": [4, 1, 1, 1]})
    assert OpenStore(store).attributes["generation"] == before
    assert run(model, store, points={"x": [1.0]}).y.values.tolist() == more.y.values[:1].tolist()
    same = run(model, store, points={"x": [1.0, 2.0, 3.0], "k": [1, 1, 1]})
    assert same.y.values.tolist() == more.y.values.tolist()
    assert len(calls) == 3
    assert run(model, store, points={"x": [9.0]}, fresh=True).y.values.tolist() == [1.9]


@pytest.mark.parametrize("design", ["sobol", *map(slow, ["halton", "random", "saltelli", "morris"])])
def test_a_larger_design_keeps_the_old_points_and_their_bits(design, tmp_path):
    model, calls = counting()
    points = {"design": design, "n": 8, "seed": 5, "ranges": {"x": [0.5, 2.0], "k": [1, 1000]}}
    few = run(model, tmp_path / "s.zarr", points=points)
    assert json.loads(few.attrs[POINT_TABLE]) == {"parameters": ["x", "k"], **points}
    before = len(calls)
    many = run(model, tmp_path / "s.zarr", points=points | {"n": 16})
    size = few.sizes[POINT]
    assert many.sizes[POINT] == 2 * size
    assert len(calls) <= len(set(calls)) + 1  # what was there is not computed again; a first point is called twice
    assert len(set(calls)) == len(set(zip(many.x.values.tolist(), many.k.values.tolist(), strict=True)))
    assert before < len(calls)
    same(many.isel(point=slice(size)), few)


LINK = {"experiment": "linksweep.core.experiment:link", "sampling": {"n_sim": 60, "n_cat": 3, "seed": 8}}


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


@pytest.fixture
def file(tmp_path):
    (tmp_path / "model.py").write_text(
        "def model(x: float = 1.0, k: int = 1):\n"
        "    if k == 3:\n        raise ValueError('three')\n"
        "    return {'y': x * k}\n"
    )
    return "model.py:model"


def test_the_command_line_runs_grows_fails_retries_and_reproduces_points(file, tmp_path, sweep):
    def asked(*command, code=0):
        found, out, err = sweep(*command, "--json", cwd=tmp_path)
        assert found == code, err
        return json.loads(out or "null"), err

    table = "x,k\n0.5,2\n0.25,3\n0.5,2\n"
    (tmp_path / "t.csv").write_text(table)
    told, err = asked("run", file, "--points", "t.csv", "-o", "s.zarr", code=1)
    assert "1 point failed: ValueError: three, at x=0.25,k=3" in err
    rows = [(row["point"], row["y"], row["status"]) for row in told["rows"]]
    assert rows == [(0, 1.0, "done"), (1, None, "failed"), (2, 1.0, "done")]
    (tmp_path / "t.csv").write_text(table + "2.0,7\n")
    told, _ = asked("plan", file, "--points", "t.csv", "-o", "s.zarr")
    assert (told["grid"], told["blocks_pending"]) == ("point 4", 1)
    asked("run", file, "--points", "t.csv", "-o", "s.zarr", code=1)
    (tmp_path / "t.csv").unlink()
    told, _ = asked("status", "s.zarr")
    assert told["points"] == {"missing": 0, "done": 3, "failed": 1, "excluded": 0}
    for at in ("point=3", "x=2.0", "x=0.5,k=2"):
        assert sweep("reproduce", "s.zarr", "--at", at, cwd=tmp_path)[::2] == (0, "every bit as in s.zarr\n")
    code, _, err = sweep("reproduce", "s.zarr", "--at", "point=4", cwd=tmp_path)
    assert (code, "must be the number of a point, from 0 to 3" in err) == (2, True)
    (tmp_path / "model.py").write_text((tmp_path / "model.py").read_text().replace("k == 3", "k == 300"))
    asked("run", "--retry", "s.zarr", code=2)
    told, _ = asked("run", "--retry", "s.zarr", "--accept-code")
    assert [row["y"] for row in told["rows"]] == [1.0, 0.75, 1.0, 14.0]
    told, _ = asked("find", "s.zarr", "--where", "y > 0.9")
    assert [row["point"] for row in told["rows"]] == [0, 2, 3]
