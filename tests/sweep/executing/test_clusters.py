"""Workers of Dask: of a file's cluster, of a client of the user's, over TLS; and what is no place to run on."""

import asyncio
import enum
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress
from decimal import Context, Decimal, localcontext
from functools import partial
from itertools import combinations
from types import SimpleNamespace

import dask
import numpy as np
import pytest
import trustme
from distributed import Client, LocalCluster, Status

import linksweep
from linksweep.sweep.executing import clusters, pools
from linksweep.sweep.executing.clusters import client_at, own_cluster
from tests.sweep.opening import rows_on_disk, same
from tests.sweep.outside import Outside, command_of, wait_until, workers_below
from tests.tiers import slow

LOCAL = 'class = "distributed.LocalCluster"\n'
FILES = {  # of a cluster that a study can run on
    "two.toml": LOCAL + "scale = 2\n[options]\nn_workers = 0\nthreads_per_worker = 1\n",
    "threads.toml": LOCAL + "adapt = { minimum = 1, maximum = 2 }\n[options]\nn_workers = 0\nprocesses = false\n",
    "a.yaml": "class: distributed.LocalCluster\nadapt: { minimum: 0, maximum: 2 }\noptions: { n_workers: 0 }\n",
}
AXES = {"x": [0.1 * k for k in range(40)]}
PLACES = {"workers": 2, "pool": "serial", "dashboard": True}
PLACES |= {"client": "tcp://a:1", "scheduler": "tcp://a:1", "cluster": "a.toml"}
PAIRS = [pair for pair in combinations(PLACES, 2) if pair != ("workers", "dashboard")]
SAID = {("pool", "dashboard"): "a dashboard is for local", ("workers", "pool"): "workers = 2: pool serial has none"}
SAID[("client",)] = "client = 'tcp://a:1': must be a distributed.Client that is connected"
WRONG_FILES = [("", "class = "), ("class = 1\nscale = 1\n", "class = 1: "), (LOCAL + "scale = 0\n", "scale = 0: ")]
WRONG_FILES += [('class = "LocalCluster"\nscale = 1\n', "class = 'LocalCluster': ")]
NO_CLUSTER = 'class = "distributed.NoCluster"\n'
WRONG_FILES += [(NO_CLUSTER, "has no attribute 'NoCluster'"), (NO_CLUSTER, "either scale =")]
WRONG_FILES += [('class = "distributed.Client"\nscale = 1\n', "is no class of a Dask cluster")]
WRONG_FILES += [(LOCAL, "write either scale = WORKERS or adapt"), (LOCAL + "scale = 1\noptions = 3\n", "options = 3: ")]
WRONG_FILES += [slow(LOCAL + "scale = { dwarfs = 7 }\n", "unexpected keyword argument 'dwarfs'")]
WRONG_FILES += [(LOCAL + "adapt = { minimum = 1 }\n", "adapt: must say a maximum"), ("scale = = 1\n", "not valid TOML")]
WRONG_FILES += [(LOCAL + "adapt = { maximum = 2, pace = 3 }\n", "unknown key adapt.pace")]
WRONG_FILES += [slow(f"{LOCAL}options.n_workers = 0\nadapt = {{ maximum = 2, target_duration = 'soon' }}", "soon")]
WRONG_FILES += [(f"{LOCAL}scale = 1\noptions.{one}", "options: ") for one in ("n_workers = -1", "asynchronous = true")]
WRONG_FILES += [(LOCAL + "scale = 1\nscales = 1\n", "unknown key scales"), (LOCAL + "scale = true", "valid integer")]


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_study_runs_on_the_cluster_of_a_file(link_study, tmp_path, sweep, reference, name):
    (tmp_path / name).write_text(FILES[name])
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", "--cluster", tmp_path / name, cwd=tmp_path)
    assert (code, f"on the LocalCluster of {tmp_path / name}" in err, "distributed" in err) == (0, True, False), err
    same(tmp_path / "s.zarr", reference)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([name, "s.zarr", "small.toml"])


@pytest.mark.parametrize(("text", "says"), WRONG_FILES)
def test_what_is_wrong_in_a_file_is_told_and_nothing_written(link_study, tmp_path, sweep_here, text, says):
    path = tmp_path / "cluster.toml"
    path.write_text(text)
    code, _, err = sweep_here("run", link_study, "-o", tmp_path / "s.zarr", "--cluster", path, cwd=tmp_path)
    assert (code, err.startswith(f"error: {path}: "), says in err, "Traceback" in err) == (2, True, True, False), err
    assert "distributed." not in err.replace("distributed.LocalCluster", "").replace("'distributed.", "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cluster.toml", "small.toml"]


@pytest.mark.slow
def test_an_interrupted_start_leaves_no_process_in_a_session():
    class Interrupted(LocalCluster):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), own_cluster(Interrupted, {"n_workers": 1, "threads_per_worker": 1}):
        pass
    assert not [pid for pid in workers_below(os.getpid()) if "spawn_main" in command_of(pid)]


@pytest.mark.slow
def test_what_a_cluster_imports_does_not_answer_ctrl_c(tmp_path):
    """dask_jobqueue would end the process; asked for in a new one, since it is imported once."""
    (tmp_path / "cluster.toml").write_text('class = "dask_jobqueue.SLURMCluster"\nscale = 1\n')
    text = "import pathlib, signal; from linksweep.sweep.executing import clusters\n"
    text += "clusters.read_cluster_file(pathlib.Path('cluster.toml'))\n"
    text += "assert signal.getsignal(signal.SIGINT) is signal.default_int_handler"
    subprocess.run([sys.executable, "-c", text], cwd=tmp_path, check=True)


def test_a_dashboard_needs_bokeh(monkeypatch):
    monkeypatch.setattr(pools, "find_spec", lambda name: None)
    with pytest.raises(linksweep.SweepError, match=r"`pip install 'linksweep\[report\]'`"):
        pools.Resources(dashboard=True)


@pytest.mark.parametrize("speaks", [False, True])
def test_a_port_that_says_nothing_or_is_of_a_server_of_another_kind(monkeypatch, speaks):
    monkeypatch.setattr(clusters, "CONNECT_TIMEOUT_S", 0.2)

    def speak(server):
        with suppress(OSError), server.accept()[0] as connection:
            connection.sendall(b"SSH-2.0-OpenSSH_9.2p1 Debian-2\r\n" * 10)
            connection.recv(1)

    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        address = "tcp://{}:{}".format(*server.getsockname())
        if speaks:
            threading.Thread(target=speak, args=(server,), daemon=True).start()
        with pytest.raises(linksweep.SweepError, match=f"no Dask scheduler answers at '{address}'"), client_at(address):
            pass


@pytest.fixture(params=["threads", slow("processes")])
def client(request):
    how = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with LocalCluster(processes=request.param == "processes", **how) as cluster, cluster.get_client() as client:
        yield client


def test_a_client_computes_the_same_bits_and_goes_on_to_work(capfd, client, tmp_path, monkeypatch):
    scale = 3.0

    def noise(x: float, rng):
        """Known to this process alone: it travels by value.  Worker processes of Dask bear what others do."""
        if x == 0.0 and multiprocessing.parent_process():
            signal.raise_signal(signal.SIGINT)
            multiprocessing.Process(target=int).start()
            os.system("echo from outside")
        return scale * x + rng.normal() + float(Decimal(1) / 7)

    sampling = {"n_sim": 30, "seed": 4}
    monkeypatch.setattr(clusters, "REPLACE_EVERY_S", 0.2)
    before, cluster = client.submit(np.sqrt, 4.0), client.cluster
    with dask.config.set({"distributed.deploy.lost-worker-timeout": 0}):  # workers that die often are given up
        [cluster.sync(worker.close) for worker in [*cluster.workers.values()]]
        wait_until(lambda: not cluster.workers, "a cluster that has lost its workers")
    # As where the processes of others died while they started.
    cluster.workers.update(dict.fromkeys(cluster.worker_spec, SimpleNamespace(status=Status.failed)))
    with localcontext(Context(prec=3)):  # which the threads of workers do not have
        here = linksweep.run(noise, tmp_path / "here.zarr", axes=AXES, sampling=sampling, pool="serial")
        there = linksweep.run(noise, tmp_path / "there.zarr", axes=AXES, sampling=sampling, client=client)
    same(here, there)
    assert "outside" not in capfd.readouterr().out
    with pytest.raises(linksweep.SweepError, match="stopped"):  # a run that is interrupted leaves no tasks with it
        linksweep.run(lambda x: time.sleep(0.02) / x, tmp_path / "s.zarr", axes=AXES, client=client, max_failures=1)
    wait_until(lambda: not any(client.processing().values()), "the end of its tasks")
    assert (client.status, before.result(), client.submit(np.sqrt, 9.0).result()) == ("running", 2.0, 3.0)
    reads = "import linksweep\n@linksweep.experiment(reads=['k.csv'])\ndef f(x: int):\n    return x\n"
    (tmp_path / "m.py").write_text(reads)
    for n in (1, 2):  # as where a cell is executed again: workers get the same code anew, with its class
        (tmp_path / "k.csv").write_text(str(n))  # which is for them as it is now
        linksweep.run(f"{tmp_path}/m.py:f", tmp_path / "m", axes={"x": [n]}, client=client, fresh=True)
        members = list(enum.Enum("Kind", "RED BLUE"))
        axes = {"k": members, "x": range(n)}
        ds = linksweep.run(partial(lambda red, k, x: k is red, members[0]), tmp_path / "k", axes=axes, client=client)
    assert ds.result.values.tolist() == [[True] * 2, [False] * 2]


@pytest.mark.slow
def test_a_client_of_a_scheduler_elsewhere_is_as_its_address(link_study, tmp_path, reference):
    rows, axes = partial(rows_on_disk, store := tmp_path / "t.zarr"), {"x": [1, 2, 3]}
    with closing(Outside(tmp_path)) as outside:
        outside.start_worker()
        with Client(outside.address, set_as_default=False, timeout=2) as client:
            linksweep.run(link_study, tmp_path / "s.zarr", client=client)
            threading.Timer(0.0, lambda: wait_until(rows, "a point") and outside.kill(outside.scheduler)).start()
            for words in ("is lost; what was finished is kept", "that is connected"):
                with pytest.raises(linksweep.SweepError, match=words):
                    linksweep.run(lambda x: time.sleep(60 * (x == 2)) or x, store, axes=axes, client=client)
    assert int((linksweep.open(store)["status"] == 1).sum()) == rows()
    same(tmp_path / "s.zarr", reference)


def test_an_asynchronous_or_closed_client_is_refused(client):
    async def use():
        async with Client(client.scheduler.address, asynchronous=True, set_as_default=False) as other:
            with pytest.raises(linksweep.SweepError, match="without asynchronous=True"):
                pools.Resources(client=other)

    asyncio.run(use())
    (other := Client(client.scheduler.address, set_as_default=False)).close()
    with pytest.raises(linksweep.SweepError, match="which is closed: must be"):
        pools.Resources(client=other)


def tls_files(folder):
    folder.mkdir()
    issued = (authority := trustme.CA()).issue_cert("localhost", "127.0.0.1")
    files = {"ca": authority.cert_pem, "cert": issued.cert_chain_pems[0], "key": issued.private_key_pem}
    for name, part in files.items():
        part.write_to_path(str(folder / f"{name}.pem"))
    return [word for name in files for word in (f"--tls-{name}", str(folder / f"{name}.pem"))]


@pytest.mark.slow
def test_a_study_runs_over_tls_and_wrong_certificates_are_refused_in_a_sentence(link_study, tmp_path, sweep, reference):
    files, strangers, rubbish = (tls_files(tmp_path / name) for name in ("tls", "strangers", "rubbish"))
    (tmp_path / "rubbish" / "key.pem").write_text("no key\n")
    (tmp_path / "dask").mkdir()
    with closing(Outside(tmp_path / "dask", "--tls-ca-file", *files[1:], protocol="tls")) as outside:
        outside.start_worker()
        run = ("run", link_study, "-o", tmp_path / "s.zarr", "--scheduler", outside.address)
        wrong = ([], "no certificates for"), (strangers, "certificate verify failed")
        for options, says in (*wrong, (rubbish, "cannot use the TLS files")):
            code, _, err = sweep(*run, *options)
            assert (code, len(err.splitlines()), says in err) == (2, 1, True), err
            assert not (tmp_path / "s.zarr").exists()
        assert f"the Dask scheduler at {outside.address}" in sweep(*run, *files, code=0)[2]
    same(tmp_path / "s.zarr", reference)


@pytest.mark.parametrize("pair", [*PAIRS, ("client",)], ids=" ".join)
def test_two_places_to_run_on_are_refused(pair, here):
    with pytest.raises(linksweep.SweepError, match=SAID.get(pair, "are for different places to run on: leave out one")):
        linksweep.run(lambda x: x, "s.zarr", axes={"x": [1.0]}, **{name: PLACES[name] for name in pair})
    assert not list(here.iterdir())
