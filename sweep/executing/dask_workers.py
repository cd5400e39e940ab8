"""Brings the workers of a Dask client what they need, compares them with this process, and watches them."""

import time
from asyncio import run_coroutine_threadsafe
from concurrent.futures import Future as Fetching
from concurrent.futures import wait
from threading import Event
from typing import Any

from distributed import Client, Future, WorkerPlugin

from linksweep.sweep.code.load import sendable, source_digest
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.execute import Say
from linksweep.sweep.executing.versions import Identity, differences, identity, require_same
from linksweep.sweep.executing.worker_plugin import Answer, SourcesPlugin, TaskPlugin

LOOK_EVERY_S = 1.0
"""Seconds between two looks at the number of workers."""

PATIENCE_S = 3.0
"""Seconds without workers before the user is told: a worker that died is replaced sooner."""

MAX_ATTEMPTS, PAUSE_S = 6, 0.25
"""Attempts to bring the workers what they need while some of them leave, and the seconds between two attempts."""


class DaskWorkers:
    """The workers of a Dask ``client`` for an experiment: ``where`` they are in words, how many ``threads`` they have,
    and the identity that is ``expected`` of them.
    """

    def __init__(self, client: Client, where: str, reference: str, say: Say) -> None:
        self.client, self.where = client, where
        self.threads, self.expected = 1, identity(reference)
        self._reference, self._say = reference, say
        self._warned: set[str] = set()
        self._looked = self._had_workers = time.monotonic()
        self._waiting = False

    def prepare(self) -> None:
        """Wait for a worker, bring the workers what they need, and compare them with the client.

        Raises SweepError with a list where a worker would compute other numbers.
        """
        reference = self._reference
        try:
            self._register(TaskPlugin())
            in_this_process = str(self.client.scheduler_info()["address"]).startswith("inproc://")
            if not in_this_process and (sources := sendable(reference)) is not None:
                self._register(SourcesPlugin(sources))
            # Where there is no worker yet, an adaptive cluster starts one for this.
            probe = self.client.submit(identity, reference, source_digest(reference), pure=False)
            ended = Event()
            probe.add_done_callback(lambda _: ended.set())
            while not ended.wait(LOOK_EVERY_S):
                self.look()
            found = self.client.run(identity, reference, source_digest(reference), on_error="return")
        except SweepError:
            raise
        except Exception as error:  # whatever keeps a worker from importing what it is sent
            raise (self.unable(error) if self.client.status == "running" else self.gone()) from error
        for worker, what in sorted(found.items()):
            if isinstance(what, Identity):
                self.warn(worker, differences(self.expected.others, what.others))
        require_same(self.expected.deciding, found)
        self.look()

    def _register(self, plugin: WorkerPlugin) -> None:
        """Bring a plugin to all workers; some of them may leave meanwhile."""
        for attempt in range(MAX_ATTEMPTS):
            try:
                self.client.register_plugin(plugin)
                return
            except OSError:
                if self.client.status != "running" or attempt == MAX_ATTEMPTS - 1:
                    raise
                time.sleep(PAUSE_S)

    def look_if_due(self) -> None:
        """Call `look`, unless that was done a moment ago."""
        if time.monotonic() - self._looked > LOOK_EVERY_S:
            self.look()

    def look(self) -> None:
        """Count the threads of the workers; raises SweepError where the connection is lost."""
        if self.client.status != "running":
            raise self.gone()
        try:
            self.threads = sum(self.client.nthreads().values())
        except (OSError, TimeoutError) as error:
            raise self.gone() from error
        self._looked = time.monotonic()
        if self.threads:
            if self._waiting:
                self._say(f"{self.where} has workers again")
            self._had_workers, self._waiting = self._looked, False
        elif not self._waiting and self._looked - self._had_workers > PATIENCE_S:
            self._say(f"{self.where} has no workers; waiting for some")
            self._waiting = True
        self.threads = max(1, self.threads)

    def result(self, future: Future[Any]) -> Answer:
        """Wait for a result, and watch the workers meanwhile: if the worker that had it has died since, it is computed
        again, which would take for ever without workers.
        """
        fetching = self.fetch([future])
        while not wait([fetching], LOOK_EVERY_S).done:
            self.look()
        return fetching.result()[0]

    def fetch(self, futures: list[Future[Any]]) -> Fetching[list[Answer]]:
        """Begin to fetch results, in one message.

        Fetching goes on whether it is waited for or not.  Dask cancels what takes longer than its timeouts; if it had
        not begun yet, as on a machine that stalls for a moment, all that the client fetches later fails.
        """
        loop: Any = self.client.loop
        return run_coroutine_threadsafe(self.client.gather(futures, asynchronous=True), loop.asyncio_loop)

    def warn(self, worker: str, texts: list[str]) -> None:
        """Say once how a worker differs in what decides at most how sums are rounded."""
        for text in texts:
            if text not in self._warned:
                self._warned.add(text)
                self._say(f"warning: {text} (worker {worker}); the last digits of results may differ")

    def gone(self) -> SweepError:
        """Return the error for a connection that is lost."""
        return SweepError(
            f"the connection to {self.where} is lost; what was finished is kept, the same command goes on from there"
        )

    def unable(self, error: BaseException) -> SweepError:
        """Return the error for workers that cannot import what they are sent."""
        return SweepError(f"the workers of {self.where} cannot run linksweep: {type(error).__name__}: {error}")
