"""Workers of this machine: where they cannot be started, and where that takes long."""

import os
import signal
import subprocess
import sys
import time

import pytest

from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing import pools
from linksweep.sweep.executing.pools import Resources
from tests.patience import PATIENCE_S
from tests.sweep.outside import workers_below

SCRIPT = """
import linksweep

def double(x: float = 1.0):
    return 2.0 * x
{guard}
    print(linksweep.run(double, axes={{"x": [1.0, 2.0]}}, store="s.zarr", workers=1).double.values)
"""


def run_script(folder, text):
    (folder / "script.py").write_text(text)
    return subprocess.run([sys.executable, "script.py"], cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_a_script_without_a_guard_gets_one_sentence(tmp_path):
    done = run_script(tmp_path, SCRIPT.format(guard="if True:"))
    assert (done.returncode, done.stdout) == (1, "")
    [sentence] = done.stderr.splitlines()
    assert sentence.startswith("error: worker processes cannot be started")
    assert "under `if __name__ == '__main__':`" in sentence


@pytest.mark.slow
def test_one_with_a_guard_computes(tmp_path):
    done = run_script(tmp_path, SCRIPT.format(guard="if __name__ == '__main__':"))
    assert (done.returncode, done.stdout) == (0, "[2. 4.]\n"), done.stderr


@pytest.mark.slow
def test_a_script_that_comes_by_standard_input_computes_in_processes(tmp_path):
    script = SCRIPT.format(guard="if __name__ == '__main__':") + "    print(__file__)"
    done = subprocess.run(
        [sys.executable, "-"], input=script, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "[2. 4.]\n<stdin>\n"), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("killed", [2, 1000])
def test_workers_that_are_killed_while_they_start_are_started_again(tmp_path, start_sweep, killed):
    (tmp_path / "f.py").write_text("def f(x: float = 1.0):\n    return 2.0 * x\n")
    process = start_sweep("run", "f.py:f", "--axis", "x=1,2,3", "--workers", "2", "-o", "s.zarr", cwd=tmp_path)
    dead = set()
    while process.poll() is None:
        for pid in set(workers_below(process.pid)) - dead:
            if len(dead) < killed:
                dead.add(pid)
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.01)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == (0 if killed == 2 else 2), err
    assert len(dead) >= 2
    assert "__main__" not in err
    assert "Traceback" not in err
    if killed > 2:
        assert "error: worker processes cannot be started: some ended before they were ready, 5 times" in err
        assert not (tmp_path / "s.zarr").exists()


NO_DASHBOARD = """
import sys
import linksweep

def double(x: float = 1.0):
    return 2.0 * x

if __name__ == "__main__":
    linksweep.run(double, axes={"x": [1.0, 2.0]}, store="s.zarr", workers=1)
    print([name for name in ("bokeh", "dask.array") if name in sys.modules])
"""


@pytest.mark.slow
def test_a_dashboard_that_nobody_asked_for_is_not_imported(tmp_path):
    done = run_script(tmp_path, NO_DASHBOARD)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


@pytest.mark.parametrize(
    ("wished", "expected"),
    [
        ({"pool": "serial"}, "pool 'serial' has no workers and no dashboard"),
        ({"scheduler": "tcp://a:1"}, "a scheduler and a cluster have their own"),
    ],
)
def test_a_dashboard_without_local_workers_is_refused(wished, expected):
    with pytest.raises(SweepError, match=expected):
        Resources(**wished, dashboard=True)


def test_one_without_bokeh_is_refused(monkeypatch):
    monkeypatch.setattr(pools, "find_spec", lambda name: None)
    with pytest.raises(SweepError, match=r"needs bokeh: `pip install 'linksweep\[report\]'`"):
        Resources(dashboard=True)
    assert Resources(workers=2).dashboard is False
