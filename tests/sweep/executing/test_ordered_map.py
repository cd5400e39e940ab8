"""Pieces of work on the workers of a scheduler: these are asked who they are before they get any."""

import pytest
from distributed import Client
from distributed.comm import CommClosedError

from sweep.contract import SweepError
from sweep.executing.local_cluster import local_cluster
from sweep.executing.ordered_map import ordered_map
from tests.patience import PATIENCE_S

GONE = "tcp://127.0.0.1:9"


@pytest.fixture(scope="module")
def cluster():
    with local_cluster({"n_workers": 1, "threads_per_worker": 1, "processes": True}) as cluster:
        yield cluster


def answering(monkeypatch, lost):
    """Let workers whose addresses ``lost`` names answer with what Dask says of a connection that is closed."""

    def run(client, *arguments, real=Client.run, **options):
        return real(client, *arguments, **options) | {worker: CommClosedError("closed") for worker in lost(client)}

    monkeypatch.setattr(Client, "run", run)


def doubled(cluster):
    with ordered_map(None, cluster.scheduler_address, "core.experiment:link") as mapped:
        return list(mapped(pow, [(2, n) for n in range(5)]))


def test_a_worker_that_goes_while_it_is_asked_is_not_missed(cluster, monkeypatch):
    answering(monkeypatch, lambda client: [GONE])
    assert doubled(cluster) == [1, 2, 4, 8, 16]


def test_no_worker_is_left_once_they_have_been_asked(cluster, monkeypatch):
    """Workers are there when they are asked, and gone when they are counted again."""
    counts = iter([{GONE: 1}, {}, {}, {}])
    monkeypatch.setattr(
        Client, "run", lambda *_, workers, **__: {worker: CommClosedError("closed") for worker in workers}
    )
    monkeypatch.setattr(Client, "nthreads", lambda _client: next(counts))
    with pytest.raises(SweepError, match="has no workers"):
        doubled(cluster)


def test_one_that_joins_while_others_are_asked_is_asked_too(cluster, monkeypatch):
    calls = []

    def run(client, *arguments, workers, real=Client.run, **options):
        calls.append(workers)
        if len(calls) == 1:
            cluster.scale(2)
            client.wait_for_workers(2, PATIENCE_S)
        return real(client, *arguments, workers=workers, **options)

    monkeypatch.setattr(Client, "run", run)
    assert doubled(cluster) == [1, 2, 4, 8, 16]
    first, second = calls
    assert len(first) == len(second) == 1
    assert first != second


def test_one_that_is_there_and_does_not_answer_is_refused(cluster, monkeypatch):
    answering(monkeypatch, lambda client: list(client.nthreads()))
    with pytest.raises(SweepError, match="CommClosedError: closed"):
        doubled(cluster)
