"""The plan of a study: points cut into blocks, each with its own random stream, and what is still pending."""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.grid import Grid, GridPoint

TARGET = 2**24
"""Random numbers in one block or task: about 0.2 s of work, against 2 ms that Dask spends on a task."""

OVERHEAD = 20_000
"""What one evaluation costs beside its random numbers, counted in random numbers."""

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
            cost = max(1.0, self.grid.study.experiment.cost(point.parameters))
            for block in self.blocks(cost):
                yield Work(point, block, block.realisations * cost + block.n_cat * OVERHEAD)

    def pending(self, done: Collection[bytes]) -> Iterator[Work]:
        """Yield the blocks that the store does not hold."""
        return (work for work in self.work() if work.key not in done)

    def blocks(self, cost: float) -> list[Block]:
        """Return the blocks of a point whose realisations cost this many random numbers each.

        The size of a block depends on the point alone, so that more realisations or catalogues leave whole blocks as
        they are; only a last, partial block is computed again.
        """
        sampling = self.grid.study.sampling
        sims = _power_of_two(TARGET / cost, MAX_SIMS)
        catalogues = _power_of_two(TARGET / (cost * sims + OVERHEAD), MAX_CATALOGUES)
        return [
            Block(group, part, first, min(catalogues, sampling.n_cat - first), min(sims, sampling.n_sim - start))
            for group, first in enumerate(range(0, sampling.n_cat, catalogues))
            for part, start in enumerate(range(0, sampling.n_sim, sims))
        ]

    def survey(self, done: Collection[bytes] = ()) -> "Survey":
        """Return how large the plan is and how much of it is pending beside the blocks that are ``done``."""
        remaining = np.zeros(len(self.grid), dtype=np.int32)
        points = blocks = realisations = pending_blocks = pending_realisations = 0
        cost = pending_cost = 0.0
        last = -1
        for work in self.work():
            points += work.point.index != last
            last = work.point.index
            blocks += 1
            realisations += work.block.realisations
            cost += work.cost
            if work.key not in done:
                remaining[last] += 1
                pending_blocks += 1
                pending_realisations += work.block.realisations
                pending_cost += work.cost
        return Survey(
            total=PlanSize(points, blocks, realisations, cost),
            pending=PlanSize(int(np.count_nonzero(remaining)), pending_blocks, pending_realisations, pending_cost),
            remaining=remaining,
        )


@dataclass(frozen=True)
class PlanSize:
    """Counts of a plan or a part of it; ``cost`` in random numbers."""

    points: int
    blocks: int
    realisations: int
    cost: float


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


def _power_of_two(ratio: float, most: int) -> int:
    return min(most, 2 ** max(0, math.floor(math.log2(ratio)))) if ratio >= 1 else 1
