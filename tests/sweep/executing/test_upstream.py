"""What is changed in libraries changes nothing but the time that they take."""

import subprocess
import sys

SCRIPT = """
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


def test_xarray_knows_arrays_of_dask_where_they_are_imported_and_does_not_import_them():
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
