"""Runs on a Dask client of the user's, which stays as it was."""

import asyncio
import re
import time
from contextlib import closing

import numpy as np
import pytest
from distributed import Client, LocalCluster

import linksweep
from linksweep import SweepError
from linksweep.sweep.executing.pools import Resources
from tests.sweep.opening import same
from tests.sweep.outside import Outside, wait_until

AXES = {"x": [0.1 * k for k in range(40)]}


@pytest.fixture(params=["threads", pytest.param("processes", marks=pytest.mark.slow)])
def client(request):
    """A client of a cluster that it has started."""
    processes = request.param == "processes"
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=processes, dashboard_address=None) as cluster,
        cluster.get_client() as client,
    ):
        yield client


def test_a_client_computes_the_same_bits_and_goes_on_to_work(client, tmp_path):
    scale = 3.0

    def noise(x: float, rng):
        """Known to this process alone: it travels by value."""
        return scale * x + rng.normal()

    sampling = {"n_sim": 30, "seed": 4}
    here = linksweep.run(noise, tmp_path / "here.zarr", axes=AXES, sampling=sampling, pool="serial")
    before = client.submit(np.sqrt, 4.0)
    there = linksweep.run(noise, tmp_path / "there.zarr", axes=AXES, sampling=sampling, client=client)
    same(here, there)
    assert (client.status, before.result(), client.submit(np.sqrt, 9.0).result()) == ("running", 2.0, 3.0)


def test_an_interrupted_run_leaves_no_tasks_with_the_client(client, tmp_path):
    def fails(x: float):
        time.sleep(0.02)
        raise ValueError(x)

    with pytest.raises(SweepError, match="stopped"):
        linksweep.run(fails, tmp_path / "s.zarr", axes=AXES, client=client, max_failures=1)
    wait_until(lambda: not any(client.processing().values()), "the end of its tasks")
    assert client.submit(np.sqrt, 9.0).result() == 3.0


@pytest.mark.slow
def test_a_client_of_a_scheduler_elsewhere_is_as_its_address(link_study, tmp_path, reference):
    with closing(Outside(tmp_path)) as outside:
        outside.start_worker()
        with Client(outside.address, set_as_default=False, timeout=2) as client:
            linksweep.run(link_study, tmp_path / "s.zarr", client=client)
            assert client.status == "running"
            outside.kill(outside.scheduler)
            wait_until(lambda: client.status != "running", "the client to notice")
            with pytest.raises(SweepError, match="that is connected"):
                linksweep.run(link_study, tmp_path / "t.zarr", client=client)
    same(tmp_path / "s.zarr", reference)


@pytest.mark.parametrize(
    ("others", "says"),
    [
        ({"workers": 2}, "workers, client: these are of different places"),
        ({"pool": "serial", "scheduler": "tcp://a:1"}, "pool, client, scheduler: these are of different places"),
        ({"cluster": "a.toml"}, "client, cluster: these are of different places"),
        ({"dashboard": True}, "dashboard, client: these are of different places"),
        ({"client": None, "workers": 2, "scheduler": "tcp://a:1"}, "workers, scheduler: these are of different places"),
        ({"client": "tcp://a:1"}, "client = 'tcp://a:1': must be a distributed.Client that is connected"),
    ],
)
def test_what_is_no_place_to_run_on_is_refused(others, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SweepError, match=re.escape(says)):
        linksweep.run(lambda x: x, "s.zarr", axes={"x": [1.0]}, **{"client": 5, **others})
    assert not list(tmp_path.iterdir())


def test_an_asynchronous_or_closed_client_is_refused(client):
    async def use():
        async with Client(client.scheduler.address, asynchronous=True, set_as_default=False) as other:
            with pytest.raises(SweepError, match="without asynchronous=True"):
                Resources(client=other)

    asyncio.run(use())
    with Client(client.scheduler.address, set_as_default=False) as other:
        pass
    with pytest.raises(SweepError, match="which is closed: must be"):
        Resources(client=other)
