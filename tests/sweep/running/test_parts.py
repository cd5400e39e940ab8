"""Parts of a study that know nothing of each other become, in whatever order they are merged, what one run makes."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import linksweep
from linksweep import SweepError
from tests.conftest import COINS
from tests.sweep.opening import Folder, check, forge, locked, merge, status_report
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
    return (
        dataset.drop_vars("wall_time").drop_attrs(deep=False),
        json.loads(dataset.attrs["failures"]),
        dataset.attrs["complete"],
    )


def require_same(one, other):
    (first, *failed), (second, *wanted) = bits(one), bits(other)
    xr.testing.assert_identical(first, second)
    assert failed == wanted


def run_parts(study, store, numbers, total, **more):
    for number in numbers:
        linksweep.run(study, store, part=f"{number}/{total}", pool="serial", max_failures="100%", **more)
    return [Path(f"{store}.part-{number}-of-{total}") for number in numbers]


floats = st.floats(-8.0, 8.0, width=16).map(lambda x: x + 0.0)
plain = st.fixed_dictionaries(
    {
        "axes": st.fixed_dictionaries(
            {"k": st.lists(st.integers(1, 9), min_size=1, max_size=7, unique=True)},
            optional={
                "x": st.lists(floats, min_size=1, max_size=5, unique=True),
                "word": st.permutations(["a", "b", "cc"]),
            },
        )
    }
)
tables = st.lists(st.tuples(floats, st.integers(1, 9)), min_size=1, max_size=12).map(
    lambda rows: {"points": {"x": [x for x, _ in rows], "k": [k for _, k in rows]}}
)
noisy = st.fixed_dictionaries(
    {
        "axes": st.fixed_dictionaries({"k": st.lists(st.integers(1, 4), min_size=1, max_size=4, unique=True)}),
        "sampling": st.fixed_dictionaries({"n_sim": st.integers(2, 1700), "seed": st.integers(0, 99)})
        | st.just({"n_sim": 100, "precision": 0.1, "max_n_sim": 4000}),
    }
)
throws = st.fixed_dictionaries(
    {
        "title": st.just("Coins"),
        "experiment": st.just(COINS),
        "axes": st.just({"metal": ["gold", "tin"], "coins": [1, 5, 20]}),
        "sampling": st.fixed_dictionaries(
            {"n_sim": st.integers(1, 1200), "n_cat": st.integers(1, 40), "seed": st.just(7)}
        ),
    }
)
link = st.fixed_dictionaries(
    {
        "experiment": st.just("linksweep.core.experiment:link"),
        "axes": st.just({"model": ["amex", "gaia"], "n_obj": [20, 30]}),
        "sampling": st.fixed_dictionaries(
            {"n_sim": st.integers(1, 30), "n_cat": st.integers(1, 20)},
            optional={"keep_samples": st.just(True), "common_random_numbers": st.just(True)},
        ),
    }
)
kinds = {"plain": plain, "tables": tables, "noisy": noisy, "throws": throws, "link": link}


@pytest.mark.parametrize("kind", [slow(kind) for kind in kinds])
def test_parts_merged_in_any_order_are_one_run(tmp_path_factory, kind):
    @settings(max_examples=examples(10), phases=[Phase.generate], suppress_health_check=[HealthCheck.too_slow])
    @given(asked=kinds[kind], total=st.integers(1, 6), rng=st.randoms(use_true_random=False))
    def property_of_parts(asked, total, rng):
        folder = tmp_path_factory.mktemp("parts")
        (folder / "m.py").write_text(MODEL)
        functions = {"plain": "plain", "tables": "plain", "noisy": "noisy"}
        study, more = (f"{folder}/m.py:{functions[kind]}", asked) if kind in functions else (asked, {})
        linksweep.run(study, folder / "w", pool="serial", max_failures="100%", **more)
        numbers = rng.sample(range(1, total + 1), total)
        stores = run_parts(study, folder / "s", numbers, total, **more)
        first = rng.randint(1, total)
        merge(stores[:first], folder / "s")
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


@pytest.mark.slow
def test_parts_share_all_work_between_them_and_evenly(tmp_path, sweep):
    """Each block is in exactly one part, and no part has more than its share and one block."""
    asked = ["quasars", "--set", "n_sim=4", "-o", tmp_path / "q"]
    counts = []
    for number in range(1, 8):
        assert sweep("run", *asked, "--part", f"{number}/7")[0] == 0
        counts.append(status_report(f"{tmp_path}/q.part-{number}-of-7")["realisations_done"])
    assert sum(counts) == 26 * 4 * 100
    assert max(counts) <= 1.2 * sum(counts) / 7


@pytest.mark.parametrize("total", [5, *map(slow, (2, 8, 10))])
def test_no_part_gets_the_same_value_of_an_axis_again_and_again(tmp_path, model, total):
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


@pytest.mark.slow
def test_parts_in_a_bucket_are_named_and_merged(model, tmp_path, bucket, sweep):
    run_parts(model, f"{bucket}/s", [1, 3], 3, **SMALL)
    assert "lost: 2" in sweep("status", f"{bucket}/s")[1]
    run_parts(model, f"{bucket}/s", [2], 3, **SMALL)
    merge([f"{bucket}/s.part-{number}-of-3" for number in (3, 1, 2)], tmp_path / "s")
    linksweep.run(model, tmp_path / "w", pool="serial", **SMALL)
    require_same(tmp_path / "s", tmp_path / "w")


def test_points_of_a_part_are_computed_again_alone(model, tmp_path, sweep):
    linksweep.run(model, tmp_path / "s", pool="serial", part="2/3", verify=2, **SMALL)
    code, _, err = sweep("reproduce", tmp_path / "s.part-2-of-3", "--at", "k=1,word=b")
    assert code == 0
    assert "every bit as in" in err


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


def test_versions_that_decide_the_numbers_are_those_of_all_parts(three, tmp_path):
    def older(attributes):
        attributes["versions"] = json.dumps(json.loads(attributes["versions"]) | {"numpy": "1.0.0"})

    forge(three[1], older)
    with pytest.raises(SweepError, match=r"numpy: .* in .*part-1-of-3, 1\.0\.0 in .*part-2-of-3"):
        merge(three, tmp_path / "s")
    assert merge(three, tmp_path / "s", accept_code=True).status.size == 8


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


class Killed(BaseException):
    """The end of a process before an operation on a file."""


@pytest.mark.parametrize("step", [40, slow(3)])
def test_parts_and_merges_that_are_killed_go_on(model, tmp_path, monkeypatch, step):
    """Before each operation on a file in turn: in a part, in the merge, and in the merges that go on."""
    linksweep.run(model, tmp_path / "w", pool="serial", **SMALL)
    left = [10**9]

    def counted(operation):
        def counting(place, *arguments):
            left[0] -= 1
            if left[0] < 0:
                raise Killed
            return operation(place, *arguments)

        return counting

    for name in ("put", "put_all", "create", "swap", "delete"):
        monkeypatch.setattr(Folder, name, counted(getattr(Folder, name)))

    def until_done(call, number):
        """Return how often it was killed."""
        killed = 0
        for steps in (number, number // 2, 10**9):
            left[0] = steps
            try:
                call()
                break
            except Killed:
                killed += 1
                left[0] = 10**9
                for lock in tmp_path.glob("*.lock"):
                    lock.write_text(json.dumps(json.loads(lock.read_text()) | {"pid": 2**22 + 1}))
        left[0] = 10**9
        return killed

    for number in range(3, 10**9, step):
        killed = until_done(lambda: run_parts(model, tmp_path / "s", [1], 3, **SMALL), number)
        stores = run_parts(model, tmp_path / "s", [1, 2, 3], 3, **SMALL)
        until_done(lambda: merge(stores[:2], tmp_path / "s"), number)  # noqa: B023
        killed += until_done(lambda: merge(stores, tmp_path / "s"), number)  # noqa: B023
        require_same(tmp_path / "s", tmp_path / "w")
        assert not check(tmp_path / "s")
        for store in (*stores, tmp_path / "s"):
            shutil.rmtree(store)
        if not killed:
            break
    assert number > 10


@pytest.mark.slow
def test_the_script_of_a_job_array_runs_each_part_and_the_merge(model, tmp_path, sweep, monkeypatch):
    """With an `sbatch` that runs the jobs at once, one after the other."""
    (tmp_path / "sbatch").write_text(
        "#!/bin/bash\nprintf '%s ' \"$@\" >> asked\necho >> asked\n"
        "if [[ $* == *--array=1-3* ]]; then job=$(cat)\n"
        '  for task in 1 2 3; do SLURM_ARRAY_TASK_ID=$task bash -c "$job"; done\n  echo 17\nelse bash; fi\n'
    )
    (tmp_path / "sbatch").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    overrides = ("--axis", "k=1,2,3,5", "--set", "x=0.5")
    folder = tmp_path / "a folder"
    folder.mkdir()
    asked = ("submit", model, *overrides, "-o", "s 1", "--slurm", "3", "--sbatch", "--time=1:00:00")
    code, _, err = sweep(*asked, cwd=folder)
    assert code == 0, err
    assert not (folder / "asked").exists()
    code, _, err = sweep(*asked, "--go", cwd=folder)
    assert code == 0, err
    array, merging = (folder / "asked").read_text().splitlines()
    assert "--time=1:00:00" in array
    assert "--dependency=afterany:17" in merging
    assert sweep("run", model, *overrides, "-o", folder / "w")[0] == 0
    require_same(folder / "s 1", folder / "w")
    for more, message in ((["--sbatch", "-p x"], "and another one"), (["--set", "y=1"], "y"), (["--axis", "k=1"], "")):
        code, _, err = sweep(*asked, *more, cwd=folder)
        assert (code, message in err) == (2, True), err
