"""What a function does to its process reaches neither the run nor, where a process is its own, the command."""

import io
import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import xarray as xr

from linksweep import run
from linksweep.sweep.executing import executor as children
from tests.sweep.outside import below, command_of, wait_until
from tests.tiers import PATIENCE_S, slow

LOCK = threading.Lock()  # cannot be pickled, nor can a function that refers to it be sent to workers

LIMIT = "a block took longer than the time limit of 4 s"
ENDINGS = {
    "SIGSEGV": ("ctypes.string_at(0)", "ended its process with SIGSEGV"),
    "exit code 3": ("os._exit(3)", "ended its process with exit code 3"),
    "SIGTERM": ("os.kill(os.getpid(), signal.SIGTERM)", "ended its process with SIGTERM"),
    "SIGKILL": ("os.kill(os.getpid(), signal.SIGKILL)", "ended its process with SIGKILL"),
    "closed files": ("os.closerange(0, 4096)", "ended its process with exit code 1"),
}
LIMITED = {
    "memory": ("kept = b'x' * 2**30; time.sleep(3600)", "needs more than the memory limit of 0.4 GB"),
    "a loop": ("while True: pass", LIMIT),
    "no exception": ("time.sleep(3600)", LIMIT),
    "no other code": ("__import__('re').match('(a+)+$', 'a' * 64 + 'b')", LIMIT),  # years, in which no other runs
}
"""How a block may end its process, without and with limits, and what is said of it."""
LIMITS = "--time-limit 4 --memory-limit 400MB"
POOLS = ("", "--workers 1", *(f"{pool} {LIMITS}" for pool in ("--pool serial", "--workers 2", "--pool threads")))
CASES = [(deed, pool) for deed in ENDINGS | LIMITED for pool in POOLS if deed in ENDINGS or LIMITS in pool]
QUICK = [("SIGSEGV", ""), ("exit code 3", f"--pool serial {LIMITS}")]

FUNCTION = """
import ctypes, json, os, signal, sys, threading, time
def f(x: float = 0.0):
    if x in ({places}):
        {deed}
    return 2.0 * x
"""


def written(folder, deed, places):
    (folder / "f.py").write_text(FUNCTION.format(deed=deed, places="".join(f"{place}," for place in places)))
    return "f.py:f"


@pytest.fixture
def sweep(start_sweep):
    """A function that runs `sweep` as a process and returns (exit code, stdout, stderr)."""

    def sweep(*arguments, cwd):
        process = start_sweep(*arguments, cwd=cwd)
        out, err = process.communicate(timeout=PATIENCE_S)
        return process.returncode, out, err

    return sweep


@pytest.mark.parametrize(("deed", "resources"), [*QUICK, *(slow(*case) for case in CASES if case not in QUICK)])
def test_a_function_that_ends_its_process_at_its_first_points_fails_these_alone(tmp_path, sweep, deed, resources):
    code, said = (ENDINGS | LIMITED)[deed]
    reference = written(tmp_path, code, (0, 1, 4))
    code, _, err = sweep("run", reference, "--axis", "x=0:5:1", "-o", "s.zarr", *resources.split(), cwd=tmp_path)
    assert code == 1, err
    assert "3 points failed" in err
    assert not [line for line in err.splitlines() if "distributed" in line or "Traceback" in line], err
    ds = xr.open_zarr(tmp_path / "s.zarr")
    assert ds["status"].values.tolist() == [2, 2, 1, 1, 2, 1]
    assert ds["f"].values[[2, 3, 5]].tolist() == [4.0, 6.0, 10.0]
    assert ds.attrs["failures"].count(said) == 3 or (resources and deed not in LIMITED)


HARMLESS = {
    "a thread": "threading.Thread(target=time.sleep, args=(3600,)).start()",
    "modules": "sys.modules['json'] = None; json.dumps = json.loads = None",
    "signals": "[signal.signal(n, signal.SIG_IGN) for n in (signal.SIGINT, signal.SIGTERM)]",
    "limits": "__import__('resource').setrlimit(__import__('resource').RLIMIT_FSIZE, (0, 0))",
}
"""What a function may do to its process without failing its own point; what is put back is in `test_own_process`."""


@pytest.mark.slow
@pytest.mark.parametrize("deed", HARMLESS)
def test_what_a_function_does_to_its_process_does_not_reach_the_run(tmp_path, sweep, deed):
    reference = written(tmp_path, HARMLESS[deed], (0,))
    code, out, err = sweep("run", reference, "--axis", "x=0:3:1", "-o", "s.zarr", cwd=tmp_path)
    assert (code, "wrote s.zarr" in err, "f: It is between 0 (x=0) and 6" in out) == (0, True, True), err
    assert xr.open_zarr(tmp_path / "s.zarr")["f"].values.tolist() == [0.0, 2.0, 4.0, 6.0]


@pytest.mark.parametrize("pool", [None, slow("processes"), slow("threads")])
def test_a_function_that_raises_keyboard_interrupt_interrupts_nobody(tmp_path, pool):
    def f(x: float):
        if x == 2.0:
            raise KeyboardInterrupt
        return x

    ds = run(f, tmp_path / "s.zarr", axes={"x": [1.0, 2.0, 3.0]}, pool=pool, workers=pool and 1)
    assert ds.status.values.tolist() == [1, 2, 1]


def test_a_function_that_cannot_be_pickled_is_computed_in_a_child(tmp_path):
    with io.StringIO("the content") as file:

        def f(x: float):
            with LOCK:
                file.seek(0)
                return {"text": file.read(), "process": float(os.getpid())}

        ds = run(f, tmp_path / "s.zarr", axes={"x": [1.0, 2.0]})
    assert ds.text.values.tolist() == ["the content"] * 2
    assert os.getpid() not in ds.process.values
    assert len(set(ds.process.values.tolist())) == 1  # it lives on


def test_where_no_process_may_be_forked_a_new_one_computes_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(children, "NOT_TO_BE_FORKED", ("sys",))

    def f(x: float):
        return {"y": x / 3.0, "forked": "pytest" in sys.modules}

    ds = run(f, tmp_path / "s.zarr", axes={"x": [1.0, 2.0]})
    assert (ds.y.values.tolist(), ds.forked.values.tolist()) == ([1.0 / 3.0, 2.0 / 3.0], [False, False])


@pytest.mark.parametrize("number", [slow(signal.SIGINT), signal.SIGKILL])
def test_a_child_does_not_outlive_its_run(tmp_path, start_sweep, number):
    reference = written(tmp_path, f"open('begun', 'w').close(); {LIMITED['no other code'][0]}", (2,))
    process = start_sweep("run", reference, "--axis", "x=0:4:1", "-o", "s.zarr", cwd=tmp_path)
    wait_until(lambda: process.poll() is not None or (tmp_path / "begun").exists(), "the block", PATIENCE_S)
    family = below(process.pid)
    assert family
    os.kill(process.pid, number)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == {signal.SIGINT: 130, signal.SIGKILL: -9}[number]
    wait_until(lambda: not any(command_of(pid) for pid in family), "the child's end", PATIENCE_S)


def test_what_a_child_leaves_running_does_not_keep_the_run(tmp_path):
    """A process that it has started has its files too."""
    ended, waited = tmp_path / "ended", tmp_path / "waited"

    def f(x: float):
        if x == 1.0:
            if os.fork():
                os._exit(3)
            for _ in range(600):
                if ended.exists():
                    os._exit(0)
                time.sleep(0.1)
            waited.touch()
            os._exit(0)
        return x

    ds = run(f, tmp_path / "s.zarr", axes={"x": [1.0, 2.0]})
    ended.touch()
    assert ds.status.values.tolist() == [2, 1]
    assert not waited.exists()


@pytest.mark.slow
@pytest.mark.parametrize("workers", [("--workers", "1"), ("--cluster", "c.toml")], ids=["own", "Dask"])
def test_no_process_of_a_run_imports_what_lies_in_the_present_folder(tmp_path, workers):
    """The folder may be a stranger's; the command that is installed does not look there either."""
    folder = tmp_path / "strangers"
    folder.mkdir()
    for name in ("sweep", "linksweep", "core", "numpy", "pickle", "signal", "selectors", "psutil", "tempfile"):
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'marks')!r}, 'a').write(__name__ + ' ')\n")
    (folder / "mine.py").write_text("import os\ndef f(x: float = 1.0):\n    return os._exit(3) if x == 2.0 else x\n")
    command = "import sys; from linksweep.sweep.__main__ import main; sys.exit(main())"
    run = ("run", "mine.py:f", "--axis", "x=1,2,3", "-o", "s.zarr", *workers)
    (folder / "c.toml").write_text('class = "distributed.LocalCluster"\nscale = 1\n[options]\nn_workers = 0\n')
    done = subprocess.run(
        [sys.executable, "-P", "-c", command, *run], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stderr
    assert "2 points done, 1 failed" in done.stderr
    assert not (tmp_path / "marks").exists(), (tmp_path / "marks").read_text()


SCRIPT = """
import sys
import linksweep

def double(x: float = 1.0):
    return 2.0 * x

print(linksweep.run(double, axes={"x": [1.0, 2.0]}, store="s.zarr", workers=2).double.values)
print([name for name in ("bokeh", "distributed", "dask.array") if name in sys.modules])
"""


@pytest.mark.parametrize("by_standard_input", [False, slow(True)])
def test_a_script_computes_in_worker_processes(tmp_path, by_standard_input):
    (tmp_path / "script.py").write_text(SCRIPT)
    command, text = ([sys.executable, "-"], SCRIPT) if by_standard_input else ([sys.executable, "script.py"], None)
    done = subprocess.run(command, input=text, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "[2. 4.]\n[]\n"), done.stderr
