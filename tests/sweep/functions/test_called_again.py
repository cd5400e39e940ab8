"""A function without ``rng`` is called twice at its first point; one that returns another result is refused by name."""

import itertools
import random
import time
import uuid
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import xarray as xr

from linksweep import Output, SweepError, experiment, run
from tests.sweep.opening import Sentences
from tests.tiers import few, slow

AXES = {"x": [1.0, 2.0, 3.0]}
counter = itertools.count()
DIFFERENT = {
    "numpy": lambda x: np.random.default_rng().normal(),
    "its own generator": lambda x, rng_of=np.random.default_rng(1): rng_of.normal(),  # noqa: B008
    **{"random": lambda x: random.random(), "a counter": lambda x: next(counter)},
    **{"the clock": lambda x: time.perf_counter_ns(), "a text": lambda x: {"x2": 2 * x, "name": uuid.uuid4().hex}},
    "one of an array": lambda x: np.array([1.0, 2.0, random.random()]),
    **{"a length": lambda x: np.ones(1 + next(counter)), "names": lambda x: {f"y{next(counter)}": x}},
    "many points at once": experiment(vectorised=True)(lambda x: np.random.default_rng().normal(size=len(x))),
    "after a point that fails": lambda x: random.random() if x > 2.0 else 1 / 0,
}
SAME = {
    "the order of a dict": lambda x: dict.fromkeys(("b", "c")[:: 1 - 2 * (next(counter) % 2)], x),
    "texts": lambda x: [f"{x}", "ü"],
    "a dataset": lambda x: xr.Dataset({"y": ("t", [x, 2.0])}, coords={"t": [0.5, 1.5]}),
    "a seeded global generator": lambda x: (np.random.seed(4), np.random.normal())[1],  # noqa: NPY002
    "NaN": experiment(outputs=[Output("y", nan=True)])(lambda x: {"y": np.array([np.nan, x, np.inf])}),
    "NaT": experiment(outputs=[Output("y", nan=True)])(lambda x: {"y": np.datetime64("NaT", "s")}),
    "another, as declared": experiment(deterministic=False)(lambda x: random.random()),
}


@pytest.mark.parametrize("kind", few(6, [*DIFFERENT][::-1]))
@pytest.mark.parametrize("pool", ["serial", slow(None), slow("processes")])
def test_another_result_is_refused_by_name(kind, pool, tmp_path):
    f, first = DIFFERENT[kind], 3 if kind == "after a point that fails" else 1 if pool == "serial" else r"\d"
    with pytest.raises(SweepError, match=rf"called twice at x = {first}.0.* argument rng; .*deterministic=False"):
        run(f, tmp_path / "s.zarr", axes=AXES, pool=pool)
    assert not (tmp_path / "s.zarr").exists()
    if kind not in ("a length", "names", "many points at once", "after a point that fails"):  # points fail anyway
        accepted = experiment(deterministic=False)(lambda x: f(x))  # noqa: PLW0108 (f stays undeclared)
        assert (run(accepted, tmp_path / "s.zarr", axes=AXES, pool=pool).status == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("pool", ["processes", "serial", "threads", None])
@pytest.mark.parametrize("last", [1, 5])
def test_so_it_is_where_a_call_takes_a_good_part_of_a_second(tmp_path, pool, last):
    def late(x: int):
        time.sleep(0.3)
        return x if x > last else random.SystemRandom().random()

    with pytest.raises(SweepError, match=r"called twice at x = \d"):
        run(late, tmp_path / "s.zarr", axes={"x": range(1, last + 1)}, pool=pool)
    assert not (tmp_path / "s.zarr").exists()
    f = experiment()(lambda x: (time.sleep(0.3), (tmp_path / uuid.uuid4().hex).touch(), x)[2])
    ds = run(f, tmp_path / "t.zarr", axes={"x": [1, 2, 3]}, pool=pool)
    assert ds.result.values.tolist() == [1, 2, 3]
    assert pool == "threads" or len([*tmp_path.iterdir()]) == 5  # once in a run, not in each process


@pytest.mark.parametrize("kind", few(4, [*SAME][::-1]))
def test_the_same_result_is_taken(kind, tmp_path):
    assert (run(SAME[kind], tmp_path / "s.zarr", axes=AXES, pool="serial").status == 1).all()


def test_the_second_call_counts_nowhere(tmp_path):
    calls, watcher = [], Sentences()
    f = experiment(lambda x: (calls.append(x), print("a line"), [*ThreadPoolExecutor().map(print, ["another"])], x)[3])
    run(f, tmp_path / "s.zarr", axes=AXES, pool="serial", progress=watcher)
    assert sorted(calls) == [1.0, 1.0, 2.0, 3.0]
    assert [said.printed for said in watcher.printed] == ["a line\nanother\n"] * 3
