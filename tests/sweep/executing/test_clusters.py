"""Clusters that a file describes, and addresses at which no Dask scheduler answers."""

import os
import signal
import socket
import threading
from contextlib import closing, suppress

import pytest
from distributed import LocalCluster

from linksweep import SweepError
from linksweep.sweep.executing import clusters, pools
from linksweep.sweep.executing.clusters import client_at, own_cluster
from linksweep.sweep.executing.pools import Resources
from tests.sweep.opening import same
from tests.sweep.outside import command_of, workers_below
from tests.tiers import slow

LOCAL = 'class = "distributed.LocalCluster"\n'
WORKERS = "[options]\nn_workers = 0\nthreads_per_worker = 1\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("two.toml", LOCAL + "scale = 2\n" + WORKERS),
        ("threads.toml", LOCAL + "adapt = { minimum = 1, maximum = 2 }\n" + WORKERS + "processes = false\n"),
        ("a.yaml", "class: distributed.LocalCluster\nadapt: { minimum: 0, maximum: 2 }\noptions: { n_workers: 0 }\n"),
    ],
)
def test_a_study_runs_on_the_cluster_of_a_file(link_study, tmp_path, sweep, reference, name, text):
    (tmp_path / name).write_text(text)
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", "--cluster", tmp_path / name, cwd=tmp_path)
    assert code == 0, err
    assert f"on the LocalCluster of {tmp_path / name}" in err
    assert "distributed" not in err
    same(tmp_path / "s.zarr", reference)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([name, "s.zarr", "small.toml"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "class = "),
        ("class = 1\nscale = 1\n", "class = 1: "),
        ('class = "LocalCluster"\nscale = 1\n', "class = 'LocalCluster': "),
        ('class = "distributed.NoCluster"\nscale = 1\n', "has no attribute 'NoCluster'"),
        ('class = "distributed.Client"\nscale = 1\n', "is no class of a Dask cluster"),
        (LOCAL, "write either scale = WORKERS or adapt"),
        (LOCAL + "scale = 0\n", "scale.n = 0: "),
        slow(LOCAL + "scale = { dwarfs = 7 }\n", "unexpected keyword argument 'dwarfs'"),
        (LOCAL + "adapt = { minimum = 1 }\n", "adapt: must say a maximum"),
        (LOCAL + "adapt = { minimum = 3, maximum = 2 }\n", "minimum = 3 must be at most maximum = 2"),
        (LOCAL + "adapt = { maximum = 2, pace = 3 }\n", "unknown key adapt.pace"),
        (LOCAL + "scale = 1\noptions = 3\n", "options = 3: "),
        (LOCAL + "scale = 1\nscales = 1\n", "unknown key scales"),
        slow(LOCAL + 'scale = 1\n[options]\nhost = "1.2.3.4"\n', "distributed.LocalCluster: "),
        ("scale = = 1\n", "not valid TOML"),
    ],
)
def test_what_is_wrong_in_a_file_is_told_and_nothing_written(link_study, tmp_path, sweep_here, text, says):
    path = tmp_path / "cluster.toml"
    path.write_text(text)
    code, _, err = sweep_here("run", link_study, "-o", tmp_path / "s.zarr", "--cluster", path, cwd=tmp_path)
    assert code == 2, err
    assert err.startswith(f"error: {path}: "), err
    assert says in err
    assert "Traceback" not in err
    assert "distributed." not in err.replace("distributed.LocalCluster", "").replace("'distributed.", "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cluster.toml", "small.toml"]


def test_contradictions_are_refused(link_study, tmp_path, sweep_here):
    (tmp_path / "c.toml").write_text(LOCAL + "scale = 1\n")
    for more in ("--scheduler tcp://a:1", "--workers 2", "--memory-limit 2GB", "--time-limit 0", "--tls-ca c.toml"):
        asked = ("run", link_study, "-o", "s.zarr", "--cluster", "c.toml", *more.split())
        code, _, err = sweep_here(*asked, cwd=tmp_path)
        assert (code, "error: " in err) == (2, True), more
    assert not (tmp_path / "s.zarr").exists()


class Interrupted(LocalCluster):
    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.slow
def test_an_interrupted_start_leaves_no_process_in_a_session():
    with pytest.raises(KeyboardInterrupt), own_cluster(Interrupted, {"n_workers": 1, "threads_per_worker": 1}):
        pass
    assert not [pid for pid in workers_below(os.getpid()) if "spawn_main" in command_of(pid)]


def test_a_dashboard_is_of_local_worker_processes_and_needs_bokeh(monkeypatch):
    for wished in ({"pool": "serial"}, {"pool": "threads"}, {"scheduler": "tcp://a:1"}):
        with pytest.raises(SweepError, match=r"a dashboard is for local|dashboard, scheduler: these are of"):
            Resources(**wished, dashboard=True)
    monkeypatch.setattr(pools, "find_spec", lambda name: None)
    with pytest.raises(SweepError, match=r"`pip install 'linksweep\[report\]'`"):
        Resources(dashboard=True)


@pytest.mark.parametrize("speaks", [False, True])
def test_a_port_that_says_nothing_or_is_of_a_server_of_another_kind(monkeypatch, speaks):
    """Dask's own client would wait for ever."""
    monkeypatch.setattr(clusters, "CONNECT_TIMEOUT_S", 1)

    def speak(server):
        with suppress(OSError), server.accept()[0] as connection:
            connection.sendall(b"SSH-2.0-OpenSSH_9.2p1 Debian-2\r\n" * 10)
            connection.recv(1)

    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        address = "tcp://{}:{}".format(*server.getsockname())
        if speaks:
            threading.Thread(target=speak, args=(server,), daemon=True).start()
        with pytest.raises(SweepError, match=f"no Dask scheduler answers at '{address}'"), client_at(address):
            pass


@pytest.mark.parametrize("address", ["host", "nonsense://x:1", "tcp://"])
def test_what_is_no_address(address):
    with pytest.raises(SweepError, match=r"expected tcp://HOST:PORT"), client_at(address):
        pass
