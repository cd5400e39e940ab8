"""Same seed, same numbers, bitwise: whatever the workers, the order and the interruptions.  All with real processes."""

import os
import signal
import subprocess
import time
from contextlib import closing
from pathlib import Path

import pytest
import xarray as xr

from tests.patience import PATIENCE_S
from tests.sweep.opening import rows_on_disk
from tests.sweep.outside import Outside
from tests.tiers import slow


def results(store):
    return xr.open_zarr(store).load().drop_attrs()


@pytest.mark.parametrize(
    "resources",
    [
        *(pytest.param(("--workers", n), marks=pytest.mark.slow) for n in (1, 4)),
        ("--workers", 2),
        slow(("--pool", "threads", "--workers", 4)),
    ],
    ids=["1 process", "4 processes", "2 processes", "4 threads"],
)
def test_any_number_of_workers(link_study, tmp_path, sweep, reference, resources):
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", *resources)
    assert code == 0, err
    xr.testing.assert_identical(results(tmp_path / "s.zarr"), reference)


@pytest.fixture
def scheduler(tmp_path):
    """The address of a Dask scheduler with two worker processes, all of them started from the command line."""
    (tmp_path / "dask").mkdir()
    with closing(Outside(tmp_path / "dask")) as outside:
        outside.start_worker("--nworkers", "2")
        yield outside.address


@pytest.mark.slow
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


def wait_for_rows(store: Path, process: subprocess.Popen) -> int:
    while not (rows := rows_on_disk(store)) and process.poll() is None:
        time.sleep(0.02)
    assert rows, "nothing was written before the end"
    return rows


@pytest.mark.parametrize("end", [pytest.param(s, marks=pytest.mark.slow) for s in (signal.SIGKILL, signal.SIGINT)])
def test_a_client_killed_half_way_is_resumed(link_study, tmp_path, start_sweep, sweep, long_reference, end):
    store = tmp_path / "s.zarr"
    process = start_sweep("run", link_study, "-o", store, *LONG, start_new_session=True)
    wait_for_rows(store, process)
    (os.killpg if end == signal.SIGINT else os.kill)(process.pid, end)  # Ctrl-C in a terminal reaches the workers too
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == (130 if end == signal.SIGINT else -signal.SIGKILL), err
    if end == signal.SIGINT:
        assert "goes on from there" in err
        assert "Traceback" not in err
        assert xr.open_zarr(store).attrs["complete"] == 0

    code, _, err = sweep("run", link_study, "-o", store, *LONG)
    assert code == 0, err
    assert "in the store already" in err or "part of the realisations" in err
    xr.testing.assert_identical(results(store), long_reference)
