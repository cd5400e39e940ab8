"""Whoever stops a run gets a clean end at once, with everything finished kept; with real signals."""

import os
import re
import signal
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
import xarray as xr

from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.interrupt import LOST_S, RunInterruptedError, watched
from linksweep.sweep.planning.work_queue import Tuning
from linksweep.sweep.stores.store import Store
from linksweep.sweep.studies.reader import study_from_dict
from tests.sweep.opening import run_study
from tests.sweep.outside import wait_until
from tests.tiers import PATIENCE_S, slow

ENDLESS_S = 3600.0
"""Longer than a test may take: what waits for it fails."""

SLEEPERS = str(Path(__file__).parents[1] / "sleepers.py") + ":experiment"
SERIAL = Resources(pool="serial")


def sleepers(seconds, sheep=20):
    return f"""
title = "Sleepers"
experiment = "{SLEEPERS}"
[axes]
sheep = {{ start = 1, stop = {sheep}, step = 1 }}
[fixed]
seconds = {seconds}
[sampling]
n_sim = 2
"""


def ended_as(body):
    """Run a body that is given the interruptions, and return what ended it."""
    try:
        with watched() as interruptions:
            body(interruptions)
    except RunInterruptedError as stop:
        return stop.signal
    return None


def test_a_held_signal_is_raised_once():
    """So that what is written after an interruption is written."""
    steps = []

    def body(interruptions):
        try:
            with interruptions.held():
                signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            with interruptions.held():
                steps.append("written")
            steps.append("after it")
            raise

    assert ended_as(body) == signal.SIGINT
    assert steps == ["written", "after it"]


IN_A_LOOP = """
import os, signal
import linksweep

def f(x: float):
    if x == 2.0:
        os.kill(os.getpid(), signal.SIGINT)
    return x

for seed in range(3):
    print("began", seed, flush=True)
    try:
        linksweep.run(f, f"{seed}.zarr", axes={"x": [1.0, 2.0, 3.0]}, pool="serial")
    except Exception as error:
        print("swallowed", type(error).__name__)
"""


def test_except_exception_in_a_loop_does_not_go_on_after_ctrl_c(tmp_path, start_sweep):
    (tmp_path / "loop.py").write_text(IN_A_LOOP)
    process = start_sweep(command=(sys.executable, "loop.py"), cwd=tmp_path)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert out.splitlines() == ["began 0"]
    assert process.returncode != 0
    assert err.splitlines()[-1].endswith("interrupted; what was done is kept, the same call goes on from there")


def test_the_second_signal_is_answered_as_before():
    seen = []
    counts = []

    def body(interruptions):
        with interruptions.held():
            for _ in range(2):
                signal.raise_signal(signal.SIGTERM)
                counts.append(len(seen))

    before = signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    try:
        assert ended_as(body) == signal.SIGTERM
    finally:
        signal.signal(signal.SIGTERM, before)
    assert counts == [0, 1]


def test_what_a_finaliser_swallows_comes_again():
    class Swallower:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def body(interruptions):
        Swallower()
        threading.Event().wait(ENDLESS_S)

    assert ended_as(body) == signal.SIGINT


@pytest.mark.parametrize("where", ["finally", "except", "with"])
def test_cleaning_up_takes_its_time(where):
    """What is on its way out is not interrupted again."""
    steps = []

    @contextmanager
    def cleaning():
        try:
            yield
        finally:
            for _ in range(8):
                time.sleep(LOST_S / 2)
            steps.append("clean")

    def body(interruptions):
        if where == "with":
            with cleaning():
                signal.raise_signal(signal.SIGINT)
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if where == "except":
                with cleaning():
                    raise
            raise
        finally:
            if where == "finally":
                with cleaning():
                    pass

    assert ended_as(body) == signal.SIGINT
    assert steps == ["clean"]


def test_an_ignored_signal_stays_ignored():
    """Under nohup a run goes on when the terminal is closed."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with watched():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("long_write", [False, True], ids=["short write", "long write"])
def test_interrupted_during_the_last_write(coins, tmp_path, monkeypatch, long_write):
    """A short write is finished, a long one given up; either way the run goes on to the same numbers."""
    write = Store.write
    written = []

    def interrupted(self, dataset):
        if dataset.attrs["complete"] and not any(written):
            signal.raise_signal(signal.SIGINT)
        write(self, dataset)
        written.append(dataset.attrs["complete"])

    tuning = Tuning(long_write_bytes=0 if long_write else 2**30)
    monkeypatch.setattr(Store, "write", interrupted)
    study = study_from_dict(coins)
    with pytest.raises(RunInterruptedError):
        run_study(study, tmp_path / "s.zarr", SERIAL, tuning=tuning)
    assert written == ([0] if long_write else [0, 1])
    monkeypatch.undo()

    resumed, _ = run_study(study, tmp_path / "s.zarr", SERIAL)
    whole, _ = run_study(study, tmp_path / "whole.zarr", SERIAL)
    xr.testing.assert_identical(resumed.drop_vars("wall_time").drop_attrs(), whole.drop_vars("wall_time").drop_attrs())


def group_of(pid):
    """Processes of a group that are not zombies."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            state, _, group = (entry / "stat").read_text().rsplit(")", 1)[1].split()[:3]
        except OSError:
            continue
        if int(group) == pid and state != "Z":
            found.append((entry / "cmdline").read_text())
    return found


def stopped(process, number):
    """Send a signal to a whole process group, as a terminal does, and return exit code and stderr."""
    os.killpg(process.pid, number)
    _, err = process.communicate(timeout=PATIENCE_S)
    wait_until(lambda: not group_of(process.pid), "the end of all processes")
    return process.returncode, err


@pytest.mark.parametrize(
    ("number", "code", "words", "pool"),
    [
        (signal.SIGINT, 130, "interrupted", ("--workers", 2)),
        slow(signal.SIGTERM, 143, "stopped by SIGTERM", ("--pool", "threads", "--workers", 2)),
        slow(signal.SIGHUP, 129, "stopped by SIGHUP", ("--pool", "serial")),
    ],
)
def test_long_blocks_are_not_waited_for(tmp_path, start_sweep, number, code, words, pool):
    (tmp_path / "study.toml").write_text(sleepers(ENDLESS_S))
    store = tmp_path / "s.zarr"
    process = start_sweep("run", tmp_path / "study.toml", "-o", store, *pool, start_new_session=True)
    assert "20 points" in process.stderr.readline()
    wait_until((store / "zarr.json").exists, "it")
    time.sleep(0.5)
    returned, err = stopped(process, number)
    assert returned == code
    said = f"{words}; kept in {store}: 0 realisations of this run; the same command goes on from there"
    assert err.splitlines()[-1] == said
    assert len(err.splitlines()) <= 2  # the other is the address of the dashboard
    assert xr.open_zarr(store).attrs["complete"] == 0


def answers_sigterm(pid):
    """Whether a process has a handler of its own: from then on the command answers for itself."""
    caught = re.search(r"SigCgt:\s*([0-9a-f]+)", Path(f"/proc/{pid}/status").read_text())
    return bool(int(caught[1], 16) & 1 << signal.SIGTERM - 1)


@pytest.mark.slow
@pytest.mark.parametrize("moment", [0.0, 0.4, 1.0])
def test_interrupted_while_the_cluster_starts(tmp_path, start_sweep, moment):
    (tmp_path / "study.toml").write_text(sleepers(ENDLESS_S))
    process = start_sweep(
        "run", tmp_path / "study.toml", "-o", tmp_path / "s.zarr", "--workers", 2, start_new_session=True
    )
    wait_until(lambda: answers_sigterm(process.pid), "it")
    time.sleep(moment)
    returned, err = stopped(process, signal.SIGINT)
    assert returned == 130, err
    assert "interrupted" in err
    assert "Traceback" not in err


INTERRUPTS_ITSELF = """
import atexit, os, signal

def late():
    try:
        exec("raise KeyboardInterrupt")  # Python then ends by the signal, whatever exit code it was told
    except KeyboardInterrupt:
        pass

def f(x: float = 1.0):
    atexit.register(late)
    os.kill(os.getpid(), signal.SIGINT)
"""


@pytest.mark.slow
def test_the_exit_code_does_not_depend_on_what_was_interrupted(tmp_path, start_sweep):
    (tmp_path / "f.py").write_text(INTERRUPTS_ITSELF)
    process = start_sweep("run", f"{tmp_path}/f.py:f", "--axis", "x=1,2", "--pool", "serial", "-o", tmp_path / "s.zarr")
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, err
    assert "interrupted; kept in" in err


@pytest.mark.slow
def test_the_second_signal_ends_it_at_once(tmp_path, start_sweep):
    """Where the end itself hangs, here in a write, another Ctrl-C helps."""
    (tmp_path / "study.toml").write_text(sleepers(0.0, sheep=3))
    slow = (
        "import time, linksweep.sweep.stores.store, linksweep.sweep.cli\n"
        "def slow(self, dataset):\n"
        "    print('writing', flush=True)\n"
        "    time.sleep(3600)\n"
        "linksweep.sweep.stores.store.Store.write = slow\n"
        "linksweep.sweep.cli.main()"
    )
    command = [sys.executable, "-c", slow, "run", tmp_path / "study.toml", "-o", tmp_path / "s.zarr"]
    process = start_sweep(command=command, start_new_session=True)
    assert process.stdout.readline() == "writing\n"
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(0.3)
    assert process.poll() is None  # a short write is waited for
    returned, err = stopped(process, signal.SIGINT)
    assert returned == 130
    assert err.endswith("stopped immediately\n")
    assert "Traceback" not in err


def test_what_was_finished_before_is_kept(tmp_path, start_sweep, sweep):
    (tmp_path / "study.toml").write_text(sleepers(0.1, sheep=12))
    store = tmp_path / "s.zarr"
    process = start_sweep("run", tmp_path / "study.toml", "-o", store, "--pool", "serial", start_new_session=True)
    wait_until(lambda: any((store / "blocks").glob("rows*")), "it")
    returned, err = stopped(process, signal.SIGTERM)
    assert returned == 143, err
    assert int(xr.open_zarr(store)["n_sim_done"].sum()) > 0
    code, _, err = sweep("run", tmp_path / "study.toml", "-o", store)
    assert code == 0, err
    assert "of them in the store already" in err
    sweep("run", tmp_path / "study.toml", "-o", tmp_path / "whole.zarr")
    whole, resumed = (
        xr.open_zarr(path).load().drop_vars("wall_time").drop_attrs() for path in (tmp_path / "whole.zarr", store)
    )
    xr.testing.assert_identical(resumed, whole)
