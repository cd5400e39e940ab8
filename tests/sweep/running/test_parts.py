"""Parts of a study that know nothing of each other, and stores of other points, become, whatever the order,
what one run makes; what does not belong together is refused.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, Phase, given, settings, strategies as st

import linksweep
from linksweep import SweepError
from tests.sweep.opening import MERGED, Killed, OpenStore, bare, check, dying, locked, merge, status_report, until_done
from tests.tiers import examples, slow

MODEL = """
def plain(x: float = 1.0, k: int = 1, word: str = "a"):
    if k == 7 and word == "b":
        raise ValueError(f"no {word} at {x}")
    return {"y": x * k, "n": 2**40 + k, "text": word * k, "whole": k if k < 5 else x}


def noisy(rng, x: float = 1.0, k: int = 1):
    value = rng.normal(x, k)
    if value > 3.9 * k + x:
        raise ValueError(f"too far: {value}")
    return {"value": value, "square": value**2}
"""


def bits(store):
    """Return what anybody reads from a store: its arrays to the bit, and why points failed."""
    dataset = xr.open_zarr(store, mask_and_scale=False).load()
    return bare(dataset), json.loads(dataset.attrs["failures"]), dataset.attrs["complete"]


def require_same(one, other):
    (first, *failed), (second, *wanted) = bits(one), bits(other)
    xr.testing.assert_identical(first, second)
    assert failed == wanted


def run_parts(study, store, numbers, total, **more):
    for number in numbers:
        linksweep.run(study, store, part=f"{number}/{total}", pool="serial", max_failures="100%", **more)
    return [Path(f"{store}.part-{number}-of-{total}") for number in numbers]


floats = st.floats(-8.0, 8.0, width=16).map(lambda x: x + 0.0)


def some(values, most):
    return st.lists(values, min_size=1, max_size=most, unique=True)


def table(**columns):
    return st.fixed_dictionaries(columns)


LINK = {"experiment": "linksweep.core.experiment:link", "axes": {"model": ["amex", "gaia"], "n_obj": [20, 30]}}
KINDS = {  # the study, or the name of a function above, and what is asked of it
    "plain": ("plain", table(axes=table(k=some(st.integers(1, 9), 7), x=some(floats, 5), word=some(st.just("b"), 1)))),
    "noisy": (
        "noisy",
        table(
            axes=table(k=some(st.integers(1, 4), 4)),
            sampling=table(n_sim=st.integers(2, 1700), seed=st.integers(0, 99))
            | st.just({"n_sim": 100, "precision": 0.1, "max_n_sim": 4000}),
        ),
    ),
    "link": (
        LINK,
        table(
            sampling=table(
                n_sim=st.integers(1, 30),
                n_cat=st.integers(1, 20),
                keep_samples=st.booleans(),
                common_random_numbers=st.booleans(),
            )
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_parts_merged_in_any_order_are_one_run(tmp_path_factory, kind):
    study, asked_for = KINDS[kind]

    @settings(max_examples=examples(10), phases=[Phase.generate], suppress_health_check=[HealthCheck.too_slow])
    @given(asked=asked_for, total=st.integers(1, 6), rng=st.randoms(use_true_random=False))
    def property_of_parts(asked, total, rng):
        folder = tmp_path_factory.mktemp("parts")
        (folder / "m.py").write_text(MODEL)
        whole, more = (f"{folder}/m.py:{study}", asked) if isinstance(study, str) else (study | asked, {})
        linksweep.run(whole, folder / "w", pool="serial", max_failures="100%", **more)
        stores = run_parts(whole, folder / "s", rng.sample(range(1, total + 1), total), total, **more)
        merge(stores[: rng.randint(1, total)], folder / "s")
        merge(rng.sample(stores, total), folder / "s")
        require_same(folder / "s", folder / "w")
        assert not check(folder / "s")
        shutil.rmtree(folder)

    property_of_parts()


SMALL = {"axes": {"k": [1, 2, 3, 7], "word": ["a", "b"]}, "fixed": {"x": 0.5}}


@pytest.fixture
def model(tmp_path):
    (tmp_path / "m.py").write_text(MODEL)
    return f"{tmp_path}/m.py:plain"


@pytest.fixture
def three(model, tmp_path):
    """The three parts of a small study, in one of which a point has failed."""
    return run_parts(model, tmp_path / "s", [1, 2, 3], 3, **SMALL)


@pytest.mark.parametrize("total", [5, *map(slow, (2, 8, 10))])
def test_no_part_gets_the_same_value_of_an_axis_again_and_again(tmp_path, total):
    """Points that take long where a value is large are shared evenly, also where there are as many parts as values."""
    (tmp_path / "slow.py").write_text("def slow(a: int = 1, b: int = 1):\n    return {'cost': a * b}\n")
    axes = {"a": list(range(1, 11)), "b": list(range(1, 11))}
    stores = run_parts(f"{tmp_path}/slow.py:slow", tmp_path / "s", range(1, total + 1), total, axes=axes)
    for one, factor in (("a", 1.25), ("b", 1.25), ("cost", 1.3)):
        parts = [xr.open_zarr(store).load() for store in stores]
        sums = [float(part[one].broadcast_like(part.status).where(part.status == 1).sum()) for part in parts]
        assert max(sums) <= factor * np.mean(sums), one


def test_a_lost_part_is_named_and_the_same_commands_go_on(model, tmp_path, sweep):
    stores = run_parts(model, tmp_path / "s", [1, 3], 3, **SMALL)
    code, out, _ = sweep("status", tmp_path / "s")
    assert code == 0
    assert "lost: 2" in out
    code, out, _ = sweep("merge", *stores, tmp_path / "s.part-2-of-3", "-o", tmp_path / "s")
    assert code == 1
    assert "INCOMPLETE" in out
    assert "lost parts: 2 of 3" in out
    assert status_report(tmp_path / "s")["lost_parts"] == "2 of 3"
    stores += run_parts(model, tmp_path / "s", [2], 3, **SMALL)
    code, out, _ = sweep("merge", *stores, "-o", tmp_path / "s")
    assert code == 1  # a point has failed
    assert "lost" not in out
    linksweep.run(model, tmp_path / "w", pool="serial", **SMALL)
    require_same(tmp_path / "s", tmp_path / "w")
    more = linksweep.run(model, tmp_path / "s", pool="serial", **SMALL | {"axes": {"k": [1, 2, 3, 7, 8]}})
    assert more.status.shape == (5,)  # and it goes on as any other
    with pytest.raises(SweepError, match="holds a store already"):
        merge(stores, tmp_path / "s")


@pytest.mark.parametrize("part", ["0/3", "4/3", "3", "-1/3", "1/0", "1/2/3", "a/b", "", "1.5/3", "2/1000000"])
def test_what_is_no_part_is_refused_and_nothing_written(model, tmp_path, part):
    with pytest.raises(SweepError, match="must be K/N"):
        linksweep.run(model, tmp_path / "s", part=part, **SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["m.py"]


@pytest.mark.parametrize(
    ("first", "last", "count", "task", "part"),
    [(0, 2, 3, 0, "1-of-3"), (1, 3, 3, 3, "3-of-3"), (5, 6, 2, 6, "2-of-2"), (1, 9, 3, 1, None), (None, 3, 3, 1, None)],
)
def test_a_task_of_an_array_is_a_part(model, tmp_path, sweep, monkeypatch, first, last, count, task, part):
    numbers = {"ID": task, "MIN": first, "MAX": last, "COUNT": count}
    for name, number in numbers.items():
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", "" if number is None else str(number))
    code, _, err = sweep("run", model, "--axis", "k=1,2", "-o", tmp_path / "s", "--part", "array")
    assert code == (0 if part else 2), err
    assert sorted(path.name for path in tmp_path.glob("s*")) == ([f"s.part-{part}"] if part else [])
    assert part or "name the part, as in --part $SLURM_ARRAY_TASK_ID/100" in err


def test_what_does_not_belong_together_is_refused_and_nothing_is_written(three, model, tmp_path):
    def refused(stores, message):
        before = sorted(path.name for path in tmp_path.iterdir())
        with pytest.raises(SweepError, match=message):
            merge(stores, tmp_path / "m")
        assert sorted(path.name for path in tmp_path.iterdir()) == before

    other = run_parts(model, tmp_path / "o", [2], 3, axes=SMALL["axes"], fixed={"x": 0.75})
    refused([three[0], *other], "fixed.x: 0.5 in .*s.part-1-of-3, 0.75 in .*o.part-2-of-3")
    other = run_parts(model, tmp_path / "p", [2], 3, axes={"k": [1, 2]}, fixed=SMALL["fixed"])
    refused([three[0], *other], "the points are others")
    refused([three[0], *run_parts(model, tmp_path / "s", [2], 4, **SMALL)], "is part 1/3, and .* is part 2/4")
    linksweep.run(model, tmp_path / "w", pool="serial", **SMALL)
    refused([tmp_path / "w", three[0]], "is no part of a study, and .* is part 1/3")
    shutil.copytree(three[1], tmp_path / "copy")
    refused([*three, tmp_path / "copy"], "is part 2/3, and so is")
    (tmp_path / "m.py").write_text(MODEL.replace("x * k", "k * x"))
    shutil.rmtree(three[1])
    refused([three[0], *run_parts(model, tmp_path / "s", [2], 3, **SMALL)], "plain .* has changed")
    refused([tmp_path / "nothing"], "no store there")
    with pytest.raises(SweepError, match="holds a store already"):
        merge(three[:1], tmp_path / "w")
    with pytest.raises(SweepError, match="part: 1/3 in the store, the whole in the study"):
        linksweep.run(model, three[0], pool="serial", **SMALL)


def test_a_part_that_is_running_is_left_out_and_named(three, tmp_path, sweep):
    with locked(three[1]):
        assert "running: 2" in sweep("status", tmp_path / "s")[1]
        assert merge(three, tmp_path / "s").attrs["lost_parts"] == "2 of 3"
    assert "lost_parts" not in merge(three, tmp_path / "s").attrs


def test_results_that_differ_in_kind_between_parts_fail_as_in_one_run(tmp_path):
    """Integers that floats of other parts do not hold, and results of another kind than those of the first point."""
    (tmp_path / "f.py").write_text(
        "def f(k: int = 1):\n    y = 2**60 + k if k == 2 else k / 2 if k % 2 else k\n"
        "    return {'y': y, 'z': 1} if k == 6 else {'y': y}\n"
    )
    axes = {"axes": {"k": [1, 2, 3, 4, 5, 6]}}
    linksweep.run(f"{tmp_path}/f.py:f", tmp_path / "w", pool="serial", **axes)
    merge(run_parts(f"{tmp_path}/f.py:f", tmp_path / "s", range(1, 7), 6, **axes), tmp_path / "s")
    require_same(tmp_path / "s", tmp_path / "w")


@pytest.mark.parametrize("step", [90, slow(3)])
def test_parts_and_merges_that_are_killed_go_on(model, tmp_path, monkeypatch, step):
    """Before each operation on a file in turn: in a part, in the merge, and in the merges that go on."""
    linksweep.run(model, tmp_path / "w", pool="serial", **SMALL)
    left = dying(monkeypatch)
    for number in range(3, 10**9, step):
        _, killed = until_done(left, number, lambda: run_parts(model, tmp_path / "s", [1], 3, **SMALL))
        stores = run_parts(model, tmp_path / "s", [1, 2, 3], 3, **SMALL)
        for some in (stores[:2], stores):
            _, again = until_done(left, number, lambda: merge(some, tmp_path / "s"))  # noqa: B023
            killed += again
        require_same(tmp_path / "s", tmp_path / "w")
        assert not check(tmp_path / "s")
        for store in (*stores, tmp_path / "s"):
            shutil.rmtree(store)
        if not killed:
            break
    assert number > 10


PLAIN = (
    "def model(x: float = 1.0, k: int = 1):\n"
    "    if k == 9:\n        raise ValueError('nine')\n"
    "    return {'y': x * k, 'name': f'{x:g}'}\n"
)


@pytest.fixture
def run_into(tmp_path):
    (tmp_path / "model.py").write_text(PLAIN)

    def compute(store, study=f"{tmp_path}/model.py:model", **given):
        return linksweep.run(study, store=tmp_path / store, pool="serial", **given)

    return compute


def test_points_beside_a_table_are_a_table(run_into, tmp_path):
    run_into("a.zarr", axes={"x": [1.0, 2.0]}, fixed={"k": 3})
    run_into("b.zarr", points={"x": [1.0, 5.0], "k": [3, 5]})
    ds = merge([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "c.zarr")
    rows = zip(ds.x.values.tolist(), ds.k.values.tolist(), ds.y.values.tolist(), strict=True)
    assert set(rows) == {(1.0, 3, 3.0), (2.0, 3, 6.0), (5.0, 5, 25.0)}


def test_failures_are_kept_unless_the_other_store_has_the_point(run_into, tmp_path):
    run_into("a.zarr", axes={"k": [1, 9]})
    run_into("b.zarr", axes={"k": [2]})
    ds = merge([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "c.zarr")
    assert json.loads(ds.attrs["failures"]) == {"k=9": "ValueError: nine"}
    assert ds.status.values.tolist() == [1, 1, 2]
    told = json.loads(ds.attrs[MERGED])
    assert [one["store"].rpartition("/")[2] for one in told] == ["a.zarr", "b.zarr"]
    assert told[0]["study_digest"] == OpenStore(tmp_path / "a.zarr").attributes["study_digest"]
    (tmp_path / "model.py").write_text(PLAIN.replace("k == 9", "k == 99"))
    run_into("d.zarr", axes={"k": [9]})
    with pytest.raises(SweepError, match=r"model\.model .* has changed"):
        merge([tmp_path / "c.zarr", tmp_path / "d.zarr"], tmp_path / "e.zarr")
    assert not (tmp_path / "e.zarr").exists()
    healed = merge([tmp_path / "c.zarr", tmp_path / "d.zarr"], tmp_path / "e.zarr", accept_code=True)
    assert healed.status.values.tolist() == [1, 1, 1]
    assert healed.code.values.tolist() == [1, 1, 2]
    assert healed.attrs["failures"] == "{}"
    run_into("e.zarr", axes={"k": [1, 3]})  # it goes on as any other
    assert len(json.loads(linksweep.open(tmp_path / "e.zarr").attrs[MERGED])) == 2


def test_stores_that_do_not_belong_together_are_refused_and_nothing_is_written(run_into, tmp_path):
    run_into("a.zarr", axes={"k": [1]})
    (tmp_path / "other.py").write_text("def model(k: int = 1):\n    return {'y': 1.0, 'name': 'x'}\n")
    run_into("b.zarr", f"{tmp_path}/other.py:model", axes={"k": [1]})
    with pytest.raises(SweepError, match="these differ"):
        merge([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "c.zarr")
    link = {"experiment": "linksweep.core.experiment:link", "fixed": {"n_obj": 20}}
    for store, sampling in (("s.zarr", {"n_sim": 10, "seed": 1}), ("t.zarr", {"n_sim": 20, "seed": 2})):
        linksweep.run(link | {"sampling": sampling}, tmp_path / store, pool="serial")
    with pytest.raises(SweepError) as told:
        merge([tmp_path / "s.zarr", tmp_path / "t.zarr"], tmp_path / "c.zarr")
    assert f"seed: 1 in {tmp_path}/s.zarr, 2 in {tmp_path}/t.zarr" in told.value.problems
    assert f"sampling.n_sim: 10 in {tmp_path}/s.zarr, 20 in {tmp_path}/t.zarr" in told.value.problems
    with pytest.raises(SweepError, match="experiment: "):
        merge([tmp_path / "a.zarr", tmp_path / "s.zarr"], tmp_path / "c.zarr")
    run_into("d.zarr", axes={"k": [2]})
    with pytest.raises(SweepError, match="holds a store already"):
        merge([tmp_path / "a.zarr", tmp_path / "d.zarr"], tmp_path / "a.zarr")
    assert not (tmp_path / "c.zarr").exists()


def test_other_bits_of_the_same_point_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.py").write_text(
        "import pathlib\ndef m(k: int = 1):\n    return float(pathlib.Path('n').read_text())\n"
    )
    for store, number in (("a.zarr", "1.0"), ("b.zarr", "1.0000000000000002")):
        (tmp_path / "n").write_text(number)
        linksweep.run("m.py:m", store, axes={"k": [1, 2]}, pool="serial")
    with pytest.raises(SweepError, match=r"has other numbers than .*b\.zarr at k="):
        merge(["a.zarr", "b.zarr"], "c.zarr")
    assert not (tmp_path / "c.zarr").exists()


def test_what_another_merge_has_left_is_not_replaced(run_into, tmp_path, monkeypatch):
    for name, k in (("a.zarr", 1), ("b.zarr", 2), ("d.zarr", 3)):
        run_into(name, axes={"k": [k]})
    one, two, three, into = (tmp_path / f"{name}.zarr" for name in "abdc")
    with monkeypatch.context() as patch:
        dying(patch)[0] = 7
        with pytest.raises(Killed):
            merge([one, two], into)
    with pytest.raises(SweepError, match="holds a store already"):
        merge([one, three], into)
    assert merge([one, two], into).k.values.tolist() == [1, 2]
