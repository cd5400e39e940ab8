"""Results whose length differs between points are padded, beside their lengths, if that is declared."""

import itertools
import json
import math

import numpy as np
import pytest
import xarray as xr
from astropy.table import Table as AstropyTable
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st

import linksweep
from linksweep import Output, SweepError, experiment
from linksweep.sweep.report.page import report_page
from linksweep.sweep.result import Result
from tests.sweep.opening import OFTEN, bare, check, dying, merge, run, same, until_done
from tests.tiers import examples

KINDS = {
    "number": lambda k, n: k / 3.0 + np.arange(n),
    "mixed": lambda k, n: k * np.arange(n) if k > 1 else np.arange(n) / 7.0,
    "count": lambda k, n: [2**60 + k + j for j in range(n)],
    "truth": lambda k, n: np.arange(n) % 2 == k % 2,
    "word": lambda k, n: np.array([f"é{k}" * j for j in range(n)], dtype=object if n else str),
    "time": lambda k, n: np.datetime64("2020-01-01T00:00:00.000000001") + np.arange(n),
    "table": lambda k, n: np.outer([1.0, k], np.arange(n)),
}
DIMS = {"table": ("state", "step")}


@experiment(outputs=[Output(name, dims=DIMS.get(name, ("step",)), ragged="step") for name in KINDS])
def walk(k: int, n: int):
    if k == n == 9:
        raise ValueError("no such walk")
    return {name: make(k, n) for name, make in KINDS.items()}


def plain(array):
    """Return values as a list, None where a number is missing."""
    return [None if isinstance(one, float) and math.isnan(one) else one for one in array.ravel().tolist()]


def expected(ks, ns):
    """Return the arrays that a dataset of all points has, by plain loops."""
    done = [n for k in ks for n in ns if (k, n) != (9, 9)]
    longest, found = max([1, *done]), {}
    for name, make in KINDS.items():
        shape = (len(ks), len(ns), *((2,) if name == "table" else ()), longest)
        missing = {"word": "", "time": np.datetime64("NaT")}.get(name, np.nan)
        found[name] = np.full(shape, missing, dtype="M8[ns]" if name == "time" else object)
        for i, j in np.ndindex(len(ks), len(ns)):
            if (ks[i], ns[j]) != (9, 9):
                found[name][i, j, ..., : ns[j]] = make(ks[i], ns[j])
    return found


lengths = st.lists(st.integers(0, 9), min_size=1, max_size=4, unique=True)
runs = st.lists(st.tuples(lengths, lengths), min_size=1, max_size=4)


@pytest.mark.slow
@settings(
    max_examples=examples(12), deadline=None, suppress_health_check=[HealthCheck.too_slow], phases=[Phase.generate]
)
@given(runs=runs, parts=st.integers(0, 3))
def test_whatever_the_order_a_dataset_has_the_values_of_each_point(tmp_path_factory, runs, parts):
    assume(any((k, n) != (9, 9) for ks, ns in runs for k in ks for n in ns))  # no lengths are known where all fail
    folder = tmp_path_factory.mktemp("ragged")
    for ks, ns in runs:
        linksweep.run(walk, folder / "s", axes={"k": ks, "n": ns}, pool="serial", max_failures="100%")
    ks, ns = (sorted({value for run in runs for value in run[place]}) for place in (0, 1))
    whole = {"axes": {"k": ks, "n": ns}, "max_failures": "100%", "pool": "serial"}
    found = linksweep.run(walk, folder / "s", **whole)
    assert found.equals(linksweep.open(folder / "s"))
    for name, values in expected(ks, ns).items():
        lengths = np.array([[np.nan if (k, n) == (9, 9) else n for n in ns] for k in ks])
        np.testing.assert_array_equal(found[f"{name}_length"], lengths)
        assert plain(found[name].values) == plain(values), name
    stored = xr.open_zarr(folder / "s", mask_and_scale=False).load()
    at_once = folder / "once"
    linksweep.run(walk, at_once, **whole)
    if parts:
        for part in range(1, parts + 1):
            linksweep.run(walk, at_once, part=f"{part}/{parts}", **whole)
        at_once = folder / "merged"
        merge(sorted(folder.glob("once.part-*")), at_once)
    once = xr.open_zarr(at_once, mask_and_scale=False).load()
    assert bare(once).identical(bare(stored))


@pytest.mark.slow
def test_tables_pages_and_laws_know_the_lengths(tmp_path):
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
    back = AstropyTable.read(tmp_path / "t.ecsv")
    assert [part.shape for part in back["table"]] == [(2, 3), (2, 5)] * 2
    law = linksweep.fit_power_law(ds.isel(step=slice(1, None)), "number", over="step")  # each line to its own end
    assert bool((law.exponent > 0.0).all())
    assert not linksweep.find(ds, "number < 1", over="step").to_dataframe().empty


@pytest.mark.parametrize(
    ("outputs", "problem"),
    [
        ([Output("a", ragged=3)], "ragged = 3: must be True, or one of its dims"),
        ([Output("a", dims="s", ragged="t")], "ragged = 't': must be True, or one of its dims (s)"),
        ([Output("a", dims=("s", "t"), ragged=True)], "say along which of its dimensions, such as ragged='t'"),
        ([Output("a", dims="s", coords={"s": [1, 2]}, ragged=True)], "return its coordinate as another output"),
    ],
)
def test_a_declaration_that_means_nothing_is_refused_by_name(outputs, problem):
    with pytest.raises(SweepError) as refused:
        experiment(outputs=outputs)(lambda x: {"a": [x]})
    assert problem in str(refused.value)


def test_statistics_need_one_length():
    with pytest.raises(SweepError, match="ragged: statistics of realisations need one length"):
        experiment(outputs=[Output("a", ragged=True)])(lambda x, rng: {"a": [x]})


def grows(n: int):
    return {"a": list(range(n)), "a_length": n} if n == 4 else {"a": list(range(n)), "b": np.ones((2, n))}


@pytest.mark.parametrize(
    ("outputs", "n", "problem"),
    [
        ((), [2, 3], "declare Output('a', ragged=True), Output('b', dims=('b_dim_0', 'b_dim_1'), ragged='b_dim_1')"),
        ([Output("a", ragged=True)], [2, 3], "declare Output('b', dims=('b_dim_0', 'b_dim_1'), ragged='b_dim_1')"),
        ([Output("b", ragged=True)], [2], "'b' has the dimensions (b_dim_0, b_dim_1): declare which of them is ragged"),
        ([Output("a", ragged=True)], [4], "'a' is ragged, and 'a_length' is the name of its length; take another"),
        ([Output("a", dims="p", ragged=True), Output("b", dims=("q", "p"))], [0, 2], ""),
        ([Output("a", dims="p", ragged=True), Output("b", dims=("p", "q"), ragged="q")], [2], "several ragged"),
        ([Output("b", dims=("q", "p"), ragged="q")], [0], "'a' has no values"),
    ],
)
def test_results_that_are_not_as_declared_are_refused_by_name(tmp_path, outputs, n, problem):
    declared = experiment(outputs=outputs)(grows) if outputs else grows
    ds = linksweep.run(declared, tmp_path / "s", axes={"n": n}, pool="serial", max_failures="100%")
    assert (problem or "{}") in ds.attrs["failures"]


GROWS = """
from linksweep import Output, experiment

@experiment(outputs=[Output("path", dims="step", ragged=True), Output("words", dims="step")])
def grows(n: int):
    return {"path": list(range(n)) if n % 2 else [0.5] * n, "words": ["w"] * n}
"""


@pytest.mark.slow
def test_a_run_that_was_killed_at_any_instant_goes_on(tmp_path, monkeypatch):
    (tmp_path / "grows.py").write_text(GROWS)
    study = {"title": "", "experiment": f"{tmp_path / 'grows.py'}:grows", "axes": {"n": [1, 2, 4, 3, 9, 5]}}
    wanted = run(study, tmp_path / "whole", OFTEN)
    left = dying(monkeypatch)
    for number in itertools.count():
        store = tmp_path / f"{number}"
        found, killed = until_done(left, number, lambda: run(study, store, OFTEN))  # noqa: B023
        same(found, wanted)
        assert check(store).remarks == []
        if not killed:
            return
