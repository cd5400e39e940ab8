"""Addresses at which no Dask scheduler answers are refused in time and by name."""

import socket
import threading
from contextlib import closing, suppress

import pytest
from distributed import LocalCluster

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing import clusters
from linksweep.sweep.executing.clusters import client_at, own_cluster


def test_a_port_that_says_nothing(monkeypatch):
    """Dask's own client would wait for ever."""
    monkeypatch.setattr(clusters, "CONNECT_TIMEOUT_S", 1)
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        address = "tcp://{}:{}".format(*server.getsockname())
        with (
            pytest.raises(SweepError, match=f"no Dask scheduler answers at '{address}' within 1 s$"),
            client_at(address),
        ):
            pass


def test_a_server_of_another_kind_that_speaks_first():
    def speak(server):
        with suppress(OSError), server.accept()[0] as connection:
            connection.sendall(b"SSH-2.0-OpenSSH_9.2p1 Debian-2\r\n" * 10)
            connection.recv(1)

    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        address = "tcp://{}:{}".format(*server.getsockname())
        threading.Thread(target=speak, args=(server,), daemon=True).start()
        with pytest.raises(SweepError, match=f"no Dask scheduler answers at '{address}'"), client_at(address):
            pass


def test_the_address_of_a_worker():
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": True, "protocol": "tcp://"}
    with own_cluster(LocalCluster, options) as cluster:
        (worker,) = cluster.scheduler_info["workers"]
        with pytest.raises(SweepError, match=f"'{worker}' is the address of a Dask worker"), client_at(worker):
            pass


@pytest.mark.parametrize("address", ["host", "nonsense://x:1", "tcp://"])
def test_what_is_no_address(address):
    with pytest.raises(SweepError, match=r"expected tcp://HOST:PORT"), client_at(address):
        pass
