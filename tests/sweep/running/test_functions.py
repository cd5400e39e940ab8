"""Plain functions from a study to a store: once at each point, to the last bit, held to the first result."""

import json
import re

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st

import linksweep
from linksweep import Output, experiment
from tests.sweep.opening import dying, same, until_done
from tests.tiers import examples, slow


def run(function, store, **given):
    return linksweep.run(function, store=store, pool="serial", **given)


def test_integers_beside_points_that_failed_are_missing_there_and_exact_in_the_file(tmp_path):
    def large(k: int):
        return {"y": 2**60 + k // (k != 1), "n": k // (k != 1), "t": np.datetime64("2024-01-01") + k // (k != 1)}

    ds = run(large, tmp_path / "s.zarr", axes={"k": range(3)})
    np.testing.assert_array_equal(ds.n, [0.0, np.nan, 2.0])
    plain = xr.open_zarr(tmp_path / "s.zarr").load()
    for name in ("y", "n", "t"):
        assert plain[name].isnull().values.tolist() == [False, True, False]
        np.testing.assert_array_equal(plain[name], ds[name].astype(plain[name].dtype))
    assert [y for y in ds.y.values.tolist() if y == y] == [2**60, 2**60 + 2]  # noqa: PLR0124 (NaN)
    exact = xr.open_zarr(tmp_path / "s.zarr", mask_and_scale=False)
    assert exact.y.dtype == np.int64
    assert exact.y.values.tolist() == [2**60, exact.y.attrs["_FillValue"], 2**60 + 2]


def test_statistics_extend_to_the_bits_of_one_run(tmp_path):
    outputs = [Output("wait", statistics=["mean", "std", "q95", "median", "max", "min"])]

    @experiment(outputs=[*outputs, Output("long", statistics="count")])
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


@pytest.mark.parametrize("sign", [1, -1])
def test_statistics_are_made_of_integers_that_floats_hold_and_of_no_others(tmp_path, sign):
    def whole(beyond: int = 0, *, rng):
        return {"n": sign * (2**53 + beyond)}

    axes, sampling = {"beyond": [0, 1, -1, -(2**52)]}, {"n_sim": 5}
    ds = run(whole, tmp_path / "w", axes=axes, sampling=sampling)
    assert ds.status.values.tolist() == [1, 2, 1, 1]
    expected = [sign * (2**53), sign * (2**53 - 1), sign * 2**52]
    assert np.delete(ds.n_mean.values, 1) == pytest.approx(expected, rel=3e-16)
    assert "beyond 2**53" in json.loads(ds.attrs["failures"])["beyond=1"]


NUMBER = st.one_of(
    st.integers(-3, 3), st.integers(-(2**53), 2**53), st.sampled_from([0.0, -0.0, 0.5, 1e300]), st.just(np.float32(0.1))
)
SEVERAL = st.one_of(
    st.lists(st.integers(-5, 5), min_size=2, max_size=2), st.lists(st.floats(-1, 1), min_size=2, max_size=2)
)
VALUES = st.fixed_dictionaries(
    {"a": NUMBER, "big": st.one_of(NUMBER, st.integers(2**53 + 1, 2**63 - 1)), "v": SEVERAL.map(np.array)}
)


def joined(values):
    """What NumPy makes of numbers of all points; those that no float can hold beside floats are left out."""
    floats = any(np.asarray(value).dtype.kind == "f" for value in values)
    kept = [
        k for k, v in enumerate(values) if not floats or np.asarray(v).dtype.kind == "f" or np.all(np.abs(v) <= 2**53)
    ]
    return {k: np.asarray(values[k], dtype=float if floats else np.int64) for k in kept}


@settings(max_examples=examples(30))
@given(values=st.lists(VALUES, min_size=2, max_size=6), data=st.data())
def test_integers_and_floats_are_joined_whatever_the_order_and_the_runs(tmp_path_factory, values, data):
    table = [
        {name: v if np.ndim(v) else v.item() if hasattr(v, "item") else v for name, v in row.items()} for row in values
    ]

    def numbers(k: int):
        return table[k]

    store = tmp_path_factory.mktemp("joined") / "s.zarr"
    first = data.draw(st.sets(st.integers(0, len(table) - 1)))
    for axis in [sorted(first)] * bool(first) + [data.draw(st.permutations(range(len(table))))]:
        ds = run(numbers, store, axes={"k": axis})
    expected = {name: joined([row[name] for row in table]) for name in ("a", "big", "v")}
    left = sorted(set.intersection(*map(set, expected.values())))
    for name, own in expected.items():
        assert sorted(ds.k.values[ds.status.values == 1]) == left
        for k in left:
            found = ds[name].sel(k=k).values
            assert found.astype(own[k].dtype).tobytes() == own[k].tobytes()
        if len(left) == len(table):
            assert ds[name].dtype == own[0].dtype
    for message in json.loads(ds.attrs["failures"]).values():
        assert re.fullmatch(r"numbers: 'big' is \d+, which is beyond 2\*\*53, and other points have floats", message)


@pytest.mark.parametrize("kill", [7, 13, *map(slow, range(20))])
def test_killed_while_integers_become_floats_none_is_rounded(tmp_path, monkeypatch, kill):
    def steps(k: int):
        return k / 2 if k % 2 else 2**53 + k - 9 if k > 8 else k // 2

    left = dying(monkeypatch)
    run(steps, tmp_path / "s.zarr", axes={"k": [0, 10]})
    ds, _ = until_done(left, kill, lambda: run(steps, tmp_path / "s.zarr", axes={"k": [0, 1, 10]}))
    assert ds.status.values.tolist() == [1, 1, 2]
    assert "beyond 2**53" in json.loads(ds.attrs["failures"])["k=10"]
