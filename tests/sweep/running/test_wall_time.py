"""How long each point took stands beside its results, and is no part of them."""

import time

import numpy as np
import pytest
import xarray as xr

import linksweep
from linksweep import SweepError
from tests.sweep.opening import Folder, check, merge


def sleeps(x: float):
    time.sleep(x)
    if x == 0.02:
        raise ValueError("not this one")
    return 2.0 * x


def draws(rng, x: float):
    time.sleep(1e-4 * x)
    return rng.normal(x)


@pytest.mark.parametrize("pool", ["serial", "threads", "processes"])
def test_each_point_has_the_time_that_it_took(tmp_path, pool):
    store = tmp_path / "s.zarr"
    first = linksweep.run(sleeps, store, axes={"x": [0.05, 0.02, 0.1]}, pool=pool)
    assert (first.wall_time.dims, first.wall_time.attrs["units"]) == (("x",), "s")
    assert np.isnan(first.wall_time.sel(x=0.02))
    assert all(first.wall_time.sel(x=x) >= x for x in (0.05, 0.1))
    linksweep.run(sleeps, store, axes={"x": [0.01]}, pool=pool)
    both = linksweep.open(store)
    assert both.sel(x=first.x).wall_time.equals(first.wall_time)
    assert both.wall_time.sel(x=0.01) >= 0.01
    assert xr.open_zarr(store).load().wall_time.equals(both.wall_time)
    assert not check(store)


def test_blocks_add_up_whoever_computed_them(tmp_path):
    how = {"axes": {"x": [1.0, 3.0]}, "sampling": {"n_sim": 600}, "pool": "serial"}  # two blocks
    for part in (1, 2):
        linksweep.run(draws, tmp_path / "s", part=f"{part}/2", **how)
    merged = merge([Folder(path) for path in tmp_path.glob("s.part-*")], tmp_path / "s")
    few = linksweep.run(draws, tmp_path / "t", **{**how, "sampling": {"n_sim": 100}})
    more = linksweep.run(draws, tmp_path / "t", **how)
    for ds in (merged, more):
        assert all(ds.wall_time.sel(x=x) >= 600 * 1e-4 * x for x in (1.0, 3.0))
    assert (more.wall_time > few.wall_time).all()
    assert merged.drop_vars("wall_time").equals(more.drop_vars("wall_time"))
    # the same points took another time, and are the same numbers
    again = merge([Folder(tmp_path / "s"), Folder(tmp_path / "t")], tmp_path / "u")
    assert again.drop_vars("wall_time").equals(more.drop_vars("wall_time"))


def test_the_name_is_not_that_of_a_result(tmp_path):
    def named(x: float):
        return {"wall_time": x}

    with pytest.raises(SweepError, match="wall_time"):
        linksweep.experiment(outputs=["wall_time"])(named)
    ds = linksweep.run(named, tmp_path / "s", axes={"x": [1.0]}, pool="serial", max_failures="100%")
    assert "the output 'wall_time'" in ds.attrs["failures"]
