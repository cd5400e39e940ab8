"""What runs on a worker: a task's blocks, one after the other, each to its sums."""

import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Experiment, NotFiniteError, Point, ResultError, check_finite, checked
from sweep.executing.captured import Captured, captured
from sweep.executing.deadlines import Deadlines, TimeLimitError
from sweep.functions.adapter import FunctionExperiment
from sweep.functions.results import Flat
from sweep.load import load_experiment
from sweep.planning.plan import Block, generators

ENOUGH_S = 2.0
"""A task that takes longer hands back what it has, so that results are not kept waiting for those of slower points."""

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
    """Blocks to compute, as plain values that pickle small; ``keep_samples`` asks for the realisations too.

    ``source_digest`` names the sources of the experiment, which were provided or are in its file.  With
    ``time_limit_s``, for a block of one point, the process must be one that may be ended.
    """

    experiment_reference: str
    seed: int
    units: tuple[PointBlock, ...]
    keep_samples: bool = False
    time_limit_s: float | None = None
    source_digest: str | None = None


@dataclass(frozen=True)
class Failure:
    """Why a block has no sums: in a sentence, with the traceback where Python has one; both bounded, and such that
    every encoding of Unicode can hold them.
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
    took, (rows,).  The last units have no rows where the task took longer than `ENOUGH_S`.

    ``failures`` maps the number of a row that could not be computed to the reason, ``samples`` that of one whose
    samples are kept to these, (realisations, width), ``said`` the first row of a unit to what was printed in it.
    Of a plain function ``values`` are the results by row; the client makes sums of them, since only it knows what they
    are to be like.  ``texts`` are those in them, by their digests.
    """

    sums: NDArray[np.float64]
    seconds: NDArray[np.float64]
    failures: dict[int, Failure] = field(default_factory=dict)
    samples: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    said: dict[int, Captured] = field(default_factory=dict)
    values: dict[int, Flat] = field(default_factory=dict)
    texts: dict[bytes, str] = field(default_factory=dict)


def run_task(task: Task, deadlines: Deadlines | None = None) -> TaskResult:
    """Compute the blocks of a task, the last ones only if it has not taken `ENOUGH_S` before; a point that raises is
    recorded and the rest goes on.

    ``deadlines`` are those of this process if it has some.
    """
    begun = time.monotonic()
    results: list[TaskResult] = []
    for result in run_units(task, deadlines or Deadlines()):
        results.append(result)
        if time.monotonic() - begun > ENOUGH_S:
            break
    return joined(results)


def run_units(task: Task, deadlines: Deadlines) -> Iterator[TaskResult]:
    """Yield the result of each unit of a task; no more of a point that took too long is tried."""
    experiment = load_experiment(task.experiment_reference, digest=task.source_digest)
    if isinstance(experiment, FunctionExperiment) and experiment.vectorised and len(task.units) > 1:
        together = _together(experiment, task, deadlines)
        if not together.failures:
            yield together
            return
    with captured() as said:
        yield from _one_by_one(experiment, task, deadlines, said)


def _one_by_one(experiment: Experiment, task: Task, deadlines: Deadlines, said: Captured) -> Iterator[TaskResult]:
    """Yield the result of each unit of a task, with what was ``said`` meanwhile."""
    defaults = experiment.defaults()
    given_up: list[tuple[bytes, dict[str, Any], Failure]] = []
    for unit in task.units:
        result = failed(len(unit.points), experiment.sums_width)
        for stream, point, reason in given_up:
            known = [row for row, own in enumerate(unit.points) if (stream, point) == (unit.stream, own)]
            result.failures.update(dict.fromkeys(known, reason))
        rows = [row for row in range(len(unit.points)) if row not in result.failures]
        begun = time.perf_counter()
        points = [defaults | unit.points[row] for row in rows]
        if rows and not _try(experiment, points, rows, unit, task, result, deadlines) and len(rows) > 1:
            for point, row in zip(points, rows, strict=True):  # who of those that share the draw is to blame?
                _try(experiment, [point], [row], unit, task, result, deadlines)
        if (told := said.taken()) is not None:
            result.said[min(rows, default=0)] = told
        result.seconds[rows] = (time.perf_counter() - begun) / max(1, len(rows))
        late = [row for row in rows if row in result.failures and result.failures[row].kind == "time limit"]
        given_up += [(unit.stream, unit.points[row], result.failures[row]) for row in late]
        yield result


def _together(experiment: FunctionExperiment, task: Task, deadlines: Deadlines) -> TaskResult:
    """Return the results of all points of a task from one call of a vectorised function."""
    defaults = experiment.defaults()
    points = [defaults | unit.points[0] for unit in task.units]
    result = failed(len(points), experiment.sums_width)
    begun = time.perf_counter()
    with captured() as said:
        try:
            with deadlines.within(None if task.time_limit_s is None else task.time_limit_s * len(points)):
                result.values.update(enumerate(experiment.many(points)))
        except (KeyboardInterrupt, GeneratorExit):
            raise
        except BaseException as error:  # who is to blame is found out one by one
            result.failures.update(dict.fromkeys(range(len(points)), failure_of(error)))
        if (told := said.taken()) is not None:
            result.said[0] = told
    result.seconds[:] = (time.perf_counter() - begun) / len(points)
    return result


def _try(
    experiment: Experiment,
    points: Sequence[Point],
    rows: list[int],
    unit: PointBlock,
    task: Task,
    result: TaskResult,
    deadlines: Deadlines,
) -> bool:
    """Compute some points of a unit into these rows of its result; return whether that went well."""
    try:
        with deadlines.within(None if task.time_limit_s is None else task.time_limit_s * len(rows)):
            if isinstance(experiment, FunctionExperiment):
                values = function_values(experiment, points, unit.stream, unit.block, task.seed)
                result.values.update(zip(rows, values, strict=True))
                return True
            sums, samples = run_block(experiment, points, unit.stream, unit.block, task.seed, task.keep_samples)
    except TimeLimitError:
        result.failures.update(dict.fromkeys(rows, too_long(task, traceback.format_exc())))
        return False
    except (KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:  # a point that fails, or leaves with sys.exit, must not take others with it
        result.failures.update(dict.fromkeys(rows, failure_of(error)))
        return False
    result.sums[rows] = sums
    if task.keep_samples:
        result.samples.update(zip(rows, samples, strict=True))
    for row in rows:
        result.failures.pop(row, None)
    return True


def function_values(
    experiment: FunctionExperiment, points: Sequence[Point], stream: bytes, block: Block, seed: int
) -> list[Flat]:
    """Return the results of a plain function at points: of one evaluation each, or of a block of realisations.

    Raises ResultError for what is no result, and whatever the function raises.
    """
    if experiment.vectorised:
        return experiment.many(points)
    return experiment.block(points, block.n_sim, (rng for rng, _ in _streams(stream, block, seed)))


def failure_of(error: BaseException) -> Failure:
    """Return why a point failed, from what was raised."""
    if isinstance(error, NotFiniteError):
        return Failure("NaN", str(error))
    if isinstance(error, ResultError):
        return Failure("exception", str(error))
    text = str(error)
    return Failure("exception", f"{type(error).__name__}{f': {text}' if text else ''}", traceback.format_exc())


def too_long(task: Task, trace: str) -> Failure:
    """Return the failure of a block that reached its time limit."""
    return Failure("time limit", f"a block took longer than the time limit of {task.time_limit_s:g} s", trace)


def failed(rows: int, width: int, reason: Failure | None = None) -> TaskResult:
    """Return the result of so many rows without sums, all for one reason."""
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
    )


def _printable(text: str, most: int) -> str:
    """Return a text with its middle left out where it is long, and lone surrogates escaped: no file can hold them."""
    if len(text) > most:
        text = f"{text[: most // 2]} [...] {text[-most // 2 :]}"
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def run_block(
    experiment: Experiment, points: Sequence[Point], stream: bytes, block: Block, seed: int, keep_samples: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sums of one block of each point, (points, width), flat in the order of `Experiment.sums`; and, where
    they are to be kept, its realisations, (points, realisations, width): catalogue by catalogue, flat in the order of
    the outputs.

    Raises ResultError where these are not what is declared or not finite, and whatever the experiment raises.
    """
    kept = experiment.sample_outputs if keep_samples else ()
    evaluate = experiment.samples if kept and experiment.samples is not None else experiment.evaluate
    who = "samples" if kept else "evaluate"
    shapes = {name: (len(points), *shape) for name, shape in experiment.sums.items()}
    shapes_kept = {o.name: (len(points), block.n_sim, *experiment.shape_of(o)) for o in kept}
    if not kept and (together := _together_if_alike(experiment, points, stream, block, seed)) is not None:
        return together, np.empty((len(points), 0, experiment.samples_width))
    total = np.zeros((len(points), experiment.sums_width))
    samples: list[NDArray[np.float64]] = []
    for rng, catalogue_rng in _streams(stream, block, seed):
        drawn = evaluate(points, block.n_sim, rng, catalogue_rng)
        sums = checked(who, drawn, "sum", shapes, beside=list(shapes_kept))
        check_finite(sums, experiment.nan_sums)
        total += np.concatenate([array.reshape(len(points), -1) for array in sums.values()], axis=1)
        if kept:
            realisations = checked(who, drawn, "sample output", shapes_kept, beside=list(shapes))
            check_finite(realisations, [output.name for output in kept if output.nan])
            flat = [array.reshape(len(points), block.n_sim, -1) for array in realisations.values()]
            samples.append(np.concatenate(flat, axis=2))
    return total, np.concatenate(samples, axis=1) if samples else np.empty((len(points), 0, experiment.samples_width))


def _together_if_alike(
    experiment: Experiment, points: Sequence[Point], stream: bytes, block: Block, seed: int
) -> NDArray[np.float64] | None:
    """Return the sums of a block whose catalogues are evaluated together, None where the experiment does not do that;
    what it raises is raised again by the catalogue that is to blame.
    """
    if experiment.evaluate_catalogues is None or block.n_cat == 1:
        return None
    shapes = {name: (block.n_cat, len(points), *shape) for name, shape in experiment.sums.items()}
    with suppress(Exception):
        drawn = experiment.evaluate_catalogues(points, block.n_sim, list(_streams(stream, block, seed)))
        sums = checked("evaluate_catalogues", drawn, "sum", shapes)
        check_finite(sums, experiment.nan_sums)
        flat = np.concatenate([array.reshape(block.n_cat, len(points), -1) for array in sums.values()], axis=2)
        total = np.zeros(flat.shape[1:])
        for catalogue in flat:
            total += catalogue  # in their order, as they are added one by one
        return total
    return None


def _streams(stream: bytes, block: Block, seed: int) -> Iterator[tuple[np.random.Generator, np.random.Generator]]:
    """Yield the generators of a block's part of each of its catalogues, and of the catalogue."""
    for catalogue in range(block.first_catalogue, block.first_catalogue + block.n_cat):
        yield generators(seed, stream, catalogue, block.part)
