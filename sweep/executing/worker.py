"""Computes a task on a worker: its blocks one after the other, or many points at once; checks that what a plain
function returns depends on its point alone, and bears what code may do to its process: print, warn, change it, fork it,
take too long.
"""

import ctypes
import decimal
import io
import os
import random
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_info, threadpool_limits

from linksweep.sweep.code import load_experiment
from linksweep.sweep.contract import Experiment, NotFiniteError, Outcome, Point, shown
from linksweep.sweep.executing.pools import ONE_THREAD
from linksweep.sweep.executing.task import Captured, Failure, PointBlock, Task, TaskResult, TimeLimitError
from linksweep.sweep.functions.results import layout_differences, same_value
from linksweep.sweep.interrupt import SIGNALS
from linksweep.sweep.planning.plan import generators_of

# Characters and different warnings of one block that are kept.
MOST_PRINTED, MOST_WARNINGS = 10_000, 100

# Seconds between the exception and the end of the process: a block in compiled code does not see the exception.
GRACE_S = 2.0


class _Stream(io.TextIOBase):
    """A standard stream that keeps what captured threads write; others write to the stream ``before``."""

    def __init__(self, before: Any) -> None:
        self.before = before

    def write(self, text: str) -> int:
        """Write a text."""
        if (captured := _routes.captured()) is not None:
            captured.printed += text[: MOST_PRINTED - len(captured.printed)]
        else:
            self.before.write(text)
        return len(text)

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        """Return where programs write that a block starts."""
        number: int = self.before.fileno()
        return number


class _Snapshot:
    """What a block may change of its process, as it is now: the working folder, the environment, the standard streams,
    the filters of warnings.
    """

    def __init__(self) -> None:
        self._folder, self._environment, self._variables = _working_folder(), _environment(), dict(os.environ)
        self._streams, self._filters = (sys.stdin, sys.stdout, sys.stderr), list(warnings.filters)

    def put_back(self) -> None:
        """Undo what has changed since."""
        if self._folder is not None and _working_folder() != self._folder:
            with suppress(OSError):  # it may be gone
                os.chdir(self._folder)
        if _environment() != self._environment:
            set_environment(self._variables)
        sys.stdin, sys.stdout, sys.stderr = self._streams
        if warnings.filters != self._filters:
            _set_filters(self._filters)


class _Routes:
    """Standard output and error and warnings of this process while some of its threads are captured; the process is put
    back after each block.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads: dict[int, Captured] = {}

    @contextmanager
    def capturing(self) -> Iterator[Captured]:
        """Capture what the calling thread prints in this block, and its warnings."""
        result, thread = Captured(), threading.get_ident()
        with self._lock:
            if not self._threads:
                self._before, self._warn_before = _Snapshot(), warnings.showwarning
                self._generators = np.random.get_state(), random.getstate()  # noqa: NPY002
                sys.stdout, sys.stderr = _Stream(sys.stdout), _Stream(sys.stderr)
                warnings.showwarning = self._warn  # type: ignore[assignment]
                seldom = ("default", "module", "once")  # count all of these; keep "ignore" and "error"
                _set_filters([("always" if f[0] in seldom else f[0], *f[1:]) for f in warnings.filters])
                warnings.simplefilter("always", append=True)
                self._between_blocks = _Snapshot()
            before = self._threads.get(thread)  # as where a block runs a study
            self._threads[thread] = result
        try:
            yield result
        finally:
            with self._lock:
                del self._threads[thread]
                self._threads |= {} if before is None else {thread: before}
                if not self._threads:
                    self._before.put_back()
                    warnings.showwarning = self._warn_before
                    np.random.set_state(self._generators[0])  # noqa: NPY002
                    random.setstate(self._generators[1])

    def restore(self) -> None:
        """Undo what a captured thread has changed about the process."""
        with self._lock:
            if self._threads:
                self._between_blocks.put_back()

    def captured(self) -> Captured | None:
        """Return what the calling thread is captured in: that of a block under way for a thread that one has started,
        None for the main thread while others compute, as it then shows how far they are.
        """
        with self._lock:
            mine = self._threads.get(threading.get_ident())
            is_main = threading.current_thread() is threading.main_thread()
            return mine or (None if is_main else next(iter(self._threads.values()), None))

    def _warn(self, message: Any, category: type[Warning], filename: str, lineno: int, *rest: Any) -> None:
        if (captured := self.captured()) is None:
            self._warn_before(message, category, filename, lineno, *rest)
            return
        text = f"{category.__name__}: {message} ({Path(filename).name}, line {lineno})"
        if text in captured.warnings or len(captured.warnings) < MOST_WARNINGS:
            captured.warnings[text] += 1


_routes = _Routes()


@contextmanager
def undisturbed(task: Task, seed: int) -> Iterator[None]:
    """Run code of an experiment in a captured thread so that no point depends on the one before it, as far as that is
    cheap: the generators of NumPy and Python for a process start from a ``seed``, and what is set for the arithmetic of
    NumPy and of decimals is as in the ``task`` and ends with this block, as does a process that is forked in it.
    """
    parent = os.getpid()
    np.random.seed(seed)  # noqa: NPY002 (for code that draws from it, although it should not)
    random.seed(seed)
    try:
        with np.errstate(**task.errors), decimal.localcontext(task.decimals):
            yield
    except BaseException as error:
        if os.getpid() != parent:  # as Python ends: with the code of `sys.exit`, or with 1 and a traceback
            code = error.code if isinstance(error, SystemExit) else 1
            if not isinstance(error, SystemExit):
                traceback.print_exception(error, file=sys.__stderr__)
            os._exit(0 if code is None else code if isinstance(code, int) else 1)
        raise
    finally:
        if os.getpid() != parent:  # it would go on with the run beside its parent
            os._exit(0)
        _routes.restore()


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception stops the run, as the user's interruption does, which Python raises in the main
    thread of a process that answers SIGINT so.  All other exceptions belong to the experiment.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    return isinstance(error, KeyboardInterrupt) and in_main_thread and signal.getsignal(signal.SIGINT) is not ignored


def ignored(*_signal: object) -> None:
    """Ignore a signal in this process, but not in the programs that it starts, as SIG_IGN would."""


def leave_signals_to_parent() -> None:
    """Let only the parent of this process answer SIGINT and SIGHUP; programs that a block starts may too."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, ignored)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


def limit_threads() -> threadpool_limits:
    """Limit libraries of linear algebra to one thread, those too that this process loads later; return the limits."""
    for name in ONE_THREAD:
        os.putenv(name, "1")  # `os.environ` stays the user's
    return threadpool_limits(1)


# The limits of blocks under way in this process, each with the most threads before: those of the first are the user's.
_limits, _changing = list[tuple[threadpool_limits, int | None]](), threading.Lock()


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit libraries of linear algebra to one thread: sums of products must not depend on the number of cores.  Of
    blocks at once, in several threads, the last to end lifts the limit.
    """
    with _changing:
        most = max((one["num_threads"] for one in threadpool_info()), default=None)
        _limits.append((limit_threads(), most))
        _let_other_threads_change_limits()
    try:
        yield
    finally:
        with _changing:
            before, most = _limits.pop()
            if not _limits:
                for name in ONE_THREAD:
                    os.unsetenv(name)
                os.environ.update({name: os.environ[name] for name in ONE_THREAD if name in os.environ})
                threadpool_limits(most)  # of what was loaded meanwhile
                before.restore_original_limits()
                _let_other_threads_change_limits()


def _let_other_threads_change_limits() -> None:
    # A thread that has set one of OpenBLAS is the only one that can, until a `with` ends in it (threadpoolctl 3.8).
    with threadpool_limits():
        pass


def _set_filters(filters: list[Any]) -> None:
    """Let these be the filters of warnings, from their entries in `warnings.filters`."""
    warnings.resetwarnings()
    for action, message, category, module, line in filters:
        texts = [getattr(pattern, "pattern", pattern) or "" for pattern in (message, module)]
        warnings.filterwarnings(action, texts[0], category, texts[1], line, append=True)


def set_environment(variables: Mapping[str, str]) -> None:
    """Let these, and no others, be the variables of the environment of this process."""
    for name in os.environ.keys() - variables.keys():
        del os.environ[name]
    os.environ.update(variables)


def _environment() -> dict[Any, Any]:
    # Private: what os.environ keeps, in a hundredth of the time of dict(os.environ), which decodes all of it (1 us
    # against 60 us of about 300 us that a point of a plain function takes in all).
    return dict(getattr(os.environ, "_data", os.environ))


def _working_folder() -> str | None:
    with suppress(OSError):
        return os.getcwd()
    return None


class Deadlines:
    """The times by which the blocks under way in this process must have ended, one for each thread.

    A process has one alarm clock, so all its blocks share one instance.  The process must be one that may be ended:
    a worker of a cluster or a child of one.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ends: dict[int, float] = {}

    @contextmanager
    def within(self, seconds: float | None) -> Iterator[None]:
        """Raise TimeLimitError in this block after ``seconds``; `GRACE_S` later the system ends the process with
        SIGALRM, even if the code never releases the interpreter's lock.

        For the exception, time in which the process was stopped does not count, but for a tenth of the limit.
        """
        if seconds is None:
            yield
            return
        thread = threading.get_ident()
        lock, over, rung = threading.Lock(), threading.Event(), threading.Event()

        def raised(kind: type[BaseException] | None) -> None:
            argument = None if kind is None else ctypes.py_object(kind)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), argument)

        def ring() -> None:
            any(over.wait(seconds / 10.0) for _ in range(10))
            with lock:
                if not over.is_set():
                    rung.set()
                    raised(TimeLimitError)

        timer = threading.Thread(target=ring, daemon=True)
        try:
            self._set(thread, time.monotonic() + seconds + GRACE_S)
            timer.start()
            yield
        finally:
            try:
                with lock:
                    over.set()
                    if rung.is_set():  # else Python 3.11 would hang where it then traces, as for coverage
                        raised(None)  # else one that is pending hits the next block
            finally:  # the exception may be raised, once, in the lines above
                self._set(thread, None)

    def _set(self, thread: int, end: float | None) -> None:
        """Set or drop a thread's end, and set the alarm to the earliest of all ends."""
        with self._lock:
            self._ends.pop(thread, None)
            if end is not None:
                self._ends[thread] = end
            wait = max(1e-3, min(self._ends.values()) - time.monotonic()) if self._ends else 0.0
            signal.setitimer(signal.ITIMER_REAL, wait)


# Seconds after which a task returns what it has, so that its results do not wait for those of slower points.
ENOUGH_S = 2.0

# Most catalogues in one call.
MOST_CATALOGUES = 256

# A first call in a process that takes longer is slow by itself; a shorter one may be so for what it imports.
IMPORTS_S = 30.0

# Points of a process's first call of a vectorised function for more than these that are also computed alone.
CHECKED = 3

# Seconds of a first call after which there is no second one.
LONGEST_S = 1.0

# The reference and the digest of an experiment.
Who = tuple[str, str | None]

# The experiments that were called in this process, by thread.
_called: set[tuple[Who, int]] = set()

# How points of vectorised functions depend on those beside them, beyond a tolerance.
_dependence: dict[tuple[Who, float], str] = {}

# The functions that returned the same twice in this process.
_agreed: set[Who] = set()


def compute(task: Task, deadlines: Deadlines | None = None) -> TaskResult:
    """Return the result of a task."""
    return TaskResult.joined([*run_units(task, deadlines or Deadlines())])


def run_units(task: Task, deadlines: Deadlines, apart: bool = False) -> Iterator[TaskResult]:
    """Yield the results of the units of a task in their order: of one, or unless they are to be ``apart`` of several
    that were computed in one call; a point that raises is recorded and the rest goes on.

    None begins after `ENOUGH_S` or the task's ``enough_s``, whichever is longer, nor after a point that took too long:
    its other blocks would too, and the rest is given out again.
    """
    if task.function is not None:
        yield _returned(task.function, task.time_limit_s, deadlines)
        return
    begun, computing = time.monotonic(), _Computing(task, deadlines)
    if task.first:
        with _routes.capturing():  # what a second call says was said by the first
            yield TaskResult(np.zeros(0), refused=computing.how_calls_differ(task.units, task.first))
        return
    caller = computing.who, threading.get_ident()
    for result in computing.results(apart):
        result.cold = caller not in _called and float(result.seconds[0]) < IMPORTS_S
        _called.add(caller)
        result.outcomes = task.keep(result.outcomes)
        yield result
        is_over = any(failure.kind == "time limit" for failure in result.failures.values())
        if is_over or time.monotonic() - begun > max(ENOUGH_S, task.enough_s):
            return


def _returned(function: Callable[[], Any], time_limit_s: float | None, deadlines: Deadlines) -> TaskResult:
    """Return the result of the task of calling a function."""
    row: tuple[Any, Exception | None]
    try:
        with deadlines.within(time_limit_s):
            row = function(), None
    except TimeLimitError as error:
        return TaskResult.failed(1, Failure.raised(error, time_limit_s))
    except Exception as error:  # raised again by the client
        row = None, error
    return TaskResult(np.zeros(1), {0: Outcome(row)})


class _Computing:
    """Calls the experiment of a task for its units, and says which point is to blame for what goes wrong."""

    def __init__(self, task: Task, deadlines: Deadlines) -> None:
        self.task, self.who, self._deadlines = task, (task.experiment_reference, task.source_digest), deadlines
        self.experiment = load_experiment(task.experiment_reference, digest=task.source_digest)
        self._kind = self.who, self.experiment.tolerance

    def results(self, apart: bool) -> Iterator[TaskResult]:
        """Yield the results of the units, one by one or unless ``apart`` of several together."""
        with _routes.capturing() if self.task.caught else nullcontext(Captured()) as said:
            for units, result in self._computed(apart, said):
                if printed := said.taken():
                    result.said[0] = printed
                self._repeat(units, result)
                said.taken()  # what the second call says was said by the first
                if wrong := _dependence.get(self._kind, ""):
                    rows = range(len(result.seconds))
                    result.outcomes, result.failures = {}, dict.fromkeys(rows, Failure("exception", wrong))
                yield result

    def _computed(self, apart: bool, said: Captured) -> Iterator[tuple[Sequence[PointBlock], TaskResult]]:
        """Yield units and their result."""
        for units in alike(self.task.units) if self.experiment.evaluate_catalogues else [self.task.units]:
            if not apart and (together := self._together(units)) is not None:
                yield units, together
                continue
            said.taken()  # the units print it again, one by one
            for unit in units:
                begun = time.perf_counter()
                yield [unit], _result(self._rows(unit, unit.points), begun)

    def _together(self, units: Sequence[PointBlock]) -> TaskResult | None:
        """Return the result of units from one call: of all points of a vectorised function, or of blocks of one point
        with small catalogues.  None for others, and where it raises: one by one the units show which is to blame.
        """
        task, experiment, block = self.task, self.experiment, units[0].block
        begun = time.perf_counter()
        if experiment.vectorised and len(units) > 1:
            got = self._outcomes(units[0], len(units) + CHECKED, lambda: self._checked(units))
        elif block.n_cat > 1 and not task.keep_samples and task.time_limit_s is None and experiment.evaluate_catalogues:
            # No realisation is kept so, and no block has a time limit.
            points = [experiment.defaults() | point for point in units[0].points]
            pairs = [pair for unit in units for pair in generators_of(task.seed, unit.stream, unit.block)]
            n_cat = [unit.block.n_cat for unit in units]
            call = partial(experiment.compute_catalogues, points, block.n_sim, pairs, n_cat)
            got = self._outcomes(units[0], len(points), call)
        else:
            return None
        if isinstance(got, BaseException):
            return None
        return _result([Failure.raised(one.row) if isinstance(one.row, NotFiniteError) else one for one in got], begun)

    def _rows(self, unit: PointBlock, some: Sequence[dict[str, Any]]) -> Sequence[Outcome | Failure]:
        """Return what some points of a unit leave, or why they fail."""
        task, experiment, n_sim = self.task, self.experiment, unit.block.n_sim
        pairs = [] if experiment.deterministic else generators_of(task.seed, unit.stream, unit.block)
        points = [experiment.defaults() | point for point in some]
        got = self._outcomes(unit, len(some), lambda: experiment.compute(points, n_sim, pairs, task.keep_samples))
        if not isinstance(got, BaseException):
            return got
        if not task.caught and not isinstance(got, TimeLimitError):
            raise got
        if len(some) > 1:  # which of those that share the draw is to blame?
            return [row for point in some for row in self._rows(unit, [point])]
        return [Failure.raised(got, task.time_limit_s)]

    def _outcomes(
        self, unit: PointBlock, points: int, call: Callable[[], list[Outcome]], turn: int = 0
    ) -> list[Outcome] | BaseException:
        """Return what a call for so many points returns or raises, unless that is an interruption; in another ``turn``
        the generators of the process start elsewhere.
        """
        task, limit = self.task, self.task.time_limit_s
        try:
            with undisturbed(task, task.seed_of(unit) ^ turn), self._deadlines.within(limit and limit * points):
                return call()
        except BaseException as error:  # a point that fails, or leaves with sys.exit, must not take others with it
            if is_interruption(error):
                raise
            return error

    def _checked(self, units: Sequence[PointBlock]) -> list[Outcome]:
        """Return what a vectorised function returns for the points of units.

        The first call in a process also computes some points alone; where a result differs, all points fail, in this
        call and later ones.
        """
        points = [self.experiment.defaults() | unit.points[0] for unit in units]
        outcomes = self.experiment.compute(points, 1, ())
        rows = zip(points, outcomes, (unit.stream for unit in units), strict=True)
        done = [row for row in rows if not isinstance(row[1].row, NotFiniteError)]
        if self._kind not in _dependence and done:
            wrong = dependence(self.experiment, done)
            if wrong or len(done) > CHECKED:
                _dependence[self._kind] = wrong
        return outcomes

    def _repeat(self, units: Sequence[PointBlock], result: TaskResult) -> None:
        """Call a repeatable function again at the points of some units, and say in their result if it then differs, or
        that another process is to do so.
        """
        if not self.task.repeatable or not result.outcomes or self.who in _agreed:
            return
        if (seconds := float(result.seconds.sum())) > LONGEST_S:
            return
        if seconds > self.task.at_once_s:
            result.again = True
        else:
            result.refused = self.how_calls_differ([units[k] for k in result.outcomes], [*result.outcomes.values()])

    def how_calls_differ(self, units: Sequence[PointBlock], first: Sequence[Outcome]) -> str:
        """Call the function again at the points of some units; return a sentence if it then gives other results than
        the ``first``, or raises an exception, '' if it gives the same.
        """
        points = [self.experiment.defaults() | unit.points[0] for unit in units]
        # Other random numbers than at first, if it takes those of the process.
        again = self._outcomes(units[0], len(points), lambda: self.experiment.compute(points, 1, ()), turn=1)
        if isinstance(again, TimeLimitError):
            return ""
        if isinstance(again, list):
            again = next((one.row for one in again if isinstance(one.row, NotFiniteError)), again)
        if isinstance(again, BaseException):
            how = f"and then raises {type(again).__name__}"
        else:
            # What is large of the first results was written before they were sent here.
            again = [*self.task.keep(dict(enumerate(again))).values()] if self.task.first else again
            how = next(filter(None, map(_difference, first, again)), "")
        if not how:
            _agreed.add(self.who)
            return ""
        place = ", ".join(f"{name} = {shown(value)}" for name, value in points[0].items()) or "its only point"
        return (
            f"{self.experiment.name}: called twice at {place}, it returns a result {how}. A function that draws random "
            "numbers takes them from its argument rng; one whose results need not be the same declares "
            "@experiment(deterministic=False)"
        )


def _result(rows: Sequence[Outcome | Failure], begun: float) -> TaskResult:
    """Return the result of units from their rows, which were computed together since ``begun``."""
    outcomes = {k: row for k, row in enumerate(rows) if isinstance(row, Outcome)}
    failures = {k: row for k, row in enumerate(rows) if isinstance(row, Failure)}
    return TaskResult(np.full(len(rows), (time.perf_counter() - begun) / len(rows)), outcomes, failures)


def alike(units: Sequence[PointBlock]) -> Iterator[tuple[PointBlock, ...]]:
    """Yield units in groups: those of small catalogues of one point with equally many realisations, and those between
    them, whose blocks have only one catalogue.
    """
    for small, group in groupby(units, lambda u: (u.stream, u.block.n_sim, u.points) if u.block.n_cat > 1 else None):
        whole = tuple(group)
        most = max(1, MOST_CATALOGUES // max(unit.block.n_cat for unit in whole)) if small else len(whole)
        yield from (whole[first : first + most] for first in range(0, len(whole), most))


def dependence(experiment: Experiment, rows: Sequence[tuple[Point, Outcome, bytes]]) -> str:
    """Return how one of many points, with their results and digests, differs from the result of that point alone, in
    words; '' where none does.

    The points with the least digests are compared: the same of the same points, whatever their order, and at least one
    that is neither the first nor the last.  Raises whatever the function raises.
    """
    among = _columns([outcome for _, outcome, _ in rows])
    for place in sorted(range(len(rows)), key=lambda place: rows[place][2])[:CHECKED]:
        alone = _columns(experiment.compute([rows[place][0]], 1, ()))
        for name in among.keys() & alone.keys():
            there, here = np.asarray(among[name][place]), np.asarray(alone[name][0])
            if not _agree(there, here, among[name], experiment.tolerance):
                where = ", ".join(f"{parameter}={shown(value)}" for parameter, value in rows[place][0].items())
                return (
                    f"{experiment.name}: {name!r} is {shown(there.tolist())} in a call for {len(rows):,} points, but "
                    f"{shown(here.tolist())} for the same point ({where}) alone; what a vectorised function returns "
                    "for a point must not depend on the others by more than its tolerance (1e-12 if it declares none)"
                )
    return ""


def _columns(outcomes: Sequence[Outcome]) -> dict[str, NDArray[Any]]:
    """Return the results of points of one layout by name, (points, ...)."""
    fields = outcomes[0].layout.fields
    return {field.name: np.array([outcome.row[k] for outcome in outcomes]) for k, field in enumerate(fields)}


def _agree(one: NDArray[Any], other: NDArray[Any], everything: NDArray[Any], tolerance: float) -> bool:
    """Return whether values agree; floats within the tolerance, relative to them or to a hundredth of the largest that
    another point has in their place, as for those that are zero but for rounding.
    """
    if one.shape != other.shape:
        return False
    same = one == other
    if one.dtype.kind == other.dtype.kind == "f":
        others = 0.01 * np.max(np.abs(everything), axis=0, where=np.isfinite(everything), initial=0.0)
        same |= np.isclose(one, other, rtol=tolerance, atol=tolerance * others, equal_nan=True)
    return bool(np.all(same))


def _difference(first: Outcome, second: Outcome) -> str:
    """Return how two results differ, '' where they do not: their order does not matter, and NaN is NaN."""
    if (wrong := layout_differences(first.layout, second.layout)) or layout_differences(second.layout, first.layout):
        return f"and then another one: {'; '.join(wrong) or 'of another type'}"
    other = dict(zip((field.name for field in second.layout.fields), second.row, strict=True))
    pairs = zip(first.layout.fields, first.row, strict=True)
    return next((f"and then one with another {f.name!r}" for f, v in pairs if not same_value(v, other[f.name])), "")
