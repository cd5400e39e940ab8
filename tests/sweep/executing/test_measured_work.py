"""Work is given out by the time that it takes, whatever the experiment says, and kept soon after it is finished."""

import os
import signal
from pathlib import Path

import pytest
import xarray as xr

from linksweep.sweep.executing import executor, worker
from linksweep.sweep.executing.pools import ANY_RESOURCES, POOLS, Limits, Resources
from linksweep.sweep.stores.store import OpenStore
from linksweep.sweep.studies.reader import study_from_dict
from tests.sweep.opening import Silent, run_study
from tests.sweep.outside import wait_until
from tests.tiers import slow

SLEEPERS = str(Path(__file__).parents[1] / "sleepers.py") + ":experiment"


class Watcher(Silent):
    """Keeps what is said, and how many blocks each task did."""

    def __init__(self):
        self.said, self.blocks = [], []

    def say(self, text):
        self.said.append(text)

    def advance(self, works, result, taken):
        self.blocks.append(len(works))


def _finished(store):
    """Return how many blocks the ledger holds."""
    return len(OpenStore(store).ledger().rows) if (store / "zarr.json").exists() else 0


@pytest.mark.parametrize("pool", [p if p == "threads" else slow(p) for p in POOLS])
def test_what_is_finished_is_kept_though_a_later_block_never_ends(tmp_path, start_sweep, pool):
    """Nothing else comes in that would make it durable, and the end comes without a warning."""
    (tmp_path / "study.toml").write_text(
        f'title = "Sleepers"\nexperiment = "{SLEEPERS}"\nsampling = {{ n_sim = 2 }}\n'
        "axes = { seconds = [0.6, 0.7, 0.8, 3600.0] }\n"
    )
    store = tmp_path / "s.zarr"
    resources = ("--pool", pool) if not POOLS[pool].has_workers else ("--pool", pool, "--workers", 1)
    process = start_sweep("run", tmp_path / "study.toml", "-o", store, *resources, start_new_session=True)
    wait_until(lambda: process.poll() is not None or _finished(store) == 3, "three blocks", 240)
    assert process.poll() is None, process.communicate()[1]
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert _finished(store) == 3


@pytest.mark.parametrize(
    "resources",
    [
        Resources(pool="serial"),
        pytest.param(Resources(pool="serial", limits=Limits(time_s=600)), marks=pytest.mark.slow),
        Resources(pool="threads", workers=2),
    ],
    ids=["serial", "guarded", "threads"],
)
def test_a_task_that_takes_too_long_hands_back_what_it_has(coins, tmp_path, monkeypatch, resources):
    """To the bits of one that does not."""
    study = study_from_dict(coins)
    whole, _ = run_study(study, tmp_path / "whole.zarr", Resources(pool="serial"))
    monkeypatch.setattr(worker, "ENOUGH_S", -1.0)
    monkeypatch.setattr("linksweep.sweep.executing.children.ENOUGH_S", -1.0)
    watcher = Watcher()
    dataset, failures = run_study(study, tmp_path / "s.zarr", resources, watcher)
    assert not failures
    assert set(watcher.blocks) == {1}
    xr.testing.assert_identical(dataset.drop_vars("wall_time").drop_attrs(), whole.drop_vars("wall_time").drop_attrs())


def test_work_that_turns_out_long_moves_to_worker_processes(coins, tmp_path, monkeypatch):
    study = study_from_dict(coins)
    watcher = Watcher()
    whole, _ = run_study(study, tmp_path / "whole.zarr", ANY_RESOURCES, watcher)
    assert watcher.said == []  # short work stays in this process
    monkeypatch.setattr(executor, "WORKERS_START_S", -1.0)
    monkeypatch.setattr(executor, "JUDGED_S", -1.0)
    dataset, failures = run_study(study, tmp_path / "s.zarr", ANY_RESOURCES, watcher)
    assert not failures
    assert any("the rest runs on" in text and "local worker process" in text for text in watcher.said)
    xr.testing.assert_identical(dataset.drop_vars("wall_time").drop_attrs(), whole.drop_vars("wall_time").drop_attrs())
