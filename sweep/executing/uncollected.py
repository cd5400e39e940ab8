"""Imports without a search for garbage: modules are none, and Python looks for some each time that it has made a few
hundred objects.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Collect no garbage in this block: importing Dask, pandas and xarray takes a tenth less time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
