"""Pieces of work on the workers of a scheduler: these are asked who they are before they get any."""

import time

import pytest
from distributed import Client
from distributed.comm import CommClosedError

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing import ordered_map, versions
from linksweep.sweep.executing.local_cluster import local_cluster
from tests.patience import PATIENCE_S

EXPERIMENT = "linksweep.core.experiment:link"
ONE = {"n_workers": 1, "threads_per_worker": 1, "processes": True, "protocol": "tcp://"}


@pytest.fixture(scope="module")
def cluster():
    with local_cluster(ONE) as cluster:
        yield cluster


def doubled(cluster, pieces=5):
    with ordered_map.ordered_map(None, cluster.scheduler_address, EXPERIMENT) as mapped:
        return list(mapped(pow, [(2, n) for n in range(pieces)]))


def let_versions_be_others():
    versions.version_of = lambda name: "0.1"


def test_a_worker_that_goes_while_it_is_asked_is_not_missed(cluster, monkeypatch):
    """It answers with what Dask says of a connection that is closed."""
    gone = {"tcp://127.0.0.1:9": CommClosedError("closed")}
    monkeypatch.setattr(Client, "run", lambda *given, real=Client.run, **options: real(*given, **options) | gone)
    assert doubled(cluster) == [1, 2, 4, 8, 16]


def test_no_worker_is_left_once_they_have_been_asked(cluster, monkeypatch):
    monkeypatch.setattr(Client, "nthreads", lambda _client: {})
    with pytest.raises(SweepError, match="has no workers"):
        doubled(cluster)


def test_one_that_joins_later_is_compared_too(monkeypatch):
    with local_cluster(ONE) as cluster:

        def run(client, *arguments, real=Client.run, **options):
            answers = real(client, *arguments, **options)
            cluster.scale(2)
            client.wait_for_workers(2, PATIENCE_S)
            (joined,) = client.nthreads().keys() - answers.keys()
            real(client, let_versions_be_others, workers=[joined])
            return answers

        monkeypatch.setattr(Client, "run", run)
        with pytest.raises(SweepError, match=r"tcp://.*: numpy is .* here, 0\.1 there"):
            doubled(cluster, 20)


def test_without_workers_it_does_not_wait_for_ever(cluster, monkeypatch):
    monkeypatch.setattr(ordered_map, "LOOK_EVERY_S", 0.1)
    monkeypatch.setattr(ordered_map, "WITHOUT_WORKERS_S", 0.5)
    with ordered_map.ordered_map(None, cluster.scheduler_address, EXPERIMENT) as mapped:
        results = mapped(time.sleep, [(0.0,), (5.0,)])
        next(results)
        monkeypatch.setattr(Client, "nthreads", lambda _client: {})
        with pytest.raises(SweepError, match="the workers have gone"):
            next(results)


def test_a_scheduler_that_goes_is_told():
    with local_cluster(ONE) as own, ordered_map.ordered_map(None, own.scheduler_address, EXPERIMENT) as mapped:
        results = mapped(time.sleep, [(0.0,), *[(1.0,)] * 5])
        next(results)
        own.close()
        with pytest.raises(SweepError, match="the connection to the Dask scheduler is lost"):
            list(results)
