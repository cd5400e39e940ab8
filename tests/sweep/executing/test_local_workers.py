"""Worker processes of this machine: scripts need no guard for them, and Dask is not imported."""

import subprocess
import sys

import pytest

from tests.tiers import slow

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


WITH_AND_WITHOUT_DASK = """
import sys
import numpy as np, xarray as xr
from linksweep.sweep.stores.store import dask_arrays_only_where_imported
dask_arrays_only_where_imported()
plain = xr.Dataset({"a": ("x", np.arange(4.0))})
assert bool((plain["a"] == plain["a"]).all())
assert "dask.array" not in sys.modules
import dask.array
chunked = xr.DataArray(dask.array.arange(4, chunks=2), dims="x")
assert chunked.chunks == ((2, 2),)
assert isinstance(plain.chunk(x=2)["a"].data, dask.array.Array)
assert "dask.array" in repr(chunked)
assert float((chunked + plain["a"]).sum().compute()) == 12.0
masked = xr.DataArray(dask.array.ma.masked_equal(dask.array.arange(4, chunks=2), 1), dims="x")
assert int(masked.isnull().sum()) == 1
from xarray.namedarray.pycompat import mod_version
assert str(mod_version("dask")) == dask.__version__
"""


@pytest.mark.slow
def test_xarray_knows_arrays_of_dask_where_they_are_imported_and_does_not_import_them():
    done = subprocess.run([sys.executable, "-c", WITH_AND_WITHOUT_DASK], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
