"""Worker processes are forked from one that has imported what they need, and cannot tell."""

import os
import subprocess
import sys

import xarray as xr
from distributed import LocalCluster

from sweep.executing.children import ENVIRONMENT, PRELOADED
from sweep.executing.own_cluster import own_cluster

ONE = {"n_workers": 1, "threads_per_worker": 1, "processes": True}


def test_workers_have_the_environment_of_now_and_ours(monkeypatch):
    """Not that of the moment at which the process began that they are forked from."""
    for value in ("first", "second"):
        monkeypatch.setenv("LINKSWEEP_TEST", value)
        with own_cluster(LocalCluster, ONE) as cluster, cluster.get_client() as client:
            [found] = client.run(lambda: dict(os.environ)).values()
        assert found["LINKSWEEP_TEST"] == value
        assert {name: found[name] for name in ENVIRONMENT} == ENVIRONMENT


def test_what_they_are_forked_from_has_no_threads():
    """A lock that another thread holds while a process is forked would never be released in the child."""
    look = f"import os, {', '.join(PRELOADED)}\nprint(len(os.listdir('/proc/self/task')))"
    command = [sys.executable, "-c", look]
    done = subprocess.run(command, env=os.environ | ENVIRONMENT, capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"


def test_a_temporary_directory_with_a_long_name(link_study, tmp_path, start_sweep, sweep, monkeypatch):
    """It cannot hold a socket, so workers are started anew."""
    long = tmp_path / ("long" * 30)
    long.mkdir()
    assert sweep("run", link_study, "-o", tmp_path / "a.zarr", "--pool", "serial")[0] == 0
    monkeypatch.setenv("TMPDIR", str(long))
    process = start_sweep("run", link_study, "-o", tmp_path / "b.zarr", "--workers", 1)
    _, err = process.communicate(timeout=120)
    assert (process.returncode, "Traceback" in err) == (0, False), err
    a, b = (xr.open_zarr(tmp_path / name).load().drop_attrs() for name in ("a.zarr", "b.zarr"))
    xr.testing.assert_identical(a, b)
    assert not list(long.iterdir())
