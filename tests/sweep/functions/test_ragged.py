"""Results whose length differs between points are padded, beside their lengths, if that is declared."""

import json

import numpy as np
import pytest
from astropy.table import Table as AstropyTable

import linksweep
from linksweep import Output, SweepError, experiment
from linksweep.sweep.report.page import report_page
from linksweep.sweep.result import Result
from tests.sweep.opening import check

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
        ([Output("a", ragged=True)], "ragged: statistics of realisations need one length"),
    ],
)
def test_a_declaration_that_means_nothing_is_refused_by_name(outputs, problem):
    with pytest.raises(SweepError) as refused:
        experiment(outputs=outputs)((lambda x, rng: [x]) if "statistics" in problem else (lambda x: [x]))
    assert problem in str(refused.value)


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
