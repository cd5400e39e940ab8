"""Runs tasks in a child process, so that a block that ends its process ends nothing else and can be identified."""

import fcntl
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import IO, Any

from linksweep.sweep.code.load import load_experiment, new_process, provide, sendable
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.deadlines import Deadlines
from linksweep.sweep.executing.own_process import ignored
from linksweep.sweep.executing.task import Failure, PointBlock, Task, TaskResult, failed, joined, too_long
from linksweep.sweep.executing.together import takes_several
from linksweep.sweep.executing.versions import Identity, differences, identity
from linksweep.sweep.executing.worker import ENOUGH_S, run_units

TRIES = 2
"""How often a block may end its child, when it is known which block it was."""

MEMORY_SHARE = 0.95
"""Share of the memory limit at which a child is ended, the same at which Dask's nanny ends a worker."""

LOOK_EVERY_S = 0.05
"""Seconds between two looks at the child's memory."""

SEND_EVERY_S = 0.02
"""Seconds of work whose results a child sends together."""

LAST_WORDS = 4096
"""Bytes that are kept of the end of what a child wrote to standard error."""

END_S = 1.0
"""Seconds that a child gets to end by itself: threads and files that an experiment leaves may keep it."""

NOT_TO_BE_FORKED = ("jax", "torch", "tensorflow", "cupy")
"""Libraries with threads or devices of their own, for which a fork of a process that used them may wait for ever."""


def run_guarded(task: Task, expected: Identity, memory_limit: int | None) -> TaskResult:
    """Compute a task as `run_task` does, in a child process that a block may end or overfill (``memory_limit``, bytes).

    As with `run_task`, the last blocks have no result where the task takes longer than `ENOUGH_S`.

    Raises SweepError where the child cannot start or is not as ``expected``.
    """
    with Children(expected, memory_limit) as children:
        return children.run(task)


class Children:
    """Computes tasks in a child process, which lives on for the next task unless a block ends it; then another one
    takes its place.

    With ``forked`` it is a copy of this process where there can be one, which starts in milliseconds and has every
    function that this one has; else a new process, which imports or unpickles what it needs.
    """

    def __init__(self, expected: Identity, memory_limit: int | None = None, *, forked: bool = False) -> None:
        self._expected, self._memory_limit, self._forked = expected, memory_limit, forked
        self._child: _Forked | _New | None = None

    def __enter__(self) -> "Children":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        self._end(END_S if kind is None else 0.0)

    def _end(self, patience_s: float) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.end(patience_s)

    def run(self, task: Task) -> TaskResult:
        """Compute a task as `run_guarded` does."""
        parts = [_Part(unit) for unit in task.units]
        width = load_experiment(task.experiment_reference, digest=task.source_digest).sums_width
        enough = time.monotonic() + max(ENOUGH_S, task.enough_s)
        one_by_one = task.time_limit_s is not None
        while pending := [part for part in parts if part.result is None]:
            if pending[0].whole and pending[0] is not parts[0] and time.monotonic() > enough:
                break
            death = self._attempt(task, pending, one_by_one, enough)
            if death is None:
                continue
            guilty = next(part for part in pending if part.result is None)
            if not one_by_one and len(pending) > 1:  # it is not known how far the child came
                one_by_one = True
                continue
            if len(guilty.unit.points) > 1:  # which of those that share the draw is to blame?
                place = parts.index(guilty)
                alone = (replace(guilty.unit, points=(own,)) for own in guilty.unit.points)
                parts[place : place + 1] = [_Part(unit, whole=False) for unit in alone]
                continue
            guilty.deaths += 1
            if death.kind == "time limit" or guilty.deaths >= TRIES:
                for part in pending:
                    same_point = (part.unit.stream, part.unit.points) == (guilty.unit.stream, guilty.unit.points)
                    if part.result is None and same_point:
                        part.result = failed(1, width, death)
        results: list[TaskResult] = []
        for part in parts:
            if part.result is None:
                break
            results.append(part.result)
        return joined(results)

    def _attempt(self, task: Task, parts: "Sequence[_Part]", one_by_one: bool, enough: float) -> Failure | None:
        """Fill in the results of these parts, in order.  Return None once the child has done all or it is later than
        ``enough``, or why the child has ended.
        """
        todo = replace(task, units=tuple(part.unit for part in parts))
        try:
            self._child = self._child or (
                _Forked() if self._forked and _may_be_forked() else _New(todo, self._expected)
            )
        except OSError as error:
            raise SweepError(f"a child process could not start: {error}") from error
        child, waiting = self._child, iter(parts)
        try:
            child.channel.send((todo, one_by_one, enough - time.monotonic()))
            while (answer := self._received(child)) is not None:
                for result in answer:
                    _fill_in(waiting, result)
            return None
        except (EOFError, OSError):
            self._child = None
            return child.death(task, self._memory_limit)
        except BaseException:
            self._end(0.0)
            raise

    def _received(self, child: "_Forked | _New") -> Any:
        """Return the next answer of a child; end the child where it overfills its memory.

        Raises EOFError where it has ended; what it has started may keep its files open.
        """
        while not child.channel.poll(LOOK_EVERY_S):
            if child.code(0.0) is not None and not child.channel.poll():
                raise EOFError
            if self._memory_limit and child.memory() > MEMORY_SHARE * self._memory_limit:
                child.overfull = True
                child.kill()
        return child.channel.recv()


@dataclass(eq=False)
class _Part:
    """A unit of a task, or one point of it, how often it ended a child, and its result."""

    unit: PointBlock
    whole: bool = True
    deaths: int = 0
    result: TaskResult | None = None


def _fill_in(waiting: "Iterator[_Part]", result: TaskResult) -> None:
    """Give a result to the parts that it is of; where these are several, the first one has all of it."""
    rows, given = len(result.seconds), result
    while rows > 0:
        part = next(waiting)
        part.result, given = given, failed(0, result.sums.shape[1])
        rows -= len(part.unit.points)


def _may_be_forked() -> bool:
    """Return whether a copy of this process can compute: Accelerate on macOS cannot, nor some libraries that the user
    may have computed with.  Python lets no daemonic process have children of this kind.
    """
    known = any(name in sys.modules for name in NOT_TO_BE_FORKED)
    return sys.platform == "linux" and not known and not multiprocessing.current_process().daemon


class _Child:
    """A process that computes tasks, and the ``channel`` to it."""

    pid: int
    overfull = False

    def __init__(self) -> None:
        self.channel, self._theirs = multiprocessing.Pipe()
        self._words: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the child)

    def memory(self) -> float:
        """Return the bytes of memory that the process takes."""
        import psutil

        with suppress(psutil.NoSuchProcess):
            return float(psutil.Process(self.pid).memory_info().rss)
        return 0.0

    def kill(self) -> None:
        """End the process at once."""
        raise NotImplementedError

    def code(self, patience_s: float) -> int | None:
        """Return the exit code, None where the process has not ended by then."""
        raise NotImplementedError

    def end(self, patience_s: float) -> None:
        """End the process; let it take so many seconds for its own clean-up."""
        if patience_s:
            with suppress(OSError):
                self.channel.send(None)
        if not patience_s or self.code(patience_s) is None:
            self.kill()
            self.code(END_S)
        self.channel.close()
        self._words.close()

    def last_words(self) -> str:
        """Return the end of what the process wrote where Python writes before it is ended by a signal."""
        size = self._words.seek(0, os.SEEK_END)
        self._words.seek(max(0, size - LAST_WORDS))
        return self._words.read().decode(errors="replace").strip()

    def death(self, task: Task, memory_limit: int | None) -> Failure:
        """Return the failure for which a process that does not answer any more stands, and end it if need be."""
        code = self.code(END_S)
        words = self.last_words()
        self.end(0.0)
        if self.overfull and memory_limit:
            return Failure("killed", f"needs more than the memory limit of {memory_limit / 1e9:.3g} GB", words)
        if code is None:
            return Failure("killed", "closed the files of its process, among them the one for its results", words)
        if code >= 0:
            return Failure("killed", f"ended its process with exit code {code}", words)
        if task.time_limit_s is not None and code == -signal.SIGALRM:
            return too_long(task, words)
        name = signal.Signals(-code).name
        reason = ", perhaps because the machine had no memory left" if name == "SIGKILL" else ""
        return Failure("killed", f"ended its process with {name}{reason}", words)


class _Forked(_Child):
    """A copy of this process."""

    def __init__(self) -> None:
        super().__init__()
        self._process = multiprocessing.get_context("fork").Process(target=self._compute)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads: see `_may_be_forked`
            self._process.start()
        self._theirs.close()
        assert self._process.pid is not None, "it has started"
        self.pid = self._process.pid

    def _compute(self) -> None:
        self.channel.close()
        signal.set_wakeup_fd(-1)  # that of an event loop of the parent
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        parent = multiprocessing.parent_process()
        assert parent is not None, "this is a child"
        _end_with(parent.sentinel)
        _serve(self._theirs, self._words)

    def kill(self) -> None:
        self._process.kill()

    def code(self, patience_s: float) -> int | None:
        self._process.join(patience_s)
        return self._process.exitcode


class _New(_Child):
    """A new process; raises SweepError where it does not start, and where it is not as ``expected``."""

    def __init__(self, task: Task, expected: Identity) -> None:
        super().__init__()
        number = self._theirs.fileno()
        files: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": self._words, "stderr": self._words}
        start = f"from linksweep.sweep.executing.isolated import child; child({number})"
        self._process = new_process(start, **files, pass_fds=[number])
        self._theirs.close()
        self.pid = self._process.pid
        try:
            self.channel.send((sendable(task.experiment_reference, task.source_digest), task))
            answer = self.channel.recv()
            if isinstance(answer, SweepError):
                raise answer
            if differ := differences(expected.deciding, answer.deciding):
                raise SweepError([f"a process started since the run began differs: {text}" for text in differ])
        except (EOFError, OSError) as error:
            code, words = self.code(END_S), self.last_words()
            self.end(0.0)
            raise SweepError(f"a child process could not start (exit code {code}): {words}") from error
        except BaseException:
            self.end(0.0)
            raise

    def kill(self) -> None:
        self._process.kill()

    def code(self, patience_s: float) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(patience_s)
        return None

    def end(self, patience_s: float) -> None:
        super().end(patience_s)
        assert self._process.stdin is not None, "it ends with this one"
        self._process.stdin.close()


def child(number: int) -> None:
    """Run as a new child whose channel has this file descriptor."""
    _end_with(0)
    channel = Connection(number)
    sources, task = channel.recv()
    if sources is not None:
        provide(sources)
    try:
        channel.send(identity(task.experiment_reference, task.source_digest))
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

    from threadpoolctl import threadpool_limits

    for number in (signal.SIGINT, signal.SIGHUP):  # only the parent answers; programs that a block starts may too
        signal.signal(number, ignored)
    with suppress(OSError):
        os.dup2(2, 1)  # what is printed outside of Python must not get among the results
    faulthandler.enable(words, all_threads=False)  # prints where the code was when the process ends
    faulthandler.register(signal.SIGALRM, words, all_threads=False, chain=True)
    with threadpool_limits(1), suppress(EOFError):
        while (message := channel.recv()) is not None:
            _answer(channel, *message)


def _answer(channel: Connection, task: Task, one_by_one: bool, enough_s: float) -> None:
    """Send the results of a task: several at once, or with ``one_by_one`` each unit as soon as it is done."""
    enough, sent = time.monotonic() + enough_s, time.monotonic()
    experiment = load_experiment(task.experiment_reference, digest=task.source_digest)
    split = one_by_one and (experiment.vectorised or takes_several(experiment, task))
    deadlines, ready = Deadlines(), list[TaskResult]()
    for part in [replace(task, units=(unit,)) for unit in task.units] if split else [task]:
        for result in run_units(part, deadlines):
            ready.append(result)
            now = time.monotonic()
            if one_by_one or now > min(enough, sent + SEND_EVERY_S):
                channel.send(ready)
                ready, sent = [], now
            if now > enough:
                break
        if time.monotonic() > enough:
            break
    channel.send(ready)
    channel.send(None)
