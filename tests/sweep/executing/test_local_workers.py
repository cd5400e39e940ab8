"""Worker processes of this machine: scripts need no guard for them, and Dask is not imported."""

import subprocess
import sys

import pytest

SCRIPT = """
import sys
import linksweep

def double(x: float = 1.0):
    return 2.0 * x

print(linksweep.run(double, axes={"x": [1.0, 2.0]}, store="s.zarr", workers=2).double.values)
print([name for name in ("bokeh", "distributed", "dask.array") if name in sys.modules])
"""


@pytest.mark.parametrize("by_standard_input", [False, True])
def test_a_script_computes_in_worker_processes(tmp_path, by_standard_input):
    (tmp_path / "script.py").write_text(SCRIPT)
    command, text = ([sys.executable, "-"], SCRIPT) if by_standard_input else ([sys.executable, "script.py"], None)
    done = subprocess.run(command, input=text, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "[2. 4.]\n[]\n"), done.stderr
