"""How the work of a study is dealt to parts that know nothing of each other: by its plan and their number alone."""

import math
from collections.abc import Iterator, Mapping
from heapq import heapreplace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract.block import Block, BlockRows, ledger_key
from linksweep.sweep.planning.plan import MOST_SHARING, Plan
from linksweep.sweep.planning.point_status import Status

# The blocks of each point, by its index, that are a part's; None for a point of which no other part has a block.
Share = Mapping[int, tuple[Block, ...] | None]


class Unit(NamedTuple):
    """What no two parts divide: a block of points that share its random numbers, or all blocks of these points."""

    cost: float
    indices: tuple[int, ...]
    block: Block | None


def _units(plan: Plan) -> Iterator[Unit]:
    """Yield the units of a plan in the order of its points."""
    grid, sampling = plan.grid, plan.grid.study.sampling
    groups: dict[object, list[tuple[int, float]]] = {}
    for index, parameters in grid.parameters():
        key = grid.draw(parameters) if sampling.common_random_numbers else index
        groups.setdefault(key, []).append((index, plan.cost(parameters)))
    for members in groups.values():
        for start in range(0, len(members), MOST_SHARING):
            indices, costs = zip(*members[start : start + MOST_SHARING], strict=True)
            blocks = plan.blocks(costs[0])
            if len(blocks) == 1 or sampling.precision is not None:
                # How many blocks a precision needs is known from all earlier ones of the point.
                yield Unit(_rounded(sum(plan.cost_of(block, costs) for block in blocks)), indices, None)
            else:
                yield from (Unit(_rounded(plan.cost_of(block, costs)), indices, block) for block in blocks)


def _rounded(cost: float) -> float:
    # The last digits of what an experiment declares may depend on the machine; the parts may not.
    return float(f"{cost:.6g}")


def deal(plan: Plan, parts: int) -> Iterator[tuple[Unit, int]]:
    """Yield each unit of a plan with the number, from 1, of the part that has it.

    The costliest comes first, and each goes to the part with the least so far (Graham 1969, Bounds on multiprocessing
    timing anomalies).  Where all cost the same that deals them in rounds, each of which begins further on: else a part
    would have the same value of an axis again and again, whose points may be those that take long.
    """
    step = next(n for n in range(max(1, round(0.618 * parts)), 2 * parts + 1) if math.gcd(n, parts) == 1)
    loads = [(0.0, part, part, 0) for part in range(parts)]
    for unit in sorted(_units(plan), key=lambda unit: -unit.cost):
        load, _, part, units = loads[0]
        heapreplace(loads, (load + unit.cost, (part - step * (units + 1)) % parts, part, units + 1))
        yield unit, part + 1


def share_of(plan: Plan) -> Share | None:
    """Return what the part that a study is has to compute, None for a whole study."""
    part = plan.grid.study.part
    if part is None:
        return None
    blocks: dict[int, list[Block | None]] = {}
    for unit, number in deal(plan, part.total):
        if number == part.number:
            for index in unit.indices:
                blocks.setdefault(index, []).append(unit.block)
    costs = {index: plan.cost(parameters) for index, parameters in plan.grid.parameters() if index in blocks}
    whole = {index for index, own in blocks.items() if None in own or len(own) == len(plan.blocks(costs[index]))}
    return {i: None if i in whole else tuple(sorted(filter(None, own))) for i, own in sorted(blocks.items())}


def lost_parts(plan: Plan, status: NDArray[np.int8], rows: BlockRows, parts: int) -> list[int]:
    """Return the numbers of the parts that have a block which is missing in a ledger's ``rows``, of points that are
    missing by their ``status``.
    """
    missing = {point.index: point.digest for point in plan.grid.points(np.flatnonzero(status == Status.MISSING))}

    def lacks(unit: Unit) -> bool:
        digests = (missing[index] for index in unit.indices if index in missing)
        return any(unit.block is None or ledger_key(digest, unit.block) not in rows for digest in digests)

    return sorted({number for unit, number in deal(plan, parts) if lacks(unit)}) if missing else []
