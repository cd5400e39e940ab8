"""Same seed, same numbers, bitwise: whatever the workers, the order and the interruptions.  All with real processes."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import xarray as xr
import zarr


def results(store):
    return xr.open_zarr(store).load().drop_attrs()


@pytest.fixture
def reference(link_study, tmp_path, sweep):
    """The results of the serial reference."""
    code, _, err = sweep("run", link_study, "-o", tmp_path / "serial.zarr", "--pool", "serial")
    assert code == 0, err
    return results(tmp_path / "serial.zarr")


@pytest.mark.parametrize(
    "resources",
    [("--workers", 1), ("--workers", 2), ("--workers", 4), ("--pool", "threads", "--workers", 4)],
    ids=["1 process", "2 processes", "4 processes", "4 threads"],
)
def test_any_number_of_workers(link_study, tmp_path, sweep, reference, resources):
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", *resources)
    assert code == 0, err
    xr.testing.assert_identical(results(tmp_path / "s.zarr"), reference)


@pytest.fixture
def scheduler(tmp_path):
    """The address of a Dask scheduler with two worker processes, all of them started from the command line."""
    file = tmp_path / "scheduler.json"
    dask = (
        [sys.executable, "-m", "distributed.cli.dask_scheduler"],
        [sys.executable, "-m", "distributed.cli.dask_worker"],
    )
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    options = ["--scheduler-file", str(file), "--no-dashboard"]
    processes = [
        subprocess.Popen([*dask[0], "--host", "127.0.0.1", "--port", "0", *options], **quiet),
        subprocess.Popen([*dask[1], "--host", "127.0.0.1", "--nworkers", "2", "--nthreads", "1", *options], **quiet),
    ]
    deadline = time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    found = re.search(r"tcp://[\d.:]+", file.read_text())
    yield found[0]
    for process in reversed(processes):
        process.send_signal(signal.SIGINT)
    for process in processes:
        process.wait(timeout=30)


def test_a_scheduler_that_runs_elsewhere(link_study, tmp_path, sweep, reference, scheduler):
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", "--scheduler", scheduler)
    assert code == 0, err
    assert scheduler in err
    xr.testing.assert_identical(results(tmp_path / "s.zarr"), reference)


LONG = ("--set", "n_sim=20000", "--set", "n_cat=6")


@pytest.fixture
def long_reference(link_study, tmp_path, sweep):
    code, _, err = sweep("run", link_study, "-o", tmp_path / "serial.zarr", "--pool", "serial", *LONG)
    assert code == 0, err
    return results(tmp_path / "serial.zarr")


def rows_on_disk(store: Path) -> int:
    try:
        return int(zarr.open_array(store, path="blocks/index", mode="r")[:].any(axis=1).sum())
    except (FileNotFoundError, ValueError):
        return 0


def wait_for_rows(store: Path, process: subprocess.Popen) -> int:
    deadline = time.monotonic() + 120
    while not (rows := rows_on_disk(store)) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    assert rows, "nothing was written before the end"
    return rows


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_a_client_killed_half_way_is_resumed(link_study, tmp_path, start_sweep, sweep, long_reference, end):
    store = tmp_path / "s.zarr"
    process = start_sweep("run", link_study, "-o", store, *LONG, start_new_session=True)
    wait_for_rows(store, process)
    (os.killpg if end == signal.SIGINT else os.kill)(process.pid, end)  # Ctrl-C in a terminal reaches the workers too
    _, err = process.communicate(timeout=60)
    assert process.returncode == (130 if end == signal.SIGINT else -signal.SIGKILL), err
    if end == signal.SIGINT:
        assert "goes on from there" in err
        assert "Traceback" not in err
        assert xr.open_zarr(store).attrs["complete"] == 0

    code, _, err = sweep("run", link_study, "-o", store, *LONG)
    assert code == 0, err
    assert "in the store already" in err or "part of the realisations" in err
    xr.testing.assert_identical(results(store), long_reference)


def test_a_killed_worker_costs_nothing_but_time(link_study, tmp_path, start_sweep, long_reference):
    store = tmp_path / "s.zarr"
    process = start_sweep("run", link_study, "-o", store, *LONG, "--workers", 2)
    wait_for_rows(store, process)
    os.kill(worker_pids(process.pid)[0], signal.SIGKILL)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    xr.testing.assert_identical(results(store), long_reference)


def worker_pids(client: int) -> list[int]:
    """Processes below the client that Dask's nannies started."""
    pids = []
    for pid in (int(p) for p in os.listdir("/proc") if p.isdigit()):
        try:
            stat = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
            command = Path(f"/proc/{pid}/cmdline").read_text()
        except OSError:
            continue
        if int(stat[1]) == client and "spawn_main" in command:
            pids.append(pid)
    return pids


@pytest.mark.parametrize("seed", range(6))
def test_killed_at_any_instant_the_store_is_whole_or_shorter(link_study, tmp_path, start_sweep, sweep, seed):
    """Kills at moments spread over the start, the work and the last writes; what is there is then resumed."""
    store = tmp_path / "s.zarr"
    process = start_sweep("run", link_study, "-o", store, "--pool", "serial")
    time.sleep(0.4 + 0.25 * seed)
    process.kill()
    process.communicate()
    code, _, err = sweep("run", link_study, "-o", store, "--pool", "serial")
    assert code == 0, err
    code, _, err = sweep("run", link_study, "-o", tmp_path / "whole.zarr", "--pool", "serial")
    xr.testing.assert_identical(results(store), results(tmp_path / "whole.zarr"))
