"""Runs whose points fail: seen while they go on, grouped at their end, and ended where they only fail."""

import io
import re
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from hypothesis import given, strategies as st
from rich.console import Console

import linksweep
from linksweep import SweepError
from linksweep.sweep.executing.task import Failure
from linksweep.sweep.running import progress
from linksweep.sweep.running.progress import FIRST, FailureCount, MaxFailures
from linksweep.sweep.running.run import TooManyFailuresError
from linksweep.sweep.studies.reader import study_of_function
from tests.sweep.opening import SERIAL, make_grid, run_study, status_report
from tests.tiers import slow

FUNCTIONS = """
def never(x: int):
    raise ImportError(f"no package for {x}")

def random_never(x: int, rng):
    raise ImportError(f"no package for {x}")
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "f.py").write_text(FUNCTIONS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


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
    assert "ValueError: no <sun> at 1" in shown.getvalue()
    assert "18/18" not in shown.getvalue()


def test_a_notebook_does_not_call_a_run_with_failures_done(tmp_path, monkeypatch):
    display, shown = pytest.importorskip("IPython.display"), []

    def show(line, **_):
        shown.append(line.data)
        return SimpleNamespace(update=show)

    monkeypatch.setattr(display, "display", show)
    for _ in range(2):  # the second time nothing is left to do
        run_study(odd_study(), tmp_path / "s.zarr", SERIAL, progress.NotebookProgress(odd_study()))
        assert shown[-1].endswith("9 done, 9 failed of 18 points, ended")
    run_study(odd_study(1), tmp_path / "one.zarr", SERIAL, progress.NotebookProgress(odd_study(1)))
    assert shown[-1].endswith("1/1 points, done")


THREADS, LIMITS = ("--pool", "threads", "--workers", "2"), ("--pool", "serial", "--time-limit", "100")


@pytest.mark.parametrize(
    "pool", [("--pool", "serial"), (), THREADS, slow(("--workers", "2")), slow(LIMITS)], ids=" ".join
)
@pytest.mark.parametrize("name", ["never", slow("random_never")])
def test_a_run_whose_first_points_all_fail_alike_stops_and_goes_on_where_it_stopped(folder, sweep_here, name, pool):
    command = ("run", f"f.py:{name}", "--axis", "x=0:99:1", "-o", "s.zarr", *pool)
    code, out, err = sweep_here(*command)
    words = "stopped: the first 20 points all failed for the same reason: "
    assert (code, out, words in err) == (1, "", True)
    assert re.search(r"like ImportError: no package for (\d+), for example at x=\1", err)  # whichever came first
    before = status_report("s.zarr")["points"]["failed"]
    assert FIRST <= before < 100
    assert sweep_here(*command)[0] == 1
    assert status_report("s.zarr")["points"]["failed"] > before
    assert sweep_here(*command, "--max-failures", "100%")[0] == 1
    assert status_report("s.zarr")["points"] == {"missing": 0, "done": 0, "failed": 100, "excluded": 0}


@pytest.mark.parametrize(("most", "failed"), [(0, 1), (7, 8), ("7", 8), ("30%", None), ("100 %", 50)])
def test_the_most_failures_that_are_allowed(tmp_path, most, failed):
    def late(x: int):
        return 1 // (x % 2 == 0)  # the values between come last

    with nullcontext() if failed == 50 else pytest.raises(TooManyFailuresError, match=r"stopped: .* failed, more than"):
        linksweep.run(late, tmp_path / "s.zarr", axes={"x": range(100)}, pool="serial", max_failures=most)
    found = status_report(tmp_path / "s.zarr")["points"]
    assert found["done"] == 50
    assert 20 < found["failed"] < 50 if failed is None else found["failed"] == failed


@pytest.mark.parametrize("wrong", ["-1", "101%", "many", "", "1.5", "5 %%"])
def test_a_limit_that_is_none_is_refused(folder, sweep, wrong):
    code, _, err = sweep("run", "f.py:never", "--axis", "x=0,1", "--max-failures", wrong)
    assert code == 2
    assert f"{wrong!r}: must be a number of points, like 10, or a percentage, like '5%'" in err
    assert not (folder / "results").exists()
    with pytest.raises(SweepError, match="max_failures = True: must be"):
        linksweep.run("f.py:never", axes={"x": [0]}, max_failures=True)


@given(st.lists(st.booleans(), min_size=1, max_size=60), st.one_of(st.none(), st.integers(0, 30), st.floats(0, 100)))
def test_the_rule_in_any_order(fails, limit):
    """Against a count by hand, point by point."""
    study = odd_study(100)
    points = list(make_grid(study).points())
    most = None if limit is None else MaxFailures(limit) if isinstance(limit, int) else MaxFailures(percent=limit)
    count = FailureCount(study, 100, most=most)
    for n, (point, fail) in enumerate(zip(points, fails, strict=False), 1):
        count.take([point], {point.index: Failure("exception", f"wrong at {n}")} if fail else {})
        bad = sum(fails[:n])
        if limit is None:
            expected = n >= 20 and all(fails[:20])
        elif isinstance(limit, int):
            expected = bad > limit
        else:
            expected = n >= 20 and 100.0 * bad > limit * n
        assert bool(count.too_many()) == expected
        assert str(count) == (f"{n - bad} done, {bad} failed of 100 points" if bad else f"{n}/100 points")


SLOW_FIRST = """
import time
{module}

def f(x: int):
    {call}
    time.sleep(0.001)
    return float(x)
"""


@pytest.mark.parametrize(
    ("module", "call"),
    [("called = []", "called or called.append(time.sleep(1.0))"), slow("time.sleep(1.0)", "pass")],
    ids=["first call", "module"],
)
def test_imports_neither_start_workers_nor_make_a_point_slow(tmp_path, sweep_here, module, call):
    """A second for each of 24 points would be worth the start of workers."""
    (tmp_path / "f.py").write_text(SLOW_FIRST.format(module=module, call=call))
    code, _, err = sweep_here("run", "f.py:f", "--axis", "x=0:23:1", "--log", "run.log", cwd=tmp_path)
    assert (code, "in one process" in err) == (0, True), err
    assert not re.search(r"the rest runs on|slowest|about \d+ s left", err + (tmp_path / "run.log").read_text())
