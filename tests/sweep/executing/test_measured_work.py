"""Work is given out by the time that it takes, and kept soon; what is not the experiment's fault is tried again."""

import os
import signal
import sys
import time
from types import SimpleNamespace

import pytest
from distributed import Client, KilledWorker, LocalCluster

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing import clusters, executor, worker
from linksweep.sweep.executing.clusters import own_cluster, run_on_worker
from linksweep.sweep.executing.pools import ANY_RESOURCES, POOLS, Limits, Resources
from tests.sweep.opening import SERIAL, Sentences, existing_store, live_study, rows_on_disk, run_study, same
from tests.sweep.outside import wait_until
from tests.tiers import slow

GUARDED, THREADS = Resources(pool="serial", limits=Limits(time_s=600)), Resources(pool="threads", workers=2)
LEFT = {"failures": 0}
ERRORS = [UnboundLocalError("result"), slow(TimeoutError("of a stream")), slow(OSError("Too many open files"))]
EXPERIMENT = "linksweep.core.experiment:link"


@pytest.mark.slow
@pytest.mark.parametrize("pool", POOLS)
def test_what_is_finished_is_kept_though_a_later_block_never_ends(tmp_path, start_sweep, pool):
    (tmp_path / "f.py").write_text("import time\ndef f(seconds: float):\n    return time.sleep(seconds) or seconds\n")
    store = tmp_path / "s.zarr"
    resources = ("--pool", pool) if not POOLS[pool].has_workers else ("--pool", pool, "--workers", 1)
    seconds = "0.2,0.3,0.4" if pool == "threads" else "0.6,0.7,0.8"  # of shorter ones a task has several
    run = ("run", tmp_path / "f.py:f", "--axis", f"seconds={seconds},3600", "-o", store)
    process = start_sweep(*run, *resources, start_new_session=True)
    wait_until(lambda: process.poll() is not None or rows_on_disk(store) == 3, "three blocks", 240)
    assert process.poll() is None, process.communicate()[1]
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert rows_on_disk(store) == 3


@pytest.fixture
def study(coins):
    return live_study(coins)


@pytest.mark.parametrize("resources", [SERIAL, slow(GUARDED), THREADS], ids=["serial", "guarded", "threads"])
def test_a_task_that_takes_too_long_hands_back_what_it_has(study, coin_store, tmp_path, monkeypatch, resources):
    monkeypatch.setattr(worker, "ENOUGH_S", -1.0)
    watcher = Sentences()
    dataset, failures = run_study(study, tmp_path / "s.zarr", resources, watcher)
    assert (failures, set(watcher.blocks)) == ({}, {1})
    same(dataset, coin_store)


def test_work_that_turns_out_long_moves_to_worker_processes(study, tmp_path, monkeypatch):
    watcher = Sentences()
    whole, _ = run_study(study, tmp_path / "whole.zarr", ANY_RESOURCES, watcher)
    assert watcher.said == []  # short work stays in this process
    monkeypatch.setattr(executor, "WORKERS_START_S", -1.0)
    monkeypatch.setattr(executor, "JUDGED_S", 0.0)
    dataset, failures = run_study(study, tmp_path / "s.zarr", ANY_RESOURCES, watcher)
    assert not failures
    assert any("the rest runs on" in text and "local worker process" in text for text in watcher.said)
    same(dataset, whole)


@pytest.fixture(scope="module")
def dask():
    """Workers of Dask that are threads of this process, where functions can be replaced."""
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "protocol": "tcp://"}
    with own_cluster(LocalCluster, options) as cluster:
        yield Resources(scheduler=cluster.scheduler_address)


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch):
    monkeypatch.setattr(clusters, "PAUSE_S", 1e-3)


def computing(*arguments, **options):
    """Fail on a worker, beside the experiment, as Dask did under load; some times, and then no more."""
    LEFT["failures"] -= 1
    if LEFT["failures"] >= 0:
        raise UnboundLocalError("cannot access local variable 'result'")
    return run_on_worker(*arguments, **options)


@pytest.fixture
def failing(monkeypatch):
    gather = Client.gather

    def failing(times, error=None):
        monkeypatch.setitem(LEFT, "failures", times)

        async def fetching(*arguments, **options):
            LEFT["failures"] -= 1
            if LEFT["failures"] >= 0:
                raise error
            return await gather(*arguments, **options)

        where = (clusters, "run_on_worker", computing) if error is None else (Client, "gather", fetching)
        monkeypatch.setattr(*where)

    return failing


@pytest.mark.parametrize("error", [None, *ERRORS])
def test_an_error_inside_dask_is_no_points(study, coin_store, tmp_path, dask, failing, monkeypatch, error):
    sentences, register, gone = Sentences(), Client.register_plugin, iter([OSError("a worker left meanwhile")] * 2)

    def registered(*arguments):
        for trouble in gone:
            raise trouble
        register(*arguments)

    monkeypatch.setattr(Client, "register_plugin", registered)
    failing(3 if error else 4, error)
    dataset, failures = run_study(study, tmp_path / "s.zarr", dask, sentences)
    assert not failures
    same(dataset, coin_store)
    assert error or any("UnboundLocalError: cannot access local" in text for text in sentences.said)


@pytest.mark.parametrize("dies", [False, slow(True)])
def test_one_that_stays_stops_the_run_and_blames_no_point(coins, tmp_path, dask, failing, dies):
    sentences, study = Sentences(), live_study(coins | {"axes": {"coins": [5]}, "sampling": {"n_sim": 10}})  # one task
    failing(10**6 if dies else 6, KilledWorker("task", None, 0) if dies else None)
    words = r"failed 6 times outside of the experiment, last with UnboundLocal|die whatever they do; no point is blamed"
    with pytest.raises(SweepError, match=words):
        run_study(study, tmp_path / "s.zarr", dask, sentences)
    assert any("a worker died" in text for text in sentences.said) == dies
    assert not existing_store(tmp_path / "s.zarr", study).failures


def slept(seconds):
    return time.sleep(seconds) or seconds


@pytest.mark.parametrize("resources", [Resources(), Resources(pool="threads", workers=3)], ids=["here", "threads"])
def test_results_come_in_the_order_of_the_pieces(resources):
    seconds = [0.1, 0.0, 0.05, 0.0, 0.0]
    with executor.mapped(EXPERIMENT, resources, print) as run:
        assert list(run(slept, [(one,) for one in seconds])) == seconds
        assert list(run(pow, [])) == []
        with pytest.raises(ZeroDivisionError):
            list(run(divmod, [(1, 1), (1, 0)]))
        with pytest.raises(SystemExit):  # which ends a thread
            list(run(sys.exit, [(3,)]))
        assert list(run(divmod, [(7, 2)])) == [(3, 1)]


def died_once(path, number):
    if number == 3 and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.slow
def test_the_piece_of_a_worker_that_dies_is_computed_by_another_and_limits_hold_for_pieces(tmp_path):
    with executor.mapped(EXPERIMENT, Resources(workers=2), print) as run:
        assert list(run(died_once, [(tmp_path / "died", n) for n in range(8)])) == list(range(8))
    for how in ({"workers": 1}, {"pool": "threads"}, {"pool": "serial"}):
        resources, words = Resources(**how, limits=Limits(time_s=0.5)), r"longer than the time limit of 0\.5 s"
        with pytest.raises(SweepError, match=words), executor.mapped(EXPERIMENT, resources, print) as run:
            list(run(slept, [(60.0,)]))


@pytest.mark.slow
def test_a_point_whose_workers_die_is_blamed_where_others_compute(coins, tmp_path, dask, monkeypatch):
    def dying(task, **options):
        if any(dict(point).get("coins") == 7 for unit in task.units for point in unit.points):
            with (tmp_path / "guarded").open("a") as file:
                file.write(f"{options['guarded']} ")
            raise KilledWorker("task", SimpleNamespace(address="tcp://a:1"), 0)
        return run_on_worker(task, **options | {"guarded": False})

    monkeypatch.setattr(clusters, "run_on_worker", dying)
    more = {"axes": {"coins": [*range(1, 61)]}, "fixed": {}, "sampling": {"n_sim": 10}}
    many = live_study(coins | more)
    _, failures = run_study(many, tmp_path / "s.zarr", dask, Sentences())
    assert (*failures, "its worker died 3 times" in failures["coins=7"]) == ("coins=7", True)
    assert (tmp_path / "guarded").read_text() == "False True True "  # in a child process from the second time on
