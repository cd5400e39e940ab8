"""Parts of a study, and stores of other points, become what one run makes; what does not belong together is refused."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, Phase, given, settings, strategies as st

import linksweep
from linksweep import Limits, SweepError
from tests.sweep import opening
from tests.sweep.opening import MERGED, OpenStore, check, dying, locked, merge, same, status_report, until_done
from tests.tiers import examples, slow

MODEL = """
from pathlib import Path
MENDED = Path(__file__).with_name("mended")
def plain(x: float = 1.0, k: int = 1, word: str = "a"):
    "Results of a part.  Of the merged store, too."
    if k == 7 and word == "b" and not MENDED.exists(): raise ValueError(f"no {word} at {x}")
    return {"y": x * k, "n": 2**40 + k, "text": word * k, "whole": k if k < 5 else x}
def noisy(rng, x: float = 1.0, k: int = 1):
    value = rng.normal(x, k)
    if value > 3.9 * k + x:
        raise ValueError(f"too far: {value}")
    return {"value": value, "square": value**2}
"""
TASKS = [(0, 2, 3, 0, "1-of-3"), (5, 6, 2, 6, "2-of-2"), (1, 9, 3, 1, None), (None, 3, 3, 1, None)]
NO_PARTS = ["0/3", "4/3", "3", "-1/3", "1/0", "1/2/3", "a/b", "", "1.5/3", "2/1000000"]
NO_LIMITS = [*map(Limits, ("60", np.inf, np.nan, -1, 0)), Limits(None, "300MB"), Limits(memory=-5), {"time_s": 1.0}]
SMALL = {"axes": {"k": [1, 2, 3, 7], "word": ["a", "b"]}, "fixed": {"x": 0.5}}


def require_same(*stores):
    """Refuse stores that differ in a bit, also of what stands for missing values, or in why points failed."""
    one, other = (xr.open_zarr(store, mask_and_scale=False).load() for store in stores)
    same(one, other)
    keys = ("failures", "complete", "warnings", "title", "description")
    assert [one.attrs.get(key) for key in keys] == [other.attrs.get(key) for key in keys]


def run_parts(study, store, numbers, total, **more):
    for number in numbers:
        linksweep.run(study, store, part=f"{number}/{total}", pool="serial", max_failures="100%", **more)
    return [Path(f"{store}.part-{number}-of-{total}") for number in numbers]


def some(values, most):
    return st.lists(values, min_size=1, max_size=most, unique=True)


LINK = {"experiment": "linksweep.core.experiment:link", "axes": {"model": ["amex", "gaia"], "n_obj": [20, 30]}}
LINK["exclude"] = [{"n_obj": 25}]  # of which a warning says that no point has it
FLOATS = st.floats(-8.0, 8.0, width=16).map(lambda x: x + 0.0)
NUMBERS = {"n_sim": st.integers(2, 1700), "seed": st.integers(0, 99)}
SAMPLES = {"n_sim": st.integers(1, 30), "n_cat": st.integers(1, 20)}
SAMPLES |= dict.fromkeys(("keep_samples", "common_random_numbers"), st.booleans())
PRECISION = st.just({"n_sim": 100, "precision": 0.1, "max_n_sim": 4000})
KINDS = {  # the study, or the name of a function above, and the axes and the sampling that are asked of it
    "plain": ("plain", {"k": some(st.integers(1, 9), 7), "x": some(FLOATS, 5), "word": st.just(["b"])}, st.just({})),
    "noisy": ("noisy", {"k": some(st.integers(1, 4), 4)}, st.fixed_dictionaries(NUMBERS) | PRECISION),
    "link": (LINK, {}, st.fixed_dictionaries(SAMPLES)),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_parts_merged_in_any_order_are_one_run(tmp_path_factory, kind):
    study, axes, samplings = KINDS[kind]

    @settings(max_examples=examples(10), phases=[Phase.generate], suppress_health_check=[HealthCheck.too_slow])
    @given(st.fixed_dictionaries(axes), samplings, st.integers(1, 6), st.randoms(use_true_random=False))
    def property_of_parts(axes, sampling, total, rng):
        folder = tmp_path_factory.mktemp("parts")
        (folder / "m.py").write_text(MODEL)
        more = {"axes": axes, "sampling": sampling} if axes else {}
        whole = f"{folder}/m.py:{study}" if axes else study | {"sampling": sampling}
        linksweep.run(whole, folder / "w", pool="serial", max_failures="100%", **more)
        stores = run_parts(whole, folder / "s", rng.sample(range(1, total + 1), total), total, **more)
        merge(stores[: rng.randint(1, total)], folder / "s")
        merge(rng.sample(stores, total), folder / "s")
        require_same(folder / "s", folder / "w")
        assert not check(folder / "s")
        shutil.rmtree(folder)

    property_of_parts()


@pytest.fixture
def model(tmp_path):
    (tmp_path / "m.py").write_text(MODEL)
    return f"{tmp_path}/m.py:plain"


@pytest.fixture
def into(model, tmp_path):
    return lambda store, study=model, **how: linksweep.run(study, tmp_path / store, pool="serial", **how)


@pytest.fixture
def three(model, tmp_path):
    return run_parts(model, tmp_path / "s", [1, 2, 3], 3, **SMALL)


@pytest.mark.parametrize("total", [5, *map(slow, (2, 8, 10))])
def test_no_part_gets_the_same_value_of_an_axis_again_and_again(tmp_path, total):
    (tmp_path / "slow.py").write_text("def slow(a: int = 1, b: int = 1):\n    return {'cost': a * b}\n")
    axes = {"a": list(range(1, 11)), "b": list(range(1, 11))}
    stores = run_parts(f"{tmp_path}/slow.py:slow", tmp_path / "s", range(1, total + 1), total, axes=axes)
    for one, factor in (("a", 1.25), ("b", 1.25), ("cost", 1.3)):
        parts = [xr.open_zarr(store).load() for store in stores]
        sums = [float(part[one].broadcast_like(part.status).where(part.status == 1).sum()) for part in parts]
        assert max(sums) <= factor * np.mean(sums), one


def test_a_lost_part_is_named_and_the_same_commands_go_on(model, tmp_path, sweep):
    _, stores = (run_parts(model, tmp_path / store, [1, 3], 3, **SMALL) for store in "ts")
    assert "lost: 2" in sweep("status", tmp_path / "s", code=0)[1]
    code, out, _ = sweep("merge", *stores, tmp_path / "s.part-2-of-3", "-o", tmp_path / "s")
    assert (code, "INCOMPLETE" in out, "lost parts: 2 of 3" in out) == (1, True, True)
    assert status_report(tmp_path / "s")["lost_parts"] == "2 of 3"
    stores += run_parts(model, tmp_path / "s", [2], 3, **SMALL)
    assert "lost" not in sweep("merge", stores[-1], "-o", tmp_path / "s", code=1)[1]  # a point of part 3 has failed
    (tmp_path / "mended").touch()
    sweep("run", "--retry", tmp_path / "s.part-3-of-3", code=0)
    sweep("merge", *stores, "-o", tmp_path / "s", code=0)
    linksweep.run(model, tmp_path / "w", pool="serial", **SMALL)
    require_same(tmp_path / "s", tmp_path / "w")
    more = linksweep.run(model, tmp_path / "s", pool="serial", **SMALL | {"axes": {"k": [1, 2, 3, 7, 8]}})
    assert more.status.shape == (5,)  # and it goes on as any other
    with pytest.raises(SweepError, match="holds a store already"):
        merge(stores, tmp_path / "s")
    several = LINK | {"title": "l", "sampling": {"n_sim": 9, "n_cat": 40}}  # blocks of each point
    refined = opening.make_grid(opening.live_study(several)).point(1)
    several |= {"counts": {refined.digest.hex(): 30}}
    stores = run_parts(several, tmp_path / "l", [1, 3], 3)
    assert merge(stores, tmp_path / "l").attrs["lost_parts"] == "2 of 3"
    merge(run_parts(several, tmp_path / "l", [2], 3), tmp_path / "l")
    linksweep.run(several, tmp_path / "v", pool="serial")
    require_same(tmp_path / "l", tmp_path / "v")


@pytest.mark.parametrize("seed", [0, 3])
def test_a_point_that_fails_in_several_parts_has_the_failure_of_its_earliest_block(tmp_path, seed):
    (tmp_path / "n.py").write_text("def rare(rng):\n    assert (u := rng.random()) < 0.999, u\n    return u\n")
    study, how = f"{tmp_path}/n.py:rare", {"sampling": {"n_sim": 8 * 512, "seed": seed}}
    merge(run_parts(study, tmp_path / "s", [1, 2, 3], 3, **how), tmp_path / "s")
    linksweep.run(study, tmp_path / "w", pool="serial", max_failures="100%", **how)
    require_same(tmp_path / "s", tmp_path / "w")


@pytest.mark.parametrize("how", [*({"part": part} for part in NO_PARTS), *({"limits": one} for one in NO_LIMITS)])
def test_parts_and_limits_that_cannot_be_are_refused_and_nothing_written(model, tmp_path, how):
    with pytest.raises(SweepError, match="must be"):
        linksweep.run(model, tmp_path / "s", **SMALL, **how)
    assert [path.name for path in tmp_path.iterdir()] == ["m.py"]


@pytest.mark.parametrize(("first", "last", "count", "task", "part"), TASKS)
def test_a_task_of_an_array_is_a_part(model, tmp_path, sweep, monkeypatch, first, last, count, task, part):
    for name, number in {"ID": task, "MIN": first, "MAX": last, "COUNT": count}.items():
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", "" if number is None else str(number))
    code, _, err = sweep("run", model, "--axis", "k=1,2", "-o", f"{tmp_path}/s/", "--part", "array")
    assert code == (0 if part else 2), err
    assert sorted(path.name for path in tmp_path.glob("s*")) == ([f"s.part-{part}"] if part else [])
    assert part or "name the part, as in --part $SLURM_ARRAY_TASK_ID/100" in err


def test_what_does_not_belong_together_is_refused_and_nothing_is_written(three, model, into, coin_store, tmp_path):
    def refused(stores, *messages, to="m"):
        before = sorted(path.name for path in tmp_path.iterdir())
        with pytest.raises(SweepError) as raised:
            merge(stores, tmp_path / to)
        assert all(re.search(message, "\n".join(raised.value.problems)) for message in messages), raised.value.problems
        assert sorted(path.name for path in tmp_path.iterdir()) == before

    other = run_parts(model, tmp_path / "o", [2], 3, axes=SMALL["axes"], fixed={"x": 0.75})
    refused([three[0], *other], "fixed.x: 0.5 in .*s.part-1-of-3, 0.75 in .*o.part-2-of-3")
    other = run_parts(model, tmp_path / "p", [2], 3, axes={"k": [1, 2]}, fixed=SMALL["fixed"])
    refused([*run_parts(model, tmp_path / "p", [1], 3, **SMALL), *other], "the points are others")
    assert status_report(tmp_path / "p")["parts"][3] == {"complete": "1-2", "lost": "3"}
    refused([three[0], *run_parts(model, tmp_path / "s", [2], 4, **SMALL)], "is part 1/3, and .* is part 2/4")
    into("w", **SMALL)
    refused([tmp_path / "w", three[0]], "is no part of a study, and .* is part 1/3")
    shutil.copytree(three[1], tmp_path / "copy")
    refused([*three, tmp_path / "copy"], "is part 2/3, and so is")
    refused([], "no store there")
    refused(three, "is the place of a part", to="d.part-1-of-3")
    refused(three[:1], "holds a store already", to="w")
    with pytest.raises(SweepError, match=r"with -o\n.*part: 1/3 in the store, the whole in the study"):
        linksweep.run(model, three[0], pool="serial", **SMALL)
    with pytest.raises(SweepError, match="part: 1/3 of other points or realisations in the store than in the study"):
        run_parts(model, tmp_path / "s", [1], 3, **SMALL | {"axes": {"k": [1, 2, 3, 7, 8], "word": ["a", "b"]}})
    (tmp_path / "other.py").write_text("def plain(k: int = 1):\n    return {'y': 1.0, 'name': 'x'}\n")
    into("b", f"{tmp_path}/other.py:plain", axes={"k": [1]})
    refused([tmp_path / "w", tmp_path / "b"], "these differ")
    refused([tmp_path / "w", coin_store], "experiment: ")
    asked = {"n_sim": (10, 20), "precision": (0.5, 0.4), "max_n_sim": (90, 80)}
    for seed, store in enumerate("tu"):
        sampling = {"seed": seed} | {name: some[seed] for name, some in asked.items()}
        into(store, f"{tmp_path}/m.py:noisy", sampling=sampling)
    differences = [rf"{name}: {one} in .*t, {other} in .*u" for name, (one, other) in {"seed": (0, 1), **asked}.items()]
    refused([tmp_path / "t", tmp_path / "u"], *differences)
    into("d", axes={"k": [8]}, fixed=SMALL["fixed"])
    refused([tmp_path / "w", tmp_path / "d"], "holds a store already", to="w")
    merge(three[:1], tmp_path / "e")
    (tmp_path / "m.py").write_text(MODEL.replace("x * k", "k * x"))
    shutil.rmtree(three[1])
    other = run_parts(model, tmp_path / "s", [2], 3, **SMALL)
    refused([three[0], *other], "plain .* has changed")
    refused(other, "plain .* has changed", to="e")


def test_a_part_that_is_running_is_left_out_and_named(three, tmp_path, sweep):
    with locked(three[1]):
        assert "running: 2" in sweep("status", tmp_path / "s")[1]
        assert "nothing can be merged yet" in sweep("merge", three[1], "-o", tmp_path / "s", code=2)[2]
        three[1].rename(tmp_path / "later")  # a part that has just begun has no store
        named = [*tmp_path.glob("s.part-*"), three[1]]  # as a shell names them, with the lock
        assert merge(named, tmp_path / "s").attrs["lost_parts"] == "2 of 3"
    (tmp_path / "later").rename(three[1])
    assert "lost_parts" not in merge(three, tmp_path / "s").attrs
    how = {"part": "1/2", "sampling": {"n_sim": 3000}, "pool": "serial", "max_failures": 0}  # each task is one block
    with pytest.raises(KeyboardInterrupt):
        linksweep.run(f"{tmp_path}/m.py:noisy", tmp_path / "n", progress=opening.Stopping(2), **how)
    assert linksweep.open(tmp_path / "n.part-1-of-2").attrs["complete"] == 0
    assert linksweep.run(f"{tmp_path}/m.py:noisy", tmp_path / "n", **how).attrs["complete"] == 1


@pytest.mark.slow
def test_results_that_differ_in_kind_between_parts_fail_as_in_one_run(tmp_path):
    text = "def f(k: int = 1):\n    y = 2**60 + k if k == 2 else k / 2 if k % 2 else k\n"
    (tmp_path / "f.py").write_text(f"{text}    return {{'y': y, 'z': 1}} if k == 6 else {{'y': y}}\n")
    axes = {"axes": {"k": [1, 2, 3, 4, 5, 6]}}
    linksweep.run(f"{tmp_path}/f.py:f", tmp_path / "w", pool="serial", **axes)
    stores = run_parts(f"{tmp_path}/f.py:f", tmp_path / "s", range(1, 7), 6, **axes)
    merge(stores[:3], tmp_path / "s")
    merge(stores[3:], tmp_path / "s")
    require_same(tmp_path / "s", tmp_path / "w")


@pytest.mark.parametrize("step", [90, slow(3)])
def test_parts_and_merges_that_are_killed_go_on(model, tmp_path, monkeypatch, step):
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


def test_failures_are_kept_unless_the_other_store_has_the_point(into, tmp_path, sweep):
    a, b, c, d, e, f = (tmp_path / name for name in "abcdef")
    for store, k, x in (("a", [1, 7], 1.0), ("b", [2], 1.0), ("f", [7], 2.0)):
        into(store, axes={"k": k}, fixed={"word": "b", "x": x})
    merge([a, f], tmp_path / "g")
    assert "2 points failed: ValueError: no b at 1.0, for example at k=7,x=1.0" in sweep("watch", tmp_path / "g")[1]
    for word in "zyx":
        into(word, axes={"word": [word]})
    assert [*merge([tmp_path / word for word in "zyx"], tmp_path / "words").word.values] == ["z", "y", "x"]
    ds = merge([a, b], c)
    with pytest.raises(SweepError, match="holds a store already"):
        merge([a, f], c)
    assert merge([a, b], c).status.equals(ds.status)
    assert (ds.attrs["failures"], ds.status.values.tolist()) == ('{"k=7": "ValueError: no b at 1.0"}', [1, 1, 2])
    raised = json.loads(ds.attrs[MERGED])
    assert [one["store"].rpartition("/")[2] for one in raised] == ["a", "b"]
    assert raised[1]["study_digest"] == OpenStore(b).attributes["study_digest"]
    (tmp_path / "m.py").write_text(MODEL.replace("k == 7", "k == 77"))
    into("d", axes={"k": [7]}, fixed={"word": "b"})
    with pytest.raises(SweepError, match=r"m\.plain .* has changed"):
        merge([c, d], e)
    assert not e.exists()
    healed = merge([c, d], e, accept_code=True)
    assert [healed.status.sum(), *healed.code.values, healed.attrs["failures"]] == [3, 1, 1, 2, "{}"]
    into("e", axes={"k": [1, 3]}, fixed={"word": "b"})  # it goes on as any other
    assert len(json.loads(linksweep.open(e).attrs[MERGED])) == 2


@pytest.mark.parametrize("numbers", [("1.0", "1.0000000000000002"), ("[1.0, 2.0]", "[2.0, 1.0]")])
def test_other_bits_of_the_same_point_are_refused(here, numbers):
    drawn = {"sampling": {"n_sim": 2, "keep_samples": True}} if "[" in numbers[0] else {}
    text = f"import pathlib\ndef m(k: int = 1{', *, rng, n_sim' * bool(drawn)}):\n"
    Path("m.py").write_text(f"{text}    return eval(pathlib.Path('n').read_text())\n")
    for store, number in zip("ab", numbers, strict=True):
        (here / "n").write_text(number)
        linksweep.run("m.py:m", store, axes={"k": [1, 2]}, pool="serial", **drawn)
    with pytest.raises(SweepError, match=r"has other numbers than .*b at k="):
        merge(["a", "b"], "c")
    assert not (here / "c").exists()
