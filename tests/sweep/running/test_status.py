"""How far a run is, what is left of it, what fails and how often it may, and what is printed."""

import io
import json
import logging
import re
import shutil
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, strategies as st
from rich.console import Console

import linksweep
from linksweep.sweep.executing.task import Failure
from linksweep.sweep.running import progress
from linksweep.sweep.running.progress import FIRST, FailureCount, MaxFailures
from linksweep.sweep.running.run import TooManyFailuresError
from linksweep.sweep.studies.reader import study_of_function
from tests.sweep.opening import SERIAL, OpenStore, check, files_of, make_grid, run_study, status_report
from tests.tiers import PATIENCE_S, few, slow

ENDS = [("False", (), 0), ("x == 2.0", (), 1), ("x == 2.0", ("--set", "n_sim=1500"), 1)]
ENDS += [("x > 0.0 and y", ("--axis", "y=0,1", "--max-failures", "2"), 1)]
THREADS, LIMITS = ("--pool", "threads", "--workers", "2"), ("--pool", "serial", "--time-limit", "100")
MODELS = """
import numpy as np
def many(x):
    day = np.datetime64("2020-01-01") + int(1 / (x != 3) * x)
    return {"f": x * 1.5e-6, "whole": int(x), "truth": x > 1, "day": day, "text": f"q{x}", "array": np.arange(3) * x}
def noisy(x, rng=None):
    return rng.normal(x)
"""
CODE = """
def f(x: float, y: int = 0, rng=None):
    if {fails}:
        raise ValueError(f"no root at {{x}}")
    return rng.normal(x)
"""
FUNCTIONS = """
def never(x: int):
    raise ImportError(f"no package for {x}")
def random_never(x: int, rng):
    raise ImportError(f"no package for {x}")
"""
SLOW_FIRST = """
import time
{module}
def f(x: int):
    {call}
    time.sleep(0.001)
    return float(x)
"""
FIRST_CALL = "called = []", "called or called.append(time.sleep(1.0))"


def test_points_that_nobody_asked_for_and_failures_are_told_and_all_are_counted(sweep, tmp_path):
    (tmp_path / "f.py").write_text("def f(a: int, b: int = 1):\n    return a // (a - 3) + b\n")
    said = []
    for options in ("--axis a=1:5:1", "--axis a=7 --axis b=2", "--axis a=1,2 --only"):
        sweep("run", "f.py:f", *options.split(), "-o", "s.zarr", "-q", cwd=tmp_path)
        said.append([" ".join(sweep(look, "s.zarr", cwd=tmp_path)[1].split()) for look in ("status", "watch")])
    assert "finished: 4 of 5 points done, 1 failed" in said[0][0]
    assert "finished: 5 of 6 points done, 1 failed" in said[1][0]
    assert "(s.zarr): finished" in said[1][1]
    assert ["ZeroDivisionError" in watched for _, watched in said] == [True, True, False]
    text = "def f(a: int):\n    if a > 1:\n        raise ValueError('even' if a % 2 == 0 else 'odd')\n    return a\n"
    (tmp_path / "f.py").write_text(text)
    code, _, err = sweep("run", "f.py:f", "--axis", "a=1:401:1", "-o", "t.zarr", "-q", cwd=tmp_path)
    reasons = "400 points failed: 200 like ValueError: even, for example at a=2; 200 like ValueError: odd, for"
    assert (code, reasons in " ".join(err.split())) == (1, True)
    failures = json.loads(sweep("status", "t.zarr", "--json", cwd=tmp_path)[1])["failures"]
    assert list(failures) == [f"a={a}" for a in range(2, 402)]
    words = " ".join(sweep("status", "t.zarr", cwd=tmp_path)[1].split())
    assert "finished: 1 of 401 points done, 400 failed" in words
    assert reasons.replace(";", "") in words
    assert "next: sweep run --retry t.zarr" in words
    assert len(OpenStore(tmp_path / "t.zarr").attributes["failures"]) < 12_000


def test_a_finished_run_writes_what_is_not_as_it_would_write_it_once(tmp_path, coins):
    whole = linksweep.run(coins, tmp_path / "s.zarr", pool="serial")
    store, coins = (tmp_path / "s.zarr").rename(tmp_path / "t.zarr"), coins | {"title": "Another"}
    for damage in (lambda file: None, Path.unlink, lambda file: file.write_bytes(b"")):
        for chunk in list((store / "status").glob("*0.0")):
            damage(chunk)
        linksweep.run(coins, store, pool="serial")
        stored, before = linksweep.open(store), files_of(store)
        linksweep.run(coins, store, pool="serial")
        assert files_of(store) == before
        assert (stored.equals(whole), stored.attrs["title"], bool(check(store))) == (True, "Another", False)
        assert str(store) in (store / "zarr.json").read_text()


@pytest.mark.parametrize("asked", few(2, ["many --axis x=0,3", "noisy --axis x=0,2 --set n_sim=5", "many --axis x=2"]))
def test_a_run_prints_what_the_dataset_in_its_store_says(tmp_path, sweep, asked):
    (tmp_path / "models.py").write_text(MODELS)
    command = ("run", *f"models.py:{asked} -o s.zarr".split())
    printed = " ".join(sweep(*command, cwd=tmp_path)[1].split())
    for sentence in linksweep.answer(linksweep.open(tmp_path / "s.zarr")).sentences:
        assert " ".join(sentence.split()) in printed or sentence.startswith("Incomplete")
    assert sweep(*command, "--json", cwd=tmp_path)[1] == sweep("show", "s.zarr", "--json", cwd=tmp_path)[1]
    assert " ".join(sweep("show", "s.zarr", cwd=tmp_path)[1].partition("\n\n")[0].split()) in printed


@pytest.fixture
def run_f(tmp_path, sweep_here):
    def run(*options, fails="x == 2.0"):
        (tmp_path / "f.py").write_text(CODE.format(fails=fails))
        asked = ("f.py:f", "--axis", "x=0:4:1", "--pool", "serial", "-o", "s.zarr")
        return sweep_here("run", *asked, *options, cwd=tmp_path)

    return run


def test_quiet_verbose_and_logged_runs_say_what_they_should_and_count_work(run_f, tmp_path, sweep_here, monkeypatch):
    code, out, err = run_f("--quiet", fails="False")
    assert (code, err, "f_mean" in out) == (0, "", True)
    code, _, err = run_f("-q", "--fresh")
    assert (code, len(err.splitlines()), err.startswith("1 point failed")) == (1, 1, True)
    report = sorted(line for line in run_f("--verbose", "--fresh")[2].splitlines() if line.startswith("x="))
    assert report == ["x=0.0: done", "x=1.0: done", "x=2.0: failed (exception)", "x=3.0: done", "x=4.0: done"]
    assert run_f("--quiet", "--fresh", "--log", "run.log")[0] == 1
    first = (tmp_path / "run.log").read_text()
    assert re.search(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} INFO 5 points; [\d,]+ realisations", first, re.MULTILINE)
    failed = "ERROR x=2.0: failed (exception): ValueError: no root at 2.0"
    assert all(words in first for words in ("DEBUG x=1.0: done", failed, "realisations/s"))
    assert first.count("Traceback (most recent call last)") == first.count("raise ValueError(f") == 1
    run_f("--log", "run.log")
    assert (tmp_path / "run.log").read_text().startswith(first)
    monkeypatch.setattr(progress, "LINE_LAST_S", -1.0)
    run_f("--set", "n_sim=10", "--fresh", fails="False")
    more = ("--set", "n_sim=10", "--pool", "serial", "-o", "s.zarr")
    err = sweep_here("run", "f.py:f", "--axis", "x=0:9:1", *more, cwd=tmp_path)[2]
    lines = re.findall(r"(\d+)/10 points \((\d+) % of the work", err)
    assert lines
    assert all(10 * int(points) == int(percent) for points, percent in lines)


def test_code_that_changes_its_process_as_it_is_imported_moves_no_store_and_silences_no_run(tmp_path, sweep_here):
    changing = "import logging, os\nos.chdir('/')\nlogging.disable()\nlogging.getLogger('linksweep').disabled = True\n"
    (tmp_path / "f.py").write_text(changing + CODE.format(fails="False"))
    (tmp_path / "x.csv").write_text("x\n1\n2\n")
    code, _, err = sweep_here("run", "f.py:f", "--points", "x.csv", cwd=tmp_path)
    assert (code, "wrote results/f.zarr" in err, (tmp_path / "results" / "f.zarr").exists()) == (0, True, True), err


@pytest.mark.parametrize("option", ["--log", "--events"])
@pytest.mark.parametrize("place", ["no/such/folder/run.log", ".", "/proc/run.log", "a\0b"])
def test_a_file_that_cannot_be_written_ends_it_before_anything_is_computed(run_f, tmp_path, option, place):
    code, out, err = run_f(option, place)
    assert (code, out, option in err or repr(place) in err) == (2, "", True)
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


@pytest.mark.parametrize(("fails", "options", "wanted"), few(2, ENDS[::-1]))
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
    assert events[-1]["failed"] == points["failed"]
    assert sum(event["event"] == "failed" for event in events) == points["failed"]
    assert (events[0]["event"], events[0]["points"]) == ("started", sum(points.values()))
    assert (code, events[-2]["event"]) == (wanted, "written")
    again = run_with_events()[1][len(events)]
    assert (again["done"], again["failed"]) == (points["done"], points["failed"])
    code, events = run_with_events("--set", "seed=9")
    assert (code, "different study" in events[-1]["reason"]) == (2, True)


@pytest.fixture
def folder(here):
    (here / "f.py").write_text(FUNCTIONS)
    return here


def odd_study(points=18):
    def odd(x: int):
        if x % 2:
            raise ValueError(f"no <sun> at {x}")
        return x

    return study_of_function(odd, axes={"x": range(points)})


def test_the_bar_has_what_failed_in_red_and_the_first_reason(tmp_path, monkeypatch):
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=140, color_system="standard", legacy_windows=False)
    monkeypatch.setattr(progress, "Console", lambda **_: console)
    with progress.TerminalProgress(odd_study()) as bar:
        run_study(odd_study(), tmp_path / "s.zarr", SERIAL, bar)
    assert re.search(r"9 done, \x1b\[1;31m9 failed\x1b\[0m of 18 points", shown.getvalue())
    assert ("ValueError: no <sun> at 1" in shown.getvalue(), "18/18" in shown.getvalue()) == (True, False)


def test_a_notebook_does_not_call_a_run_with_failures_done(tmp_path, monkeypatch, capsys):
    display, shown = pytest.importorskip("IPython.display"), []
    monkeypatch.setattr(logging.root, "handlers", [])  # what nobody handles is printed

    def show(line, **_):
        shown.append(line.data)
        return SimpleNamespace(update=show)

    monkeypatch.setattr(display, "display", show)
    for _ in range(2):  # the second time nothing is left to do
        run_study(odd_study(), tmp_path / "s.zarr", SERIAL, progress.NotebookProgress(odd_study()))
        assert shown[-1].endswith("9 done, 9 failed of 18 points, ended")
    run_study(odd_study(1), tmp_path / "one.zarr", SERIAL, progress.NotebookProgress(odd_study(1)))
    assert shown[-1].endswith("1/1 points, done")
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("pool", [("--pool", "serial"), (), *map(slow, (THREADS, ("--workers", "2"), LIMITS))], ids=str)
@pytest.mark.parametrize("name", ["never", slow("random_never")])
def test_a_run_whose_first_points_all_fail_alike_stops_and_goes_on_where_it_stopped(folder, sweep_here, name, pool):
    command = ("run", f"f.py:{name}", "--axis", "x=0:99:1", "-o", "s.zarr", *pool)
    code, out, err = sweep_here(*command)
    assert (code, out, "stopped: the first 20 points all failed for the same reason: " in err) == (1, "", True)
    assert re.search(r"like ImportError: no package for (\d+), for example at x=\1", err)  # whichever came first
    before = status_report("s.zarr")["points"]["failed"]
    assert FIRST <= before < (FIRST + 1 if "serial" in pool else 100)
    assert sweep_here(*command)[0] == 1
    assert status_report("s.zarr")["points"]["failed"] > before
    assert sweep_here(*command, "--max-failures", "100%")[0] == 1
    assert status_report("s.zarr")["points"] == {"missing": 0, "done": 0, "failed": 100, "excluded": 0}


@pytest.mark.parametrize(("most", "failed"), few(3, [(0, 1), ("30%", None), ("100 %", 50), (7, 8), ("7", 8)]))
def test_the_most_failures_that_are_allowed(tmp_path, most, failed):
    def late(x: int):
        return 1 // (x % 2 == 0)  # the values between come last

    with nullcontext() if failed == 50 else pytest.raises(TooManyFailuresError, match=r"stopped: .* failed, more than"):
        linksweep.run(late, tmp_path / "s.zarr", axes={"x": range(100)}, pool="serial", max_failures=most)
    result = status_report(tmp_path / "s.zarr")["points"]
    assert result["done"] == 50
    assert 20 < result["failed"] < 50 if failed is None else result["failed"] == failed


@pytest.mark.parametrize("wrong", ["-1", "101%", "many", "", "1.5", "5 %%"])
def test_a_limit_that_is_none_is_refused(folder, sweep, wrong):
    code, _, err = sweep("run", "f.py:never", "--axis", "x=0,1", "--max-failures", wrong)
    words = f"{wrong!r}: must be a number of points, like 10, or a percentage, like '5%'"
    assert (code, words in err) == (2, True), err
    assert not (folder / "results").exists()
    with pytest.raises(linksweep.SweepError, match="max_failures = True: must be"):
        linksweep.run("f.py:never", axes={"x": [0]}, max_failures=True)


@given(st.randoms(use_true_random=False))
def test_the_rule_in_any_order(chance):
    limit, first, study = chance.choice([None, 0, 7, 40.0, 50.0]), chance.choice([0.0, 0.5, 1.0]), odd_study(100)
    fails = [chance.random() < (0.5 if k >= 20 else first) for k in range(50)]
    points = list(make_grid(study).points())
    most = None if limit is None else MaxFailures(limit) if isinstance(limit, int) else MaxFailures(percent=limit)
    count = FailureCount(study, 100, most=most)
    for n, (point, fail) in enumerate(zip(points, fails, strict=False), 1):
        count.take([], {}, begun=[point.index])
        count.take([point], {point.index: Failure("exception", f"wrong at {n}")} if fail else {})
        bad = sum(fails[:n])
        if limit is None:
            expected = n >= 20 and all(fails[:n])
        elif isinstance(limit, int):
            expected = bad > limit
        else:
            expected = n >= 20 and 100.0 * bad > limit * n
        assert bool(count.too_many()) == expected
        assert str(count) == (f"{n - bad} done, {bad} failed of 100 points" if bad else f"{n}/100 points")


@pytest.mark.parametrize(("module", "call"), [FIRST_CALL, slow("time.sleep(1.0)", "pass")])
def test_imports_neither_start_workers_nor_make_a_point_slow(tmp_path, sweep_here, module, call):
    """A second for each of 24 points would be worth the start of workers."""
    (tmp_path / "f.py").write_text(SLOW_FIRST.format(module=module, call=call))
    code, _, err = sweep_here("run", "f.py:f", "--axis", "x=0:23:1", "--log", "run.log", cwd=tmp_path)
    assert (code, "on 1 local worker process" in err) == (0, True), err
    assert not re.search(r"the rest runs on|slowest|about \d+ s left", err + (tmp_path / "run.log").read_text())
