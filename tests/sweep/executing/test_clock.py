"""A clock that is set back: durations are measured with another one, and Dask's streams are woken."""

import sys
import time
from concurrent.futures import TimeoutError as NotYetError

import numpy as np
import pytest
import xarray as xr
from distributed import LocalCluster

from sweep.executing.choose import Resources
from sweep.executing.clock import STEP_S, Clock, wake
from sweep.executing.local_cluster import own_cluster
from sweep.running.run import run_study
from sweep.studies.reader import load_study

REAL = time.time


@pytest.fixture
def set_clock_back(monkeypatch):
    """A function that sets the clock back by so much, after so many seconds, for all that has been imported."""

    def set_back(by_s, after_s=0.0):
        begun = time.monotonic()

        def changed():
            return REAL() - (by_s if time.monotonic() - begun >= after_s else 0.0)

        monkeypatch.setattr("time.time", changed)
        for module in [m for name, m in sys.modules.items() if name.startswith("distributed")]:
            if getattr(module, "time", None) is REAL:
                monkeypatch.setattr(module, "time", changed)

    return set_back


@pytest.mark.parametrize(
    ("back_s", "after_s"), [(1e6, 0.2), *(pytest.param(*p, marks=pytest.mark.slow) for p in ((1e9, 0.4), (5.0, 0.6)))]
)
def test_a_run_goes_on_with_the_same_bits(link_study, tmp_path, set_clock_back, back_s, after_s):
    study = load_study(str(link_study), ["n_cat=15"])
    straight, _ = run_study(study, tmp_path / "straight.zarr", Resources(pool="serial"))
    set_clock_back(back_s, after_s)
    back, _ = run_study(study, tmp_path / "back.zarr", Resources(workers=2, pool="threads"))
    xr.testing.assert_identical(straight.drop_attrs(), back.drop_attrs())
    assert np.all(back["status"] == 1)


def test_a_step_back_is_noticed_once(set_clock_back):
    clock = Clock()
    assert not clock.was_set_back()
    set_clock_back(10 * STEP_S)
    assert clock.was_set_back()
    assert not clock.was_set_back()
    set_clock_back(0.0)  # forward again
    assert not clock.was_set_back()


@pytest.mark.slow
@pytest.mark.parametrize("whose", ["client", "scheduler to worker", "scheduler to client", "worker"])
def test_a_stream_that_waits_for_another_day_is_woken(whose):
    """Each stream is brought into the state in which a clock that is set back leaves it."""
    options = {"n_workers": 1, "processes": False}
    with own_cluster(LocalCluster, options) as cluster, cluster.get_client() as client:
        client.submit(abs, -1).result(timeout=10)
        (worker,) = cluster.workers.values()
        streams = {
            "client": [client.scheduler_comm],
            "scheduler to worker": cluster.scheduler.stream_comms.values(),
            "scheduler to client": cluster.scheduler.client_comms.values(),
            "worker": [worker.batched_stream],
        }[whose]
        time.sleep(0.1)  # what is left of the last message
        for stream in streams:
            stream.next_deadline = time.time() + 1e6
        future = client.submit(abs, -2)
        with pytest.raises((TimeoutError, NotYetError)):
            future.result(timeout=0.5)
        wake(client)
        assert future.result(timeout=10) == 2
