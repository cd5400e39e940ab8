"""How the errors of points that share random numbers go together, from the scatter of their blocks."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from sweep.contract import Array, Output
from sweep.planning.accumulator import DONE, Accumulator
from sweep.planning.plan import Block, Plan, ledger_key

LARGEST = 10**7
"""Elements of one covariance at most: it has one for every pair of points along an axis."""

Variable = tuple[tuple[str, ...], Array, dict[str, Any]]


def covariances(plan: Plan, accumulator: Accumulator, rows: Mapping[bytes, int], sums: Array) -> dict[str, Variable]:
    """Return ``NAME_mc_covariance_AXIS`` of every headline result with a Monte-Carlo error, for every axis along which
    points share their random numbers; dimensions of the grid and ``AXIS_other``.

    Blocks of equal size that points share are paired samples of their results, so their scatter has all errors that go
    together: those of realisations, and those of catalogues if there are several.  The inverse of a covariance from B
    samples of p numbers is too large on average by (B - 1)/(B - p - 2), so the covariance is given larger by this
    factor (Hartlap, Simon & Schneider 2007, A&A 464, 399), and not at all where there are too few blocks for it.
    """
    grid = plan.grid
    experiment = grid.study.experiment
    blocks = _paired_blocks(plan)
    headline = [name for name, _ in experiment.errors_of_headline()]
    outputs = [output for output in experiment.outputs if output.name in headline and not output.dims]
    shared = [
        dimension
        for dimension, axes in grid.dimensions.items()
        if set(axes) <= set(experiment.shared)
        and len(blocks) > (along := len(grid.study.axes[dimension])) + 2
        and len(grid) * along <= LARGEST
    ]
    samples = _samples(plan, accumulator, blocks, outputs, rows, sums) if shared else {}
    return {
        f"{output.name}_mc_covariance_{dimension}": _covariance(plan, samples[output.name], output, dimension)
        for dimension in shared
        for output in outputs
    }


def _paired_blocks(plan: Plan) -> list[Block]:
    """Return the blocks of whole size, which are the same for all points that share random numbers."""
    blocks = plan.blocks(1.0)
    return [block for block in blocks if block.n_sim == blocks[0].n_sim]


def _samples(
    plan: Plan,
    accumulator: Accumulator,
    blocks: list[Block],
    outputs: list[Output],
    rows: Mapping[bytes, int],
    sums: Array,
) -> dict[str, Array]:
    """Return the results of every block by itself, (points, blocks), NaN for points that are not done."""
    experiment = plan.grid.study.experiment
    samples = {output.name: np.full((len(plan.grid), len(blocks)), np.nan) for output in outputs}
    n, n_cat = (np.full(len(blocks), float(count)) for count in (blocks[0].realisations, blocks[0].n_cat))
    for point in plan.grid.points():
        if accumulator.status[point.index] == DONE:
            own = sums[[rows[ledger_key(point.digest, block)] for block in blocks]]
            results = experiment.summarise(experiment.named(own), n, n_cat)
            for name, values in samples.items():
                values[point.index] = results[name]
    return samples


def _covariance(plan: Plan, samples: Array, output: Output, dimension: str) -> Variable:
    grid, count = plan.grid, samples.shape[1]
    dimensions = list(grid.dimensions)
    along = grid.shape[dimensions.index(dimension)]
    shaped = np.moveaxis(samples.reshape(*grid.shape, count), dimensions.index(dimension), -2)
    centred = shaped - shaped.mean(axis=-1, keepdims=True)
    covariance = centred @ np.swapaxes(centred, -1, -2) / (count * (count - along - 2))
    attributes = {
        "units": squared(output.unit),
        "long_name": f"covariance of {output.meaning} between points along {dimension}, from {count} blocks",
    }
    return (*(d for d in dimensions if d != dimension), dimension, f"{dimension}_other"), covariance, attributes


def squared(unit: str) -> str:
    """Return the square of a unit in the same notation: ``mas2 / yr2`` of ``mas / yr`` (no reader of units knows the
    power of a bracket with a solidus in it).
    """
    return re.sub(r"([A-Za-z]+)(?:\*\*|\^)?(-?\d+)?", lambda part: f"{part[1]}{2 * int(part[2] or 1)}", unit)
