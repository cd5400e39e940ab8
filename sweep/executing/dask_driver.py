"""Computes jobs on the workers of a Dask client, and goes on when these die, stall or come late."""

import time
from asyncio import run_coroutine_threadsafe
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future as Fetching
from concurrent.futures import wait
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from threading import Event
from typing import Any, Generic

from distributed import Client, Future, KilledWorker, WorkerPlugin

from linksweep.sweep.code.load import Identity, differences, identity, require_same, sendable, source_digest
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.dask_worker import Answer, SourcesPlugin, TaskPlugin, run_on_worker
from linksweep.sweep.executing.pools import Limits
from linksweep.sweep.executing.task import AnyJob, Failure, Say
from linksweep.sweep.planning.work_queue import TASK_S, TASKS_IN_FLIGHT, task_seconds

LOOK_EVERY_S = 1.0
"""Seconds between two looks at the number of workers."""

PATIENCE_S = 3.0
"""Seconds without workers before the user is told: a worker that died is replaced sooner."""

MAX_ATTEMPTS = 6
"""Attempts to bring the workers what they need while some of them leave, or a task that fails outside of the
experiment to an end; the pause after the first is `FIRST_PAUSE_S` long, each other of a task twice the one before."""

FIRST_PAUSE_S = 0.25

MOST_SENT, MOST_FETCHED = 32, 256
"""Most tasks that are sent in one message, and most results that are fetched in one."""

MAX_LOSSES = 3
"""How often a block may be with a worker that dies: in a task, in a child process, and in one of its own."""

KEPT = "what was finished is kept, the same command goes on from there"


@dataclass
class _Submission(Generic[AnyJob]):
    """A job on its way to a worker: how often it was with a worker that died, how often Dask failed with it, and the
    time of the monotonic clock before which it is not sent.

    ``succeeded`` counts the tasks of the run that had succeeded when this job was last lost.
    """

    job: AnyJob
    losses: int = 0
    troubles: int = 0
    not_before: float = 0.0
    succeeded: int = 0


class DaskWorkers:
    """The workers of a Dask ``client`` for an experiment: ``where`` they are in words, how many ``threads`` they have,
    and the identity that is ``expected`` of them.  ``memory_limit`` is that of a worker's child, by default its own.
    """

    def __init__(self, client: Client, where: str, reference: str, say: Say, memory_limit: int | None = None) -> None:
        self.client, self.where, self.say = client, where, say
        self.threads, self.expected = 1, identity(reference)
        self._reference, self._memory_limit = reference, memory_limit
        self._warned: set[str] = set()
        self._looked = self._had_workers = time.monotonic()
        self._waiting = False

    def prepare(self) -> None:
        """Wait for a worker, bring the workers what they need, and compare them with the client.

        Raises SweepError with a list where a worker would compute other numbers.
        """
        arguments = self._reference, source_digest(self._reference)
        try:
            self._register(TaskPlugin())
            in_this_process = str(self.client.scheduler_info()["address"]).startswith("inproc://")
            if not in_this_process and (sources := sendable(self._reference)) is not None:
                self._register(SourcesPlugin(sources))
            # Where there is no worker yet, an adaptive cluster starts one for this.
            probe = self.client.submit(identity, *arguments, pure=False)
            ended = Event()
            probe.add_done_callback(lambda _: ended.set())
            while not ended.wait(LOOK_EVERY_S):
                self.look()
            answers = self.client.run(identity, *arguments, on_error="return")
        except SweepError:
            raise
        except Exception as error:  # whatever keeps a worker from importing what it is sent
            raise (self.unable(error) if self.client.status == "running" else self.gone()) from error
        for worker, answer in sorted(answers.items()):
            if isinstance(answer, Identity):
                self.warn(worker, differences(self.expected.others, answer.others))
        require_same(self.expected.deciding, answers)
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
                time.sleep(FIRST_PAUSE_S)

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
                self.say(f"{self.where} has workers again")
            self._had_workers, self._waiting = self._looked, False
        elif not self._waiting and self._looked - self._had_workers > PATIENCE_S:
            self.say(f"{self.where} has no workers; waiting for some")
            self._waiting = True
        self.threads = max(1, self.threads)

    def look_if_due(self) -> None:
        """Call `look`, unless that was done a moment ago."""
        if time.monotonic() - self._looked > LOOK_EVERY_S:
            self.look()

    def memory_limit(self) -> int | None:
        """Return the bytes that a child of a worker may take: by default those of the worker that has least."""
        if self._memory_limit is not None:
            return self._memory_limit
        limits = (worker["memory_limit"] for worker in self.client.scheduler_info()["workers"].values())
        return min(filter(None, limits), default=None)

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
                self.say(f"warning: {text} (worker {worker}); the last digits of results may differ")

    def gone(self) -> SweepError:
        """Return the error for a connection that is lost."""
        return SweepError(f"the connection to {self.where} is lost; {KEPT}")

    def unable(self, error: BaseException) -> SweepError:
        """Return the error for workers that cannot import what they are sent."""
        return SweepError(f"the workers of {self.where} cannot run linksweep: {type(error).__name__}: {error}")


class DaskDriver:
    """An executor on the workers of a Dask client.

    The work of a worker that died is done again in a child process of another one, where a block that ends its process
    ends nothing else and can be identified: no block is blamed for another.
    """

    def __init__(self, workers: DaskWorkers, limits: Limits, guarded: bool = False) -> None:
        """``guarded`` lets everything run in child processes, for workers in a process that must not be ended."""
        self._workers, self._limits, self._guarded = workers, limits, guarded

    def __call__(self, take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        """Compute everything that ``take`` gives; begin now, not when the first result is asked for."""
        loop = _Loop(self._workers, self._limits, self._guarded, take)
        loop.send_what_is_new()
        return loop.results()


class _Loop(Generic[AnyJob]):
    """The loop over the jobs of one call."""

    def __init__(
        self, workers: DaskWorkers, limits: Limits, guarded: bool, take: Callable[[int], Sequence[AnyJob]]
    ) -> None:
        self._workers, self._limits, self._guarded = workers, limits, guarded
        self._take: Callable[[int], Sequence[AnyJob]] = take
        self._in_flight: dict[Future[Any], _Submission[AnyJob]] = {}
        self._ended: SimpleQueue[Future[Any]] = SimpleQueue()
        self._arrived: deque[tuple[Future[Any], Answer | None]] = deque()
        self._retries: deque[_Submission[AnyJob]] = deque()
        self._given_up: dict[bytes, Failure] = {}
        self._troubles: set[str] = set()
        self._succeeded = 0

    def _room(self) -> int:
        return max(0, TASKS_IN_FLIGHT * self._workers.threads - len(self._in_flight))

    def send_what_is_new(self) -> None:
        """Send as much as there is room for: in several messages, so that workers need not wait for all to be sent."""
        while (room := min(self._room(), MOST_SENT)) and (jobs := self._take(room)):
            self._send([_Submission(job) for job in jobs])

    def results(self) -> Iterator[tuple[AnyJob, Any]]:
        """Yield each job with its result until there are no more."""
        while True:
            now = time.monotonic()
            for again in [one for one in self._retries if one.not_before <= now][: self._room()]:
                self._retries.remove(again)
                rest, failures = again.job.without(self._given_up)
                yield from failures
                if rest is not None:
                    self._send([replace(again, job=rest)])
            if not self._arrived or self._room() >= self._workers.threads:
                self.send_what_is_new()
            if not self._retries and not self._in_flight:
                return
            if not self._arrived:
                self._wait(FIRST_PAUSE_S if self._retries else LOOK_EVERY_S)
            if not self._arrived:
                continue
            future, fetched = self._arrived.popleft()
            one = self._in_flight.pop(future)
            answer, error = self._received(future, fetched)
            if answer is not None:
                self._succeeded += 1
                result = answer.result
            elif not isinstance(error, KilledWorker):
                self._retries.append(self._after_trouble(one, error))
                continue
            elif parts := self._after_loss(one):
                self._retries.extend(parts)
                continue
            else:
                result = one.job.failed(Failure("killed", f"its worker died {MAX_LOSSES} times: {error}"))
            self._given_up = one.job.given_up(result) | self._given_up
            yield one.job, result

    def _send(self, submissions: Sequence[_Submission[AnyJob]]) -> None:
        """Send jobs in one message; all of them were with a worker that died equally often."""
        seconds = task_seconds(self._workers.threads)
        enough_s = 2.0 * seconds if seconds > TASK_S else 0.0
        guarded = self._guarded or submissions[0].losses > 0
        futures = self._workers.client.map(
            run_on_worker,
            [one.job.task(self._limits, enough_s) for one in submissions],
            expected=self._workers.expected,
            guarded=guarded,
            memory_limit=self._workers.memory_limit() if guarded else None,
            pure=False,
        )
        for future, one in zip(futures, submissions, strict=True):
            self._in_flight[future] = one
            future.add_done_callback(self._ended.put)

    def _after_loss(self, one: _Submission[AnyJob]) -> list[_Submission[AnyJob]]:
        """Return what is to be tried after the death of a worker: the same work in a child process, then each block in
        one of its own, then nothing.

        Raises SweepError where workers die and nothing else succeeds: that is no proof against a block.
        """
        losses, blocks = one.losses + 1, len(one.job)
        if losses < MAX_LOSSES:
            words = "one block" if blocks == 1 else f"{blocks} blocks"
            self._workers.say(
                f"a worker died that had {words}; a child process of another one does them again ({losses})"
            )
            jobs = [one.job] if losses == 1 else one.job.alone()
            return [replace(one, job=job, losses=losses, succeeded=self._succeeded) for job in jobs]
        if one.succeeded == self._succeeded:
            raise SweepError(
                f"the workers of {self._workers.where} die whatever they do; no point is blamed for it, {KEPT}"
            )
        return []

    def _after_trouble(self, one: _Submission[AnyJob], error: BaseException | None) -> _Submission[AnyJob]:
        """Return what is to be tried after an error that is not the experiment's; raises SweepError after too many."""
        troubles = one.troubles + 1
        what = f"{type(error).__name__}: {error}"
        if troubles >= MAX_ATTEMPTS:
            raise SweepError(
                f"a task on {self._workers.where} failed {troubles} times outside of the experiment, last with {what}; "
                f"no point is blamed for it, {KEPT}"
            ) from error
        if what not in self._troubles:
            self._troubles.add(what)
            self._workers.say(f"warning: a task failed outside of the experiment ({what}); it is tried again")
        return replace(one, troubles=troubles, not_before=time.monotonic() + FIRST_PAUSE_S * 2.0 ** (troubles - 1))

    def _wait(self, timeout: float) -> None:
        """Wait for futures that end, and watch the workers meanwhile; fetch results in one message, since one by one
        each would cost a round trip to the worker.  What fails so is fetched by itself later.
        """
        self._workers.look_if_due()
        try:
            futures = [self._ended.get(timeout=timeout)]
        except Empty:
            return
        while len(futures) < MOST_FETCHED and not self._ended.empty():
            futures.append(self._ended.get())
        good = [future for future in futures if future.status == "finished"]
        answers: list[Answer] = []
        if len(good) > 1:
            with suppress(Exception):
                answers = self._workers.fetch(good).result(LOOK_EVERY_S)
        known = dict(zip(good, answers, strict=False))
        self._arrived.extend((future, known.get(future)) for future in futures)

    def _received(self, future: Future[Any], fetched: Answer | None) -> tuple[Answer | None, BaseException | None]:
        """Return a worker's answer, or the error with which Dask lost it; what the experiment raises is in the answer.

        Raises SweepError where the worker differs, where it cannot run linksweep, and where the connection is lost.
        """
        try:
            answer = fetched or self._workers.result(future)
        except SweepError:
            raise
        except ImportError as error:
            raise self._workers.unable(error) from error
        except Exception as error:
            if self._workers.client.status != "running":
                raise self._workers.gone() from error
            return None, error
        finally:
            future.release()
        self._workers.warn(answer.worker, answer.others)
        if answer.deciding:
            raise SweepError([f"{answer.worker}: {text}" for text in answer.deciding], "a worker that differs")
        return answer, None
