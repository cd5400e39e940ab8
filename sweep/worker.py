"""What runs on a worker: a task's blocks, one after the other, each to its sums."""

import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Experiment
from sweep.load import load_experiment
from sweep.plan import Block, generators


@dataclass(frozen=True)
class Task:
    """Blocks of points to compute, as plain values that pickle small.

    ``items`` holds (parameters of the point, its digest, the block); ``keep_samples`` asks for the realisations too.
    """

    experiment_reference: str
    seed: int
    items: tuple[tuple[dict[str, Any], bytes, Block], ...]
    keep_samples: bool = False


@dataclass(frozen=True)
class Failure:
    """Why a block has no sums: in a sentence, with the traceback where Python has one."""

    kind: Literal["exception", "NaN", "killed", "time limit"]
    message: str
    traceback: str = ""


@dataclass(frozen=True)
class TaskResult:
    """Sums of a task's blocks, (blocks, width), in its order, and the seconds that each took, (blocks,).

    ``failures`` maps the number of a block that failed to the reason, ``samples`` that of one whose samples are kept to
    these, (realisations, width).
    """

    sums: NDArray[np.float64]
    seconds: NDArray[np.float64]
    failures: dict[int, Failure]
    samples: dict[int, NDArray[np.float64]]


def run_task(task: Task) -> TaskResult:
    """Compute the blocks of a task; a block that raises is recorded and the rest goes on."""
    experiment = load_experiment(task.experiment_reference)
    sums = np.full((len(task.items), experiment.sums_width), np.nan)
    seconds = np.zeros(len(task.items))
    failures: dict[int, Failure] = {}
    samples: dict[int, NDArray[np.float64]] = {}
    for number, (parameters, digest, block) in enumerate(task.items):
        begun = time.perf_counter()
        try:
            sums[number] = run_block(experiment, parameters, digest, block, task.seed)
            if np.isnan(sums[number]).all():
                failures[number] = Failure("NaN", "all sums are NaN")
            elif task.keep_samples:
                samples[number] = sample_block(experiment, parameters, digest, block, task.seed)
        except Exception as error:  # a point that fails must not take others with it
            failures[number] = Failure("exception", f"{type(error).__name__}: {error}", traceback.format_exc())
        seconds[number] = time.perf_counter() - begun
    return TaskResult(sums, seconds, failures, samples)


def run_block(
    experiment: Experiment, parameters: dict[str, Any], digest: bytes, block: Block, seed: int
) -> NDArray[np.float64]:
    """Return the sums of one block, flat in the order of `Experiment.sums`."""
    total = np.zeros(experiment.sums_width)
    for rng, catalogue_rng in _streams(digest, block, seed):
        sums = experiment.evaluate([parameters], block.n_sim, rng, catalogue_rng)
        total += np.concatenate([np.reshape(sums[name], -1) for name in experiment.sums], dtype=np.float64)
    return total


def sample_block(
    experiment: Experiment, parameters: dict[str, Any], digest: bytes, block: Block, seed: int
) -> NDArray[np.float64]:
    """Return the realisations of one block themselves, catalogue by catalogue, flat in the order of the outputs."""
    assert experiment.samples is not None, "a study that keeps samples was validated"
    rows = []
    for rng, catalogue_rng in _streams(digest, block, seed):
        drawn = experiment.samples([parameters], block.n_sim, rng, catalogue_rng)
        rows.append(np.hstack([np.reshape(drawn[o.name], (block.n_sim, -1)) for o in experiment.sample_outputs]))
    return np.concatenate(rows)


def _streams(digest: bytes, block: Block, seed: int) -> Iterator[tuple[np.random.Generator, np.random.Generator]]:
    """Yield the generators of a block's part of each of its catalogues, and of the catalogue."""
    for catalogue in range(block.first_catalogue, block.first_catalogue + block.n_cat):
        yield generators(seed, digest, catalogue, block.part)
