"""Covariances of the errors of points that share random numbers, by a jackknife over what they share."""

import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from linksweep.sweep.contract import FEWEST_SAMPLES, Array, Output, Rows
from linksweep.sweep.contract.block import Block, ledger_key
from linksweep.sweep.contract.reducer import Sums
from linksweep.sweep.formatting import described
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.planning.point_status import Status

LARGEST = 10**7
"""Most elements of one covariance, which has one for every pair of points along an axis, and of its samples."""

Variable = tuple[tuple[str, ...], Array, dict[str, Any]]


def covariances(plan: Plan, accumulator: Accumulator, rows: Mapping[bytes, int], ledger: Rows) -> dict[str, Variable]:
    """Return ``NAME_mc_covariance_AXIS`` of every result with a Monte-Carlo error, for every axis along which points
    share their random numbers; dimensions of the result and ``AXIS_other``.

    The independent samples are the catalogues, each with all its blocks, or the blocks where there is one catalogue.
    The results without each of them in turn give the covariance (Efron 1982, The Jackknife, Sect. 3.5 and 6.1).  It has
    all correlated errors: those of realisations, and those of catalogues if there are several.  The attribute
    ``samples`` says how many samples there were; with fewer than `FEWEST_SAMPLES` there is no covariance.
    """
    samples = _independent(plan)
    if len(samples) < FEWEST_SAMPLES:
        return {}
    outputs = {output.name: output for output in plan.grid.study.experiment.outputs}
    with_error = [o for o in outputs.values() if f"{o.name}_mc_error" in outputs and o.name not in plan.grid.study.axes]
    along = {output: _shared_dimensions(plan, output, len(samples)) for output in with_error}
    along = {output: dimensions for output, dimensions in along.items() if dimensions}
    deviations = _deviations(plan, accumulator, samples, list(along), rows, ledger) if along else {}
    return {
        f"{output.name}_mc_covariance_{dimension}": _covariance(plan, deviations[output.name], output, dimension)
        for output, dimensions in along.items()
        for dimension in dimensions
    }


def _shared_dimensions(plan: Plan, output: Output, samples: int) -> list[str]:
    """Return the dimensions along which points share random numbers, unless the covariance is too large."""
    grid, experiment = plan.grid, plan.grid.study.experiment
    size = len(grid) * experiment.size_of(output)
    shared = [d for d, axes in grid.dimensions.items() if set(axes) <= set(experiment.shared)]
    lengths = dict(zip(grid.dimensions, grid.shape, strict=True))
    return [d for d in shared if size * max(lengths[d], samples) <= LARGEST]


def _independent(plan: Plan) -> list[list[Block]]:
    """Return the blocks of each sample: points that share random numbers have the same blocks whatever they cost.

    Where there is one catalogue, each of its blocks is a sample, except a last one that is smaller.
    """
    blocks = plan.blocks(1.0)
    if plan.grid.study.sampling.n_cat == 1:
        return [[block] for block in blocks if block.n_sim == blocks[0].n_sim]
    return [list(group) for _, group in groupby(blocks, key=lambda block: block.group)]


def _deviations(
    plan: Plan,
    accumulator: Accumulator,
    samples: Sequence[Sequence[Block]],
    outputs: Sequence[Output],
    rows: Mapping[bytes, int],
    ledger: Rows,
) -> dict[str, Array]:
    """Return each result without each of the samples in turn, less the mean, scaled so that products add up to the
    covariance; (points, size of the result, samples), NaN for points that are not done.
    """
    grid, count = plan.grid, len(samples)
    experiment, n_cat, reducer = grid.study.experiment, grid.study.sampling.n_cat, accumulator.reducer
    assert isinstance(reducer, Sums), "only points with sums share random numbers"
    own_n = sum(block.realisations for block in samples[0])
    catalogues = np.full(count, float(max(n_cat - 1, 1)))
    deviations = {o.name: np.full((len(grid), experiment.size_of(o), count), np.nan) for o in outputs}
    for point in grid.points(np.flatnonzero(accumulator.status == Status.DONE)):
        keys = [[ledger_key(point.digest, block) for block in blocks] for blocks in samples]
        own = np.array([reducer.flat(ledger[[rows[key] for key in some]]).sum(axis=0) for some in keys])
        n = float(accumulator.realisations[point.index])
        without = reducer.typed(reducer.flat(accumulator.total[point.index : point.index + 1]) - own)
        results = reducer.finish(without, np.full(count, n - own_n), catalogues)
        scale = (n - own_n) / np.sqrt(n * own_n * (count - 1.0))  # sqrt((count - 1)/count), if these are all blocks
        for name, mine in deviations.items():
            values = np.reshape(results[name], (count, -1)).T
            mine[point.index] = scale * (values - values.mean(axis=1, keepdims=True))
    return {name: grid.with_repeats(mine) for name, mine in deviations.items()}


def _covariance(plan: Plan, deviations: Array, output: Output, dimension: str) -> Variable:
    grid, count = plan.grid, deviations.shape[-1]
    dimensions = list(grid.dimensions)
    shaped = deviations.reshape(*grid.shape, *grid.study.experiment.shape_of(output), count)
    shaped = np.moveaxis(shaped, dimensions.index(dimension), -2)
    covariance = shaped @ np.swapaxes(shaped, -1, -2)
    meaning = f"covariance of {output.name} between points along {dimension}"
    attributes = described(squared(output.unit), meaning) | {"samples": count}
    others = (d for d in dimensions if d != dimension)
    return (*others, *output.dims, dimension, f"{dimension}_other"), covariance, attributes


def squared(unit: str) -> str:
    """Return the square of a unit in the same notation: ``mas2 / yr2`` of ``mas / yr`` (no reader of units knows the
    power of a bracket with a solidus in it).
    """
    return re.sub(r"([A-Za-z]+)(?:\*\*|\^)?(-?\d+)?", lambda part: f"{part[1]}{2 * int(part[2] or 1)}", unit)
