"""`sweep run --events FILE`: what other programs read is what the store holds, however the run ends."""

import json
import signal
import time

import pytest

from tests.sweep.opening import rows_on_disk, status_report
from tests.tiers import PATIENCE_S

CODE = """
import time
def f(x: float, y: int = 0, rng=None):
    time.sleep({pause})
    if {fails}:
        raise ValueError(f"no root at {{x}}")
    return rng.normal(x)
"""


@pytest.fixture
def run_f(tmp_path, sweep_here):
    """A function that runs f into s.zarr, with conditions on which it fails; returns the exit code and all events."""

    def run(*options, fails="x == 2.0", pause=0.0):
        (tmp_path / "f.py").write_text(CODE.format(fails=fails, pause=pause))
        given = ("f.py:f", "--axis", "x=0:4:1", "--pool", "serial", "-o", "s.zarr", "--events", "e.jsonl")
        code, _, err = sweep_here("run", *given, *options, cwd=tmp_path)
        return code, events_in(tmp_path / "e.jsonl"), err

    return run


def events_in(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def totals(events):
    """Return how many points are done and failed after the last run."""
    begun = max(i for i, event in enumerate(events) if event["event"] == "started")
    ended = [event for event in events[begun:] if event["event"] == "points"]
    return tuple(events[begun][key] + sum(event[key] for event in ended) for key in ("done", "failed"))


@pytest.mark.parametrize(
    ("fails", "options", "wanted"),
    [
        ("False", (), 0),
        ("x == 2.0", (), 1),
        ("x > 0.0 and y", ("--axis", "y=0,1", "--max-failures", "2"), 1),
        ("x == 2.0", ("--set", "n_sim=1500"), 1),
    ],
)
def test_counts_are_those_of_the_store(run_f, tmp_path, fails, options, wanted):
    code, events, _ = run_f(*options, fails=fails)
    points = status_report(tmp_path / "s.zarr")["points"]
    assert totals(events) == (points["done"], points["failed"])
    assert sum(event["event"] == "failed" for event in events) == points["failed"]
    assert (events[0]["event"], events[0]["points"]) == ("started", sum(points.values()))
    assert [event["event"] for event in events[-2:]] == ["written", "ended"]
    assert (code, events[-1]["exit_code"]) == (wanted, wanted)
    before = len(events)
    code, events, _ = run_f(*options, fails=fails)
    assert events[before]["done"] == points["done"]
    assert events[before]["failed"] == points["failed"]
    assert events[-1]["exit_code"] == code


def test_it_says_why_a_run_did_not_begin(run_f, tmp_path):
    run_f()
    code, events, _ = run_f("--set", "seed=9")
    assert (code, events[-1]["event"], events[-1]["exit_code"]) == (2, "ended", 2)
    assert "different study" in events[-1]["reason"]


@pytest.mark.parametrize("file", ["-", ".", "no/such/folder.jsonl"])
def test_a_file_that_cannot_be_written_is_refused(run_f, tmp_path, sweep_here, file):
    (tmp_path / "f.py").write_text(CODE.format(fails="False", pause=0))
    code, out, err = sweep_here("run", "f.py:f", "--axis", "x=1,2", "-o", "s.zarr", "--events", file, cwd=tmp_path)
    assert (code, out) == (2, "")
    assert "--events" in err
    assert [path.name for path in tmp_path.iterdir()] == ["f.py"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_the_last_event(tmp_path, start_sweep, number):
    (tmp_path / "f.py").write_text(CODE.format(fails="x == 2.0", pause=0.05))
    given = ("--axis", "x=0:400:1", "--set", "n_sim=2", "--pool", "serial", "-o", "s.zarr", "--events", "e.jsonl")
    process = start_sweep("run", "f.py:f", *given, cwd=tmp_path)
    deadline = time.monotonic() + PATIENCE_S
    while rows_on_disk(tmp_path / "s.zarr") < 10:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(PATIENCE_S) == 128 + number
    events, points = events_in(tmp_path / "e.jsonl"), status_report(tmp_path / "s.zarr")["points"]
    assert (events[-1]["event"], events[-1]["exit_code"]) == ("ended", 128 + number)
    assert totals(events) == (points["done"], points["failed"])
    assert points["missing"] > 0
