"""Results of plain functions in a store: to the last bit, held to the first; large arrays: written once, read late."""

import itertools
import json
import os
import re
import subprocess
from contextlib import closing
from datetime import datetime
from enum import Enum
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st

import linksweep
from linksweep import Limits, Output, SweepError, experiment
from linksweep.sweep.analysis.tables import tables
from linksweep.sweep.plots.figure import draw_figure
from tests.sweep.opening import dying, same, until_done
from tests.sweep.outside import Outside
from tests.tiers import examples, few, slow

NUMBER = st.integers(-3, 3) | st.integers(-(2**53), 2**53) | st.sampled_from([0.0, -0.0, 0.5, 1e300, np.float32(0.1)])
SEVERAL = st.one_of(*(st.lists(one, min_size=2, max_size=2) for one in (st.integers(-5, 5), st.floats(-1, 1))))
LARGE = NUMBER | st.integers(2**53 + 1, 2**63 - 1)
VALUES = st.fixed_dictionaries({"a": NUMBER, "big": LARGE, "v": SEVERAL.map(np.array)})
Word = Enum("Word", {"LONG": "a word", "NONE": ""}, type=str)
FIRST = st.integers(-(2**63), -(2**63) + 3000)
OF_A_KIND = {
    "whole": st.one_of(FIRST, st.integers(-3, 3), st.integers(-(2**63), 2**63 - 1)),
    **{"wholes": st.lists(FIRST, min_size=2, max_size=2), "ragged": st.lists(FIRST, max_size=3)},
    "text": st.one_of(st.text(st.characters(codec="utf-8"), max_size=3), st.sampled_from(Word)),
    "texts": st.lists(st.sampled_from(Word), min_size=2, max_size=2),
    **{"time": st.datetimes(datetime(1700, 1, 1), datetime(2200, 1, 1)), "truth": st.booleans()},
    "number": st.floats(allow_nan=False, allow_infinity=False),
}
PICTURES = "import numpy as np\nfrom pathlib import Path\ndef picture(a: int):\n"
PICTURES += '    assert HIDDEN == (not list(Path("FOLDER").glob("*.zarr")))\n'
PICTURES += '    return {"image": np.random.default_rng(a).normal(size=(1100, 500))}\n'


def run(function, store, **options):
    return linksweep.run(function, store=store, pool="serial", **options)


def test_statistics_extend_to_the_bits_of_one_run(tmp_path):
    wait = Output("wait", statistics=["mean", "std", "q95", "median", "max", "min"])

    @experiment(outputs=[wait, Output("long", statistics="count")])
    def queue(rng):
        wait = rng.exponential(2.0)
        return {"wait": wait, "long": wait > 3.0}

    def asked(store, n_sim):
        return run(queue, tmp_path / store, sampling={"n_sim": n_sim, "seed": 3, "keep_samples": True})

    short, whole = asked("q.zarr", 600), asked("q.zarr", 1000)
    same(whole, asked("once.zarr", 1000))
    assert short.wait_max <= whole.wait_max == whole.wait_samples.max()
    assert whole.long_count.item() == (whole.wait_samples > 3.0).sum()
    assert "wait_max_mc_error" not in whole


@settings(max_examples=examples(15, quick=3))
@given(table=st.lists(st.none() | st.fixed_dictionaries(OF_A_KIND), min_size=1, max_size=4).filter(any))
def test_a_run_returns_what_its_store_has_and_no_value_is_taken_for_a_missing_one(tmp_path_factory, table):
    @experiment(outputs=[*map(Output, OF_A_KIND.keys() - {"ragged"}), Output("ragged", ragged=True)])
    def row(k: int, name: str):
        return table[k] or 1 / 0

    store = tmp_path_factory.mktemp("same") / "s.zarr"
    made = run(row, store, axes={"k": range(len(table)), "name": ["é"]}, max_failures="100%").squeeze("name")
    whole, plain = linksweep.open(store).squeeze("name"), xr.open_zarr(store).load().squeeze("name")
    exact = xr.open_zarr(store, mask_and_scale=False).squeeze("name").whole
    assert exact.values.tolist() == [row["whole"] if row else exact.attrs["_FillValue"] for row in table]
    xr.testing.assert_identical(made, whole)
    assert {n: v.dtype for n, v in made.variables.items()} == {n: v.dtype for n, v in whole.variables.items()}
    for k, wanted in enumerate(table):
        for name, value in (wanted or {}).items():
            ours = (..., slice(len(value))) if name == "ragged" else ...
            result = np.datetime64(value, "ns").item() if name == "time" else value
            assert whole[name][k].values[ours].tolist() == result
            assert "text" in name or plain[name][k].notnull().values[ours].all()
        if wanted:
            assert whole.ragged[k, len(wanted["ragged"]) :].isnull().all()
        else:
            assert all(plain[name][k].isnull().all() for name in ("whole", "wholes", "time", "truth", "number"))


@pytest.mark.parametrize("sign", [1, -1])
def test_statistics_are_made_of_integers_that_floats_hold_and_of_no_others(tmp_path, sign):
    axes = {"beyond": [0, 1, -1, -(2**52)]}
    ds = run(lambda rng, beyond=0: {"n": sign * (2**53 + beyond)}, tmp_path / "w", axes=axes, sampling={"n_sim": 5})
    assert ds.status.values.tolist() == [1, 2, 1, 1]
    assert ds.n_mean.values[[0, 2, 3]] == pytest.approx([sign * n for n in (2**53, 2**53 - 1, 2**52)], rel=3e-16)
    assert "beyond 2**53" in json.loads(ds.attrs["failures"])["beyond=1"]


def joined(values):
    """What NumPy makes of numbers of all points; those that no float can hold beside floats are left out."""
    floats = any(np.asarray(value).dtype.kind == "f" for value in values)
    beyond = {k for k, v in enumerate(values) if np.asarray(v).dtype.kind == "i" and np.any(np.abs(v) > 2**53)}
    kept = {k: v for k, v in enumerate(values) if not floats or k not in beyond}
    return {k: np.asarray(v, dtype=float if floats else np.int64) for k, v in kept.items()}


def plain(value):
    return value if np.ndim(value) or not hasattr(value, "item") else value.item()


@settings(max_examples=examples(30, quick=3))
@given(values=st.lists(VALUES, min_size=2, max_size=6), data=st.data())
def test_integers_and_floats_are_joined_whatever_the_order_and_the_runs(tmp_path_factory, values, data):
    def numbers(k: int):
        return {name: plain(value) for name, value in values[k].items()}

    store = tmp_path_factory.mktemp("joined") / "s.zarr"
    first = data.draw(st.sets(st.integers(0, len(values) - 1)))
    for axis in [sorted(first)] * bool(first) + [data.draw(st.permutations(range(len(values))))]:
        ds = run(numbers, store, axes={"k": axis})
    expected = {name: joined([plain(row[name]) for row in values]) for name in ("a", "big", "v")}
    left = sorted(set.intersection(*map(set, expected.values())))
    for name, ours in expected.items():
        assert sorted(ds.k.values[ds.status.values == 1]) == left
        for k in left:
            assert ds[name].sel(k=k).values.astype(ours[k].dtype).tobytes() == ours[k].tobytes()
        assert len(left) < len(values) or ds[name].dtype == ours[0].dtype
    for message in json.loads(ds.attrs["failures"]).values():
        assert re.fullmatch(r"numbers: 'big' is \d+, which is beyond 2\*\*53, and is to be a float", message)


@pytest.mark.parametrize("kill", [7, 13, *map(slow, range(20))])
def test_killed_while_integers_become_floats_none_is_rounded(tmp_path, monkeypatch, kill):
    def steps(k: int):
        return k / 2 if k % 2 else 2**53 + k - 9 if k > 8 else k // 2

    left = dying(monkeypatch)
    run(steps, tmp_path / "s.zarr", axes={"k": [0, 10]})
    ds, _ = until_done(left, kill, lambda: run(steps, tmp_path / "s.zarr", axes={"k": [0, 1, 10]}))
    assert ds.status.values.tolist() == [1, 1, 2]
    assert "beyond 2**53" in json.loads(ds.attrs["failures"])["k=10"]


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr("linksweep.sweep.contract.rows.MOST_VALUES", 64)


@experiment(outputs=[Output("image", nan=True), Output("level"), Output("names")])
def picture(a: int, b: int = 0):
    if b == 2:
        raise ValueError("two")
    drawn = np.random.default_rng([a, b]).normal(size=(9, 40))
    drawn.flat[:: 7 + a] = np.nan
    drawn.flat[1] = np.inf
    return {"image": drawn, "level": a / 3, "names": [f"{a}", "x"]}


def check(dataset):
    for a, b in itertools.product(dataset["a"].values, dataset["b"].values):
        point = dataset.sel(a=a, b=b)
        wanted = picture(a, b)["image"] if point["status"] == 1 else np.full((9, 40), np.nan)
        np.testing.assert_array_equal(point["image"], wanted)


def digests(store):
    files = [file for file in Path(store).glob("*/c*.*") if file.parent.name != "wall_time"]
    return {file.relative_to(store): file.read_bytes() for file in files}


@pytest.mark.parametrize("options", few(1, [{"workers": 2}, {"pool": "threads", "workers": 2}, {"limits": Limits(60)}]))
def test_who_writes_large_arrays_changes_no_bit_and_they_are_stored_once(options, small, tmp_path):
    axes = {"a": range(3), "b": [0, 2]}
    serial = linksweep.run(picture, tmp_path / "serial.zarr", axes=axes, pool="serial", max_failures="100%")
    ds = linksweep.run(picture, tmp_path / "s.zarr", axes=axes, max_failures="100%", **options)
    same(ds, serial)
    check(ds)
    assert digests(tmp_path / "s.zarr") == digests(tmp_path / "serial.zarr")
    # A chunk is one file with two names; missing ones are files of their own.
    linked = [file for file in (tmp_path / "s.zarr" / "image").glob("c*.*") if file.stat().st_nlink == 2]
    assert len(linked) == np.sum(ds["status"].values == 1) * 9
    assert len(list((tmp_path / "s.zarr" / "blocks").glob("large.*"))) == len(linked)


@pytest.mark.slow
@pytest.mark.parametrize("hides", [False, True])
def test_workers_of_a_scheduler_write_large_arrays_where_they_see_the_store(hides, tmp_path):
    folder = tmp_path / "stores"
    folder.mkdir()
    hide = ["unshare", "--mount", "sh", "-c", f'mount -t tmpfs none "{folder}" && "$@"', "sh"] if hides else []
    if hides and (os.geteuid() != 0 or subprocess.run([*hide, "true"], check=False).returncode):
        pytest.skip("a file system of its own for a process needs root and unshare")
    (tmp_path / "pictures.py").write_text(PICTURES.replace("HIDDEN", str(hides)).replace("FOLDER", str(folder)))
    study = {"title": "p", "experiment": f"{tmp_path}/pictures.py:picture", "axes": {"a": [1, 2, 3]}}
    with closing(Outside(tmp_path)) as outside:
        outside.start_worker(before=hide)
        ds = linksweep.run(study, folder / "s.zarr", scheduler=outside.address)
    wanted = [np.random.default_rng(a).normal(size=(1100, 500)) for a in (1, 2, 3)]
    np.testing.assert_array_equal(ds["image"].values, wanted)
    np.testing.assert_array_equal(xr.open_zarr(folder / "s.zarr")["image"].values, wanted)


def test_a_store_is_opened_without_its_large_arrays_and_they_are_read_from_it_or_not_at_all(small, tmp_path):
    store, how = tmp_path / "s.zarr", {"pool": "serial", "max_failures": "100%"}
    ds = linksweep.run(picture, store, axes={"a": [1, 2], "b": [0, 2]}, **how)
    linksweep.run(picture, store, axes={"a": [0, 1, 2], "b": [0, 1, 2]}, **how)
    check(ds)  # a later run leaves what an earlier one has returned
    opened = linksweep.open(store)
    [file.unlink() for file in (store / "blocks").glob("large.*")]
    assert ("0.3333" in str(tables(opened)), draw_figure(opened).axes[0].get_label()) == (True, "level")
    for lost in (ds, opened):
        with pytest.raises(SweepError, match=r"blocks/large\.[0-9a-f]{32} cannot be read: it is missing"):
            lost["image"].sel(a=1, b=0).load()
