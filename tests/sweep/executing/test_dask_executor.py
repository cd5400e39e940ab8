"""How an executor talks to a Dask client: what it says to a client that records it."""

import asyncio
import threading
import time
from types import SimpleNamespace

import distributed
import pytest
from distributed.comm import CommClosedError

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing import dask_driver
from linksweep.sweep.executing.dask_driver import MAX_ATTEMPTS, MOST_FETCHED, MOST_SENT, DaskDriver, DaskWorkers
from linksweep.sweep.executing.dask_worker import Answer
from linksweep.sweep.executing.executor import of_study
from linksweep.sweep.executing.pools import NO_LIMITS
from linksweep.sweep.executing.task import failed
from linksweep.sweep.executing.versions import identity
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.checked_grid import make_grid
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.planning.work_queue import Pending
from linksweep.sweep.studies.reader import study_from_dict

STUDY = {
    "title": "t",
    "experiment": "tests.sweep.coins:experiment",
    "axes": {"coins": list(range(1, 301))},
    "sampling": {"n_sim": 1, "seed": 1},
}


class Ended:
    """A future that has ended well."""

    status = "finished"

    def __init__(self, works):
        self.answer = Answer("somewhere", [], [], failed(len(works)))

    def add_done_callback(self, call):
        call(self)

    def release(self):
        pass


class Client:
    """What a client of 32 threads would do at once."""

    status = "running"

    def __init__(self, refusals=0, unable_to_gather=False, threads=32):
        self.refusals, self.unable_to_gather, self.threads = refusals, unable_to_gather, threads
        self.sent, self.gathered, self.enough_s = [], [], set()

    def register_plugin(self, plugin):
        if self.refusals:
            self.refusals -= 1
            raise CommClosedError("a worker has gone")

    def scheduler_info(self):
        return {"address": "inproc://x"}

    def nthreads(self):
        return {"somewhere": self.threads}

    def submit(self, function, *arguments, **options):
        return Ended([None])

    def run(self, function, *arguments, **options):
        reference = STUDY["experiment"]
        return {"somewhere": identity(reference), "gone": CommClosedError("a worker has gone")}

    def map(self, function, tasks, **options):
        self.sent.append(len(tasks))
        self.enough_s |= {task.enough_s for task in tasks}
        return [Ended(task.units) for task in tasks]

    async def gather(self, futures, asynchronous):
        if self.unable_to_gather and len(futures) > 1:
            raise RuntimeError("one of them is lost")
        self.gathered.append(len(futures))
        return [future.answer for future in futures]


@pytest.fixture
def loop():
    """An event loop that runs in a thread, as that of a client does."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield SimpleNamespace(asyncio_loop=loop)
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


@pytest.fixture
def run(monkeypatch, loop):
    """Run the study with a client; returns the numbers of points of the results."""
    monkeypatch.setattr(time, "sleep", lambda seconds: None)

    def with_client(client):
        client.loop = loop
        study = study_from_dict(STUDY)
        plan = Plan(make_grid(study))
        pending = Pending(plan, Accumulator(plan))
        workers = DaskWorkers(client, "a client", study.experiment_reference, print)
        workers.prepare()
        return [len(works) for works, _ in of_study(study, DaskDriver(workers, NO_LIMITS))(pending.take)]

    return with_client


def test_tasks_are_sent_and_results_fetched_many_at_a_time(run):
    client = Client()
    assert sum(run(client)) == 300
    assert sum(client.sent) == 300
    assert max(client.sent) <= MOST_SENT
    assert len(client.sent) < 30
    assert sum(client.gathered) == 300
    assert len(client.gathered) < 30
    assert max(client.gathered) <= MOST_FETCHED


@pytest.mark.parametrize(("threads", "enough_s"), [(32, 0.0), (1000, 10.0)])
def test_on_many_threads_a_task_may_take_longer(run, threads, enough_s):
    """So that no more come in than a scheduler and a client can handle."""
    client = Client(threads=threads)
    assert sum(run(client)) == 300
    assert client.enough_s == {enough_s}


def test_results_that_cannot_be_fetched_together_are_fetched_one_by_one(run):
    client = Client(unable_to_gather=True)
    assert sum(run(client)) == 300
    assert client.gathered == [1] * 300


def test_a_worker_that_goes_while_it_is_told_of_the_run_stops_nothing(run):
    assert sum(run(Client(refusals=2))) == 300


def test_nothing_but_workers_that_go_stops_it(run):
    with pytest.raises(SweepError, match="a worker has gone"):
        run(Client(refusals=MAX_ATTEMPTS))


@pytest.mark.slow
def test_results_are_fetched_where_the_client_stands_still_for_longer_than_it_is_looked_after(monkeypatch):
    """Dask had ended what was to be fetched before it began, and the client could fetch nothing from then on."""
    monkeypatch.setattr(dask_driver, "LOOK_EVERY_S", 0.02)
    monkeypatch.setattr(DaskWorkers, "look", lambda self: None)  # it takes the same client
    done = threading.Event()
    with distributed.Client(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as client:
        workers = DaskWorkers(client, "a worker", STUDY["experiment"], print)
        future = client.submit(abs, -3)
        distributed.wait(future)

        def stand_still():
            time.sleep(0.05)
            if not done.is_set():
                client.loop.add_callback(stand_still)

        client.loop.add_callback(stand_still)
        try:
            assert workers.result(future) == 3
        finally:
            done.set()
