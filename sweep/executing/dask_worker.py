"""What linksweep brings to a Dask worker: one thread for linear algebra, time limits, the function that runs a task.

The process that workers are forked from imports this module.
"""

import os
import signal
from dataclasses import dataclass
from typing import Any

from distributed import WorkerPlugin, get_worker
from threadpoolctl import threadpool_limits

from linksweep.sweep.code.load import Identity, Live, LocalFiles, differences, identity, provide
from linksweep.sweep.executing.children import Children
from linksweep.sweep.executing.process import Deadlines
from linksweep.sweep.executing.task import Call, Task
from linksweep.sweep.executing.worker import compute

PLUGIN = "linksweep"


class TaskPlugin(WorkerPlugin):
    """Limits BLAS to one thread for as long as the plugin is on a worker, and holds the deadlines of its blocks.

    Dask's nanny limits BLAS for the workers that it starts, but not in other processes (distributed#9075): sums of
    products there would depend on the number of cores, and workers would compete for the cores.
    """

    name = PLUGIN
    idempotent = True  # a second client of the same workers must not reset their alarm

    def setup(self, worker: Any) -> None:
        """Set the limits when the plugin reaches a worker; in a process of its own this runs in the main thread."""
        self._limits = threadpool_limits(1)
        self.deadlines = Deadlines()
        if getattr(worker, "nanny", None):  # a process of its own
            os.dup2(2, 1)  # standard output goes to standard error, also that of C code and of programs it starts
            if hasattr(signal, "pthread_sigmask"):
                signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])

    def teardown(self, worker: Any) -> None:
        """Lift the limit of one thread."""
        self._limits.restore_original_limits()


class SourcesPlugin(WorkerPlugin):
    """Brings the sources of an experiment's file and of its local modules, which a worker may not have."""

    idempotent = True

    def __init__(self, sources: LocalFiles | Live) -> None:
        self._sources = sources
        self.name = f"{PLUGIN}-{sources.path}-{sources.digest}"

    def setup(self, worker: Any) -> None:
        """Let the worker load the experiment."""
        provide(self._sources)


@dataclass(frozen=True)
class Answer:
    """A worker's answer: its address, how it differs from the client, and the result if this decides no number."""

    worker: str
    deciding: list[str]
    others: list[str]
    result: Any = None


def run_on_worker(task: Task | Call, expected: Identity, guarded: bool, memory_limit: int | None) -> Answer:
    """Run a task on the worker that this is called on, if it computes the same numbers as the client.

    With ``guarded`` blocks run in a child process of at most ``memory_limit`` bytes (None: no limit).
    """
    worker = get_worker()
    here = identity(task.experiment_reference, task.source_digest)
    deciding, others = differences(expected.deciding, here.deciding), differences(expected.others, here.others)
    if deciding:
        return Answer(worker.address, deciding, others)
    if guarded and isinstance(task, Task):
        with Children(expected, memory_limit) as children:
            return Answer(worker.address, deciding, others, children.run(task))
    plugin = worker.plugins[PLUGIN]
    assert isinstance(plugin, TaskPlugin)
    return Answer(worker.address, deciding, others, compute(task, plugin.deadlines))
