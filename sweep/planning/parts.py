"""How the work of a study is dealt to parts that know nothing of each other: by its plan and their number alone."""

import math
from collections.abc import Iterator, Mapping
from heapq import heapreplace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract.rows import Block, BlockRows, ledger_key
from linksweep.sweep.planning.plan import MOST_SHARING, Plan
from linksweep.sweep.planning.point_status import Status

# The blocks of each point, by its index, that are a part's; None for a point of which no other part has a block.
Share = Mapping[int, tuple[Block, ...] | None]


class Unit(NamedTuple):
    """What no two parts divide: a block of points that share its random numbers, or all blocks of these points, which
    have so many ``units`` together.
    """

    cost: float
    indices: tuple[int, ...]
    block: Block | None
    units: int


def _units(plan: Plan) -> Iterator[Unit]:
    """Yield the units of a plan in the order of its points."""
    grid, sampling = plan.grid, plan.grid.study.sampling
    groups: dict[object, list[tuple[int, float]]] = {}
    for index, parameters in grid.parameters():
        key = grid.draw(parameters) if grid.study.draws_together else index
        groups.setdefault(key, []).append((index, plan.cost(parameters)))
    for members in groups.values():
        for start in range(0, len(members), MOST_SHARING):
            indices, costs = zip(*members[start : start + MOST_SHARING], strict=True)
            blocks = plan.blocks(costs[0])
            if len(blocks) == 1 or sampling.precision is not None:
                # How many blocks a precision needs is known from all earlier ones of the point.
                yield Unit(_rounded(sum(plan.cost_of(block, costs) for block in blocks)), indices, None, 1)
            else:
                yield from (Unit(_rounded(plan.cost_of(one, costs)), indices, one, len(blocks)) for one in blocks)


def _rounded(cost: float) -> float:
    # The last digits of what an experiment declares may depend on the machine; the parts may not.
    return float(f"{cost:.6g}")


def deal(plan: Plan, parts: int) -> Iterator[tuple[Unit, int]]:
    """Yield each unit of a plan with the number, from 1, of the part that has it.

    The costliest comes first, and each goes to the part with the least so far (Graham 1969, Bounds on multiprocessing
    timing anomalies).  Where all cost the same that deals them in rounds, each of which begins further on: else a part
    would have the same value of an axis again and again, whose points may be those that take long.
    """
    step = _step(parts)
    loads = [(0.0, part, part, 0) for part in range(parts)]
    for unit in sorted(_units(plan), key=lambda unit: -unit.cost):
        load, _, part, units = loads[0]
        heapreplace(loads, (load + unit.cost, (part - step * (units + 1)) % parts, part, units + 1))
        yield unit, part + 1


def _step(parts: int) -> int:
    """Return how much further on a round begins than the last: in time a part has every place in it."""
    return next(n for n in range(max(1, round(0.618 * parts)), 2 * parts + 1) if math.gcd(n, parts) == 1)


def _dealt_alike(plan: Plan, parts: int) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return the indices of all points, and for each the number that `deal` gives to it, where each is a unit and all
    cost the same: a million take a second.  None elsewhere.
    """
    sampling = plan.grid.study.sampling
    if not plan.costs_nothing_special or plan.grid.study.draws_together:
        return None
    if sampling.precision is None and len(plan.blocks(1.0)) > 1:
        return None
    indices = plan.grid.indices()
    rounds, places = np.divmod(np.arange(len(indices)), parts)
    return indices, (places + _step(parts) * rounds) % parts + 1


def share_of(plan: Plan) -> Share | None:
    """Return what the part that a study is has to compute, None for a whole study."""
    part = plan.grid.study.part
    if part is None:
        return None
    if (alike := _dealt_alike(plan, part.total)) is not None:
        return dict.fromkeys(alike[0][alike[1] == part.number].tolist())
    units: dict[int, list[Unit]] = {}
    for unit, number in deal(plan, part.total):
        if number == part.number:
            for index in unit.indices:
                units.setdefault(index, []).append(unit)
    return {
        index: None if len(some) == some[0].units else tuple(sorted(unit.block for unit in some if unit.block))
        for index, some in sorted(units.items())
    }


def lost_parts(plan: Plan, status: NDArray[np.int8], rows: BlockRows, parts: int) -> list[int]:
    """Return the numbers of the parts that have a block which is missing in a ledger's ``rows``, of points that are
    missing by their ``status``.
    """
    missing = status == int(Status.MISSING)
    if (alike := _dealt_alike(plan, parts)) is not None:
        return [int(number) for number in np.unique(alike[1][missing[alike[0]]])]
    digests = {point.index: point.digest for point in plan.grid.points(np.flatnonzero(missing))}

    def lacks(unit: Unit) -> bool:
        some = (digests[index] for index in unit.indices if index in digests)
        return any(unit.block is None or ledger_key(digest, unit.block) not in rows for digest in some)

    return sorted({number for unit, number in deal(plan, parts) if lacks(unit)}) if digests else []
