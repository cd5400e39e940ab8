"""Worker processes are forked from one that has imported what they need, and cannot tell."""

import os
import signal
import subprocess
import sys
import time
from multiprocessing import forkserver

import pytest
import xarray as xr
from distributed import LocalCluster

from linksweep.sweep.executing.clusters import own_cluster
from linksweep.sweep.executing.dask_worker import TaskPlugin
from linksweep.sweep.executing.forkserver import ENVIRONMENT, PRELOADED, SAFE_PATH, signals_blocked, start_method
from tests.patience import PATIENCE_S
from tests.sweep.executing.test_faults import started_to_write
from tests.sweep.outside import below, command_of, wait_until, workers_below

ONE = {"n_workers": 1, "threads_per_worker": 1, "processes": True}


def servers_below(pid):
    found = [child for child in below(pid) if "multiprocessing.forkserver" in command_of(child)]
    return [child for child in found if child not in workers_below(pid)]


@pytest.mark.slow
def test_workers_have_the_environment_of_their_run(monkeypatch):
    before = dict(os.environ)
    for value in ("first", "second"):
        monkeypatch.setenv("LINKSWEEP_TEST", value)
        with own_cluster(LocalCluster, ONE) as cluster, cluster.get_client() as client:
            [found] = client.run(lambda: dict(os.environ)).values()
            assert len(servers_below(os.getpid())) == 1
        assert found["LINKSWEEP_TEST"] == value
        assert {name: found[name] for name in ENVIRONMENT} == ENVIRONMENT
        assert not found[SAFE_PATH]
        assert not servers_below(os.getpid())
    ours = {"LINKSWEEP_TEST", *ENVIRONMENT, "__DASK_PARENT_PID"}  # Dask leaves the others here, as it always does
    assert {k: v for k, v in os.environ.items() if k not in ours} == {k: v for k, v in before.items() if k not in ours}


def blocked_signals():
    return signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_a_signal_to_all_processes_leaves_what_workers_are_forked_from():
    """Dask would start another of its own, with more in it than may be forked.  What workers run may use SIGTERM."""
    with own_cluster(LocalCluster, ONE) as cluster, cluster.get_client() as client:
        client.register_plugin(TaskPlugin())
        [server] = servers_below(os.getpid())
        os.kill(server, signal.SIGTERM)
        [blocked] = client.run(blocked_signals).values()
        assert {signal.SIGINT, signal.SIGHUP} <= blocked
        assert signal.SIGTERM not in blocked
        assert servers_below(os.getpid()) == [server]


@pytest.mark.slow
def test_two_clusters_share_what_they_are_forked_from():
    with own_cluster(LocalCluster, ONE) as first, first.get_client() as client:
        with own_cluster(LocalCluster, ONE):
            assert len(servers_below(os.getpid())) == 1
        assert client.submit(int, "7").result() == 7
    assert not servers_below(os.getpid())


@pytest.mark.slow
def test_a_server_of_the_users_own_is_left_alone():
    forkserver.ensure_running()
    try:
        # For some microseconds a process that starts has no command line.
        own = wait_until(lambda: servers_below(os.getpid()), "the user's server")
        with own_cluster(LocalCluster, ONE) as cluster:
            [worker] = cluster.workers.values()
            assert "spawn_main" in command_of(worker.pid)
        assert servers_below(os.getpid()) == own
    finally:
        forkserver._forkserver._stop()


def interrupted_meanwhile():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.2)  # not made yet when the interrupt arrives
    return "made"


def test_what_is_made_while_it_is_interrupted_is_undone():
    undone = []
    with pytest.raises(KeyboardInterrupt):
        signals_blocked(interrupted_meanwhile, undone.append)
    assert undone == ["made"]


class Interrupted(LocalCluster):
    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        interrupted_meanwhile()


def test_an_interrupted_start_leaves_no_process_in_a_session():
    with pytest.raises(KeyboardInterrupt), own_cluster(Interrupted, ONE):
        pass
    assert not servers_below(os.getpid())
    assert not workers_below(os.getpid())


def test_an_interrupted_server_is_ended(monkeypatch):
    start = forkserver.ensure_running

    def interrupted():
        start()
        interrupted_meanwhile()

    monkeypatch.setattr(forkserver, "ensure_running", interrupted)
    with pytest.raises(KeyboardInterrupt), start_method():
        pass
    assert not servers_below(os.getpid())


@pytest.mark.slow
def test_the_process_that_workers_are_forked_from_may_die(link_study, tmp_path, start_sweep, sweep):
    more = ("--set", "n_sim=20000", "--set", "n_cat=6")
    assert sweep("run", link_study, "-o", tmp_path / "a.zarr", "--pool", "serial", *more)[0] == 0
    process = start_sweep("run", link_study, "-o", tmp_path / "b.zarr", "--workers", 2, *more)
    started_to_write(tmp_path / "b.zarr", process)
    for server in servers_below(process.pid):
        os.kill(server, signal.SIGKILL)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, "Traceback" in err) == (0, False), err
    a, b = (xr.open_zarr(tmp_path / name).load().drop_attrs() for name in ("a.zarr", "b.zarr"))
    xr.testing.assert_identical(a, b)


def test_what_they_are_forked_from_has_no_threads():
    """A lock that another thread holds while a process is forked would never be released in the child."""
    look = f"import os, {', '.join(PRELOADED)}\nprint(len(os.listdir('/proc/self/task')))"
    command = [sys.executable, "-c", look]
    done = subprocess.run(command, env=os.environ | ENVIRONMENT, capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"


@pytest.mark.slow
def test_a_temporary_directory_with_a_long_name(link_study, tmp_path, start_sweep, sweep, monkeypatch):
    """It cannot hold a socket, so workers are started anew."""
    long = tmp_path / ("long" * 30)
    long.mkdir()
    assert sweep("run", link_study, "-o", tmp_path / "a.zarr", "--pool", "serial")[0] == 0
    monkeypatch.setenv("TMPDIR", str(long))
    process = start_sweep("run", link_study, "-o", tmp_path / "b.zarr", "--workers", 1)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, "Traceback" in err) == (0, False), err
    a, b = (xr.open_zarr(tmp_path / name).load().drop_attrs() for name in ("a.zarr", "b.zarr"))
    xr.testing.assert_identical(a, b)
    assert not list(long.iterdir())


@pytest.mark.slow
def test_no_process_of_a_run_imports_what_lies_in_the_present_folder(tmp_path):
    """The folder may be a stranger's; the command that is installed does not look there either."""
    folder = tmp_path / "strangers"
    folder.mkdir()
    names = (
        "sweep",
        "linksweep",
        "core",
        "numpy",
        "pickle",
        "signal",
        "selectors",
        "psutil",
        "tempfile",
        "faulthandler",
    )
    for name in names:
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'marks')!r}, 'a').write(__name__ + ' ')\n")
    (folder / "mine.py").write_text("import os\ndef f(x: float = 1.0):\n    return os._exit(3) if x == 2.0 else x\n")
    command = "import sys; from linksweep.sweep.__main__ import main; sys.exit(main())"
    run = ("run", "mine.py:f", "--axis", "x=1,2,3", "-o", "s.zarr", "--workers", "1")
    done = subprocess.run(
        [sys.executable, "-P", "-c", command, *run], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stderr
    assert "2 points done, 1 failed" in done.stderr
    assert not (tmp_path / "marks").exists(), (tmp_path / "marks").read_text()
