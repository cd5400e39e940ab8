"""What a person sees of a run, what the log file keeps, and what other programs read, however it ends."""

import json
import re
import shutil
import sys

import pytest

from tests.sweep.opening import status_report
from tests.tiers import PATIENCE_S

CODE = """
def f(x: float, y: int = 0, rng=None):
    if {fails}:
        raise ValueError(f"no root at {{x}}")
    return rng.normal(x)
"""


@pytest.fixture
def run(tmp_path, sweep_here):
    """A function that runs f into s.zarr, with conditions on which it fails."""

    def run(*options, fails="x == 2.0"):
        (tmp_path / "f.py").write_text(CODE.format(fails=fails))
        asked = ("f.py:f", "--axis", "x=0:4:1", "--pool", "serial", "-o", "s.zarr")
        return sweep_here("run", *asked, *options, cwd=tmp_path)

    return run


def test_quiet_prints_the_table_and_errors(run):
    code, out, err = run("--quiet", fails="False")
    assert (code, err, "f_mean" in out) == (0, "", True)
    code, _, err = run("-q", "--fresh")
    assert (code, len(err.splitlines())) == (1, 1)
    assert err.startswith("1 point failed")


def test_verbose_tells_each_point(run):
    told = sorted(line for line in run("--verbose")[2].splitlines() if line.startswith("x="))
    assert told == ["x=0.0: done", "x=1.0: done", "x=2.0: failed (exception)", "x=3.0: done", "x=4.0: done"]


def test_the_log_has_everything_with_times_and_tracebacks_and_grows(run, tmp_path):
    assert run("--quiet", "--log", "run.log")[0] == 1
    first = (tmp_path / "run.log").read_text()
    assert re.search(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} INFO 5 points; [\d,]+ realisations", first, re.MULTILINE)
    assert "DEBUG x=1.0: done" in first
    assert "ERROR x=2.0: failed (exception): ValueError: no root at 2.0" in first
    assert first.count("Traceback (most recent call last)") == first.count("raise ValueError(f") == 1
    assert "realisations/s" in first
    run("--log", "run.log")
    assert (tmp_path / "run.log").read_text().startswith(first)


@pytest.mark.parametrize("option", ["--log", "--events"])
@pytest.mark.parametrize("place", ["no/such/folder/run.log", ".", "/proc/run.log", "a\0b"])
def test_a_file_that_cannot_be_written_ends_it_before_anything_is_computed(run, tmp_path, option, place):
    code, out, err = run(option, place)
    assert (code, out) == (2, "")
    assert option in err or repr(place) in err
    assert [path.name for path in tmp_path.iterdir()] == ["f.py"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("script") is None, reason="needs the command script, which has a terminal")
def test_on_a_terminal_the_bar_shows_the_time_left(link_study, tmp_path, start_sweep):
    """The bar is drawn again and again; what stays are the sentences."""
    store = tmp_path / "s.zarr"
    inner = f"TERM=xterm {sys.executable} -m linksweep run {link_study} -o {store} --set n_sim=100000 --workers 1"
    process = start_sweep(command=["script", "-qec", inner, "/dev/null"])
    shown, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, shown
    assert "━" in shown
    assert re.search(r"of the work\), about \d+ s left, \d", re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", shown))
    assert "wrote" in shown


def events_in(folder):
    return [json.loads(line) for line in (folder / "e.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(
    ("fails", "options", "wanted"),
    [
        ("False", (), 0),
        ("x == 2.0", (), 1),
        ("x > 0.0 and y", ("--axis", "y=0,1", "--max-failures", "2"), 1),
        ("x == 2.0", ("--set", "n_sim=1500"), 1),
    ],
)
def test_counts_of_events_are_those_of_the_store(run, tmp_path, fails, options, wanted):
    assert run(*options, "--events", "e.jsonl", fails=fails)[0] == wanted
    events, points = events_in(tmp_path), status_report(tmp_path / "s.zarr")["points"]
    ended = [event for event in events if event["event"] == "points"]
    for key in ("done", "failed"):
        assert events[0][key] + sum(event[key] for event in ended) == points[key]
    assert sum(event["event"] == "failed" for event in events) == points["failed"]
    assert (events[0]["event"], events[0]["points"]) == ("started", sum(points.values()))
    assert [event["event"] for event in events[-2:]] == ["written", "ended"]
    assert events[-1]["exit_code"] == wanted
    code, before = run(*options, "--events", "e.jsonl", fails=fails)[0], len(events)
    events = events_in(tmp_path)
    assert (events[before]["done"], events[before]["failed"]) == (points["done"], points["failed"])
    assert events[-1]["exit_code"] == code
    assert run("--set", "seed=9", "--events", "e.jsonl", fails=fails)[0] == 2
    last = events_in(tmp_path)[-1]
    assert (last["event"], last["exit_code"], "different study" in last["reason"]) == ("ended", 2, True)
