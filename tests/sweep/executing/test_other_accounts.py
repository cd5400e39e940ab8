"""What another account of this machine, as real processes, can do with what a run listens on: nothing."""

import json
import os
import subprocess
import sys
import tempfile

import pytest
from distributed import LocalCluster

from linksweep.sweep.executing.clusters import own_cluster
from linksweep.sweep.executing.executor import mapped
from linksweep.sweep.executing.pools import Resources
from tests.sweep.outside import below, listening, unix_sockets, wait_until
from tests.tiers import PATIENCE_S

NOBODY = 65534
CLUSTERS = ['class = "distributed.LocalCluster"\nscale = 1\n[options]\nn_workers = 0\n']
CLUSTERS += ['class = "dask_jobqueue.local.LocalCluster"\nscale = 1\n[options]\ncores = 1\nmemory = "1GB"\n']
pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root has other accounts")
ATTACK = r"""
import asyncio, json, os, pickle, socket, sys
from contextlib import suppress
from urllib.request import urlopen
from distributed import Client, Security
from distributed.comm import connect
account, ports, sockets, folders = json.loads(sys.argv[1])
OWN = Security.temporary()
"name".encode("idna")  # imported before this account may read nothing of Python any more
os.setgroups([])
os.setgid(account)
os.setuid(account)
TRIES_S = 20
PAGES = ("", "status", "health", "info/main/workers.html", "json/counts.json")
got = []
async def ask(address, security):
    comm = await connect(address, timeout=TRIES_S, **(security or Security()).get_connection_args("client"))
    try:
        await comm.write({"op": "run", "reply": True, "function": pickle.dumps(os.getuid), "wait": True})
        return await comm.read()
    finally:
        comm.abort()
async def run(address, security):
    async with Client(address, timeout=TRIES_S, security=security, asynchronous=True) as client:
        return await client.run(os.getuid)
async def tried(what, attempt):
    with suppress(Exception):
        got.append(f"{what}: {await asyncio.wait_for(attempt, TRIES_S)}"[:300])
def opened(port, page):
    with urlopen(f"http://127.0.0.1:{port}/{page}", timeout=TRIES_S) as answer:
        return answer.read()[:100]
async def everything():
    attempts = []
    for port in ports:
        for protocol, security in (("tcp", None), ("tls", OWN)):
            address = f"{protocol}://127.0.0.1:{port}"
            attempts += [tried(f"client of {address}", run(address, security))]
            attempts += [tried(f"run at {address}", ask(address, security))]
        attempts += [tried(f"page {page!r} of {port}", asyncio.to_thread(opened, port, page)) for page in PAGES]
    await asyncio.gather(*attempts)
asyncio.run(everything())
for name in sockets:
    with suppress(Exception), socket.socket(socket.AF_UNIX) as end:
        end.connect(name.replace("@", "\0", 1))
        got.append(f"socket {name}")
for file in (os.path.join(folder, name) for root in folders for folder, _, files in os.walk(root) for name in files):
    with suppress(Exception), open(file, "rb") as opened:
        opened.read()
        got.append(f"file {file}")
print(json.dumps(got), flush=True)
os._exit(0)  # threads may wait for answers for ever
"""


def what_others_get(folders=(), pid=None, but=()):
    """Return what another account gets from folders and all that a process and those below it listen on, but ports."""
    pid = pid or os.getpid()
    family = {pid, *below(pid)}
    ports = sorted({port for _, port in listening(family)} - set(but))
    command = [sys.executable, "-c", ATTACK, json.dumps((NOBODY, ports, unix_sockets(family), folders))]
    done = subprocess.run(command, cwd="/", stdout=subprocess.PIPE, text=True, timeout=PATIENCE_S, check=True)
    return ports, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_the_attempts_succeed_where_everybody_is_let_in():
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": True, "protocol": "tcp://"}
    with own_cluster(LocalCluster, options) as cluster, cluster.get_client() as client:
        client.wait_for_workers(1, PATIENCE_S)
        ports, got = what_others_get()
    assert len(ports) >= 3
    assert sum(one.startswith("run at") and f"'result': {os.getuid()}" in one for one in got) >= 2, got
    assert any(one.startswith("client of") for one in got), got


def test_worker_processes_let_nobody_in(monkeypatch):
    before = {port for _, port in listening(below(os.getpid()))}
    with tempfile.TemporaryDirectory(prefix="everybody-") as folder:
        os.chmod(folder, 0o777)  # as /tmp is
        monkeypatch.setattr(tempfile, "tempdir", folder)
        with mapped("linksweep.core.experiment:link", Resources(workers=2), print) as run:
            assert list(run(pow, [(2, 3)])) == [8]
            _, got = what_others_get([folder], but=before)
    assert not got


@pytest.mark.slow
@pytest.mark.parametrize("text", CLUSTERS)
def test_a_cluster_of_a_file_runs_nothing_for_others(tmp_path, start_sweep, text):
    (tmp_path / "c.toml").write_text(text)
    (tmp_path / "slow.py").write_text("import time\ndef slow(x: float = 1.0):\n    return time.sleep(1) or x\n")
    run = ("run", "slow.py:slow", "--axis", "x=1:1000:1", "--cluster", "c.toml", "-o", "s.zarr")
    process = start_sweep(*run, cwd=tmp_path)
    try:
        wait_until((tmp_path / "s.zarr").exists, "a store, which is made once there are workers")
        ports, got = what_others_get(pid=process.pid)
    finally:
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE_S)
    assert len(ports) >= 3, err
    assert {one.split()[0] for one in got} <= {"page"}, got
