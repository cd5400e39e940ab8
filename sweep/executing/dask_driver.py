"""Computes jobs on the workers of a Dask client, and goes on when these die, stall or come late."""

import os
import signal
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
from typing import Any

from distributed import Client, Future, KilledWorker, WorkerPlugin, get_worker
from threadpoolctl import threadpool_limits

from linksweep.sweep.code.load import provide, sendable, source_digest
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.children import Children
from linksweep.sweep.executing.pools import Limits
from linksweep.sweep.executing.process import Deadlines
from linksweep.sweep.executing.task import AnyJob, Call, Failure, Say, Task
from linksweep.sweep.executing.versions import Identity, identity, other_versions
from linksweep.sweep.executing.worker import compute
from linksweep.sweep.planning.work_queue import TASK_S, TASKS_IN_FLIGHT, task_seconds

PLUGIN = "linksweep"

# Seconds between two looks at the number of workers.
LOOK_EVERY_S = 1.0

# Seconds without workers before the user is told: a worker that died is replaced sooner.
PATIENCE_S = 3.0

# Attempts to bring the workers what they need while some of them leave, or a task that fails outside of the experiment
# to an end, with a pause after each.
MAX_ATTEMPTS = 6

PAUSE_S = 0.25

# Most tasks that are sent in one message, and most results that are fetched in one: with a message for each, the round
# trip to a worker limited a run to 60 tasks a second.
MOST_SENT, MOST_FETCHED = 32, 256

# How often a block may be with a worker that dies: in a task, in a child process, and in one of its own.
MAX_LOSSES = 3

KEPT = "what was finished is kept, the same command goes on from there"


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
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])  # which an experiment may need

    def teardown(self, worker: Any) -> None:
        """Lift the limit of one thread."""
        self._limits.restore_original_limits()


class SourcesPlugin(WorkerPlugin):
    """Brings the sources of an experiment's file and of its local modules, which a worker may not have."""

    idempotent = True

    def __init__(self, sources: Any) -> None:
        self._sources = sources
        self.name = f"{PLUGIN}-{sources.path}-{sources.digest}"

    def setup(self, worker: Any) -> None:
        """Let the worker load the experiment."""
        provide(self._sources)


@dataclass(frozen=True)
class Reply:
    """A worker's answer: its address, how it differs from the client, and the result if this decides no number."""

    worker: str
    deciding: list[str]
    others: list[str]
    result: Any = None


def run_on_worker(task: Task | Call, expected: Identity, guarded: bool, memory_limit: int | None) -> Reply:
    """Run a task on the worker that this is called on, if it computes the same numbers as the client.

    With ``guarded`` blocks run in a child process of at most ``memory_limit`` bytes (None: no limit).
    """
    worker = get_worker()
    reference, digest = task.experiment_reference, task.source_digest
    here = identity(reference, digest)
    answer = Reply(
        worker.address,
        other_versions(expected.deciding, here.deciding),
        other_versions(expected.others, here.others),
    )
    if answer.deciding:
        return answer
    if guarded and isinstance(task, Task):
        limits = Limits(task.time_limit_s, memory_limit)
        with Children(reference, 1, limits, forked=False, digest=digest, expected=expected) as child:
            return replace(answer, result=child.run(task))
    plugin = worker.plugins[PLUGIN]
    assert isinstance(plugin, TaskPlugin)
    return replace(answer, result=compute(task, plugin.deadlines))


@dataclass
class _Submission:
    """A job on its way to a worker: how often it was with a worker that died, and how often Dask failed with it.

    ``succeeded`` counts the tasks of the run that had succeeded when this job was last lost.
    """

    job: Any
    losses: int = 0
    troubles: int = 0
    succeeded: int = 0


class DaskDriver:
    """An executor on the workers of a Dask ``client``; ``where`` these are in words.

    The work of a worker that died is done again in a child process of another one, where a block that ends its process
    ends nothing else and can be identified: no block is blamed for another.
    """

    def __init__(self, client: Client, where: str, reference: str, limits: Limits, say: Say) -> None:
        self.client, self._where, self._reference, self._limits, self._say = client, where, reference, limits, say
        self._expected = identity(reference)
        self._threads = 1
        self._warned: set[str] = set()
        self._looked = self._had_workers = time.monotonic()
        self._waiting = False
        self._in_flight: dict[Future[Any], _Submission] = {}

    def cancel(self) -> None:
        """Take back the tasks whose results nobody will take: the client may be used for others."""
        if self._in_flight and self.client.status == "running":
            with suppress(OSError, TimeoutError):
                self.client.cancel(list(self._in_flight))

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
                self._look()
            answers = self.client.run(identity, *arguments, on_error="return")
        except SweepError:
            raise
        except Exception as error:  # whatever keeps a worker from importing what it is sent
            raise (self._unable(error) if self.client.status == "running" else self._gone()) from error
        problems = []
        for worker, answer in sorted(answers.items()):
            if isinstance(answer, Identity):
                self._warn(worker, other_versions(self._expected.others, answer.others))
                problems += [f"{worker}: {text}" for text in other_versions(self._expected.deciding, answer.deciding)]
            elif not isinstance(answer, OSError):  # else it has gone; should it return, its first task is compared
                problems.append(f"{worker}: {type(answer).__name__}: {answer}")
        if problems:
            raise SweepError(problems, "workers that would not compute what this process would")
        self._look()

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

    def _look(self) -> None:
        """Count the threads of the workers; raises SweepError where the connection is lost."""
        if self.client.status != "running":
            raise self._gone()
        try:
            threads = sum(self.client.nthreads().values())
        except (OSError, TimeoutError) as error:
            raise self._gone() from error
        self._looked, self._threads = time.monotonic(), max(1, threads)
        if threads:
            if self._waiting:
                self._say(f"{self._where} has workers again")
            self._had_workers, self._waiting = self._looked, False
        elif not self._waiting and self._looked - self._had_workers > PATIENCE_S:
            self._say(f"{self._where} has no workers; waiting for some")
            self._waiting = True

    def _warn(self, worker: str, texts: list[str]) -> None:
        """Say once how a worker differs in what decides at most how sums are rounded."""
        for text in texts:
            if text not in self._warned:
                self._warned.add(text)
                self._say(f"warning: {text} (worker {worker}); the last digits of results may differ")

    def _gone(self) -> SweepError:
        return SweepError(f"the connection to {self._where} is lost; {KEPT}")

    def _unable(self, error: BaseException) -> SweepError:
        return SweepError(f"the workers of {self._where} cannot run linksweep: {type(error).__name__}: {error}")

    def __call__(self, take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        """Compute everything that ``take`` gives; begin now, not when the first result is asked for."""
        self._take: Callable[[int], Sequence[Any]] = take
        self._ended: SimpleQueue[Future[Any]] = SimpleQueue()
        self._arrived: deque[tuple[Future[Any], Reply | None]] = deque()
        self._succeeded = 0
        self._send_what_is_new()
        return self._results()

    def _room(self) -> int:
        return max(0, TASKS_IN_FLIGHT * self._threads - len(self._in_flight))

    def _send_what_is_new(self) -> None:
        """Send as much as there is room for: in several messages, so that workers need not wait for all to be sent."""
        while (room := min(self._room(), MOST_SENT)) and (jobs := self._take(room)):
            self._send([_Submission(job) for job in jobs])

    def _results(self) -> Iterator[tuple[Any, Any]]:
        """Yield each job with its result until there are no more."""
        while True:
            if not self._arrived or self._room() >= self._threads:
                self._send_what_is_new()
            if not self._in_flight:
                return
            if not self._arrived:
                self._wait()
                continue
            future, fetched = self._arrived.popleft()
            one = self._in_flight.pop(future)
            try:
                answer = self._received(future, fetched)
            except SweepError:
                raise
            except KilledWorker as error:
                if one.losses + 1 < MAX_LOSSES:
                    self._send(self._after_loss(one))
                    continue
                if one.succeeded == self._succeeded:  # that is no proof against a block
                    words = f"the workers of {self._where} die whatever they do; no point is blamed for it, {KEPT}"
                    raise SweepError(words) from error
                yield one.job, one.job.failed(Failure("killed", f"its worker died {MAX_LOSSES} times: {error}"))
            except Exception as error:
                self._send([self._after_trouble(one, error)])
            else:
                self._succeeded += 1
                yield one.job, answer.result

    def _send(self, submissions: Sequence[_Submission]) -> None:
        """Send jobs in one message; all of them were with a worker that died equally often."""
        if not submissions:
            return
        seconds = task_seconds(self._threads)
        enough_s = 2.0 * seconds if seconds > TASK_S else 0.0
        guarded = submissions[0].losses > 0
        futures = self.client.map(
            run_on_worker,
            [one.job.task(self._limits, enough_s) for one in submissions],
            expected=self._expected,
            guarded=guarded,
            memory_limit=self._memory_limit() if guarded else None,
            pure=False,
        )
        for future, one in zip(futures, submissions, strict=True):
            self._in_flight[future] = one
            future.add_done_callback(self._ended.put)

    def _memory_limit(self) -> int | None:
        """Return the bytes that a child of a worker may take: by default those of the worker that has least."""
        limits = (worker["memory_limit"] for worker in self.client.scheduler_info()["workers"].values())
        return self._limits.memory or min(filter(None, limits), default=None)

    def _after_loss(self, one: _Submission) -> list[_Submission]:
        """Return what is to be tried after the death of a worker: the work that is still wanted in a child process, and
        if that takes its worker with it, each block in one of its own.
        """
        losses = one.losses + 1
        self._say(f"a worker died; a child process of another one does its work again ({losses})")
        jobs = [one.job] if losses == 1 else one.job.alone()
        some = [replace(one, job=job.wanted(), losses=losses, succeeded=self._succeeded) for job in jobs]
        return [again for again in some if again.job]

    def _after_trouble(self, one: _Submission, error: Exception) -> _Submission:
        """Return what is to be tried after an error that is not the experiment's; raises SweepError after too many."""
        what = f"{type(error).__name__}: {error}"
        if one.troubles + 1 >= MAX_ATTEMPTS:
            raise SweepError(
                f"a task on {self._where} failed {MAX_ATTEMPTS} times outside of the experiment, last with {what}; "
                f"no point is blamed for it, {KEPT}"
            ) from error
        self._say(f"warning: a task failed outside of the experiment ({what}); it is tried again")
        time.sleep(PAUSE_S)  # what ails Dask may pass
        return replace(one, troubles=one.troubles + 1)

    def _wait(self) -> None:
        """Wait for futures that end, and watch the workers meanwhile; fetch results in one message.  What fails so is
        fetched by itself later.
        """
        if time.monotonic() - self._looked > LOOK_EVERY_S:
            self._look()
        try:
            futures = [self._ended.get(timeout=LOOK_EVERY_S)]
        except Empty:
            return
        while len(futures) < MOST_FETCHED and not self._ended.empty():
            futures.append(self._ended.get())
        good = [future for future in futures if future.status == "finished"]
        answers: list[Reply] = []
        if len(good) > 1:
            with suppress(Exception):
                answers = self._fetch(good).result(LOOK_EVERY_S)
        known = dict(zip(good, answers, strict=False))
        self._arrived.extend((future, known.get(future)) for future in futures)

    def _fetch(self, futures: list[Future[Any]]) -> Fetching[list[Reply]]:
        """Begin to fetch results, in one message.

        Fetching goes on whether it is waited for or not.  Dask cancels what takes longer than its timeouts; if it had
        not begun yet, as on a machine that stalls for a moment, all that the client fetches later fails.
        """
        loop: Any = self.client.loop
        return run_coroutine_threadsafe(self.client.gather(futures, asynchronous=True), loop.asyncio_loop)

    def _result(self, future: Future[Any]) -> Reply:
        """Wait for a result, and watch the workers meanwhile: if the worker that had it has died since, it is computed
        again, which would take for ever without workers.
        """
        fetching = self._fetch([future])
        while not wait([fetching], LOOK_EVERY_S).done:
            self._look()
        return fetching.result()[0]

    def _received(self, future: Future[Any], fetched: Reply | None) -> Reply:
        """Return a worker's answer; raises the error with which Dask lost it.  What the experiment raises is in it.

        Raises SweepError where the worker differs, where it cannot run linksweep, and where the connection is lost.
        """
        try:
            answer = fetched or self._result(future)
        except ImportError as error:
            raise self._unable(error) from error
        except Exception as error:
            if self.client.status != "running" and not isinstance(error, SweepError):
                raise self._gone() from error
            raise
        finally:
            future.release()
        self._warn(answer.worker, answer.others)
        if answer.deciding:
            raise SweepError([f"{answer.worker}: {text}" for text in answer.deciding], "a worker that differs")
        return answer
