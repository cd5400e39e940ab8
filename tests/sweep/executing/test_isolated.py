"""What a function does to its process reaches neither the run nor, where a process is its own, the command."""

import decimal
import io
import os
import random
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from multiprocessing.pool import ThreadPool
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from linksweep import SweepError, run
from linksweep.sweep.executing.worker import Deadlines, TimeLimitError
from tests.sweep.opening import RunInterruptedError
from tests.sweep.outside import below, command_of, wait_until
from tests.tiers import PATIENCE_S, examples, slow

LOCK = threading.Lock()  # cannot be pickled, nor can a function that refers to it be sent to workers
LIMIT = "a block took longer than the time limit of 4 s"
ENDINGS = {
    "SIGSEGV": ("ctypes.string_at(0)", "ended its process with SIGSEGV"),
    "exit code 3": ("os._exit(3)", "ended its process with exit code 3"),
    "SIGTERM": ("os.kill(os.getpid(), signal.SIGTERM)", "ended its process with SIGTERM"),
    "SIGKILL": ("os.kill(os.getpid(), signal.SIGKILL)", "ended its process with SIGKILL"),
    "closed files": ("os.closerange(0, 4096)", "ended its process with exit code 1"),
}
LIMITED = {  # how a block may end its process, without and with limits, and what is said of it
    "memory": ("kept = b'x' * 2**30; time.sleep(3600)", "needs more than the memory limit of 0.4 GB"),
    "a loop": ("while True: pass", LIMIT),
    "no exception": ("time.sleep(3600)", LIMIT),
    "no other code": ("__import__('re').match('(a+)+$', 'a' * 64 + 'b')", LIMIT),  # years, in which no other runs
}
LIMITS = "--time-limit 4 --memory-limit 400MB"
POOLS = ("", "--workers 1", *(f"{pool} {LIMITS}" for pool in ("--pool serial", "--workers 2", "--pool threads")))
CASES = [(deed, pool) for deed in ENDINGS | LIMITED for pool in POOLS if deed in ENDINGS or LIMITS in pool]
CASES += [("no exception", "--cluster threads.toml --time-limit 4")]  # whose workers are threads of the command
QUICK = [("SIGSEGV", "")]
FUNCTION = """
import ctypes, json, os, signal, sys, threading, time
def f(x: float = 0.0):
    if x in {places}:
        {deed}
    return 2.0 * x
"""
HARMLESS = [  # what a function may do to its process without failing its own point; what is put back is in `CHANGES`
    "threading.Thread(target=time.sleep, args=(3600,)).start()",
    "sys.modules['json'] = None; json.dumps = json.loads = None",
    "[signal.signal(n, signal.SIG_IGN) for n in (signal.SIGINT, signal.SIGTERM)]",
    "__import__('resource').setrlimit(__import__('resource').RLIMIT_FSIZE, (0, 0))",
    "sys.settrace(lambda *_: None)  # --time-limit 9",
    "globals().setdefault('calls', []).append(x); all(calls[1:] for _ in iter(int, 1))  # --time-limit 2",  # the second
]
THREE = {"x": [1.0, 2.0, 3.0]}
CHANGES = {  # what one point changes of its process, and what the others look at
    "folder": (lambda: os.chdir("/"), os.getcwd),
    "arithmetic": (lambda: np.seterr(all="raise"), lambda: str(np.float64(1.0) / np.float64(0.0) > 1.0)),
    "decimals": (lambda: setattr(decimal.getcontext(), "prec", 3), lambda: str(decimal.Decimal(1) / 3)),
    "environment": (os.environ.clear, lambda: str(sorted(os.environ.items()))),
    "one more": (lambda: os.environ.update(LINKSWEEP_X="1"), lambda: str("LINKSWEEP_X" in os.environ)),
    "random": (lambda: random.seed(1), lambda: str(random.getstate() == random.Random(1).getstate())),
    "numpy": (lambda: np.random.seed(1), lambda: str(np.random.get_state()[1][0] == 1)),  # noqa: NPY002
    "filters": (lambda: warnings.simplefilter("error"), lambda: str(warnings.warn("w", stacklevel=1))),
    "output": (lambda: setattr(sys, "stdout", None), lambda: str(print("x"))),
    "errors": (lambda: setattr(sys, "stderr", None), lambda: str(print("", end="", file=sys.stderr))),
}
SCRIPT = """
import linksweep, sys
ds = linksweep.run(lambda x: 2.0 * x, axes={"x": [1.0, 2.0]}, store="s.zarr", workers=2)
print(ds.result.values, [name for name in ("bokeh", "distributed", "dask.array") if name in sys.modules])
"""


def written(folder, deed, *places):
    (folder / "f.py").write_text(FUNCTION.format(deed=deed, places=places))
    (folder / "threads.toml").write_text("class = 'distributed.LocalCluster'\noptions.processes = false\nscale = 2\n")
    return "f.py:f"


@pytest.mark.parametrize(("deed", "resources"), [*QUICK, *(slow(*case) for case in CASES if case not in QUICK)])
def test_a_function_that_ends_its_process_at_its_first_points_fails_these_alone(tmp_path, sweep_here, deed, resources):
    code, said = (ENDINGS | LIMITED)[deed]
    np.ones(2**27 if deed == "memory" else 0)  # 1 GB that is free again
    reference, _larger = written(tmp_path, code, 0, 1, 4), np.ones(2**25)  # 268 MB, which copies do not take again
    code, _, err = sweep_here("run", reference, "--axis", "x=0:5:1", "-o", "s.zarr", *resources.split(), cwd=tmp_path)
    assert (code, "3 points failed" in err, "distributed" in err, "Traceback" in err) == (1, True, False, False), err
    ds = xr.open_zarr(tmp_path / "s.zarr")
    assert (ds.status.values.tolist(), ds.f.values[[2, 3, 5]].tolist()) == ([2, 2, 1, 1, 2, 1], [4.0, 6.0, 10.0])
    assert ds.attrs["failures"].count(said) == 3 or (resources and deed not in LIMITED)


def test_a_point_that_ends_its_process_once_is_computed_again_whatever_others_did(tmp_path):
    def f(x: int):
        mark = tmp_path / f"{x}"
        if x >= 28 and not mark.exists():
            mark.touch()
            os._exit(3)
        return x

    assert run(f, tmp_path / "s.zarr", axes={"x": range(40)}).f.values.tolist() == list(range(40))


@pytest.mark.slow
def test_of_points_that_share_random_numbers_the_one_that_ends_its_process_fails_alone(tmp_path, monkeypatch):
    monkeypatch.setattr("linksweep.sweep.planning.accumulator.SHORTEST_TASK_S", 1e6)  # two tasks have all blocks
    code = (Path(__file__).parents[1] / "spread.py").read_text().replace("SCATTER = 0.3", "CALLS, SCATTER = [], 0.3")
    ends = "    import glob, os\n    CALLS.append(0)\n    if any(p['x'] == 1.0 for p in points) and "
    ends += "(CALLS[3:] or glob.glob(f'{__file__}.*')):\n        os._exit(os.mkdir(f'{__file__}.{os.getpid()}') or 3)\n"
    sampling = {"n_sim": 10 * 512, "seed": 5, "common_random_numbers": True}
    result = []
    for name, text in (("whole", code), ("broken", code.replace("    squares = []\n", f"{ends}    squares = []\n"))):
        (tmp_path / f"{name}.py").write_text(text)
        study = {"title": "", "experiment": f"{tmp_path}/{name}.py:experiment", "axes": {"x": [0.5, 1.0, 2.0, 4.0]}}
        result.append(run(study | {"sampling": sampling}, tmp_path / f"{name}.zarr"))
    assert result[1].status.values.tolist() == [1, 2, 1, 1]
    assert result[1].width.values[[0, 2, 3]].tolist() == result[0].width.values[[0, 2, 3]].tolist()
    assert len([*tmp_path.glob("broken.py.*")]) == 4  # and no other block tries it again


@pytest.mark.slow
def test_each_worker_has_an_equal_share_of_the_memory(tmp_path, monkeypatch):
    def large(x: int):
        kept = b"x" * x
        time.sleep(x / 1e8)
        return len(kept)

    monkeypatch.setattr("psutil.virtual_memory", lambda: type("Memory", (), {"total": 6 * 10**8}))
    ds = run(large, tmp_path / "s.zarr", axes={"x": [1, 5 * 10**8]}, workers=2)
    assert (ds.status.values.tolist(), "needs more than the memory limit of 0.3 GB" in ds.failures) == ([1, 2], True)


@pytest.mark.slow
@pytest.mark.parametrize("deed", HARMLESS)
def test_what_a_function_does_to_its_process_does_not_reach_the_run(tmp_path, sweep_here, deed):
    how = "-o", "s.zarr", *deed.partition("# ")[2].split()
    code, out, err = sweep_here("run", written(tmp_path, deed, 0), "--axis", "x=0:3:1", *how, cwd=tmp_path)
    assert (code, "wrote s.zarr" in err, "f: It is between 0 (x=0) and 6" in out) == (0, True, True), err
    assert xr.open_zarr(tmp_path / "s.zarr")["f"].values.tolist() == [0.0, 2.0, 4.0, 6.0]


@pytest.mark.parametrize("pool", ["serial", slow("threads")])
def test_a_block_may_run_a_study_and_end_a_process_that_it_has_forked(tmp_path, pool):
    def f(x: int):
        if not (child := os.fork()):
            os.kill(os.getpid(), signal.SIGTERM if x != 2 else 0)
            raise ValueError("of a child that is forgotten, and does not go on with the run")
        inner = run(g, tmp_path / f"{x}.zarr", axes={"y": [1, 2]}, pool="serial")
        with (tmp_path / "mark").open("a") as file:
            file.write(f"{x}")
        return {"ended": os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), "sum": x * int(inner.g.sum())}

    def g(y: int):
        return y

    ds = run(f, tmp_path / "s.zarr", axes={"x": [1, 2, 3]}, pool=pool)
    assert (*ds["ended"].values, *ds["sum"].values) == (-signal.SIGTERM, 1, -signal.SIGTERM, 3, 6, 9)
    assert pool != "serial" or [(tmp_path / "mark").read_text().count(x) for x in "23"] == [1, 1]


def test_a_function_that_cannot_be_pickled_is_computed_in_a_child(tmp_path, monkeypatch):
    monkeypatch.setattr(threading, "enumerate", list)  # other tests may have left pools
    with io.StringIO("the content") as file:

        def f(x: float):
            with LOCK:
                file.seek(0)
                return {"text": file.read(), "process": float(os.getpid())}

        ds = run(f, tmp_path / "s.zarr", axes={"x": [1.0, 2.0]})
    assert (ds.text.values.tolist(), os.getpid() in ds.process.values) == (["the content"] * 2, False)
    assert len(set(ds.process.values.tolist())) == 1  # it lives on
    monkeypatch.setattr(os, "fork", lambda: os.listdir(tmp_path / "gone"))
    with pytest.raises(SweepError, match="a child process could not start: "):
        run(f, tmp_path / "t.zarr", axes=THREE)


@pytest.mark.parametrize("pool", [ThreadPool, ThreadPoolExecutor])
def test_where_no_process_may_be_forked_a_new_one_computes_the_same(tmp_path, monkeypatch, pool):
    large, store = bytes(10**6), tmp_path / "s.zarr"  # more than a pipe holds

    def f(x: float):
        os.write(1, large)  # what a run of weeks prints must not fill the disk
        time.sleep(0.1)
        return x / 3.0 * ("-c" in sys.argv) + large[0] + (os.fstat(1).st_size > 15 * 10**6)

    with pool(1) as busy:
        busy.map(int, "1")
        assert run(f, store, axes={"x": range(20)}, workers=1).f.values.tolist() == [x / 3.0 for x in range(20)]
    monkeypatch.setitem(sys.modules, "polars", sys)
    (tmp_path / "sitecustomize.py").write_text("import os; os._exit(3)")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SweepError, match=r"could not start \(exit code 3\)"):
        run(f, store, axes={"x": [30.0]})


def test_many_children_have_the_files_that_the_system_allows_and_go_where_their_blocks_leave_many_open(tmp_path):
    leaves = "globals().setdefault('left', []).extend(open(os.devnull) for _ in range(100)); time.sleep(0.03)"
    points = f"{written(tmp_path, leaves, *range(99))} --axis x=0:98:1"
    run_them = f"{sys.executable} -m linksweep run {points} --workers 12 -o s.zarr"
    subprocess.run(["sh", "-c", f"ulimit -Sn 40; exec {run_them}"], cwd=tmp_path, check=True)


@pytest.mark.parametrize("number", [slow(signal.SIGINT), signal.SIGKILL])
def test_a_child_does_not_outlive_its_run(tmp_path, start_sweep, number):
    reference = written(tmp_path, f"open('begun', 'w').close(); {LIMITED['no other code'][0]}", 2)
    process = start_sweep("run", reference, "--axis", "x=0:4:1", "-o", "s.zarr", cwd=tmp_path)
    wait_until(lambda: process.poll() is not None or (tmp_path / "begun").exists(), "the block", PATIENCE_S)
    family = below(process.pid)
    assert family
    os.kill(process.pid, number)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == {signal.SIGINT: 130, signal.SIGKILL: -9}[number]
    wait_until(lambda: not any(command_of(pid) for pid in family), "the child's end", PATIENCE_S)


def test_what_a_child_leaves_running_does_not_keep_the_run(tmp_path):
    ended, waited = tmp_path / "ended", tmp_path / "waited"

    def f(x: float):
        if x == 1.0:
            if os.fork():
                os._exit(3)
            with suppress(AssertionError):
                wait_until(ended.exists, "the end of the run", 60) and os._exit(0)
            waited.touch()
            os._exit(0)
        return x

    ds = run(f, tmp_path / "s.zarr", axes={"x": [1.0, 2.0]})
    ended.touch()
    assert (ds.status.values.tolist(), waited.exists()) == ([2, 1], False)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [("--workers", "1"), ("--cluster", "c.toml")], ids=["own", "Dask"])
def test_no_process_of_a_run_imports_what_lies_in_the_present_folder(tmp_path, workers):
    (folder := tmp_path / "strangers").mkdir()
    for name in ("sweep", "linksweep", "core", "numpy", "pickle", "signal", "selectors", "psutil", "tempfile"):
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'marks')!r}, 'a').write(__name__ + ' ')\n")
    (folder / "mine.py").write_text("import os\ndef f(x: float = 1.0):\n    return os._exit(3) if x == 2.0 else x\n")
    (folder / "c.toml").write_text('class = "distributed.LocalCluster"\nscale = 1\n[options]\nn_workers = 0\n')
    command = [sys.executable, "-P", "-c", "import sys; from linksweep.sweep.__main__ import main; sys.exit(main())"]
    command += ["run", "mine.py:f", "--axis", "x=1,2,3", "-o", "s.zarr", *workers]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (done.returncode, "2 points done, 1 failed" in done.stderr) == (1, True), done.stderr
    assert not (tmp_path / "marks").exists(), (tmp_path / "marks").read_text()


@pytest.mark.slow
def test_a_script_by_standard_input_computes_in_worker_processes(tmp_path):
    how = {"cwd": tmp_path, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-"], input=SCRIPT, check=False, **how)
    assert (done.returncode, done.stdout) == (0, "[2. 4.] []\n"), done.stderr


class MuteError(Exception):
    def __str__(self):
        raise RuntimeError("no words")

    __repr__ = __str__


ERRORS = [(GeneratorExit(), "serial"), (MuteError(), "serial"), (KeyboardInterrupt(), None)]
ERRORS += [slow(KeyboardInterrupt(), pool) for pool in ("processes", "threads")]


@pytest.mark.parametrize(("error", "pool"), ERRORS)
def test_a_point_that_raises_anything_fails_alone(error, pool, tmp_path):
    def f(x: float):
        if x == 2.0:
            raise error
        return x

    ds = run(f, tmp_path / "s.zarr", axes=THREE, pool=pool)
    said = ": its message cannot be made: RuntimeError" if isinstance(error, MuteError) else ""
    assert (ds.status.values.tolist(), type(error).__name__ + said in ds.attrs["failures"]) == ([1, 2, 1], True)
    if isinstance(error, KeyboardInterrupt):  # in the main thread it is the user's
        with pytest.raises(RunInterruptedError):
            run(f, tmp_path / "t.zarr", axes=THREE, pool="serial")


@pytest.mark.parametrize("options", [slow({"pool": "serial"}), slow({"pool": "threads", "workers": 1}), {}], ids=str)
def test_what_a_point_changes_is_put_back_for_the_others(options, here):
    def f(x: float):
        if x in (1.0, 4.0):
            for change, _ in CHANGES.values():
                change()
            return "changed"
        return " ".join(look() for _, look in CHANGES.values())

    def outside():  # threads of Dask draw from the generators
        generators = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
        return os.getcwd(), dict(os.environ), sys.stderr, generators if options.get("pool") != "threads" else ()

    with warnings.catch_warnings(action="ignore"):
        before, expected = outside(), f(0.0)
        ds = run(f, "s.zarr", axes={"x": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]}, **options)
    assert ds.f.values.tolist() == [expected, "changed", expected, expected, "changed", expected]
    assert (before, (here / "s.zarr").is_dir()) == (outside(), True)


@pytest.mark.parametrize("options", [{"pool": "threads", "workers": 1}, slow({"workers": 2}), {}], ids=str)
def test_global_generators_give_the_same_on_all_pools_and_another_number_at_each_point(options, tmp_path):
    def f(rng: np.random.Generator, x: float):
        return np.random.normal() + random.random()  # noqa: NPY002

    how = enumerate([({"pool": "serial"}, 3), (options, 3), ({"pool": "serial"}, 4)])
    kept = {"n_sim": 600, "keep_samples": True}  # two blocks
    runs = [run(f, tmp_path / f"{k}", axes=THREE, sampling=kept | {"seed": seed}, **o) for k, (o, seed) in how]
    assert np.unique(runs[0].f_samples).size == 3 * 600
    values, others, unlike = (ds.f_mean.values.tolist() for ds in runs)
    assert (len({*values, *unlike}), others) == (6, values)


@pytest.fixture
def deadlines():
    """On a machine that stands still for seconds the alarm would end the process of the tests."""
    before = signal.signal(signal.SIGALRM, lambda number, frame: None)
    yield Deadlines()
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    signal.signal(signal.SIGALRM, before)


def busy(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


def test_a_loop_is_ended_a_block_that_ends_with_its_bell_leaves_nothing_and_the_first_end_counts(deadlines):
    with pytest.raises(TimeLimitError), deadlines.within(0.02):
        busy(60)
    blocks = in_time = 0
    while blocks < examples(300) or not in_time:  # a machine that is slow for a while ends many
        blocks += 1
        with suppress(TimeLimitError):
            with deadlines.within(0.002):
                busy(0.0018)
            in_time += 1
        busy(0.001)  # an exception that came late would leave the test here
    inside, leave = threading.Barrier(3), threading.Barrier(3)

    def block(seconds):
        with deadlines.within(seconds):
            inside.wait(PATIENCE_S)
            leave.wait(PATIENCE_S)

    threads = [threading.Thread(target=block, args=(seconds,)) for seconds in (1000, 3000)]
    for thread in threads:
        thread.start()
    inside.wait(PATIENCE_S)
    assert 900 < signal.getitimer(signal.ITIMER_REAL)[0] <= 1002
    leave.wait(PATIENCE_S)
    for thread in threads:
        thread.join(PATIENCE_S)
