"""The plan of a study: points cut into blocks, each with its own random stream, and what is still pending."""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.contract import SweepError
from sweep.grid import Grid, GridPoint

TARGET = 2**24
"""Random numbers in one block or task: about 0.2 s of work, against 2 ms that Dask spends on a task."""

OVERHEAD = 20_000
"""What one evaluation costs beside its random numbers, counted in random numbers."""

MAX_BLOCKS = 10_000_000

MAX_SIMS = 512
MAX_CATALOGUES = 16


@dataclass(frozen=True)
class Block:
    """One point's realisations ``part`` of the catalogues of one ``group``: the unit of work, of the ledger and of
    resuming.

    Catalogues are numbered from ``first_catalogue``; each gets ``n_sim`` realisations from a stream of its own.
    """

    group: int
    part: int
    first_catalogue: int
    n_cat: int
    n_sim: int

    @property
    def realisations(self) -> int:
        """Realisations in this block."""
        return self.n_cat * self.n_sim


@dataclass(frozen=True)
class Work:
    """One block of one point, with its estimated cost in random numbers."""

    point: GridPoint
    block: Block
    cost: float

    @property
    def key(self) -> bytes:
        """What the ledger knows this work by; two runs agree on it if and only if the block's sums are the same
        numbers.
        """
        return ledger_key(self.point.digest, self.block)


@dataclass(frozen=True)
class Plan:
    """All blocks of all points of a grid.

    Invariant (a test checks this sentence): the blocks of a point tile its n_cat x n_sim realisations exactly once,
    and neither they nor their streams depend on anything but the seed, the point's own parameters, n_cat and n_sim.
    """

    grid: Grid

    def work(self) -> Iterator[Work]:
        """Yield every block of every point, in the order of the grid."""
        for point in self.grid.points():
            yield from self._work_of(point)

    def pending(self, done: Collection[bytes]) -> Iterator[Work]:
        """Yield the blocks that the store does not hold."""
        return (work for work in self.work() if work.key not in done)

    def blocks(self, cost: float) -> Iterator[Block]:
        """Yield the blocks of a point whose realisations cost this many random numbers each.

        The size of a block depends on the point alone, so that more realisations or catalogues leave whole blocks as
        they are; only a last, partial block is computed again.
        """
        sampling = self.grid.study.sampling
        sims, catalogues = _block_shape(cost)
        for group, first in enumerate(range(0, sampling.n_cat, catalogues)):
            for part, start in enumerate(range(0, sampling.n_sim, sims)):
                yield Block(
                    group, part, first, min(catalogues, sampling.n_cat - first), min(sims, sampling.n_sim - start)
                )

    def survey(self, done: Collection[bytes] = ()) -> "Survey":
        """Return how large the plan is and how much of it is pending beside the blocks that are ``done``.

        Raises SweepError for more than `MAX_BLOCKS` blocks: a study of that size would not end, and its ledger not fit.
        """
        total = pending = PlanSize(0, 0, 0, 0.0)
        remaining = np.zeros(len(self.grid), dtype=np.int32)
        for point in self.grid.points():
            whole = self._size_of(point)
            total += whole
            if total.blocks > MAX_BLOCKS:
                sampling = self.grid.study.sampling
                message = (
                    f"n_cat = {sampling.n_cat:,} and n_sim = {sampling.n_sim:,} make more than {MAX_BLOCKS:,} blocks"
                )
                raise SweepError(message, self.grid.study.source)
            left = whole
            if done:
                works = [work for work in self._work_of(point) if work.key not in done]
                realisations = sum(w.block.realisations for w in works)
                left = PlanSize(int(len(works) > 0), len(works), realisations, sum(w.cost for w in works))
            pending += left
            remaining[point.index] = left.blocks
        return Survey(total, pending, remaining)

    def _work_of(self, point: GridPoint) -> Iterator[Work]:
        cost = self._cost(point)
        for block in self.blocks(cost):
            yield Work(point, block, block.realisations * cost + block.n_cat * OVERHEAD)

    def _size_of(self, point: GridPoint) -> "PlanSize":
        """Return the counts of `_work_of` by arithmetic."""
        sampling, cost = self.grid.study.sampling, self._cost(point)
        sims, catalogues = _block_shape(cost)
        parts = -(-sampling.n_sim // sims)
        realisations = sampling.n_cat * sampling.n_sim
        work = realisations * cost + sampling.n_cat * parts * OVERHEAD
        return PlanSize(1, parts * -(-sampling.n_cat // catalogues), realisations, work)

    def _cost(self, point: GridPoint) -> float:
        return max(1.0, self.grid.study.experiment.cost(point.parameters))


@dataclass(frozen=True)
class PlanSize:
    """Counts of a plan or a part of it; ``cost`` in random numbers."""

    points: int
    blocks: int
    realisations: int
    cost: float

    def __add__(self, other: "PlanSize") -> "PlanSize":
        return PlanSize(
            self.points + other.points,
            self.blocks + other.blocks,
            self.realisations + other.realisations,
            self.cost + other.cost,
        )


@dataclass(frozen=True)
class Survey:
    """How large a plan is, how much of it is pending, and how many blocks each point of the grid still needs."""

    total: PlanSize
    pending: PlanSize
    remaining: NDArray[np.int32]


def tasks(pending: Iterator[Work]) -> Iterator[list[Work]]:
    """Group pending blocks, in order, into tasks of about `TARGET` random numbers."""
    task: list[Work] = []
    cost = 0.0
    for work in pending:
        if task and cost + work.cost > TARGET:
            yield task
            task, cost = [], 0.0
        task.append(work)
        cost += work.cost
    if task:
        yield task


def ledger_key(digest: bytes, block: Block) -> bytes:
    """Return the 32 bytes by which the ledger knows a block: digest, group, part, catalogues and realisations of
    each.
    """
    numbers = (block.group, block.part, block.n_cat, block.n_sim)
    return digest + b"".join(n.to_bytes(4, "little") for n in numbers)


def generators(seed: int, digest: bytes, catalogue: int, part: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Return the generators of a catalogue's realisations ``part`` and of the catalogue itself.

    Streams are children of the study's seed by NumPy's SeedSequence, named by the point's digest, the catalogue and
    the part: they do not depend on the grid, the order or the machine.  SFC64 is the fastest sound bit generator of
    NumPy.
    """
    words = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, len(digest), 4))

    def stream(*name: Any) -> np.random.Generator:
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(*words, *name))))

    return stream(catalogue, 1, part), stream(catalogue, 0)


def _block_shape(cost: float) -> tuple[int, int]:
    """Return how many realisations of how many catalogues a whole block holds."""
    sims = _power_of_two(TARGET / cost, MAX_SIMS)
    return sims, _power_of_two(TARGET / (cost * sims + OVERHEAD), MAX_CATALOGUES)


def _power_of_two(ratio: float, most: int) -> int:
    return min(most, 2 ** max(0, math.floor(math.log2(ratio)))) if ratio >= 1 else 1
