"""Same seed, same numbers, bitwise: whatever the workers, the order and how a study grew; the time is no result."""

import json
import os
import random
import subprocess
import sys
import time
from contextvars import ContextVar
from dataclasses import replace
from decimal import Context, Decimal, localcontext
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import linksweep
from tests.sweep import spread
from tests.sweep.opening import check, generators, live_study, make_grid, merge, plan_study, run, same
from tests.tiers import PATIENCE_S, slow

OTHER_RESOURCES = [("--workers", 1), ("--workers", 4), ("--pool", "threads", "--workers", 4)]
SPREAD = {"title": "Spread", "experiment": f"{Path(spread.__file__)}:experiment"}
SPREAD["axes"] = {"x": [0.5, 1.0, 2.0], "law": ["power", "levelling"]}
SPREAD["sampling"] = {"n_sim": 64, "n_cat": 6, "seed": 5, "common_random_numbers": True}
STEP = ContextVar("STEP", default=1.0)
THREADS = """
import pathlib, threading, time
import linksweep, threadpoolctl
from linksweep.sweep.running.merge import merge
def threads():
    return max(one["num_threads"] for one in threadpoolctl.threadpool_info())
def wait(name, is_there):
    while pathlib.Path(name).exists() != is_there:
        time.sleep(0.1)
def evaluate(points, n_sim, *generators):
    import scipy.linalg  # whose library is loaded in a block
    pathlib.Path(str(points[0]["x"])).touch()
    wait(*{0: ("1", True), 2: ("short.lock", False)}.get(points[0]["x"], (".", True)))
    return {"threads": [n_sim * threads()]}
def summarise(sums, n, n_cat):
    return {"here": sums["threads"] / n, "later": n * 0.0 + threads()}
x, outputs = linksweep.Parameter("x", "int"), (linksweep.Output("here"), linksweep.Output("later"))
experiment = linksweep.Experiment("threads", 1, (x,), {"threads": ()}, outputs, evaluate, summarise)
def run(name, x, part=None):
    axes, sampling = {"x": x}, {"n_sim": 600}
    linksweep.run("m.py:experiment", name, axes=axes, sampling=sampling, pool="serial", part=part)
if __name__ == "__main__":
    before, runs = threads(), (("short", [0]), ("long", [1, 2]))
    short, long = (threading.Thread(target=run, args=one) for one in runs)
    short.start(), wait("0", True), long.start(), long.join()  # which ends last
    [run("s", [3], f"{k}/2") for k in (1, 2)]
    merge(["s.part-1-of-2", "s.part-2-of-2"], "s")
    for ds in map(linksweep.open, ("short", "long", "s")):
        assert set(ds.here.values) | set(ds.later.values) == {1.0}, ds
    assert threads() == before
"""


@pytest.mark.parametrize("resources", [("--workers", 2), *map(slow, OTHER_RESOURCES)], ids=str)
def test_any_number_of_workers(link_study, tmp_path, sweep, reference, resources):
    sweep("run", link_study, "-o", tmp_path / "s.zarr", *resources, code=0)
    same(tmp_path / "s.zarr", reference)


def sleeps(x: float):
    time.sleep(x)
    if x == 0.02:
        raise ValueError("not this one")
    return {"y": 2.0 * x if x == 0.01 else 2, "large": np.full(100, x)}


def draws(rng, x: float):
    time.sleep(5e-5 * x)
    return rng.normal(x)


@pytest.mark.parametrize("pool", ["serial", "threads", slow("processes")])
def test_each_point_has_the_time_that_it_took_and_what_is_set_in_the_thread_of_the_run(tmp_path, monkeypatch, pool):
    store = tmp_path / "s.zarr"
    monkeypatch.setattr("linksweep.sweep.contract.rows.MOST_VALUES", 64)  # arrays are in files of their own
    first = linksweep.run(sleeps, store, axes={"x": [0.05, 0.02, 0.1]}, pool=pool)
    assert (first.wall_time.dims, first.wall_time.attrs["units"]) == (("x",), "s")
    assert np.isnan(first.wall_time.sel(x=0.02))
    assert all(first.wall_time.sel(x=x) >= x for x in (0.05, 0.1))
    for x in (0.01, 0.03):  # the second finds the integers of the first run as floats
        linksweep.run(sleeps, store, axes={"x": [x]}, pool=pool)
    both = linksweep.open(store)
    assert both.sel(x=first.x).wall_time.equals(first.wall_time)
    assert (both.large.sel(x=[0.01, 0.05, 0.1]).values.T == [0.01, 0.05, 0.1]).all()
    assert both.wall_time.sel(x=0.01) >= 0.01
    assert xr.open_zarr(store).load().wall_time.equals(both.wall_time)
    assert not check(store)

    def f(x: int):
        return {"a": STEP.get(), "b": str(Decimal(x) / 7), "c": np.geterr()["under"]}

    token = STEP.set(2.0)
    with localcontext(Context(prec=4)), np.errstate(under="raise"):
        ds = linksweep.run(f, tmp_path / "t.zarr", axes={"x": [1, 2]}, pool=pool)
    STEP.reset(token)
    assert [ds[name].values.tolist() for name in "abc"] == [[2.0, 2.0], ["0.1429", "0.2857"], ["raise", "raise"]]


def test_sums_of_products_have_one_thread_whatever_else_goes_on(tmp_path):
    (tmp_path / "m.py").write_text(THREADS)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "m.py"], cwd=tmp_path, env=environment, check=True, timeout=PATIENCE_S)


def test_blocks_add_up_whoever_computed_them(tmp_path):
    how = {"axes": {"x": [1.0, 3.0]}, "sampling": {"n_sim": 600}, "pool": "serial"}  # two blocks
    for part in (1, 2):
        linksweep.run(draws, tmp_path / "s", part=f"{part}/2", **how)
    merged = merge(sorted(tmp_path.glob("s.part-*")), tmp_path / "s")
    linksweep.run(draws, tmp_path / "t", **{**how, "sampling": {"n_sim": 100}})
    more = linksweep.run(draws, tmp_path / "t", **how)
    for ds in (merged, more):
        assert all(ds.wall_time.sel(x=x) >= 600 * 5e-5 * x for x in (1.0, 3.0))
    same(merged, more)
    # the same points took another time, and are the same numbers
    same(merge([tmp_path / "s", tmp_path / "t"], tmp_path / "u"), more)


@pytest.mark.parametrize("chains", [1, slow(6)])
def test_growth_of_any_kind_in_any_order_gives_the_bits_of_a_fresh_run(coins, tmp_path, chains):
    rng = random.Random(11)
    for chain in range(chains):
        document = coins | {"axes": {"coins": [5]}, "fixed": {}, "sampling": {"n_sim": 300, "n_cat": 3, "seed": 7}}
        store = tmp_path / f"{chain}.zarr"
        run(document, store)
        for _ in range(4):
            axes, sampling = dict(document["axes"]), dict(document["sampling"])
            kind = rng.choice(["value", "axis", "n_sim", "n_cat", "order"])
            if kind == "value":
                axes["coins"] = rng.sample([*axes["coins"], max(axes["coins"]) + 3], len(axes["coins"]) + 1)
            elif kind == "axis" and "metal" not in axes:
                axes = {"metal": ["tin", "gold"]} | axes  # gold is the default: these points are there already
            elif kind == "order":
                axes = dict(reversed(axes.items()))
            else:
                key = "n_cat" if kind == "n_cat" else "n_sim"
                sampling[key] += rng.randint(1, 400)
            assert plan_study(live_study(document), store)[1].pending.blocks == 0
            document = document | {"axes": axes, "sampling": sampling}
            same(run(document, store), run(document, tmp_path / f"{chain}-{rng.random()}.zarr"))


def test_results_are_what_a_plain_loop_over_the_streams_gives(coins, tmp_path):
    dataset = run(coins, tmp_path / "s.zarr")
    points = make_grid(live_study(coins)).points()
    point = next(p for p in points if p.parameters["metal"] == "tin" and p.parameters["coins"] == 5)
    heads = 0
    for catalogue in range(20):
        for part, n_sim in enumerate((512, 488)):
            rng, catalogue_rng = generators(7, point.digest, catalogue, part)
            bias = 0.1 * catalogue_rng.uniform(-1, 1)
            heads += rng.binomial(5, 0.4 + bias, size=n_sim).sum()
    assert dataset["share"].sel(metal="tin", coins=5).item() == heads / (5 * 20_000)


def test_points_that_share_random_numbers_are_what_they_are_alone(tmp_path, monkeypatch):
    whole = run(SPREAD, tmp_path / "whole.zarr")
    alone = run(SPREAD | {"axes": {"x": [1.0]}}, tmp_path / "s.zarr")
    assert alone["width"].item() == whole["width"].sel(x=1.0, law="power").item()
    asked = []

    def fail(points, *rest):
        asked.extend((p["x"], p["law"]) for p in points)
        if any(p["x"] == 2.0 for p in points):
            raise ValueError("not two")
        return spread.evaluate(points, *rest)

    failing = replace(spread.experiment, evaluate=fail)
    monkeypatch.setattr("linksweep.sweep.executing.worker.load_experiment", lambda reference, digest: failing)
    grown = run(SPREAD, tmp_path / "s.zarr")
    assert (1.0, "power") not in asked  # it is there already
    assert set(json.loads(grown.attrs["failures"])) == {"x=2.0,law=power", "x=2.0,law=levelling"}
    np.testing.assert_array_equal(grown["width"].sel(x=[0.5, 1.0]), whole["width"].sel(x=[0.5, 1.0]))
