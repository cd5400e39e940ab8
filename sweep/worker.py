"""What runs on a worker: a task's blocks, one after the other, each to its sums."""

import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Experiment, Point
from sweep.load import load_experiment
from sweep.plan import Block, generators


@dataclass(frozen=True)
class Unit:
    """A block of points that share its random numbers: their parameters (those that are not at their default), and the
    name of the stream.
    """

    points: tuple[dict[str, Any], ...]
    stream: bytes
    block: Block


@dataclass(frozen=True)
class Task:
    """Blocks to compute, as plain values that pickle small; ``keep_samples`` asks for the realisations too."""

    experiment_reference: str
    seed: int
    units: tuple[Unit, ...]
    keep_samples: bool = False


@dataclass(frozen=True)
class Failure:
    """Why a block has no sums: in a sentence, with the traceback where Python has one."""

    kind: Literal["exception", "NaN", "killed", "time limit"]
    message: str
    traceback: str = ""


@dataclass
class TaskResult:
    """Sums of a task, (rows, width), one row for each point of each unit in their order, and the seconds that each
    took, (rows,).

    ``failures`` maps the number of a row that could not be computed to the reason, ``samples`` that of one whose
    samples are kept to these, (realisations, width).
    """

    sums: NDArray[np.float64]
    seconds: NDArray[np.float64]
    failures: dict[int, Failure] = field(default_factory=dict)
    samples: dict[int, NDArray[np.float64]] = field(default_factory=dict)


def run_task(task: Task) -> TaskResult:
    """Compute the blocks of a task; a point that raises is recorded and the rest goes on."""
    experiment = load_experiment(task.experiment_reference)
    defaults = experiment.defaults()
    rows = sum(len(unit.points) for unit in task.units)
    result = TaskResult(np.full((rows, experiment.sums_width), np.nan), np.zeros(rows))
    first = 0
    for unit in task.units:
        points = [defaults | own for own in unit.points]
        begun = time.perf_counter()
        failures = _try(experiment, points, unit, task, result, first)
        if failures and len(points) > 1:  # who of those that share the draw is to blame?
            for number, point in enumerate(points):
                _try(experiment, [point], unit, task, result, first + number)
        result.seconds[first : first + len(points)] = (time.perf_counter() - begun) / len(points)
        first += len(points)
    return result


def _try(
    experiment: Experiment, points: list[dict[str, Any]], unit: Unit, task: Task, result: TaskResult, first: int
) -> bool:
    """Compute the rows of some points of a unit; return whether it raised."""
    stop = first + len(points)
    try:
        sums, samples = run_block(experiment, points, unit.stream, unit.block, task.seed, task.keep_samples)
    except Exception as error:  # a point that fails must not take others with it
        reason = Failure("exception", f"{type(error).__name__}: {error}", traceback.format_exc())
        result.failures.update(dict.fromkeys(range(first, stop), reason))
        return True
    result.sums[first:stop] = sums
    if task.keep_samples:
        result.samples.update(zip(range(first, stop), samples, strict=True))
    for row in range(first, stop):
        result.failures.pop(row, None)
        if np.isnan(result.sums[row]).any() and (names := _nan_results(experiment, result.sums[row], unit.block)):
            result.failures[row] = Failure("NaN", f"{', '.join(names)}: not a number")
    return False


def _nan_results(experiment: Experiment, row: NDArray[np.float64], block: Block) -> list[str]:
    """Return the headline results (all, if there are none) that these sums make NaN; some sums may be NaN rightly."""
    n, n_cat = np.array([float(block.realisations)]), np.array([float(block.n_cat)])
    results = experiment.summarise(experiment.named(row[None]), n, n_cat)
    headline = [output.name for output in experiment.outputs if output.headline] or list(results)
    return [name for name in headline if np.isnan(results[name]).any()]


def run_block(
    experiment: Experiment, points: Sequence[Point], stream: bytes, block: Block, seed: int, keep_samples: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sums of one block of each point, (points, width), flat in the order of `Experiment.sums`; and, where
    they are to be kept, its realisations, (points, realisations, width): catalogue by catalogue, flat in the order of
    the outputs.
    """
    evaluate = experiment.samples if keep_samples and experiment.samples is not None else experiment.evaluate
    kept = experiment.sample_outputs if keep_samples else ()
    total = np.zeros((len(points), experiment.sums_width))
    samples = [np.empty((len(points), 0, experiment.samples_width))]
    for rng, catalogue_rng in _streams(stream, block, seed):
        drawn = evaluate(points, block.n_sim, rng, catalogue_rng)
        total += np.hstack([np.reshape(drawn[name], (len(points), -1)) for name in experiment.sums], dtype=np.float64)
        if kept:
            shape = (len(points), block.n_sim, -1)
            samples.append(np.concatenate([np.reshape(drawn[o.name], shape) for o in kept], axis=2))
    return total, np.concatenate(samples, axis=1)


def _streams(stream: bytes, block: Block, seed: int) -> Iterator[tuple[np.random.Generator, np.random.Generator]]:
    """Yield the generators of a block's part of each of its catalogues, and of the catalogue."""
    for catalogue in range(block.first_catalogue, block.first_catalogue + block.n_cat):
        yield generators(seed, stream, catalogue, block.part)
