"""What goes to a worker and what comes back: blocks of a study or a call of a function; results and failures; versions
and code, which are compared before a run and with every task.
"""

import decimal
import platform
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Literal, Protocol, TypeVar
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_info

from linksweep.sweep.code import as_recorded_where_unsteady, code_of, load_experiment, source_digest, version_of
from linksweep.sweep.contract import Block, NotFiniteError, Outcome, ResultError
from linksweep.sweep.executing.pools import NO_LIMITS, Limits
from linksweep.sweep.planning.plan import Work
from linksweep.sweep.studies.study import Study

DECIDING = ("linksweep", "numpy", "scipy")
OTHERS = ("dask", "distributed", "msgpack", "cloudpickle", "tornado", "threadpoolctl")


@dataclass(frozen=True)
class Identity:
    """What a process computes with, by name: versions and code that decide the numbers, and other versions; and which
    values of the code differ from process to process, such as a time, as far as is known.
    """

    deciding: Mapping[str, str]
    others: Mapping[str, str]
    unsteady: frozenset[str] = frozenset()

    @classmethod
    def here(cls, reference: str, digest: str | None = None) -> "Identity":
        """Return with what this process would compute an experiment; raises SweepError as `load_experiment`."""
        experiment = load_experiment(reference, digest=digest or source_digest(reference))
        deciding = {name: version_of(name) for name in DECIDING}
        deciding[f"experiment {experiment.name!r}"] = f"version {experiment.version}"
        deciding |= code_of(reference, experiment, digest)
        others = {"python": platform.python_version(), "machine": platform.machine(), "linear algebra": _kernels()}
        return cls(deciding, others | {name: version_of(name) for name in OTHERS})

    def differences(self, there: "Identity") -> list[str]:
        """Return a phrase for everything that decides the numbers and differs in another process."""
        sides = [{k: v for k, v in one.deciding.items() if k not in self.unsteady} for one in (self, there)]
        return other_versions(*sides)

    def beside(self, there: "Identity", reference: str) -> "Identity":
        """Return this with what another process shows to be unsteady."""
        if not self.differences(there):
            return self
        same = as_recorded_where_unsteady(there.deciding, self.deciding, reference)
        return replace(self, unsteady=self.unsteady | {k for k, text in there.deciding.items() if same[k] != text})


@cache
def _kernels() -> str:
    """Return for which processor each library of linear algebra computes, on which the rounding of sums depends."""
    known = (info for info in threadpool_info() if "architecture" in info)
    return ", ".join(sorted({f"{info['internal_api']} for {info['architecture']}" for info in known})) or "unknown"


def other_versions(here: Mapping[str, str], there: Mapping[str, str]) -> list[str]:
    """Return a phrase for everything that differs between two processes."""
    pairs = {name: (here.get(name, "unknown"), there.get(name, "unknown")) for name in {**here, **there}}
    return [f"{name} is {one} here, {other} there" for name, (one, other) in pairs.items() if one != other]


# Characters that are kept of what an experiment says when it fails.
MAX_MESSAGE, MAX_TRACEBACK = 1_000, 4_000

# Writes what is large of outcomes, by row, elsewhere.
Keep = Callable[[dict[int, Outcome]], dict[int, Outcome]]


@dataclass(frozen=True)
class PointBlock:
    """A block of points that share its random numbers: their parameters (those that are not at their default), and the
    name of the stream.
    """

    points: tuple[dict[str, Any], ...]
    stream: bytes
    block: Block


@dataclass(frozen=True)
class Task:
    """Blocks to compute, as plain values with a small pickle; ``keep_samples`` asks for the realisations too.

    ``source_digest`` identifies the sources of the experiment, which were provided or are in its file.  After
    ``enough_s`` seconds, if that is more than `sweep.executing.worker.ENOUGH_S`, a worker returns what it has.
    ``time_limit_s`` is for a block of one point; with it the process must be one that may be ended.  A
    ``repeatable`` experiment is to return the same results whenever it is called: it is called again at its first
    point, by the same process only where that took at most ``at_once_s`` seconds, else by one that gets the ``first``
    results.  With ``caught`` false what it raises is raised, and what it prints is printed.  ``keep`` takes all
    outcomes, to write what is large, before they are sent.  With a ``function`` there is one unit without parameters,
    and its row is what that returns and None, or None and what it raises.  ``errors`` of NumPy and ``decimals`` are
    treated as in the thread of the run, since each thread has its own setting.
    """

    experiment_reference: str
    seed: int
    units: tuple[PointBlock, ...]
    keep_samples: bool = False
    time_limit_s: float | None = None
    source_digest: str | None = None
    enough_s: float = 0.0
    repeatable: bool = False
    at_once_s: float = float("inf")
    first: tuple[Outcome, ...] = ()
    caught: bool = True
    keep: Keep = dict
    function: Callable[[], Any] | None = None
    errors: Mapping[str, Any] = field(default_factory=np.geterr)
    decimals: decimal.Context = field(default_factory=decimal.getcontext)

    def seed_of(self, unit: PointBlock) -> int:
        """Return where the global generators of a process start for a unit: apart from its own generators."""
        return crc32(unit.stream, crc32(f"{self.seed} {tuple(unit.block)}".encode()))


class TimeLimitError(BaseException):
    """Raised inside a block at its time limit; not an Exception, because a block may catch those."""


@dataclass(frozen=True)
class Failure:
    """Why a block has no result: in a sentence, with the traceback where Python has one; both limited in length and
    without characters that an encoding of Unicode cannot write.
    """

    kind: Literal["exception", "NaN", "killed", "time limit"]
    message: str
    traceback: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "message", _printable(self.message, MAX_MESSAGE))
        object.__setattr__(self, "traceback", _printable(self.traceback, MAX_TRACEBACK))

    @classmethod
    def raised(cls, error: BaseException, limit_s: float | None = None) -> "Failure":
        """Return why a point failed, from what was raised; ``limit_s`` is the time that it had."""
        trace = "".join(traceback.format_exception(error))
        if isinstance(error, TimeLimitError):
            return cls.too_long(limit_s or 0.0, trace)
        if isinstance(error, ResultError):
            return cls("NaN" if isinstance(error, NotFiniteError) else "exception", str(error))
        try:
            text = str(error)
        except (Exception, SystemExit) as unsaid:  # whatever a class of the user's raises
            text = f"its message cannot be made: {type(unsaid).__name__}"
        return cls("exception", f"{type(error).__name__}{f': {text}' if text else ''}", trace)

    @classmethod
    def too_long(cls, limit_s: float, trace: str) -> "Failure":
        """Return the failure of a block that reached its time limit."""
        return cls("time limit", f"a block took longer than the time limit of {limit_s:g} s", trace)


@dataclass
class Captured:
    """What was printed, and how often each warning was raised."""

    printed: str = ""
    warnings: Counter[str] = field(default_factory=Counter)

    def taken(self) -> "Captured | None":
        """Return what was captured since the last call, or None if nothing was."""
        if not self.printed and not self.warnings:
            return None
        taken = Captured(self.printed, self.warnings)
        self.printed, self.warnings = "", Counter()
        return taken


@dataclass
class TaskResult:
    """Results of a task, of one row for each point of each unit in their order, and the ``seconds`` that each took,
    (rows,).  The last units have no rows where the task took longer than `linksweep.sweep.executing.worker.ENOUGH_S`.

    By the number of a row, ``outcomes`` has what its block left, ``failures`` the reason why it could not be computed,
    and ``said`` what was printed in the unit whose first row it is.  ``cold`` says that the first row was the first
    call in its process, which may include imports; ``refused`` why no result of this experiment is to be used, or '';
    ``again`` that another process is to make the second call at its points.
    """

    seconds: NDArray[np.float64]
    outcomes: dict[int, Outcome] = field(default_factory=dict)
    failures: dict[int, Failure] = field(default_factory=dict)
    said: dict[int, Captured] = field(default_factory=dict)
    cold: bool = False
    refused: str = ""
    again: bool = False

    @classmethod
    def failed(cls, rows: int, reason: Failure, seconds: float = 0.0) -> "TaskResult":
        """Return a result of so many rows, each of which failed for the ``reason`` after so many ``seconds``."""
        return cls(np.full(rows, seconds), failures=dict.fromkeys(range(rows), reason))

    @classmethod
    def joined(cls, results: "Sequence[TaskResult]") -> "TaskResult":
        """Return the result of a task from those of its parts, in their order."""
        whole, starts = cls(np.zeros(0)), np.cumsum([0, *(len(one.seconds) for one in results)])
        for first, result in zip(starts.tolist(), results, strict=False):
            for name in ("outcomes", "failures", "said"):
                getattr(whole, name).update({first + row: value for row, value in getattr(result, name).items()})
            whole.refused, whole.again = whole.refused or result.refused, whole.again or result.again
        whole.seconds = np.concatenate([whole.seconds, *(result.seconds for result in results)])
        whole.cold = any(result.cold for result in results[:1])
        return whole


@dataclass(frozen=True)
class Call:
    """A job: a function that a worker with the code of an experiment is to call."""

    experiment_reference: str
    number: int
    function: Callable[[], Any]
    cost = 1.0

    def __len__(self) -> int:
        return 1

    def task(self, limits: Limits = NO_LIMITS, _enough_s: float = 0.0) -> Task:
        """Return what a worker gets."""
        unit = PointBlock(({},), b"", Block(0, 0, 0, 1, 1))
        return Task(self.experiment_reference, 0, (unit,), time_limit_s=limits.time_s, function=self.function)

    def alone(self) -> "list[Call]":
        """Return the call: it has no parts."""
        return [self]


@dataclass(frozen=True)
class Batch:
    """A job: blocks of a study that go to a worker in one task; ``keep`` is that of its task."""

    study: Study
    works: list[Work]
    keep: Keep = dict

    def __len__(self) -> int:
        return sum(len(work.points) for work in self.works)

    @property
    def cost(self) -> float:
        """What the blocks cost, in the unit of `Work.cost`."""
        return sum(work.cost for work in self.works)

    def task(self, limits: Limits = NO_LIMITS, enough_s: float = 0.0) -> Task:
        """Return what a worker gets; after ``enough_s`` seconds it is to return what it has."""
        experiment, sampling, reference = self.study.experiment, self.study.sampling, self.study.experiment_reference
        defaults = experiment.defaults()
        units = []
        for work in self.works:
            points = (self.study.arguments(point.parameters).items() for point in work.points)
            # As it was written, also where it equals the default: 1.0 is not 1 to a function.
            changed = tuple({k: v for k, v in point if v is not defaults[k]} for point in points)
            units.append(PointBlock(changed, work.points[0].stream, work.block))
        kept, code, again = sampling.keep_samples, source_digest(reference), experiment.repeatable
        return Task(reference, sampling.seed, tuple(units), kept, limits.time_s, code, enough_s, again, keep=self.keep)

    def alone(self) -> "list[Batch]":
        """Return each block by itself."""
        return [replace(self, works=[work]) for work in self.works]


# What an executor computes in one piece.
AnyJob = TypeVar("AnyJob", Batch, Call)


class Executor(Protocol):
    """Computes jobs.

    ``take`` returns at most so many jobs that can begin now; once a result has been taken, there may be more.  Each job
    comes back with its result, in any order.  A result has no rows for the last blocks if they were not started.
    """

    def __call__(self, take: Callable[[int], Sequence[AnyJob]]) -> Iterator[tuple[AnyJob, Any]]:
        """Compute everything that ``take`` gives."""


def _printable(text: str, most: int) -> str:
    """Return a text with its middle left out where it is long, and lone surrogates escaped: no file can hold them."""
    if len(text) > most:
        text = f"{text[: most // 2]} [...] {text[-most // 2 :]}"
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
