"""What runs on a worker: a task's blocks, one after the other, each to its sums."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Experiment
from sweep.load import load_experiment
from sweep.plan import Block, generators


@dataclass(frozen=True)
class Task:
    """Blocks of points to compute, as plain values that pickle small.

    ``items`` holds (parameters of the point, its digest, the block).
    """

    experiment_reference: str
    seed: int
    items: tuple[tuple[dict[str, Any], bytes, Block], ...]


@dataclass(frozen=True)
class TaskResult:
    """Sums of a task's blocks, (blocks, width), in its order; ``errors`` maps the number of a block that failed to
    its message.
    """

    sums: NDArray[np.float64]
    errors: dict[int, str]
    seconds: float = 0.0


def run_task(task: Task) -> TaskResult:
    """Compute the blocks of a task; a block that raises is recorded and the rest goes on."""
    experiment = load_experiment(task.experiment_reference)
    sums = np.full((len(task.items), experiment.sums_width), np.nan)
    errors: dict[int, str] = {}
    for number, (parameters, digest, block) in enumerate(task.items):
        try:
            sums[number] = run_block(experiment, parameters, digest, block, task.seed)
        except Exception as error:  # a point that fails must not take others with it
            errors[number] = f"{type(error).__name__}: {error}"
    return TaskResult(sums, errors)


def run_block(
    experiment: Experiment, parameters: dict[str, Any], digest: bytes, block: Block, seed: int
) -> NDArray[np.float64]:
    """Return the sums of one block, flat in the order of `Experiment.sums`."""
    total = np.zeros(experiment.sums_width)
    for catalogue in range(block.first_catalogue, block.first_catalogue + block.n_cat):
        rng, catalogue_rng = generators(seed, digest, catalogue, block.part)
        sums = experiment.evaluate([parameters], block.n_sim, rng, catalogue_rng)
        total += np.concatenate([np.reshape(sums[name], -1) for name in experiment.sums], dtype=np.float64)
    return total
