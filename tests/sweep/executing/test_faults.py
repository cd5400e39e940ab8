"""What happens to a run when machines die, stall or come late.  All with real processes."""

import os
import signal
import time
from importlib.metadata import version
from pathlib import Path

import pytest
import xarray as xr

from tests.sweep.opening import rows_on_disk
from tests.sweep.outside import Outside, below, command_of, listening, wait_until, workers_below
from tests.tiers import PATIENCE_S

LONG = ("--set", "n_sim=20000", "--set", "n_cat=6")


def results(store):
    return xr.open_zarr(store).load().drop_vars("wall_time").drop_attrs()


def started_to_write(store: Path, process):
    def rows():
        assert process.poll() is None, process.communicate()[1]
        return rows_on_disk(store) > 0

    wait_until(rows, "the first results")


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The study that all tests here run, and its results in the serial reference."""
    from linksweep.sweep.executing.pools import NO_LIMITS, Resources
    from linksweep.sweep.studies.reader import load_study
    from tests.conftest import LINK_STUDY
    from tests.sweep.opening import run_study

    path = tmp_path_factory.mktemp("reference")
    (path / "small.toml").write_text(LINK_STUDY)
    study = load_study(str(path / "small.toml"), ("n_sim=20000", "n_cat=6"))
    dataset = run_study(study, path / "serial.zarr", Resources(pool="serial", limits=NO_LIMITS))[0]
    return dataset.drop_vars("wall_time").drop_attrs()


@pytest.fixture
def outside(tmp_path):
    (tmp_path / "dask").mkdir()
    dask = Outside(tmp_path / "dask")
    yield dask
    dask.close()


def lines_until(words, process):
    """Read what a process says until it says these words; return what came before."""
    before = ""
    for line in process.stderr:
        if words in line:
            return before
        before += line
    raise AssertionError(before)


def quiet(err):
    return not [line for line in err.splitlines() if "distributed" in line or "Traceback" in line or "tornado" in line]


@pytest.mark.slow
def test_a_killed_worker_costs_nothing_but_time(link_study, tmp_path, start_sweep, reference):
    store = tmp_path / "s.zarr"
    process = start_sweep("run", link_study, "-o", store, *LONG, "--workers", 2)
    started_to_write(store, process)
    os.kill(workers_below(process.pid)[0], signal.SIGKILL)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert quiet(err), err
    xr.testing.assert_identical(results(store), reference)


@pytest.mark.slow
def test_a_stalled_worker_goes_on(link_study, tmp_path, start_sweep, reference):
    store = tmp_path / "s.zarr"
    process = start_sweep("run", link_study, "-o", store, *LONG, "--workers", 2)
    started_to_write(store, process)
    worker = workers_below(process.pid)[0]
    os.kill(worker, signal.SIGSTOP)
    time.sleep(5)
    os.kill(worker, signal.SIGCONT)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert quiet(err), err
    xr.testing.assert_identical(results(store), reference)


@pytest.mark.slow
def test_all_workers_die_and_others_join(link_study, tmp_path, start_sweep, outside, reference):
    store = tmp_path / "s.zarr"
    workers = [outside.start_worker(), outside.start_worker()]
    process = start_sweep("run", link_study, "-o", store, *LONG, "--scheduler", outside.address)
    started_to_write(store, process)
    outside.kill(*workers)
    before = lines_until("has no workers; waiting for some", process)
    outside.start_worker()
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert "has no workers" not in before + err
    assert err.count("has workers again") == 1
    assert quiet(err), err
    xr.testing.assert_identical(results(store), reference)


@pytest.mark.slow
def test_workers_may_come_late(link_study, tmp_path, start_sweep, outside, reference):
    store = tmp_path / "s.zarr"
    process = start_sweep("run", link_study, "-o", store, *LONG, "--scheduler", outside.address)
    lines_until("has no workers; waiting for some", process)
    assert not store.exists()  # before a worker was compared with the client
    outside.start_worker()
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    assert "has no workers" not in err
    xr.testing.assert_identical(results(store), reference)


def other_version(folder, package, version):
    """Return an environment in which a package reports another version."""
    info = folder / "shim" / f"{package}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    return {"PYTHONPATH": str(folder / "shim")}


@pytest.mark.parametrize("package", ["numpy"])
def test_a_worker_with_another_version_stops_the_run_before_anything_is_written(
    link_study, tmp_path, sweep, outside, package
):
    outside.start_worker()
    outside.start_worker(**other_version(tmp_path, package, "0.0.9"))
    outside.wait_for_workers(2)
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", "--scheduler", outside.address)
    assert code == 2, err
    (line,) = [line for line in err.splitlines() if "there" in line]
    assert line.startswith("error: ")
    assert line.endswith(f": {package} is {version(package)} here, 0.0.9 there")
    assert "tcp://127.0.0.1:" in line
    assert quiet(err), err
    assert not (tmp_path / "s.zarr").exists()


@pytest.mark.slow
def test_a_worker_with_another_version_that_joins_later_stops_the_run(
    link_study, tmp_path, start_sweep, sweep, outside, reference
):
    store = tmp_path / "s.zarr"
    outside.start_worker()
    process = start_sweep("run", link_study, "-o", store, *LONG, "--scheduler", outside.address)
    started_to_write(store, process)
    outside.start_worker(**other_version(tmp_path, "numpy", "0.0.9"))
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2, err
    assert f"numpy is {version('numpy')} here, 0.0.9 there" in err
    code, _, err = sweep("run", link_study, "-o", store, *LONG, "--pool", "serial")
    assert code == 0, err
    xr.testing.assert_identical(results(store), reference)  # it has written nothing


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_run_and_loses_nothing(
    link_study, tmp_path, start_sweep, sweep, outside, reference
):
    store = tmp_path / "s.zarr"
    outside.start_worker()
    process = start_sweep("run", link_study, "-o", store, *LONG, "--scheduler", outside.address)
    started_to_write(store, process)
    outside.kill(outside.scheduler)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2, err
    words = f"error: the connection to the Dask scheduler at {outside.address} is lost; what was finished is kept"
    assert words in err
    assert quiet(err), err
    code, _, err = sweep("run", link_study, "-o", store, *LONG, "--pool", "serial")
    assert code == 0, err
    assert "already" in err or "part of the realisations" in err
    xr.testing.assert_identical(results(store), reference)


@pytest.mark.slow
@pytest.mark.parametrize("pool", ["processes", "threads"])
def test_a_local_run_listens_nowhere_and_leaves_nothing(link_study, tmp_path, start_sweep, monkeypatch, pool):
    store = tmp_path / "s.zarr"
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    process = start_sweep("run", link_study, "-o", store, *LONG, "--workers", 2, "--pool", pool, cwd=tmp_path)
    started_to_write(store, process)
    family = below(process.pid)
    assert not listening({process.pid, *family})
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, err
    wait_until(lambda: not any(command_of(pid) for pid in family), "the end of all processes", 5)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s.zarr", "small.toml", "temporary"]
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.slow
def test_a_cluster_of_a_file_listens_on_loopback_only(link_study, tmp_path, start_sweep):
    (tmp_path / "c.toml").write_text('class = "distributed.LocalCluster"\nscale = 2\n[options]\nn_workers = 0\n')
    process = start_sweep("run", link_study, "-o", tmp_path / "s.zarr", *LONG, "--cluster", tmp_path / "c.toml")
    started_to_write(tmp_path / "s.zarr", process)
    family = below(process.pid)
    addresses = [address for address, _ in listening({process.pid, *family})]
    assert set(addresses) == {"0100007F"}
    assert process.wait(PATIENCE_S) == 0
    wait_until(lambda: not any(command_of(pid) for pid in family), "the end of all processes", 5)
