"""Runs a task in a child process, so that a block that ends its process ends nothing else and can be identified."""

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import IO

from sweep.contract import SweepError
from sweep.executing.deadlines import Deadlines
from sweep.executing.task import Failure, PointBlock, Task, TaskResult, failed, joined, too_long
from sweep.executing.together import takes_several
from sweep.executing.versions import Identity, differences, identity
from sweep.executing.worker import ENOUGH_S, run_units
from sweep.load import load_experiment, provide, sources_of

TRIES = 2
"""How often a block may end its child: with the worker that it ended before, that makes three times."""

MEMORY_SHARE = 0.95
"""Share of the memory limit at which a child is ended, the same at which Dask's nanny ends a worker."""

LOOK_EVERY_S = 0.05
"""Seconds between two looks at the child's memory."""

LAST_WORDS = 4096
"""Bytes that are kept of the end of what a child wrote to standard error."""


def run_guarded(task: Task, expected: Identity, memory_limit: int | None) -> TaskResult:
    """Compute a task as `run_task` does, in a child process that a block may end or overfill (``memory_limit``, bytes).

    As with `run_task`, the last blocks have no result where the task takes longer than `ENOUGH_S`.

    Raises SweepError where the child cannot start or is not as ``expected``.
    """
    parts = [_Part(unit) for unit in task.units]
    width = load_experiment(task.experiment_reference, digest=task.source_digest).sums_width
    enough = time.monotonic() + max(ENOUGH_S, task.enough_s)
    while pending := [part for part in parts if part.result is None]:
        if pending[0].whole and pending[0] is not parts[0] and time.monotonic() > enough:
            break
        death = _run_child(task, pending, expected, memory_limit, enough)
        if death is None:
            continue
        guilty = next(part for part in pending if part.result is None)
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


@dataclass(eq=False)
class _Part:
    """A unit of a task, or one point of it, how often it ended a child, and its result."""

    unit: PointBlock
    whole: bool = True
    deaths: int = 0
    result: TaskResult | None = None


def _run_child(
    task: Task, parts: Sequence[_Part], expected: Identity, memory_limit: int | None, enough: float
) -> Failure | None:
    """Fill in the results of these parts, in order.  Return None once the child has done all or it is later than
    ``enough``, or the failure of the next part if the child died of it.
    """
    import psutil

    todo = replace(task, units=tuple(part.unit for part in parts))
    command = [sys.executable, "-c", "from sweep.executing.isolated import child; child()"]
    with (
        tempfile.TemporaryFile() as words,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=words) as process,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        overfull = False
        try:
            answers = Connection(os.dup(process.stdout.fileno()), writable=False)
            process.stdin.write(pickle.dumps((sources_of(task.experiment_reference, task.source_digest), todo)))
            process.stdin.flush()
            measured = psutil.Process(process.pid)
            waiting = iter(parts)
            greeted = False
            while parts[0].result is None or time.monotonic() < enough:
                while not answers.poll(LOOK_EVERY_S):
                    if memory_limit and measured.memory_info().rss > MEMORY_SHARE * memory_limit:
                        overfull = True
                        process.kill()
                answer = answers.recv()
                if isinstance(answer, TaskResult):
                    next(waiting).result = answer
                elif isinstance(answer, Identity):
                    greeted = True
                    if differ := differences(expected.deciding, answer.deciding):
                        raise SweepError([f"a process started since the run began differs: {text}" for text in differ])
                elif isinstance(answer, SweepError):
                    raise answer
                else:
                    break
            return None
        except (EOFError, OSError, psutil.NoSuchProcess):
            code = process.wait()
        finally:
            process.kill()
        last_words = _end_of(words)
    if not greeted:
        raise SweepError(f"a child process of a worker could not start (exit code {code}): {last_words}")
    if overfull and memory_limit:
        return Failure("killed", f"needs more than the memory limit of {memory_limit / 1e9:.3g} GB", last_words)
    return _death(task, code, last_words)


def _death(task: Task, code: int, last_words: str) -> Failure:
    """Return the failure that the exit code of a child stands for."""
    if code >= 0:
        return Failure("killed", f"ended its process with exit code {code}", last_words)
    if task.time_limit_s is not None and code == -signal.SIGALRM:
        return too_long(task, last_words)
    name = signal.Signals(-code).name
    reason = ", perhaps because the machine had no memory left" if name == "SIGKILL" else ""
    return Failure("killed", f"ended its process with {name}{reason}", last_words)


def _end_of(file: IO[bytes]) -> str:
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - LAST_WORDS))
    return file.read().decode(errors="replace").strip()


def child() -> None:
    """Run as the child: read a task from standard input, answer with an `Identity`, the result of each unit, None."""
    import faulthandler

    from threadpoolctl import threadpool_limits

    answers = Connection(os.dup(1), readable=False)
    os.dup2(2, 1)  # what an experiment prints must not get between the answers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable(all_threads=False)  # prints where the code was when the process ends
    faulthandler.register(signal.SIGALRM, all_threads=False, chain=True)
    task: Task
    sources, task = pickle.load(sys.stdin.buffer)
    if sources is not None:
        provide(sources)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        answers.send(identity(task.experiment_reference, task.source_digest))
    except SweepError as error:
        answers.send(error)
        return
    with threadpool_limits(1):
        experiment = load_experiment(task.experiment_reference, digest=task.source_digest)
        one_by_one = experiment.vectorised or takes_several(experiment, task)  # the parent waits for each unit
        for part in [replace(task, units=(unit,)) for unit in task.units] if one_by_one else [task]:
            for result in run_units(part, Deadlines()):
                answers.send(result)
    answers.send(None)


def _end_with_parent() -> None:
    sys.stdin.buffer.read()  # returns when the parent has closed the pipe or has ended
    os._exit(1)
