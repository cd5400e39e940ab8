"""What linksweep brings to a Dask worker: one thread for linear algebra, time limits, the function that runs a task."""

import os
import signal
from dataclasses import dataclass
from typing import Any

from distributed import WorkerPlugin, get_worker
from threadpoolctl import threadpool_limits

from sweep.executing.deadlines import Deadlines
from sweep.executing.isolated import run_guarded
from sweep.executing.task import Task, TaskResult
from sweep.executing.versions import Identity, differences, identity
from sweep.executing.worker import run_task
from sweep.load import provide
from sweep.session import SessionFunction
from sweep.sources import Sources

PLUGIN = "linksweep"


class TaskPlugin(WorkerPlugin):
    """Limits BLAS to one thread for as long as the plugin is on a worker, and holds the deadlines of its blocks.

    Dask's nanny does the first for the workers that it starts, but not in other processes (distributed#9075); sums of
    products would then depend on the number of cores, and workers would fight for them.
    """

    name = PLUGIN
    idempotent = True  # a second client of the same workers must not reset their alarm

    def setup(self, worker: Any) -> None:
        """Set the limits when the plugin reaches a worker, in the main thread of a process of its own."""
        self._limits = threadpool_limits(1)
        self.deadlines = Deadlines()
        if getattr(worker, "nanny", None):  # a process of its own
            os.dup2(2, 1)  # to standard error what goes to standard output: also of code in C, and of programs started
            if hasattr(signal, "pthread_sigmask"):
                signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])

    def teardown(self, worker: Any) -> None:
        """Give the threads back."""
        self._limits.restore_original_limits()


class SourcesPlugin(WorkerPlugin):
    """Brings the sources of an experiment's file and of its local modules, which a worker may not have."""

    idempotent = True

    def __init__(self, sources: Sources | SessionFunction) -> None:
        self._sources = sources
        self.name = f"{PLUGIN}-{sources.path}-{sources.digest}"

    def setup(self, worker: Any) -> None:
        """Let the worker load the experiment."""
        provide(self._sources)


@dataclass(frozen=True)
class Answer:
    """What a worker says: its address, in what it differs from the client, and the result if this decides no number."""

    worker: str
    deciding: list[str]
    others: list[str]
    result: TaskResult | None


def run_on_worker(task: Task, expected: Identity, guarded: bool, memory_limit: int | None) -> Answer:
    """Run a task on the worker that this is called on, if it computes the same numbers as the client.

    With ``guarded`` in a child process, of so many bytes at most (None: as many as the worker may have).
    """
    worker = get_worker()
    found = identity(task.experiment_reference, task.source_digest)
    deciding = differences(expected.deciding, found.deciding)
    others = differences(expected.others, found.others)
    if deciding:
        return Answer(worker.address, deciding, others, None)
    if guarded:
        result = run_guarded(task, expected, memory_limit or worker.memory_manager.memory_limit)
    else:
        plugin = worker.plugins[PLUGIN]
        assert isinstance(plugin, TaskPlugin)
        result = run_task(task, plugin.deadlines)
    return Answer(worker.address, deciding, others, result)
