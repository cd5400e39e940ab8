"""Keeps the linear algebra of Dask workers on one thread each."""

from typing import Any

from distributed import WorkerPlugin
from threadpoolctl import threadpool_limits


class PinBlas(WorkerPlugin):
    """Limits BLAS to one thread for as long as the plugin is on a worker.

    Dask's nanny does this for the workers that it starts, but not in other processes (distributed#9075); sums of
    products would then depend on the number of cores, and workers would fight for them.
    """

    def setup(self, worker: Any) -> None:
        """Set the limit when the plugin reaches a worker."""
        self._limits = threadpool_limits(1)

    def teardown(self, worker: Any) -> None:
        """Give the threads back."""
        self._limits.restore_original_limits()
