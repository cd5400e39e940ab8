"""What is not the experiment's fault is tried again, and never written against a point."""

import pytest
import xarray as xr
from distributed import KilledWorker, LocalCluster

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing import dask_driver
from linksweep.sweep.executing.clusters import own_cluster
from linksweep.sweep.executing.dask_driver import DaskDriver, run_on_worker
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.studies.reader import study_from_dict
from tests.sweep.opening import Silent, existing_store, run_study
from tests.tiers import slow


@pytest.fixture(scope="module")
def dask():
    """Workers of Dask that are threads of this process, where functions can be replaced."""
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "protocol": "tcp://"}
    with own_cluster(LocalCluster, options) as cluster:
        yield Resources(scheduler=cluster.scheduler_address)


class Sentences(Silent):
    """Keeps what is said."""

    def __init__(self):
        self.said = []

    def say(self, text):
        self.said.append(text)


@pytest.fixture
def study(coins):
    return study_from_dict(coins)


@pytest.fixture
def whole(study, tmp_path):
    """The results of a run that nothing disturbed."""
    return run_study(study, tmp_path / "whole.zarr", Resources(pool="serial"))[0].drop_vars("wall_time").drop_attrs()


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch):
    monkeypatch.setattr(dask_driver, "PAUSE_S", 1e-3)


FAILURES_LEFT = {0: 0}


def failing(*arguments, **options):
    """Fail on a worker, beside the experiment, as Dask did under load; some times, and then no more."""
    FAILURES_LEFT[0] -= 1
    if FAILURES_LEFT[0] >= 0:
        raise UnboundLocalError("cannot access local variable 'result'")
    return run_on_worker(*arguments, **options)


def test_an_error_inside_dask_is_no_points(study, whole, tmp_path, monkeypatch, dask):
    monkeypatch.setattr(dask_driver, "run_on_worker", failing)
    monkeypatch.setitem(FAILURES_LEFT, 0, 4)
    sentences = Sentences()
    dataset, failures = run_study(study, tmp_path / "s.zarr", dask, sentences)
    assert not failures
    xr.testing.assert_identical(dataset.drop_vars("wall_time").drop_attrs(), whole)
    assert any("UnboundLocalError: cannot access local variable 'result'" in text for text in sentences.said)


def test_one_that_stays_stops_the_run_and_blames_no_point(study, whole, tmp_path, monkeypatch, dask):
    monkeypatch.setattr(dask_driver, "run_on_worker", failing)
    monkeypatch.setitem(FAILURES_LEFT, 0, 10**6)
    with pytest.raises(SweepError, match=r"failed 6 times outside of the experiment, last with UnboundLocalError"):
        run_study(study, tmp_path / "s.zarr", dask)
    assert not existing_store(tmp_path / "s.zarr", study).failures
    monkeypatch.undo()
    dataset, failures = run_study(study, tmp_path / "s.zarr", dask)
    assert not failures
    xr.testing.assert_identical(dataset.drop_vars("wall_time").drop_attrs(), whole)


@pytest.fixture
def one_by_one(monkeypatch):
    """Fetch each result by itself, as where several cannot be fetched together."""
    monkeypatch.setattr(dask_driver, "MOST_FETCHED", 1)


@pytest.mark.usefixtures("one_by_one")
@pytest.mark.parametrize(
    "fate", [UnboundLocalError("result"), slow(TimeoutError("of a stream")), slow(OSError("Too many open files"))]
)
def test_errors_of_fetching_a_result_are_no_points(study, whole, tmp_path, monkeypatch, fate, dask):
    fetch, calls = DaskDriver._result, []

    def fetched(self, future):
        calls.append(future)
        if len(calls) <= 3:  # fewer than a task may fail
            raise fate
        return fetch(self, future)

    monkeypatch.setattr(DaskDriver, "_result", fetched)
    dataset, failures = run_study(study, tmp_path / "s.zarr", dask)
    assert not failures
    xr.testing.assert_identical(dataset.drop_vars("wall_time").drop_attrs(), whole)


@pytest.mark.usefixtures("one_by_one")
@pytest.mark.slow
def test_where_all_workers_die_no_point_is_blamed(study, tmp_path, monkeypatch, dask):
    def fetched(self, future):
        raise KilledWorker("task", None, 0)

    monkeypatch.setattr(DaskDriver, "_result", fetched)
    sentences = Sentences()
    with pytest.raises(SweepError, match="die whatever they do; no point is blamed"):
        run_study(study, tmp_path / "s.zarr", dask, sentences)
    assert any("a worker died" in text for text in sentences.said)
    assert not existing_store(tmp_path / "s.zarr", study).failures
