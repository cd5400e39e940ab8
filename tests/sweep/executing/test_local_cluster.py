"""Worker processes of this machine, where they cannot be started."""

import subprocess
import sys

import pytest

SCRIPT = """
import linksweep

def double(x: float = 1.0):
    return 2.0 * x
{guard}
    print(linksweep.run(double, axes={{"x": [1.0, 2.0]}}, store="s.zarr", workers=1).double.values)
"""

CATCHES = """
try:
    linksweep.run(double, axes={"x": [1.0, 2.0]}, store="s.zarr", workers=1)
except linksweep.SweepError as error:
    print(str(error)[:6])
"""


def run_script(folder, text):
    (folder / "script.py").write_text(text)
    return subprocess.run([sys.executable, "script.py"], cwd=folder, capture_output=True, text=True, check=False)


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
def test_it_can_be_caught_as_any_other_error(tmp_path):
    done = run_script(tmp_path, SCRIPT.format(guard="if False:") + CATCHES)
    assert (done.returncode, done.stdout) == (0, "worker\n"), done.stderr
