"""Chooses where jobs are computed, and computes them there: in this process, until they turn out long, in threads of
it, in child processes, so that a block that ends its process ends nothing else and can be identified, or by Dask.
"""

import ctypes
import fcntl
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from contextvars import copy_context
from dataclasses import replace
from functools import partial
from itertools import count, islice
from multiprocessing.connection import Connection, wait
from pickle import UnpicklingError
from queue import SimpleQueue
from typing import IO, Any

from linksweep.sweep.code import new_process, provide, sendable
from linksweep.sweep.contract import SweepError, refused
from linksweep.sweep.executing import worker
from linksweep.sweep.executing.pools import ANY_RESOURCES, NO_LIMITS, Limits, Place, Resources, available_cores
from linksweep.sweep.executing.task import AnyJob, Call, Executor, Failure, Identity, PointBlock, Task, TaskResult
from linksweep.sweep.interrupt import SIGNALS
from linksweep.sweep.studies.study import Study

# Seconds of a first call above which the second, which shows whether it returns the same, is made by a further child:
# it would delay what one of few has to do.
BESIDE_S = 0.2

# How often a block may end its child, when it is known which block it was.
TRIES = 2

# Share of the memory limit at which a child is ended, the same at which Dask's nanny ends a worker.
MEMORY_SHARE = 0.95

# Seconds between two looks at the children's memory.
LOOK_EVERY_S = 0.05

# Seconds of work whose results a child sends together.
SEND_EVERY_S = 0.02

# Bytes that are kept of the end of what a child wrote to standard error.
LAST_WORDS = 4096

# Seconds that children get to end by themselves: threads and files that an experiment leaves may keep them.
END_S = 1.0

# Libraries with threads or devices of their own, for which a fork of a process that used them may wait for ever.
NOT_TO_BE_FORKED = ("jax", "torch", "tensorflow", "cupy", "polars", "numba.np.ufunc.omppool")

# Files that are open in a run, and for each of its children; many systems allow 1024 where nobody asks for more.
FILES, FILES_EACH = 512, 6

# Freed memory that a child's allocator keeps: arrays of some MB are made anew for each catalogue, and giving them back
# to the system each time costs a fifth of the run.
KEEP_BYTES = 2**28


Opened = AbstractContextManager[tuple[Place, Executor]]


class Children:
    """An executor on child processes, which live on for the next job unless a block ends one or takes more memory than
    the limit; then another one takes its place.

    If ``forked`` they are copies of this process where there can be some, which start in milliseconds and have every
    function that this one has; else new processes, which import or unpickle what they need, and whose code must be as
    ``expected``, by default that of this process.
    """

    def __init__(
        self, number: int = 1, limits: Limits = NO_LIMITS, *, forked: bool = True, expected: Identity | None = None
    ) -> None:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        if 0 <= soft < (most := FILES + FILES_EACH * number):  # of 256 cores, say
            with suppress(ValueError, OSError):  # then it is said where one does not start
                resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, hard) if hard >= 0 else most, hard))
        self._limits, forked = limits, forked and _may_be_forked()
        self._new = partial(_Child, forked, limits.memory, expected)
        self._children = [self._new() for _ in range(number)]
        self._second: _Child | None = None  # makes a first call again, beside the others
        self._looked = time.monotonic()

    def __enter__(self) -> "Children":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        end = time.monotonic() + (END_S if kind is None else 0.0)
        children = [*self._children, *filter(None, [self._second])]
        for child in children if kind is None else ():
            child.send(None)  # one that waits for a task cleans up and ends
        for child in children:
            child.end(end - time.monotonic())

    def __call__(self, take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        """Compute everything that ``take`` gives."""
        return self._results(
            lambda count: [(job, replace(job.task(self._limits), at_once_s=BESIDE_S)) for job in take(count)]
        )

    def run(self, task: Task) -> TaskResult:
        """Compute one task."""
        tasks = [(None, task)]
        result: TaskResult
        [(_, result)] = self._results(lambda _: [tasks.pop()] if tasks else [])
        return result

    def _results(self, take: Callable[[int], Iterable[tuple[Any, Task]]]) -> Iterator[tuple[Any, Any]]:
        busy: dict[_Child, Any] = {}  # with their jobs

        def begin(child: _Child) -> None:
            for job, task in () if child in busy else take(1):
                for one in self._children:  # as late as there is work, and together: new processes import for a while
                    one.start(task)
                busy[child] = job
                child.begin(task)

        def results() -> Iterator[tuple[Any, Any]]:
            try:
                while busy:
                    for child in self._that_answer(busy):
                        trial = child.take()
                        if trial.again is not None and self._second is None:  # once in a run is enough
                            self._second = self._new()
                            busy[self._second] = busy[child]
                            self._second.begin(trial.again)
                        if not trial.ended:
                            continue
                        job, result = busy.pop(child), trial.result()
                        if child is self._second:
                            if result.refused:
                                yield job, result
                            continue
                        if len(self._children) > 1:  # of several none waits while a result is used; one may be the last
                            begin(child)
                        yield job, result
                    for child in self._children:
                        begin(child)
            finally:
                for child in busy:  # nobody will take these results
                    child.end()

        for child in self._children:  # now, not when the first result is asked for
            begin(child)
        return results()

    def _that_answer(self, busy: Iterable["_Child"]) -> list["_Child"]:
        """Return which children have answered or ended; end those that overfill their memory."""
        channels: dict[Any, _Child] = {child.channel: child for child in busy}
        ready = wait(list(channels), LOOK_EVERY_S)
        before, self._looked = self._looked, time.monotonic()
        for child in channels.values() if self._looked > before + LOOK_EVERY_S + worker.GRACE_S else ():
            child.trial.was_stopped = True
        if ready:
            return [channels[channel] for channel in ready]
        for child in busy:
            child.end_if_overfull()
        # What a child has started may keep its channel open.
        return [child for child in busy if child.code(0.0) is not None]


class _Trial:
    """A task on its way through children: the ``units`` that have no result yet, and the ``results`` of those before.

    ``careful`` is a task of which a child has died, so that each result is to be sent at once: else nobody knows how
    far it came.  ``inside`` counts the points that are left of a unit which was taken apart.  ``again`` is the task of
    making its first call once more.  What ``was_stopped`` together with this process, by SIGSTOP or a batch system, may
    have reached its time limit only for that.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.units, self.results = deque(task.units), list[TaskResult]()
        self.careful, self.ended, self.was_stopped = task.time_limit_s is not None, False, False
        self.again: Task | None = None
        self.inside = self._deaths = 0
        self._begun = time.monotonic()

    def rest(self) -> Task:
        """Return what a child is to compute next: of a unit that was taken apart its points alone."""
        return replace(self.task, units=tuple(self.units)[: self.inside or None])

    def take(self, result: TaskResult) -> None:
        """Add the result of the first units."""
        self._deaths, self._begun, self.was_stopped = 0, time.monotonic(), False
        self.results.append(result)
        units, rows = list[PointBlock](), len(result.seconds)
        self.inside = max(0, self.inside - rows)
        while rows > 0:
            units.append(self.units.popleft())
            rows -= len(units[-1].points)
        if result.again:
            done = tuple(units[row] for row in result.outcomes)
            self.again = replace(self.task, units=done, first=tuple(result.outcomes.values()))

    def after_death(self, death: Failure) -> None:
        """Find out which point has ended a child, and give that up after so many `TRIES`.

        Then the task ends: its other blocks are given out again, but for those of this point, which would cost as much.
        """
        if not self.units:  # only the end of the task was left to be said
            self.ended = True
        elif not self.careful:
            self.careful = True
        elif len((unit := self.units[0]).points) > 1:  # one of those that share the draw is to blame
            self.units.popleft()
            self.units.extendleft(replace(unit, points=(point,)) for point in reversed(unit.points))
            self.inside = len(unit.points)
        else:
            self._deaths += 1
            if (death.kind == "time limit" and not self.was_stopped) or self._deaths >= TRIES:
                self.take(TaskResult.failed(1, death, time.monotonic() - self._begun))
                self.ended = not self.inside

    def result(self) -> TaskResult:
        """Return the result of the task: the last units have none where it took too long."""
        return TaskResult.joined(self.results)


def _may_be_forked() -> bool:
    """Return whether a copy of this process can compute: Accelerate on macOS cannot, nor some libraries that the user
    may have computed with, nor pools of this session, such as those of Dask and joblib: a copy would wait for their
    threads, which it has not.  Python lets no daemonic process have children of this kind.
    """
    known = any(name in sys.modules for name in NOT_TO_BE_FORKED)
    threads = {*threading.enumerate()} - {threading.main_thread(), threading.current_thread()}
    pooled = any(
        type(thread).__module__ == "multiprocessing.dummy"  # of a ThreadPool; others have not imported it
        or thread.name == "IO loop"  # of Dask's clients
        # A copy makes those of Zarr anew, and sets no timers.
        or not (thread.daemon or thread.name.startswith("asyncio_") or isinstance(thread, threading.Timer))
        for thread in threads
    )
    return sys.platform == "linux" and not (known or pooled or multiprocessing.current_process().daemon)


class _Child:
    """A process that computes tasks, and the ``channel`` to it: a copy of this one (``forked``), or a new one.  Another
    one takes its place where it has ended.
    """

    def __init__(self, forked: bool, memory_limit: int | None, expected: Identity | None) -> None:
        self._forked, self._memory_limit, self._expected = forked, memory_limit, expected
        self._process: Any = None
        self._is_open = self._is_ready = False

    def start(self, task: Task) -> None:
        """Start a process for tasks like this one unless there is one; raises SweepError where it does not start."""
        if self._is_open:
            return
        with refused(OSError, said="a child process could not start: "):
            self.channel, theirs = multiprocessing.Pipe()
            self._words: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the child)
            self._is_open, self._is_ready, self._is_overfull = True, self._forked, False
            import psutil

            # A copy has all pages of this process from the start, which cost nothing and are no need of its blocks.
            inherited = psutil.Process().memory_info().rss if self._forked else 0
            self._most = inherited + MEMORY_SHARE * (self._memory_limit or float("inf"))
            if self._forked:
                arguments = self.channel, theirs, self._words
                self._process = multiprocessing.get_context("fork").Process(target=_compute_forked, args=arguments)
                # A signal that comes before the child has its own handlers would be answered by those of this process.
                before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
                try:
                    # of threads: see `_may_be_forked`
                    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
                        self._process.start()
                finally:
                    signal.pthread_sigmask(signal.SIG_SETMASK, before)
            else:
                start = f"from linksweep.sweep.executing.executor import compute_anew; compute_anew({theirs.fileno()})"
                files: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": self._words, "stderr": self._words}
                self._process = new_process(start, **files, pass_fds=[theirs.fileno()])
            theirs.close()
        self._code = task.experiment_reference, task.source_digest
        if not self._forked:  # now: where it has ended already, nobody else has the other end
            self.send((sendable(*self._code), *self._code))

    def begin(self, task: Task) -> None:
        """Give the process a task."""
        self.trial = _Trial(task)
        self._go_on()

    def _go_on(self) -> None:
        """Send what is left of the task, to another process where this one has ended."""
        self.start(self.trial.task)
        # Where the child goes on to write, too: its programs may write gigabytes.
        os.truncate(self._words.fileno(), os.lseek(self._words.fileno(), 0, os.SEEK_SET))
        if self._is_ready:  # else when it is
            self.send((self.trial.rest(), self.trial.careful))

    def send(self, message: Any) -> None:
        """Send a message; a process that has ended is noticed when its answer is waited for."""
        if self._is_open:
            with suppress(OSError):
                self.channel.send(message)

    def take(self) -> _Trial:
        """Take an answer, and return how far the task is; where the process has ended, find out why.

        Raises SweepError for a new process that cannot load the code or has another one.
        """
        trial = self.trial
        try:
            if not self.channel.poll():
                raise EOFError
            answer = self.channel.recv()
        except (EOFError, OSError, UnpicklingError):  # the last where a function has broken what pickle uses
            trial.after_death(self._death(trial.task.time_limit_s))
        else:
            if isinstance(answer, TaskResult):
                trial.take(answer)
                return trial
            if isinstance(answer, SweepError):
                raise answer
            if isinstance(answer, Identity):
                expected = self._expected or Identity.here(*self._code)
                if differ := expected.beside(answer, self._code[0]).differences(answer):
                    raise SweepError([f"a process started since the run began differs: {text}" for text in differ])
                self._is_ready = True
            else:  # all that it gives at once
                trial.ended = not trial.units or (bool(trial.results) and not trial.inside)
        if not trial.ended:
            self._go_on()
        return trial

    def end_if_overfull(self) -> None:
        """End a process that has taken more memory than the limit."""
        import psutil

        with suppress(psutil.NoSuchProcess):
            if psutil.Process(self._process.pid).memory_info().rss > self._most:
                self._is_overfull = True
                self._process.kill()

    def code(self, patience_s: float) -> int | None:
        """Return the exit code, None where the process has not ended by then."""
        if isinstance(self._process, subprocess.Popen):
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(patience_s)
            return self._process.returncode
        self._process.join(patience_s)
        exit_code: int | None = self._process.exitcode
        return exit_code

    def end(self, patience_s: float = 0.0) -> None:
        """End the process unless it ends by itself within so many seconds."""
        if not self._is_open:
            return
        if getattr(self._process, "pid", None) and (patience_s <= 0.0 or self.code(patience_s) is None):
            self._process.kill()
            self.code(END_S)
        self.channel.close()
        self._words.close()
        self._is_open = False
        if isinstance(self._process, subprocess.Popen) and self._process.stdin is not None:
            self._process.stdin.close()

    def _death(self, time_limit_s: float | None) -> Failure:
        """Return the failure for which a process that does not answer any more stands, and end it if need be."""
        code = self.code(END_S)
        # The end of what it wrote, where Python writes before it is ended by a signal.
        self._words.seek(max(0, self._words.seek(0, os.SEEK_END) - LAST_WORDS))
        words = self._words.read().decode(errors="replace").strip()
        self.end()
        if not self._is_ready:
            raise SweepError(f"a child process could not start (exit code {code}): {words}")
        if self._is_overfull and self._memory_limit:
            return Failure("killed", f"needs more than the memory limit of {self._memory_limit / 1e9:.3g} GB", words)
        if time_limit_s is not None and code == -signal.SIGALRM:
            return Failure.too_long(time_limit_s, words)
        if code is None:
            return Failure("killed", "closed the files of its process, among them the one for its results", words)
        how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        how += ", perhaps because the machine had no memory left" if how == "SIGKILL" else ""
        return Failure("killed", f"ended its process with {how}", words)


def _compute_forked(parents: Connection, channel: Connection, words: IO[bytes]) -> None:
    """Run as a copy of the parent."""
    parents.close()
    signal.set_wakeup_fd(-1)  # that of an event loop of the parent
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    sys.stdout = sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115 (locks of others came with the fork)
    parent = multiprocessing.parent_process()
    assert parent is not None, "this is a child"
    _end_with(parent.sentinel)
    _serve(channel, words)


def compute_anew(number: int) -> None:
    """Run as a new child whose channel has this file descriptor."""
    _end_with(0)
    channel = Connection(number)
    sources, reference, digest = channel.recv()
    if sources is not None:
        provide(sources)
    try:
        channel.send(Identity.here(reference, digest))
    except SweepError as error:
        channel.send(error)
        return
    _serve(channel, sys.stderr.buffer)


def _end_with(number: int) -> None:
    """Let the system end this process when the other end of a pipe is closed, as it is when the parent has ended, even
    if a block in compiled code lets no other code of Python run.
    """
    fcntl.fcntl(number, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(number, fcntl.F_SETFL, fcntl.fcntl(number, fcntl.F_GETFL) | os.O_ASYNC)


def _serve(channel: Connection, words: IO[bytes]) -> None:
    """Compute the tasks that come by a channel, and answer with results, and None at the end of each task."""
    import faulthandler

    worker.leave_signals_to_parent()
    worker.limit_threads()
    with suppress(OSError, AttributeError):  # there is only one such allocator
        for what in (-1, -3):  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD
            ctypes.CDLL(None).mallopt(what, KEEP_BYTES)
    with suppress(OSError):
        os.dup2(2, 1)  # what is printed outside of Python must not get among the results
    faulthandler.enable(words, all_threads=False)  # prints where the code was when the process ends
    faulthandler.register(signal.SIGALRM, words, all_threads=False, chain=True)
    deadlines = worker.Deadlines()
    number, most = channel.fileno(), resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    is_filled = partial(_is_filled, number, (number + most) // 2)
    with suppress(EOFError):
        while not is_filled() and (message := channel.recv()) is not None:
            for result in _results(deadlines, is_filled, *message):
                channel.send(result)
            channel.send(None)


def _is_filled(number: int, most: int) -> bool:
    """Return whether blocks have left so many files open, besides that of this number, that another process is to take
    the place of this one.
    """
    try:
        os.close(lowest := os.dup(number))
    except OSError:  # no file is left
        return True
    return lowest > most


def _results(
    deadlines: worker.Deadlines, is_filled: Callable[[], bool], task: Task, careful: bool
) -> Iterator[TaskResult]:
    """Yield the results of a task: several as one, or if ``careful`` each unit as soon as it is done.  The last units
    have none where this process is filled.
    """
    ready, sent = list[TaskResult](), time.monotonic()
    for result in worker.run_units(task, deadlines, apart=careful):
        ready.append(result)
        if is_filled():
            break
        if careful or time.monotonic() > sent + SEND_EVERY_S:
            yield TaskResult.joined(ready)
            ready, sent = [], time.monotonic()
    if ready:
        yield TaskResult.joined(ready)


Map = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[Any]]

# Seconds of work that are worth the start of worker processes: each imports for itself what its first point needs.
WORKERS_START_S = 0.3

# Seconds of work that show how long the rest takes: a first call may take a hundred times as long as the others.
JUDGED_S = 0.05

# Random numbers that take half a second to draw: a run of more is worth the start of workers, whatever it computes.
CERTAINLY_LONG = 5e7

# Results that may wait in memory for one before them.
MOST_WAITING = 16


def choose_executor(study: Study, cost: float, resources: Resources, say: Callable[[str], None]) -> Opened:
    """Return a context manager that gives the place and the executor of a run with this ``cost``.

    Where nothing is requested these are worker processes, one per core.  Unless the cost that the experiment declares
    shows that they are needed, they are started only once the time that the first points take does.
    """
    if resources == ANY_RESOURCES and (not study.experiment.says_cost or cost < CERTAINLY_LONG):
        return _measured_first(study, cost, say)
    opened: Opened = resources.open(study.experiment_reference, say)
    return opened


@contextmanager
def processes(_reference: str, workers: int, limits: Limits = NO_LIMITS) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on worker processes of one thread each, with an equal share of the memory by default."""
    import psutil

    limits = Limits(limits.time_s, limits.memory or psutil.virtual_memory().total // workers)
    words = f"on {workers} local worker {'process' if workers == 1 else 'processes'}"
    with Children(workers, limits) as children:
        yield Place(words, workers), children


@contextmanager
def threads(_reference: str, workers: int) -> Iterator[tuple[Place, Executor]]:
    """Give an executor on threads of this process."""
    from multiprocessing.pool import ThreadPool  # others would keep Python from ending while they compute

    def compute(job: AnyJob, task: Task) -> tuple[AnyJob, Any] | BaseException:
        try:
            return job, worker.compute(task)
        except BaseException as error:  # also what would end this thread; raised again in that of the run
            return error

    def execute(take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        done: SimpleQueue[tuple[AnyJob, Any] | BaseException] = SimpleQueue()
        under_way = 0
        while True:
            # One job more than threads, so that none waits while the results of another are used.
            for job in take(workers + 1 - under_way):
                # A new thread has none of the context variables that are set here.
                pool.apply_async(copy_context().run, (compute, job, job.task()), callback=done.put)
                under_way += 1
            if not under_way:
                return
            pair = done.get()
            under_way -= 1
            if isinstance(pair, BaseException):
                raise pair
            yield pair

    with ThreadPool(workers) as pool:
        yield Place(f"on {workers} local {'thread' if workers == 1 else 'threads'}", workers), execute


@contextmanager
def serial(_reference: str, _workers: int = 1) -> Iterator[tuple[Place, Executor]]:
    """Give an executor that computes one job after the other in this process: the definition of the result."""

    def execute(take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        while jobs := take(1):
            yield jobs[0], worker.compute(jobs[0].task())

    yield Place("in this process", 1), execute


@contextmanager
def _measured_first(study: Study, cost: float, say: Callable[[str], None]) -> Iterator[tuple[Place, Executor]]:
    """Give an executor for work of unknown length: it computes in one process and measures the time, until
    what is left is worth the start of worker processes, which then do the rest.

    The process is this one for code of linksweep's own, and a child for that of others.  ``cost`` is that of all work,
    in the unit of `Work.cost`.
    """
    with ExitStack() as stack:
        first = stack.enter_context(ExitStack())
        one = serial if study.is_ours else processes
        place, compute_here = first.enter_context(one(study.experiment_reference, 1))

        def execute(take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
            left, done, busy = cost, 0.0, 0.0
            for job, result in compute_here(take):
                yield job, result
                latest = job.cost * len(result.seconds) / len(job)
                left -= latest
                if not result.cold:
                    done, busy = done + latest, busy + float(result.seconds.sum())
                if busy > JUDGED_S and left * busy / done * (1.0 - 1.0 / available_cores()) > WORKERS_START_S:
                    break
            else:
                return
            first.close()
            there, executor = stack.enter_context(processes(study.experiment_reference, available_cores()))
            say(f"the first points took some time: the rest runs {there.words}")
            yield from executor(take)

        yield Place(place.words), execute


@contextmanager
def mapped(reference: str, resources: Resources, say: Callable[[str], None]) -> Iterator[Map]:
    """Give a function that maps another one over many pieces, with results in the order of the pieces: in this process
    where nothing is requested, else on the workers, which must have the code of this experiment.

    A piece gives the same bits wherever it is computed; what the function raises is raised here.
    """
    opened = serial(reference) if resources == ANY_RESOURCES else resources.open(reference, say)
    with worker.one_thread(), opened as (_, execute):

        def ordered(function: Callable[..., Any], pieces: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
            numbers, arguments = count(), iter(pieces)
            early: dict[int, Any] = {}
            turn = 0

            def take(most: int) -> list[Call]:
                room = most if len(early) < MOST_WAITING else 0
                some = islice(arguments, room)
                return [Call(reference, next(numbers), partial(function, *piece)) for piece in some]

            for call, result in execute(take):
                for failure in result.failures.values():
                    raise SweepError(f"a part of the work could not be computed: {failure.message}")
                early[call.number], error = result.outcomes[0].row
                if error is not None:
                    raise error
                while turn in early:
                    yield early.pop(turn)
                    turn += 1

        yield ordered
