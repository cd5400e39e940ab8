"""Studies that the platform's tests share, and `sweep` as a user types it."""

import gc
import os
import signal
import subprocess
import sys
import warnings
from contextlib import chdir
from decimal import localcontext
from functools import cache
from pathlib import Path

import dask
import pytest
import threadpoolctl
from click.testing import CliRunner
from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # processes of tests would fight for cores; NumPy comes later

import linksweep
from linksweep.sweep.cli import main
from tests.tiers import ALL, PATIENCE_S, QUICK, examples

gc.set_threshold(20_000)  # looking for garbage took a twentieth of the time
os.fsync = lambda descriptor: None  # no test cuts the power, and waiting for the disk took a tenth
# Every run looked through all libraries of the process: those that matter are there, and use one thread anyway.
threadpoolctl.ThreadpoolController = cache(threadpoolctl.ThreadpoolController)

dask.config.set(scheduler="synchronous")  # after its threads nothing could be forked

# Files of tests are in memory, if there is much of it: the disk took a tenth. Those of tests that pass are removed.
if os.path.isdir("/dev/shm") and os.statvfs("/dev/shm").f_bavail > 2**20:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", "/dev/shm")

# Memory that is given back to the system after each array and taken again costs more than what is computed in it.
for _name in ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_"):
    os.environ.setdefault(_name, str(2**28))  # read when a process starts: those of xdist do later

settings.register_profile(ALL, deadline=None)  # a busy machine takes longer, which proves nothing
settings.register_profile(QUICK, parent=settings.get_profile(ALL), max_examples=examples(100))

# Compiled modules are kept, whatever the environment says: tests start hundreds of processes, each of which would
# compile them again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

for _number, _handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_number) is signal.SIG_IGN:  # as under nohup, and the processes of the tests would inherit it
        signal.signal(_number, _handler)

FIRST = ("test_paper", "test_interrupt", "test_faults", "test_docs", "test_slurm", "test_study_fuzz", "test_benchmarks")
FIRST += ("test_code", "test_objects", "test_mistakes", "test_apply", "test_forecast")
"""Files that take longest: a process that got one of them at the end would keep the others waiting."""

COINS = str(Path(__file__).parent / "sweep" / "coins.py") + ":experiment"
APART = {"--workers", "--scheduler", "--cluster", "--dashboard", "--time-limit", "--memory-limit"}
APART |= {"threads", "processes"}  # what makes a command of a test a process of its own
LINK_STUDY = """
title = "A small link"
[axes]
model = ["amex", "gaia"]
v_max = [14.0, 15.0, 16.0]
[fixed]
catalogue = "quasars"
[sampling]
n_sim = 2000
n_cat = 3
seed = 11
"""


def pytest_addoption(parser):
    parser.addoption("--all", action="store_true", help="run the tests that are marked slow, too")


def runs_all(config):
    return config.getoption("--all") or "slow" in config.getoption("markexpr")


def pytest_configure(config):
    settings.load_profile(ALL if runs_all(config) else QUICK)


def pytest_collection_modifyitems(config, items):
    if not runs_all(config):
        slow = [item for item in items if item.get_closest_marker("slow")]
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if not item.get_closest_marker("slow")]
    place = {name: number for number, name in enumerate(FIRST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(FIRST)))
    gc.freeze()  # what was imported stays


@pytest.fixture
def coins():
    """A document of a study of the coin experiment: 2 x 3 points, some blocks each."""
    return coins_document()


@pytest.fixture(scope="session")
def coin_store(tmp_path_factory):
    """The store of that study; only read."""
    store = tmp_path_factory.mktemp("coins") / "coins.zarr"
    linksweep.run(coins_document(), store, pool="serial")
    return store


def coins_document():
    axes, sampling = {"metal": ["gold", "tin"], "coins": [1, 5, 20]}, {"n_sim": 1000, "n_cat": 20, "seed": 7}
    return {"title": "Coins", "experiment": COINS, "axes": axes, "fixed": {"chance": 0.4}, "sampling": sampling}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder, which is the present one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def link_study(tmp_path):
    """The path of a small study of the link."""
    path = tmp_path / "small.toml"
    path.write_text(LINK_STUDY)
    return path


@pytest.fixture
def start_sweep():
    """A function that starts `sweep` as a process of its own; what still runs at the end of the test is killed."""
    started = []

    def start(*arguments, command=(sys.executable, "-m", "linksweep"), **options):
        command = [*map(str, command), *map(str, arguments)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen(command, env=os.environ | {"PYTHONWARNINGS": "default"}, **pipes, **options))
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def run_sweep(*arguments, cwd=None, code=None):
    """Run `sweep` in this process; return (exit code, stdout, stderr), the code one that is required."""
    with chdir(cwd or Path.cwd()), localcontext(), warnings.catch_warnings(record=True):  # as the end of a process does
        warnings.filterwarnings("default", module="linksweep_local_")  # of experiments in files
        done = CliRunner().invoke(main, [str(argument) for argument in arguments], prog_name="sweep")
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert code in (None, done.exit_code), done.stderr
    return done.exit_code, done.stdout, done.stderr


@pytest.fixture
def sweep_here():
    """A function that runs `sweep` in this process and returns (exit code, stdout, stderr)."""
    return run_sweep


@pytest.fixture
def sweep(sweep_here, start_sweep):
    """Runs `sweep` to its end, and returns (exit code, stdout, stderr): in this process, which is cheap,
    and there serially, unless the command names workers or limits; else it would choose by how busy the machine is.
    """

    def sweep(*arguments, cwd=None, code=None):
        if APART & set(arguments):
            process = start_sweep(*arguments, cwd=cwd)
            out, err = process.communicate(timeout=PATIENCE_S)
            assert code in (None, process.returncode), err
            return process.returncode, out, err
        here = ("--pool", "serial") if arguments[:1] == ("run",) and "--pool" not in arguments else ()
        return sweep_here(*arguments, *here, cwd=cwd, code=code)

    return sweep
