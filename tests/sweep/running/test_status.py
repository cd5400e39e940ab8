"""How far a run is, what is left of it, and what it prints at its end."""

import json

import pytest

import linksweep
from linksweep import SweepError
from tests.sweep.opening import Stopping, check, files_of, open_dataset, run, status_report


def test_a_single_point_that_was_stopped(coins, tmp_path, sweep):
    study = coins | {"axes": {}, "fixed": {"metal": "tin"}}
    with pytest.raises(KeyboardInterrupt):
        run(study, tmp_path / "s.zarr", {"most_blocks": 1}, progress=Stopping(2))
    code, out, _ = sweep("status", tmp_path / "s.zarr")
    assert (code, "0 of 1 point done" in out) == (0, True)
    done, wanted = (status_report(tmp_path / "s.zarr")[key] for key in ("realisations_done", "realisations"))
    assert f"{100 * done // wanted} % of the realisations" in out
    assert 0 < done < wanted == 20_000


def test_points_that_nobody_asked_for_and_failures_that_left_a_store_are_told(sweep, tmp_path):
    (tmp_path / "f.py").write_text("def f(a: int, b: int = 1):\n    return a // (a - 3) + b\n")
    runs = (["--axis", "a=1:5:1"], ["--axis", "a=7", "--axis", "b=2"], ["--axis", "a=1,2", "--only"])
    said = []
    for options in runs:
        sweep("run", "f.py:f", *options, "-o", "s.zarr", "-q", "--pool", "serial", cwd=tmp_path)
        said.append([" ".join(sweep(look, "s.zarr", cwd=tmp_path)[1].split()) for look in ("status", "watch")])
    assert "finished: 4 of 5 points done, 1 failed" in said[0][0]
    assert "finished: 5 of 6 points done, 1 failed" in said[1][0]
    assert "(s.zarr): finished" in said[1][1]
    assert ["ZeroDivisionError" in watched for _, watched in said] == [True, True, False]


def test_all_failed_points_are_counted_and_a_terminal_says_why(sweep, tmp_path):
    (tmp_path / "f.py").write_text(
        "def f(a: int):\n    if a > 1:\n        raise ValueError('even' if a % 2 == 0 else 'odd')\n    return a\n"
    )
    code, _, err = sweep("run", "f.py:f", "--axis", "a=1:401:1", "-o", "s.zarr", "-q", "--pool", "serial", cwd=tmp_path)
    reasons = "400 points failed: 200 like ValueError: even, for example at a=2; 200 like ValueError: odd, for"
    assert code == 1
    assert reasons in " ".join(err.split())
    code, out, _ = sweep("status", "s.zarr", "--json", cwd=tmp_path)
    failures = json.loads(out)["failures"]
    assert list(failures) == [f"a={a}" for a in range(2, 402)]
    code, out, _ = sweep("status", "s.zarr", cwd=tmp_path)
    words = " ".join(out.split())
    assert "finished: 1 of 401 points done, 400 failed" in words
    assert reasons.replace(";", "") in words
    assert "next: sweep run --retry s.zarr" in words
    assert len(open_dataset(tmp_path / "s.zarr").attrs["failures"]) < 12_000


def test_a_smaller_study_is_answered_while_another_process_holds_the_lock(tmp_path, coins):
    store = tmp_path / "s.zarr"
    whole = linksweep.run(coins, store, pool="serial")
    lock = {"host": "elsewhere", "boot": "", "pid": 1, "started": "", "since": "then", "command": "x", "token": "t"}
    (tmp_path / "s.zarr.lock").write_text(json.dumps(lock))
    part = linksweep.run(coins | {"axes": coins["axes"] | {"metal": ["tin"]}}, store, pool="serial")
    assert part["share"].values.tolist() == whole["share"].sel(metal=["tin"]).values.tolist()
    for asked, more in (({}, {"fresh": True}), ({"axes": coins["axes"] | {"coins": [1, 5, 20, 30]}}, {})):
        with pytest.raises(SweepError, match="--break-lock"):
            linksweep.run(coins | asked, store, pool="serial", **more)


@pytest.mark.parametrize("change", ["title", "lost", "damaged", "moved"])
def test_a_finished_run_writes_what_is_not_as_it_would_write_it(tmp_path, coins, change):
    store = tmp_path / "s.zarr"
    whole = linksweep.run(coins, store, pool="serial")
    chunk = next(file for file in (store / "status").iterdir() if file.name != "zarr.json")
    if change == "title":
        coins = coins | {"title": "Another"}
    elif change == "moved":
        store = store.rename(tmp_path / "t.zarr")
    else:
        chunk.unlink() if change == "lost" else chunk.write_bytes(b"")
    linksweep.run(coins, store, pool="serial")
    stored, before = linksweep.open(store), files_of(store)
    linksweep.run(coins, store, pool="serial")
    assert files_of(store) == before
    assert stored.equals(whole)
    assert stored.attrs["title"] == coins["title"]
    assert str(store) in (store / "zarr.json").read_text()
    assert not check(store)


MODELS = """
import numpy as np

def many(x):
    day = np.datetime64("2020-01-01") + int(1 / (x != 3) * x)
    return {"f": x * 1.5e-6, "whole": int(x), "truth": x > 1, "day": day, "text": f"q{x}", "array": np.arange(3) * x}

def noisy(x, rng=None):
    return rng.normal(x)
"""


@pytest.mark.parametrize("asked", ["many --axis x=0:3", "many --axis x=2", "noisy --axis x=0:2 --set n_sim=5"])
def test_a_run_prints_what_the_dataset_in_its_store_says(tmp_path, sweep, asked):
    (tmp_path / "models.py").write_text(MODELS)
    command = ("run", *f"models.py:{asked} -o s.zarr".split())
    printed = " ".join(sweep(*command, cwd=tmp_path)[1].split())
    for sentence in linksweep.answer(linksweep.open(tmp_path / "s.zarr")).sentences:
        assert " ".join(sentence.split()) in printed or sentence.startswith("Incomplete")
    assert sweep(*command, "--json", cwd=tmp_path)[1] == sweep("show", "s.zarr", "--json", cwd=tmp_path)[1]
    table = sweep("show", "s.zarr", cwd=tmp_path)[1].partition("\n\n")[0]
    assert " ".join(table.split()) in printed
