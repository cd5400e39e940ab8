"""What happens to a run when machines die, stall or come late.  All with real processes."""

import json
import os
import re
import signal
import subprocess
import time
from contextlib import closing
from importlib.metadata import version
from itertools import product, takewhile

import pytest

import linksweep
from tests.conftest import LINK_STUDY
from tests.sweep.executing.test_clusters import FILES
from tests.sweep.opening import OpenStore, rows_on_disk, same
from tests.sweep.outside import Outside, below, command_of, listening, wait_until, workers_below
from tests.sweep.user import write_experiment, write_study
from tests.tiers import PATIENCE_S, slow

LONG = ("--set", "n_sim=20000", "--set", "n_cat=6")
TALKS = """
import os, sys, warnings
def total(points, n_sim):
    (p,) = points
    print(f"at {p['kind']}: {'x' * 5}")
    print(f"not well at {p['kind']}", file=sys.stderr)
    PROGRAM
    warnings.warn("mind the gap")
    return {"total": [n_sim * p["kind"]]}
"""
POOLS = ["--pool threads --workers 2", *map(slow, ["--pool serial", "--workers 2", "--pool serial --time-limit 60"])]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    path = tmp_path_factory.mktemp("reference")
    (path / "small.toml").write_text(LINK_STUDY)
    return linksweep.run(linksweep.load_study(path / "small.toml", LONG[1::2]), path / "s.zarr", pool="serial")


@pytest.fixture
def start(link_study, tmp_path, start_sweep):
    def start(*resources, waits=True):
        store = tmp_path / "s.zarr"
        process = start_sweep("run", link_study, "-o", store, *LONG, *resources, cwd=tmp_path)
        wait_until(lambda: not waits or process.poll() is not None or rows_on_disk(store), "the first results")
        assert process.poll() is None, process.communicate()[1]
        return process

    return start


def to_its_end(process, code=0):
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, err
    assert not [line for line in err.splitlines() if re.search("distributed|Traceback|tornado", line)], err
    return err


@pytest.fixture
def outside(tmp_path):
    (tmp_path / "dask").mkdir()
    with closing(Outside(tmp_path / "dask")) as dask:
        yield dask


def lines_until(words, process):
    return "".join(takewhile(lambda line: words not in line, process.stderr))


@pytest.mark.slow
@pytest.mark.parametrize("fate", ["killed", "stalled", "all stalled, with a time limit"])
def test_a_worker_that_is_killed_or_stalls_costs_nothing_but_time(start, tmp_path, reference, fate):
    process = start("--workers", 2, *(["--time-limit", 2] if "limit" in fate else []))
    some = workers_below(process.pid)
    for number in [signal.SIGKILL] if fate == "killed" else [signal.SIGSTOP, signal.SIGCONT]:
        for pid in [process.pid, *some] if "all" in fate else some[:1]:
            os.kill(pid, number)
        time.sleep(6 * (number == signal.SIGSTOP))
    to_its_end(process)
    same(tmp_path / "s.zarr", reference)


@pytest.mark.slow
def test_workers_may_come_late_and_all_of_them_die_and_others_join(start, tmp_path, outside, reference):
    paused = outside.start_worker("--no-nanny", "--memory-limit", "1MB")
    outside.wait_for_workers(1)
    process = start("--scheduler", outside.address, waits=False)
    lines_until("has paused all workers, as their memory is nearly full; waiting for some", process)
    assert not (tmp_path / "s.zarr").exists()  # before a worker was compared with the client
    workers = [outside.start_worker(), outside.start_worker()]
    wait_until(lambda: rows_on_disk(tmp_path / "s.zarr"), "the first results")
    outside.kill(paused, *workers)
    before = lines_until("has no workers; waiting for some", process)
    outside.start_worker()
    err = to_its_end(process)
    assert ("has no workers" in before + err, err.count("has workers again")) == (False, 1)
    same(tmp_path / "s.zarr", reference)


@pytest.mark.slow
def test_a_worker_that_a_function_fills_is_started_anew(tmp_path, outside, start_sweep):
    leaks = "    f.__dict__.setdefault('left', []).append(np.ones(2**19))\n    time.sleep(0.1)\n"
    (tmp_path / "f.py").write_text(f"import time, numpy as np\ndef f(x: int):\n{leaks}    return x\n")
    outside.start_worker("--memory-limit", "400MB")
    outside.wait_for_workers(1)
    process = start_sweep("run", "f.py:f", "--axis", "x=0:149:1", "--scheduler", outside.address, cwd=tmp_path)
    assert "starts it anew" in to_its_end(process)


@pytest.mark.parametrize("later", [slow(False), slow(True)])
def test_a_worker_with_another_version_stops_the_run(start, link_study, tmp_path, sweep, outside, request, later):
    info = tmp_path / "shim" / "numpy-0.0.9.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: numpy\nVersion: 0.0.9\n")
    if later:
        outside.start_worker("--no-nanny")
        process = start("--scheduler", outside.address)
    outside.start_worker("--no-nanny", PYTHONPATH=str(tmp_path / "shim"))
    if not later:
        outside.wait_for_workers(1)
        process = start("--scheduler", outside.address, waits=False)
    err = to_its_end(process, 2)
    assert re.search(rf"(?m)^error: .*tcp://127.0.0.1:.*: numpy is {version('numpy')} here, 0.0.9 there$", err)
    assert (tmp_path / "s.zarr").exists() == later
    if later:
        assert sweep("run", link_study, "-o", tmp_path / "s.zarr", *LONG)[0] == 0
        same(tmp_path / "s.zarr", request.getfixturevalue("reference"))  # it has written nothing


@pytest.mark.parametrize(("constant", "expected"), [(3.0, 2), slow(2.0, 0)])
def test_a_worker_with_another_value_stops_the_run(tmp_path, start_sweep, outside, monkeypatch, constant, expected):
    for folder, value in (("here", 2.0), ("there", constant)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "helper.py").write_text(f"import time\nFACTOR, NOW = {value}, time.time()\n")
    (tmp_path / "m.py").write_text("import helper\ndef f(x):\n    return helper.FACTOR * x + 0 * (helper.NOW > 0)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "here"))
    outside.start_worker("--no-nanny", PYTHONPATH=str(tmp_path / "there"))
    run = ("run", "m.py:f", "--axis", "x=1,2", "-o", "s.zarr", "--scheduler", outside.address)
    err = to_its_end(start_sweep(*run, cwd=tmp_path), expected)
    assert ("tcp://" in err and "value helper.FACTOR is 2.0 here, 3.0 there" in err) == (expected == 2), err
    assert (tmp_path / "s.zarr").exists() == (expected == 0)


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_run_and_loses_nothing(start, link_study, tmp_path, sweep, outside, reference):
    outside.start_worker()
    process = start("--scheduler", outside.address)
    outside.kill(outside.scheduler)
    words = f"error: the connection to the Dask scheduler at {outside.address} is lost; what was finished is kept"
    assert words in to_its_end(process, 2)
    code, _, err = sweep("run", link_study, "-o", tmp_path / "s.zarr", *LONG)
    assert (code, "720,000 realisations to do" in err) == (0, False), err  # these are all
    same(tmp_path / "s.zarr", reference)


@pytest.mark.slow
@pytest.mark.parametrize("pool", ["processes", "threads", "cluster"])
def test_a_run_listens_on_loopback_at_most_and_leaves_nothing(start, tmp_path, monkeypatch, pool):
    (tmp_path / "temporary").mkdir()
    (tmp_path / "c.toml").write_text(FILES["two.toml"])
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    process = start(*(("--cluster", "c.toml") if pool == "cluster" else ("--workers", 2, "--pool", pool)))
    family = below(process.pid)
    addresses = {address for address, _ in listening({process.pid, *family})}
    assert addresses == ({"127.0.0.1"} if pool == "cluster" else set())
    to_its_end(process)
    wait_until(lambda: not any(command_of(pid) for pid in family), "the end of all processes", 5)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.toml", "s.zarr", "small.toml", "temporary"]
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.slow
def test_workers_without_the_folder_compute_with_its_helpers(tmp_path, sweep, outside):
    """The worker has an empty file system mounted where the client has the study, and neither sees the other's."""
    study = tmp_path / "mine"
    evaluate = '{"total": [n_sim * helper.FACTOR * p["rate"] for p in points]}'
    write_experiment(study, before="import helper", evaluate=evaluate)
    (study / "helper.py").write_text("FACTOR = 5.0\n")
    write_study(study)
    hide = ["unshare", "--mount", "sh", "-c", f'mount -t tmpfs none "{study}" && test ! -e "{study}/user.py" && "$@"']
    if os.geteuid() != 0 or subprocess.run([*hide, "sh", "true"], check=False).returncode:
        pytest.skip("a file system of its own for a process needs root and unshare")
    outside.start_worker(before=[*hide, "sh"])
    out = sweep("run", "s.toml", "-o", "s.zarr", "--scheduler", outside.address, cwd=study, code=0)[1]
    assert OpenStore(study / "s.zarr").dataset()["mean"].values.tolist() == [5.0, 10.0], out


@pytest.mark.parametrize("pool", POOLS)
def test_what_a_model_prints_is_in_the_log_and_not_in_the_output(pool, tmp_path, start_sweep):
    program = "pass" if pool in ("--pool serial", "--pool threads --workers 2") else 'os.system("echo from outside")'
    write_experiment(tmp_path, before=TALKS.replace("PROGRAM", program), evaluate="total(points, n_sim)")
    write_study(tmp_path, "kind = [1, 2, 3]")
    arguments = ("run", "s.toml", "-o", "s.zarr", "--json", "--log", "run.log", *pool.split())
    process = start_sweep(*arguments, cwd=tmp_path)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, bool(json.loads(out)), "not well" in err) == (0, True, False), err
    log = (tmp_path / "run.log").read_text()
    for kind, said in product((1, 2, 3), ("at {}: xxxxx", "not well at {}")):
        assert f"kind={kind}: printed: {said.format(kind)}" in log
    (report,) = [line for line in err.splitlines() if "mind the gap" in line]
    first = 1 if "serial" in pool else "[123]"
    assert re.match(rf"warned 3 times, first at kind={first}: .*UserWarning: mind the gap \(user\.py, line ", report)
