"""How far a run is, what is left of it, and what it prints at its end."""

import json
import re
import shutil
import sys

import pytest

import linksweep
from linksweep import SweepError
from tests.sweep.opening import check, files_of, open_dataset, status_report
from tests.tiers import PATIENCE_S


def test_points_that_nobody_asked_for_and_failures_that_left_a_store_are_told(sweep, tmp_path):
    (tmp_path / "f.py").write_text("def f(a: int, b: int = 1):\n    return a // (a - 3) + b\n")
    said = []
    for options in ("--axis a=1:5:1", "--axis a=7 --axis b=2", "--axis a=1,2 --only"):
        sweep("run", "f.py:f", *options.split(), "-o", "s.zarr", "-q", cwd=tmp_path)
        said.append([" ".join(sweep(look, "s.zarr", cwd=tmp_path)[1].split()) for look in ("status", "watch")])
    assert "finished: 4 of 5 points done, 1 failed" in said[0][0]
    assert "finished: 5 of 6 points done, 1 failed" in said[1][0]
    assert "(s.zarr): finished" in said[1][1]
    assert ["ZeroDivisionError" in watched for _, watched in said] == [True, True, False]


def test_all_failed_points_are_counted_and_a_terminal_says_why(sweep, tmp_path):
    (tmp_path / "f.py").write_text(
        "def f(a: int):\n    if a > 1:\n        raise ValueError('even' if a % 2 == 0 else 'odd')\n    return a\n"
    )
    code, _, err = sweep("run", "f.py:f", "--axis", "a=1:401:1", "-o", "s.zarr", "-q", cwd=tmp_path)
    reasons = "400 points failed: 200 like ValueError: even, for example at a=2; 200 like ValueError: odd, for"
    assert (code, reasons in " ".join(err.split())) == (1, True)
    failures = json.loads(sweep("status", "s.zarr", "--json", cwd=tmp_path)[1])["failures"]
    assert list(failures) == [f"a={a}" for a in range(2, 402)]
    words = " ".join(sweep("status", "s.zarr", cwd=tmp_path)[1].split())
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


def test_a_finished_run_writes_what_is_not_as_it_would_write_it_once(tmp_path, coins):
    whole = linksweep.run(coins, tmp_path / "s.zarr", pool="serial")
    store, coins = (tmp_path / "s.zarr").rename(tmp_path / "t.zarr"), coins | {"title": "Another"}
    chunk = next(file for file in (store / "status").iterdir() if file.name != "zarr.json")
    for damage in (lambda: None, chunk.unlink, lambda: chunk.write_bytes(b"")):
        damage()
        linksweep.run(coins, store, pool="serial")
        stored, before = linksweep.open(store), files_of(store)
        linksweep.run(coins, store, pool="serial")
        assert files_of(store) == before
        assert (stored.equals(whole), stored.attrs["title"], bool(check(store))) == (True, "Another", False)
        assert str(store) in (store / "zarr.json").read_text()


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


CODE = """
def f(x: float, y: int = 0, rng=None):
    if {fails}:
        raise ValueError(f"no root at {{x}}")
    return rng.normal(x)
"""


@pytest.fixture
def run_f(tmp_path, sweep_here):
    def run(*options, fails="x == 2.0"):
        (tmp_path / "f.py").write_text(CODE.format(fails=fails))
        asked = ("f.py:f", "--axis", "x=0:4:1", "--pool", "serial", "-o", "s.zarr")
        return sweep_here("run", *asked, *options, cwd=tmp_path)

    return run


def test_quiet_prints_the_table_and_errors_and_verbose_each_point(run_f):
    code, out, err = run_f("--quiet", fails="False")
    assert (code, err, "f_mean" in out) == (0, "", True)
    code, _, err = run_f("-q", "--fresh")
    assert (code, len(err.splitlines()), err.startswith("1 point failed")) == (1, 1, True)
    told = sorted(line for line in run_f("--verbose", "--fresh")[2].splitlines() if line.startswith("x="))
    assert told == ["x=0.0: done", "x=1.0: done", "x=2.0: failed (exception)", "x=3.0: done", "x=4.0: done"]


def test_the_log_has_everything_with_times_and_tracebacks_and_grows(run_f, tmp_path):
    assert run_f("--quiet", "--log", "run.log")[0] == 1
    first = (tmp_path / "run.log").read_text()
    assert re.search(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} INFO 5 points; [\d,]+ realisations", first, re.MULTILINE)
    assert "DEBUG x=1.0: done" in first
    assert "ERROR x=2.0: failed (exception): ValueError: no root at 2.0" in first
    assert first.count("Traceback (most recent call last)") == first.count("raise ValueError(f") == 1
    assert "realisations/s" in first
    run_f("--log", "run.log")
    assert (tmp_path / "run.log").read_text().startswith(first)


@pytest.mark.parametrize("option", ["--log", "--events"])
@pytest.mark.parametrize("place", ["no/such/folder/run.log", ".", "/proc/run.log", "a\0b"])
def test_a_file_that_cannot_be_written_ends_it_before_anything_is_computed(run_f, tmp_path, option, place):
    code, out, err = run_f(option, place)
    assert (code, out) == (2, "")
    assert option in err or repr(place) in err
    assert [path.name for path in tmp_path.iterdir()] == ["f.py"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("script") is None, reason="needs the command script, which has a terminal")
def test_on_a_terminal_the_bar_shows_the_time_left(link_study, tmp_path, start_sweep):
    store = tmp_path / "s.zarr"
    inner = f"TERM=xterm {sys.executable} -m linksweep run {link_study} -o {store} --set n_sim=100000 --workers 1"
    process = start_sweep(command=["script", "-qec", inner, "/dev/null"])
    shown, _ = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, "━" in shown, "wrote" in shown) == (0, True, True), shown
    assert re.search(r"of the work\), about \d+ s left, \d", re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", shown))


@pytest.mark.parametrize(
    ("fails", "options", "wanted"),
    [
        ("False", (), 0),
        ("x == 2.0", (), 1),
        ("x > 0.0 and y", ("--axis", "y=0,1", "--max-failures", "2"), 1),
        ("x == 2.0", ("--set", "n_sim=1500"), 1),
    ],
)
def test_counts_of_events_are_those_of_the_store(run_f, tmp_path, fails, options, wanted):
    def run_with_events(*more):
        code = run_f(*options, *more, "--events", "e.jsonl", fails=fails)[0]
        events = [json.loads(line) for line in (tmp_path / "e.jsonl").read_text().splitlines()]
        assert (events[-1]["event"], events[-1]["exit_code"]) == ("ended", code)
        return code, events

    (code, events), points = run_with_events(), status_report(tmp_path / "s.zarr")["points"]
    ended = [event for event in events if event["event"] == "points"]
    for key in ("done", "failed"):
        assert events[0][key] + sum(event[key] for event in ended) == points[key]
    assert sum(event["event"] == "failed" for event in events) == points["failed"]
    assert (events[0]["event"], events[0]["points"]) == ("started", sum(points.values()))
    assert (code, events[-2]["event"]) == (wanted, "written")
    again = run_with_events()[1][len(events)]
    assert (again["done"], again["failed"]) == (points["done"], points["failed"])
    code, events = run_with_events("--set", "seed=9")
    assert (code, "different study" in events[-1]["reason"]) == (2, True)
