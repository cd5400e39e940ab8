"""The plan of a study: points cut into blocks, each with its own random stream, and how these are dealt to parts of a
study that know nothing of each other: by the plan and their number alone.

A stream comes from NumPy's SeedSequence of the seed and the words that name the stream: the point's stream, the
catalogue and the part of its realisations.  So it does not depend on the grid, the order or the machine.  SFC64 is the
fastest sound bit generator of NumPy.
"""

import math
import struct
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from heapq import heapreplace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Block, BlockRows, GeneratorPair, Rows, Status, SweepError, ledger_key
from linksweep.sweep.planning.grid import Grid, GridPoint, PointCache
from linksweep.sweep.studies.study import Study

# The most random numbers in a block of several catalogues, and in a task that returns samples: about 0.2 s of work,
# against 2 ms that Dask spends on a task.
TARGET = 2**24

# What one evaluation costs besides its random numbers, counted in random numbers.
OVERHEAD = 20_000

# Points that share one draw in one piece of work: enough to make the draw cheap, few enough to fit in memory.
MOST_SHARING = 64

# The least share of its cost that a point takes if it uses the random numbers of another: its part of the linear
# algebra. With errors of both catalogues it takes nearly all of it.
SHARED = 0.05

MAX_BLOCKS = 10_000_000

# For how many different costs of points the blocks are kept in memory.
MOST_CUTS = 1000

# The most entries in a table of the costs of points that is put into a store.
MOST_COSTS = 10_000

MAX_SIMS = 512
FIRST_SIMS = 64
MAX_CATALOGUES = 16

# The most random numbers in a block of one catalogue: setting up a catalogue costs as much as some tens of its
# realisations, so a block has more than that, but an interruption should lose no more than a few seconds of work.
LARGEST_BLOCK = 2**28


# A point that is not precise enough gets at most this many times its realisations before it is checked again.
LARGEST_STEP = 16

# A precision counts as reached if it is still reached with this many times the realisations: errors are estimates too,
# and the first that is small enough is often one that is too small by chance.
CONFIRMED = 1.25

# Realisations from which an error that is still not known no longer counts, as where all realisations are alike.
KNOWN_BY = 4096


class Work(NamedTuple):
    """One block of one point, or of several that share its random numbers, with its cost in random numbers."""

    points: tuple[GridPoint, ...]
    block: Block
    cost: float


@dataclass(frozen=True)
class PlanSize:
    """Counts of a plan or a part of it; ``cost`` in random numbers."""

    points: int
    blocks: int
    realisations: int
    cost: float

    def __add__(self, other: "PlanSize") -> "PlanSize":
        return PlanSize(*(one + more for one, more in zip(vars(self).values(), vars(other).values(), strict=True)))


NOTHING = PlanSize(0, 0, 0, 0.0)


@dataclass(frozen=True)
class Survey:
    """The size of a plan as far as it is known: in total, held by the ledger, and pending; how many points failed."""

    total: PlanSize
    stored: PlanSize
    pending: PlanSize
    failed: int = 0


class Plan:
    """How the points of a grid are cut into blocks.

    Invariant (a test checks this sentence): the blocks of a point tile its n_cat x n_sim realisations exactly once,
    and neither they nor their streams depend on anything but the seed, the point's own parameters, n_cat and n_sim.

    ``blocks(cost, parts)`` are those of a point, of all or some parts; ``block_shape(cost)`` says how many realisations
    of how many catalogues a whole block holds.  Both depend on the random numbers that a realisation takes alone, so
    that more realisations or catalogues leave whole blocks as they are: only a last, partial one is computed again.
    """

    def __init__(self, grid: Grid) -> None:
        """Take a grid; nothing is asked yet."""
        experiment = grid.study.experiment
        self.grid = grid
        # All points cost the same, and need not be looked at.
        self.costs_nothing_special = not experiment.says_cost
        self._cost = PointCache(experiment.cost, grid.study.varying)
        self.blocks = lru_cache(MOST_CUTS)(self._blocks)
        self.parts = lru_cache(MOST_CUTS)(self._parts)
        self.block_shape = cache(self._shape)

    def for_study(self, study: Study) -> "Plan":
        """Return the plan of the same points, for a study that knows more about their results."""
        return Plan(Grid(study, self.grid.said))

    def _blocks(self, cost: float, parts: range | None = None) -> Sequence[Block]:
        n_cat = self.grid.study.sampling.n_cat
        _, catalogues = self.block_shape(cost)
        blocks = []
        for group, first in enumerate(range(0, n_cat, catalogues)):
            for part in range(self.parts(cost)) if parts is None else parts:
                n_sim = self.realisations(cost, part + 1) - self.realisations(cost, part)
                blocks.append(Block(group, part, first, min(catalogues, n_cat - first), n_sim))
        return tuple(blocks)

    def _parts(self, cost: float, n_sim: int | None = None) -> int:
        """Return into how many parts ``n_sim`` realisations of a catalogue (by default the study's) are cut."""
        wanted = n_sim or self.grid.study.sampling.n_sim
        return bisect_left(range(wanted), wanted, key=lambda parts: self.realisations(cost, parts))

    def only_block(self) -> Block | None:
        """Return the one block that every point consists of, None if points have several blocks or different ones."""
        study = self.grid.study
        is_varied = study.draws_together or study.sampling.precision is not None or any(study.counts.values())
        blocks = self.blocks(1.0) if self.costs_nothing_special and not is_varied else ()
        return blocks[0] if len(blocks) == 1 else None

    def parts_of(self, point: GridPoint) -> range:
        """Return the parts of a point, of its first ones where a precision may call for more."""
        study = self.grid.study
        more = study.counts.get(point.digest.hex(), 0) if study.counts else 0
        return range(self.parts(self.cost(point.parameters), max(more, study.sampling.n_sim)))

    def realisations(self, cost: float, parts: int) -> int:
        """Return how many realisations of a catalogue the first ``parts`` hold.

        All parts are of the same size but for the last of the study's n_sim, which holds what is left of these.  With a
        precision to reach there is no such remainder, but the first parts are small and double the number of
        realisations each.
        """
        sampling, (sims, _) = self.grid.study.sampling, self.block_shape(cost)
        if sampling.precision is None:
            further = max(0, parts - -(-sampling.n_sim // sims))
            return min(parts * sims, sampling.n_sim) + further * min(sims, sampling.n_sim)
        doublings = max(0, (sims // FIRST_SIMS).bit_length() - 1)
        if parts > doublings:
            return sims * (parts - doublings)
        return FIRST_SIMS << (parts - 1) if parts else 0

    def _shape(self, cost: float) -> tuple[int, int]:
        if self.grid.study.draws_together:
            # Whatever the cost: points that share a draw need the same blocks.
            return MAX_SIMS, 1
        sims = _power_of_two(LARGEST_BLOCK / cost, MAX_SIMS)
        return sims, _power_of_two(TARGET / (cost * sims + OVERHEAD), MAX_CATALOGUES)

    def cost(self, parameters: dict[str, Any]) -> float:
        """Return the random numbers that one realisation of a point takes, at least 1."""
        return 1.0 if self.costs_nothing_special else max(1.0, self._cost(self.grid.study.arguments(parameters)))

    def costs(self) -> tuple[tuple[str, ...], dict[tuple[Any, ...], float]] | None:
        """Return the axes on which the cost of a point depends, and the cost by their values; None for a long table."""
        grid = self.grid
        if self.costs_nothing_special:
            return (), {(): 1.0}
        if (table := self._cost.table()) is None and len(grid) <= MOST_COSTS:
            names = tuple(grid.study.varying)
            table = names, {}
            for _, parameters in grid.parameters():
                with suppress(Exception):  # nobody has asked for it, and it cannot be computed
                    point = grid.study.arguments(parameters)
                    table[1][tuple(point[name] for name in names)] = self._cost(point)
        return table if table is not None and len(table[1]) <= MOST_COSTS else None

    def work(self, points: tuple[GridPoint, ...], block: Block) -> Work:
        """Return the work of a block of points that share its random numbers."""
        return Work(points, block, self.cost_of(block, [self.cost(point.parameters) for point in points]))

    def cost_of(self, block: Block, costs: Sequence[float]) -> float:
        """Return the cost of a block of points that share its random numbers, of which a realisation has ``costs``."""
        largest = max(costs)
        cost = largest + SHARED * (sum(costs) - largest)
        return block.realisations * cost + block.n_cat * len(costs) * OVERHEAD

    def size(self, cost: float, points: int = 1) -> PlanSize:
        """Return the counts of whole points that cost the same, by arithmetic."""
        sampling, parts = self.grid.study.sampling, self.parts(cost)
        groups = -(-sampling.n_cat // self.block_shape(cost)[1])
        realisations = sampling.n_cat * self.realisations(cost, parts)
        work = realisations * cost + sampling.n_cat * parts * OVERHEAD
        return PlanSize(points, points * parts * groups, points * realisations, points * work)

    def check_size(self, blocks: int) -> None:
        """Raise SweepError for more than `MAX_BLOCKS` blocks, more than a run can finish or a ledger hold."""
        if blocks > MAX_BLOCKS:
            sampling = self.grid.study.sampling
            sizes = f"n_cat = {sampling.n_cat:,} and n_sim = {sampling.n_sim:,}"
            raise SweepError(f"{sizes} make more than {MAX_BLOCKS:,} blocks", self.grid.study.source)

    def wanted_parts(self, cost: float, parts: int, total: Rows, reached: bool) -> tuple[int, bool]:
        """Return how many parts a point with ``parts`` needs, and whether these reach the precision; ``reached`` says
        whether those of its last check did.  Only its ``total`` (1,) decides, so all runs agree.
        """
        study = self.grid.study
        sampling, precision = study.sampling, study.sampling.precision
        if precision is None:
            return parts, True
        n_sim = self.realisations(cost, parts)
        n_cat = float(sampling.n_cat)
        try:
            results = study.experiment.reducer.finish(total, np.array([n_cat * n_sim]), np.array([n_cat]))
        except Exception:  # raised by a user's function: the point ends here, and `Accumulator.failing` says why
            return parts, False
        with np.errstate(divide="ignore", invalid="ignore"):
            headline = study.experiment.errors_of_headline()
            others = [(name, f"{name}_mc_error") for name in results if f"{name}_mc_error" in results]
            measured = {name for name, _ in headline + others if not np.isnan(results[name]).all()}
            pairs = [pair for pair in headline if pair[0] in measured]
            pairs = pairs or [pair for pair in others if pair[0] in measured][:1] or headline
            if not pairs:
                raise SweepError("precision: no result has an error to judge by, as a mean has", study.source)
            errors = np.concatenate([np.abs(results[error] / results[value]).reshape(-1) for value, error in pairs])
        unknown = n_sim < KNOWN_BY and bool(np.isnan(errors).any())
        worst = float(np.max(errors, where=~np.isnan(errors), initial=0.0))
        enough = worst <= precision and not unknown
        if enough and reached:
            return parts, True
        factor = max((worst / precision) ** 2, 2.0 if unknown else CONFIRMED)
        needed = self.parts(cost, math.ceil(n_sim * min(factor, LARGEST_STEP)))
        return min(max(parts + 1, needed), self.parts(cost, sampling.most)), enough

    def share(self) -> "Share | None":
        """Return what the part that a study is has to compute, None for a whole study."""
        part = self.grid.study.part
        if part is None:
            return None
        if (alike := _dealt_alike(self, part.total)) is not None:
            return dict.fromkeys(alike[0][alike[1] == part.number].tolist())
        divided, blocks = set[int](), dict[int, list[Block]]()
        for unit, number in deal(self, part.total):
            if number != part.number:
                divided.update(unit.indices)
                continue
            for index in unit.indices:
                blocks.setdefault(index, []).extend([unit.block] if unit.block else ())
        return {index: tuple(sorted(some)) if index in divided else None for index, some in sorted(blocks.items())}


def _power_of_two(ratio: float, most: int) -> int:
    return min(most, 2 ** max(0, math.floor(math.log2(ratio)))) if ratio >= 1 else 1


def generators(seed: int, name: bytes, catalogue: int, part: int) -> GeneratorPair:
    """Return the generators of the realisations ``part`` of a catalogue and of the catalogue itself."""
    start = struct.pack("<2Q", seed, 0) + name

    def stream(*place: int) -> np.random.Generator:
        # The words that SeedSequence(seed, spawn_key=...) makes of these: its own way to them takes twice as long.
        words = np.frombuffer(start + struct.pack(f"<{len(place)}I", *place), dtype="<u4")
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(words)))

    return stream(catalogue, 1, part), stream(catalogue, 0)


def generators_of(seed: int, name: bytes, block: Block) -> list[GeneratorPair]:
    """Return what `generators` returns for each catalogue of a block."""
    catalogues = range(block.first_catalogue, block.first_catalogue + block.n_cat)
    return [generators(seed, name, catalogue, block.part) for catalogue in catalogues]


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
    groups: dict[object, list[tuple[int, float, range]]] = {}
    for point in grid.points():
        key = point.stream if grid.study.draws_together else point.index
        groups.setdefault(key, []).append((point.index, plan.cost(point.parameters), plan.parts_of(point)))
    for members in groups.values():
        for start in range(0, len(members), MOST_SHARING):
            some = members[start : start + MOST_SHARING]
            indices, costs, parts = zip(*some, strict=True)
            blocks = plan.blocks(costs[0], max(parts, key=len))
            if len(blocks) == 1 or sampling.precision is not None:
                # How many blocks a precision needs is known from all earlier ones of the point.
                yield Unit(_rounded(sum(plan.cost_of(block, costs) for block in blocks)), indices, None)
                continue
            for block in blocks:
                indices, costs, _ = zip(*(one for one in some if block.part in one[2]), strict=True)
                yield Unit(_rounded(plan.cost_of(block, costs)), indices, block)


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
    """Return the indices of all points, and for each the number that `deal` gives to it, where each consists of one
    block and all cost the same: a million take a second.  None elsewhere.
    """
    if plan.only_block() is None:
        return None
    indices = plan.grid.indices()
    rounds, places = np.divmod(np.arange(len(indices)), parts)
    return indices, (places + _step(parts) * rounds) % parts + 1


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
