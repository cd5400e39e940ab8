"""What goes to a worker and what comes back: a task, its sums and its failures."""

import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import NotFiniteError, ResultError
from linksweep.sweep.executing.captured import Captured
from linksweep.sweep.functions.results import Flat
from linksweep.sweep.planning.block import Block

MAX_MESSAGE, MAX_TRACEBACK = 1_000, 20_000
"""Characters that are kept of what an experiment says when it fails."""


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
    ``repeatable`` experiment is to return the same results whenever it is called.
    """

    experiment_reference: str
    seed: int
    units: tuple[PointBlock, ...]
    keep_samples: bool = False
    time_limit_s: float | None = None
    source_digest: str | None = None
    enough_s: float = 0.0
    repeatable: bool = False

    def seed_of(self, unit: PointBlock) -> int:
        """Return where the global generators of a process start for a unit: apart from its own generators."""
        return crc32(unit.stream, crc32(f"{self.seed} {tuple(unit.block)}".encode()))


@dataclass(frozen=True)
class Failure:
    """Why a block has no sums: in a sentence, with the traceback where Python has one; both limited in length and
    without characters that an encoding of Unicode cannot write.
    """

    kind: Literal["exception", "NaN", "killed", "time limit"]
    message: str
    traceback: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "message", _printable(self.message, MAX_MESSAGE))
        object.__setattr__(self, "traceback", _printable(self.traceback, MAX_TRACEBACK))


@dataclass
class TaskResult:
    """Sums of a task, (rows, width), one row for each point of each unit in their order, and the seconds that each
    took, (rows,).  The last units have no rows where the task took longer than `sweep.executing.worker.ENOUGH_S`.

    By the number of a row, ``failures`` has the reason why it could not be computed, ``samples`` its samples where they
    are kept, (realisations, width), and ``said`` what was printed in the unit whose first row it is.  For a plain
    function ``values`` has the results by row; the client turns them into sums, since only it knows their layout.
    ``texts`` are the texts in these results, by their digests.  ``cold`` says that the first row was the first call in
    its process, which may include imports; ``refused`` why no result of this experiment is to be used, or ''.
    """

    sums: NDArray[np.float64]
    seconds: NDArray[np.float64]
    failures: dict[int, Failure] = field(default_factory=dict)
    samples: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    said: dict[int, Captured] = field(default_factory=dict)
    values: dict[int, Flat] = field(default_factory=dict)
    texts: dict[bytes, str] = field(default_factory=dict)
    cold: bool = False
    refused: str = ""


def failure_of(error: BaseException) -> Failure:
    """Return why a point failed, from what was raised."""
    if isinstance(error, NotFiniteError):
        return Failure("NaN", str(error))
    if isinstance(error, ResultError):
        return Failure("exception", str(error))
    try:
        text = str(error)
    except Exception as unsaid:  # whatever a class of the user's raises
        text = f"its message cannot be made: {type(unsaid).__name__}"
    return Failure("exception", f"{type(error).__name__}{f': {text}' if text else ''}", traceback.format_exc())


def too_long(task: Task, trace: str) -> Failure:
    """Return the failure of a block that reached its time limit."""
    return Failure("time limit", f"a block took longer than the time limit of {task.time_limit_s:g} s", trace)


def failed(rows: int, width: int, reason: Failure | None = None) -> TaskResult:
    """Return a result of so many rows without sums, all failed for the ``reason`` if there is one."""
    failures = {} if reason is None else dict.fromkeys(range(rows), reason)
    return TaskResult(np.full((rows, width), np.nan), np.zeros(rows), failures)


def joined(results: Sequence[TaskResult]) -> TaskResult:
    """Return the result of a task from those of its parts, in their order."""
    starts = np.cumsum([0, *(len(result.sums) for result in results)]).tolist()
    return TaskResult(
        np.concatenate([result.sums for result in results]),
        np.concatenate([result.seconds for result in results]),
        {first + row: why for first, r in zip(starts, results, strict=False) for row, why in r.failures.items()},
        {first + row: kept for first, r in zip(starts, results, strict=False) for row, kept in r.samples.items()},
        {first + row: said for first, r in zip(starts, results, strict=False) for row, said in r.said.items()},
        {first + row: value for first, r in zip(starts, results, strict=False) for row, value in r.values.items()},
        cold=any(result.cold for result in results[:1]),
        refused=next((result.refused for result in results if result.refused), ""),
    )


def _printable(text: str, most: int) -> str:
    """Return a text with its middle left out where it is long, and lone surrogates escaped: no file can hold them."""
    if len(text) > most:
        text = f"{text[: most // 2]} [...] {text[-most // 2 :]}"
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
