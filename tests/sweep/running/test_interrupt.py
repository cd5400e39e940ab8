"""Whoever stops a run gets a clean end at once; after that and after any kill the run goes on.  With real signals."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
import xarray as xr

import linksweep
from linksweep.sweep.interrupt import LOST_S, RunInterruptedError, watched
from tests.sweep.opening import TUNED, Store, existing_store, load_study, rows_on_disk, run, same
from tests.sweep.outside import below, command_of, wait_until
from tests.tiers import PATIENCE_S, slow

ENDLESS_S = 3600.0  # longer than a test may take: what waits for it fails
SLEEP = 'import os, time\ndef f(sheep: int, *, rng, n_sim):\n    time.sleep(float(os.environ["SECONDS"]))\n'
SLEEP += "    return rng.normal(size=n_sim)\n"
KILLS, LONGEST_S = 20, 4.0  # of starting and work together: a whole run takes a little longer on an idle machine
WAYS = {signal.SIGKILL: 3, signal.SIGINT: 1, signal.SIGTERM: 1}  # how often each is drawn
POOLS = {("--pool", "serial"): 3, ("--workers", "2"): 1, ("--pool", "threads", "--workers", "2"): 1}
LONG = ("--set", "n_sim=12000", "--set", "n_cat=8")
# Python has a traceback of its own for an interrupt while it starts; from here on there is none.
READY = (sys.executable, "-c", "import linksweep.sweep.__main__ as command; print('ready', flush=True); command.main()")
STOPS = [(signal.SIGINT, 130, "interrupted", ("--workers", 2))]
STOPS += [slow(signal.SIGTERM, 143, "stopped by SIGTERM", ("--pool", "threads", "--workers", 2))]
STOPS += [slow(signal.SIGHUP, 129, "stopped by SIGHUP", ("--pool", "serial"))]
SLOW = """
import time, linksweep.sweep.stores.store, linksweep.sweep.cli
def slow(self, dataset):
    print('writing', flush=True)
    time.sleep(3600)
linksweep.sweep.stores.store.Store.write = slow
linksweep.sweep.cli.main()
"""
HALF = "import signal, sys, linksweep\n"
HALF += "def hook(event, args): event == 'import' and args[0] == 'pandas.core.frame' and signal.raise_signal(2)\n"
HALF += "sys.addaudithook(hook)\n"
HALF += "try: linksweep.run\nexcept KeyboardInterrupt: print(linksweep.run.__name__)\n"


@pytest.fixture
def sleepers(tmp_path, monkeypatch):
    (tmp_path / "f.py").write_text(SLEEP)

    def command(seconds, sheep=20):
        monkeypatch.setenv("SECONDS", str(seconds))
        study = ("run", tmp_path / "f.py:f", "--axis", f"sheep=1:{sheep}:1", "--set", "n_sim=2")
        return *study, "-o", tmp_path / "s.zarr"

    return command


def ended_as(body):
    try:
        with watched() as interruptions:
            body(interruptions)
    except RunInterruptedError as stop:
        return stop.signal
    return None


def test_a_held_signal_is_raised_once_a_second_one_is_answered_as_before_and_an_ignored_one_stays_ignored():
    steps, seen = [], []

    def body(interruptions):
        try:
            signal.raise_signal(signal.SIGHUP)  # under nohup a run goes on when the terminal is closed
            with interruptions.postponed():
                signal.raise_signal(signal.SIGTERM)
                steps.append("held")
        except KeyboardInterrupt:
            with interruptions.postponed():
                steps.append("written")
            signal.raise_signal(signal.SIGTERM)
            steps.append(f"seen {len(seen)}")
            raise

    before = signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    hup = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert ended_as(body) == signal.SIGTERM
    finally:
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGHUP, hup)
    assert steps == ["held", "written", "seen 1"]


@pytest.mark.parametrize("caught", [[], [KeyboardInterrupt]])
def test_ctrl_c_ends_a_loop_with_except_exception_and_a_function_that_catches_it_when_it_returns(tmp_path, caught):
    def f(x: int):
        with suppress(*caught):
            signal.raise_signal(signal.SIGINT)
        return x

    def loop():
        for seed in range(3):
            with suppress(Exception):
                linksweep.run(f, tmp_path / f"{seed}.zarr", axes={"x": [1, 2, 3]}, pool="serial")

    with pytest.raises(KeyboardInterrupt, match="interrupted; what was done is kept, the same call goes on from there"):
        loop()
    assert not caught or rows_on_disk(tmp_path / "0.zarr") == 1
    assert not (tmp_path / "1.zarr").exists()


def test_what_was_interrupted_while_libraries_were_imported_goes_on():
    assert subprocess.check_output([sys.executable, "-c", HALF], timeout=PATIENCE_S) == b"run\n"


class Swallower:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize("is_swallowed", [slow(True), slow(False)])
def test_what_a_finaliser_swallows_comes_again_and_cleaning_up_is_not_interrupted(is_swallowed):
    steps = []

    def body(interruptions):
        try:
            Swallower() if is_swallowed else signal.raise_signal(signal.SIGTERM)
            with watched():
                threading.Event().wait(ENDLESS_S)
        finally:
            time.sleep(2 * LOST_S)
            steps.append("clean")

    assert (ended_as(body), steps) == (signal.SIGTERM, ["clean"])


@pytest.mark.parametrize("long_write", [False, True], ids=["short write", "long write"])
def test_interrupted_during_the_last_write(coins, tmp_path, monkeypatch, long_write):
    write, written = Store.write, []

    def interrupted(self, dataset):
        if dataset.attrs["complete"] and not any(written):
            signal.raise_signal(signal.SIGINT)
        write(self, dataset)
        written.append(dataset.attrs["complete"])

    with monkeypatch.context() as patch:
        patch.setattr(TUNED, "long_write_bytes", 0 if long_write else 2**30)
        patch.setattr(Store, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(coins, tmp_path / "s.zarr")
    assert written == ([0] if long_write else [0, 1])
    same(run(coins, tmp_path / "s.zarr"), run(coins, tmp_path / "whole.zarr"))


def stopped(process, number):
    family = below(process.pid)
    os.killpg(process.pid, number)
    _, err = process.communicate(timeout=PATIENCE_S)
    wait_until(lambda: not any(map(command_of, family)), "the end of all processes")
    return process.returncode, err


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code", "words", "pool"), STOPS)
def test_long_blocks_are_not_waited_for(tmp_path, start_sweep, sleepers, number, code, words, pool):
    store = tmp_path / "s.zarr"
    process = start_sweep(*sleepers(ENDLESS_S), *pool, start_new_session=True)
    assert "20 points" in process.stderr.readline()
    wait_until((store / "zarr.json").exists, "it")
    time.sleep(0.5)
    returned, err = stopped(process, number)
    assert returned == code
    assert err.splitlines()[-1].startswith(f"{words}; kept in {store}: 0 realisations of this run; ")
    assert len(err.splitlines()) <= 2  # the other is the address of the dashboard
    assert xr.open_zarr(store).attrs["complete"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("moment", [0.0, 0.4, 1.0])
def test_interrupted_while_the_cluster_starts(start_sweep, sleepers, moment):
    process = start_sweep(*sleepers(ENDLESS_S), "--workers", 2, start_new_session=True)
    file, caught = Path(f"/proc/{process.pid}/status"), re.compile(r"SigCgt:\s*([0-9a-f]+)")
    wait_until(lambda: int(caught.search(file.read_text())[1], 16) & 1 << signal.SIGTERM - 1, "an answer of its own")
    time.sleep(moment)
    returned, err = stopped(process, signal.SIGINT)
    assert (returned, "interrupted" in err, "Traceback" in err) == (130, True, False), err


@pytest.mark.slow
def test_the_second_signal_ends_it_at_once(start_sweep, sleepers):
    process = start_sweep(command=[sys.executable, "-c", SLOW, *sleepers(0.0, sheep=3)], start_new_session=True)
    assert "writing\n" in process.stderr  # which are lines: standard output has results alone
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(0.3)
    assert process.poll() is None  # a short write is waited for
    returned, err = stopped(process, signal.SIGINT)
    assert (returned, "Traceback" in err) == (130, False)


def test_nobody_else_writes_meanwhile_and_what_was_finished_is_kept(tmp_path, start_sweep, sweep, sleepers):
    store, log, asked = tmp_path / "s.zarr", ("--events", tmp_path / "e.jsonl"), sleepers(0.1, sheep=100)
    process = start_sweep(*asked, "--pool", "serial", *log, start_new_session=True)
    wait_until(lambda: rows_on_disk(store), "it")
    code, out, err = sweep(*asked)
    assert (code, out, f"{store}: is being written by process {process.pid} on " in err) == (2, "", True)
    assert f"process {process.pid} on " in sweep("status", store)[1]
    returned, err = stopped(process, signal.SIGTERM)
    assert (returned, store.with_name("s.zarr.lock").exists()) == (143, False), err
    assert "stopped: " in sweep("status", store)[1]
    assert int(xr.open_zarr(store)["n_sim_done"].sum()) > 0
    last = json.loads((tmp_path / "e.jsonl").read_text().splitlines()[-1])
    assert (last["event"], last["exit_code"]) == ("ended", 143)
    assert "of them in the store already" in sweep(*sleepers(0.0, sheep=100), code=0)[2]
    assert sweep(*asked[:-1], tmp_path / "whole.zarr")[0] == 0
    same(store, tmp_path / "whole.zarr")


def ledger_of(path, study):
    if (store := existing_store(path, study)) is None:
        return {}
    rows = store.read()
    return {key: rows[row].tobytes() for key, row in store.rows.items()}


@pytest.mark.slow
def test_killed_at_any_instant_nothing_is_lost_and_no_bit_differs(link_study, tmp_path, start_sweep, sweep):
    results, study = tmp_path / "whole.zarr", load_study(link_study, LONG[1::2])
    assert sweep("run", link_study, "-o", results, "--pool", "serial", *LONG)[0] == 0
    expected = ledger_of(results, study)
    rng = random.Random(2004)
    kills, chain, before = 0, 0, {}
    while kills < KILLS:
        store = tmp_path / f"{chain}.zarr"
        pool = rng.choices(list(POOLS), list(POOLS.values()))[0]
        process = start_sweep("run", link_study, "-o", store, *LONG, *pool, command=READY, start_new_session=True)
        assert process.stdout.readline() == "ready\n"
        try:
            process.wait(timeout=rng.uniform(0.0, LONGEST_S))
        except subprocess.TimeoutExpired:
            end = rng.choices(list(WAYS), list(WAYS.values()))[0]
            (os.kill if end == signal.SIGTERM else os.killpg)(process.pid, end)  # Ctrl-C reaches workers too
            _, err = process.communicate(timeout=PATIENCE_S)
            kills += 1
            assert process.returncode in (0, -end, 128 + end), err  # 0: it was in its last moment
            assert "Traceback" not in err, err
            after = ledger_of(store, study) if (store / "zarr.json").exists() else {}
            assert before.keys() <= after.keys()
            assert after.items() <= expected.items()
            before = after
        if process.returncode == 0:
            assert ledger_of(store, study) == expected
            same(store, results)
            chain, before = chain + 1, {}
    sweep("run", link_study, "-o", store, *LONG, code=0)
    same(store, results)
