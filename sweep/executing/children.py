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

from linksweep.sweep.code.load import Identity, differences, identity, load_experiment, new_process, provide, sendable
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.process import Deadlines, ignored
from linksweep.sweep.executing.task import Failure, PointBlock, Task, TaskResult, failed, joined, too_long
from linksweep.sweep.executing.worker import ENOUGH_S, run_units, takes_several

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


class Children:
    """Computes tasks in a child process, which lives on for the next task unless a block ends it or takes more memory
    than ``memory_limit`` (bytes); then another one takes its place.

    With ``forked`` it is a copy of this process where there can be one, which starts in milliseconds and has every
    function that this one has; else a new process, which imports or unpickles what it needs.
    """

    def __init__(self, expected: Identity, memory_limit: int | None = None, *, forked: bool = False) -> None:
        self._expected, self._memory_limit, self._forked = expected, memory_limit, forked
        self._child: _Child | None = None

    def __enter__(self) -> "Children":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        self._end(END_S if kind is None else 0.0)

    def _end(self, patience_s: float) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.end(patience_s)

    def run(self, task: Task) -> TaskResult:
        """Compute a task as `run_task` does: the last blocks have no result where it takes longer than `ENOUGH_S`.

        Raises SweepError where the child cannot start or is not as expected.
        """
        parts = [_Part(unit) for unit in task.units]
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
                alone = (replace(guilty.unit, points=(point,)) for point in guilty.unit.points)
                parts[place : place + 1] = [_Part(unit, whole=False) for unit in alone]
                continue
            guilty.deaths += 1
            if death.kind == "time limit" or guilty.deaths >= TRIES:
                for part in pending:  # nor are the other blocks of this point tried
                    same_point = (part.unit.stream, part.unit.points) == (guilty.unit.stream, guilty.unit.points)
                    if part.result is None and same_point:
                        part.result = failed(1, death)
        first = next((place for place, part in enumerate(parts) if part.result is None), len(parts))
        return joined([part.result for part in parts[:first] if part.result is not None])

    def _attempt(self, task: Task, parts: "Sequence[_Part]", one_by_one: bool, enough: float) -> Failure | None:
        """Fill in the results of these parts, in order.  Return None once the child has done all or it is later than
        ``enough``, or why the child has ended.
        """
        todo = replace(task, units=tuple(part.unit for part in parts))
        if self._child is None:
            try:
                self._child = _Child(todo, self._expected, self._forked and _may_be_forked())
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

    def _received(self, child: "_Child") -> Any:
        """Return the next answer of a child; end the child where it overfills its memory.

        Raises EOFError where it has ended; what it has started may keep its files open.
        """
        while not child.channel.poll(LOOK_EVERY_S):
            if child.code(0.0) is not None and not child.channel.poll():
                raise EOFError
            if self._memory_limit and child.memory() > MEMORY_SHARE * self._memory_limit:
                child.overfull = True
                child.process.kill()
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
    rows, empty = len(result.seconds), failed(0)
    while rows > 0:
        part = next(waiting)
        part.result, result = result, empty
        rows -= len(part.unit.points)


def _may_be_forked() -> bool:
    """Return whether a copy of this process can compute: Accelerate on macOS cannot, nor some libraries that the user
    may have computed with.  Python lets no daemonic process have children of this kind.
    """
    known = any(name in sys.modules for name in NOT_TO_BE_FORKED)
    return sys.platform == "linux" and not known and not multiprocessing.current_process().daemon


class _Child:
    """A process that computes tasks, and the ``channel`` to it: a copy of this one (``forked``), or a new one.

    Raises SweepError where a new one does not start, and where it is not as ``expected``.
    """

    def __init__(self, task: Task, expected: Identity, forked: bool) -> None:
        self.channel, theirs = multiprocessing.Pipe()
        self._words: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the child)
        self.overfull = False
        self.process: Any
        if forked:
            arguments = self.channel, theirs, self._words
            self.process = multiprocessing.get_context("fork").Process(target=_compute_forked, args=arguments)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of threads: see `_may_be_forked`
                self.process.start()
        else:
            start = f"from linksweep.sweep.executing.children import compute; compute({theirs.fileno()})"
            files: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": self._words, "stderr": self._words}
            self.process = new_process(start, **files, pass_fds=[theirs.fileno()])
        theirs.close()
        if not forked:
            self._prepare(task, expected)

    def _prepare(self, task: Task, expected: Identity) -> None:
        try:
            self.channel.send((sendable(task.experiment_reference, task.source_digest), task))
            answer = self.channel.recv()
            if isinstance(answer, SweepError):
                raise answer
            if differ := differences(expected.deciding, answer.deciding):
                raise SweepError([f"a process started since the run began differs: {text}" for text in differ])
        except (EOFError, OSError) as error:
            code, words = self.code(END_S), self._last_words()
            self.end(0.0)
            raise SweepError(f"a child process could not start (exit code {code}): {words}") from error
        except BaseException:
            self.end(0.0)
            raise

    def memory(self) -> float:
        """Return the bytes of memory that the process takes."""
        import psutil

        with suppress(psutil.NoSuchProcess):
            return float(psutil.Process(self.process.pid).memory_info().rss)
        return 0.0

    def code(self, patience_s: float) -> int | None:
        """Return the exit code, None where the process has not ended by then."""
        if isinstance(self.process, subprocess.Popen):
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(patience_s)
            return self.process.returncode
        self.process.join(patience_s)
        code: int | None = self.process.exitcode
        return code

    def end(self, patience_s: float) -> None:
        """End the process; let it take so many seconds for its own clean-up."""
        if patience_s:
            with suppress(OSError):
                self.channel.send(None)
        if not patience_s or self.code(patience_s) is None:
            self.process.kill()
            self.code(END_S)
        self.channel.close()
        self._words.close()
        if isinstance(self.process, subprocess.Popen) and self.process.stdin is not None:
            self.process.stdin.close()

    def _last_words(self) -> str:
        """Return the end of what the process wrote where Python writes before it is ended by a signal."""
        size = self._words.seek(0, os.SEEK_END)
        self._words.seek(max(0, size - LAST_WORDS))
        return self._words.read().decode(errors="replace").strip()

    def death(self, task: Task, memory_limit: int | None) -> Failure:
        """Return the failure for which a process that does not answer any more stands, and end it if need be."""
        code = self.code(END_S)
        words = self._last_words()
        self.end(0.0)
        if code is not None and task.time_limit_s is not None and code == -signal.SIGALRM and not self.overfull:
            return too_long(task, words)
        if self.overfull and memory_limit:
            reason = f"needs more than the memory limit of {memory_limit / 1e9:.3g} GB"
        elif code is None:
            reason = "closed the files of its process, among them the one for its results"
        elif code >= 0:
            reason = f"ended its process with exit code {code}"
        else:
            reason = f"ended its process with {(name := signal.Signals(-code).name)}"
            reason += ", perhaps because the machine had no memory left" if name == "SIGKILL" else ""
        return Failure("killed", reason, words)


def _compute_forked(parents: Connection, channel: Connection, words: IO[bytes]) -> None:
    """Run as a copy of the parent."""
    parents.close()
    signal.set_wakeup_fd(-1)  # that of an event loop of the parent
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    assert parent is not None, "this is a child"
    _end_with(parent.sentinel)
    _serve(channel, words)


def compute(number: int) -> None:
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
    deadlines = Deadlines()
    with threadpool_limits(1), suppress(EOFError):
        while (message := channel.recv()) is not None:
            for results in _results(deadlines, *message):
                channel.send(results)
            channel.send(None)


def _results(deadlines: Deadlines, task: Task, one_by_one: bool, enough_s: float) -> Iterator[list[TaskResult]]:
    """Yield the results of a task: several at once, or with ``one_by_one`` each unit as soon as it is done."""
    enough, sent = time.monotonic() + enough_s, time.monotonic()
    experiment = load_experiment(task.experiment_reference, digest=task.source_digest)
    split = one_by_one and (experiment.vectorised or takes_several(experiment, task))
    tasks = [replace(task, units=(unit,)) for unit in task.units] if split else [task]
    ready: list[TaskResult] = []
    for result in (result for part in tasks for result in run_units(part, deadlines)):
        ready.append(result)
        now = time.monotonic()
        if one_by_one or now > min(enough, sent + SEND_EVERY_S):
            yield ready
            ready, sent = [], now
        if now > enough:
            break
    if ready:
        yield ready
