"""A satellite's Parquet table of millions of quasars, one row group at a time: on Dask workers, in little memory.

Each pass over the table reads it again.  What is kept is a few numbers of each source and sums of cells of the sky,
added in the order of the row groups: the same bits whatever computes them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, reduce
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.link import LinkError
from core.tie.astrometry import Astrometry
from core.tie.clips import Sources, separation
from core.tie.normal_sums import NormalSums, group_sums, source_counts, source_discrepancies, source_sums, weight_sizes
from core.tie.problem import Problem
from core.tie.solution import Solution, solve
from core.tie.sources import DIVISIONS, sky_cells
from core.unknowns import Unknowns
from sweep.contract import SweepError
from sweep.executing.ordered_map import Map
from sweep.table_parquet import is_parquet, read_row_group, row_groups
from sweep.tie.column_names import columns_needed
from sweep.tie.known_spin import known_spin
from sweep.tie.matching import Match
from sweep.tie.options import SIGNS, Options
from sweep.tie.setup import ZERO_MOTION, Setup, default_epoch, zero_motion
from sweep.tie.tables import AstrometricTable, astrometry_of, digest_of
from sweep.tie.unknowns_of import unknowns_of

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FROM_ROWS = 100_000
"""Smaller tables are solved as a whole."""


def in_row_groups(satellite: str | Path, reference: str | Path, options: Options) -> bool:
    """Return whether tables are solved by row groups: quasars alone, in Parquet, and many."""
    path = Path(satellite)
    if str(reference) != ZERO_MOTION or options.missions or not path.is_file() or not is_parquet(path):
        return False
    return sum(row_groups(path)[0]) >= FROM_ROWS


@dataclass(frozen=True)
class RowGroup:
    """The rows of a table from ``first`` on, and what is asked of them; ``unknowns`` are None before they are known."""

    path: Path
    digest: str
    number: int
    first: int
    columns: tuple[str, ...]
    options: Options
    epoch: float = np.nan
    unknowns: Unknowns | None = None

    def problem(self) -> Problem:
        """Read the rows; raises SweepError for wrong ones, with their numbers in the row group."""
        own = self.astrometry()
        assert self.unknowns is not None, "the first pass finds them"
        known = None
        if (spin := self.options.known_spin) is not None:
            known = known_spin(spin, own, SIGNS[self.options.sign])
        source, weights = np.arange(len(own)), self.options.weights
        return Problem(own, zero_motion(len(own)), source, self.unknowns, self.epoch, weights, known)

    def astrometry(self) -> Astrometry:
        """Read the rows."""
        if _digest(self.path) != self.digest:
            raise SweepError("is not the same file on every worker, or was changed", str(self.path))
        table = read_row_group(self.path, self.number, self.columns)
        where = f"{self.path}, the {len(table)} rows from row {self.first + 1} on"
        found, _ = astrometry_of(table, where, self.options.satellite_options)
        if not np.all(np.isfinite(found.values[:2])):
            raise SweepError("sources without a position", where)
        return found


@lru_cache(maxsize=8)
def _digest(path: Path) -> str:
    return digest_of(path)


def _scanned(group: RowGroup) -> tuple[Astrometry, Array]:
    """Return the places and epochs of the sources, without further columns, and one value in each bin."""
    own = group.astrometry()
    columns: dict[str, Array] = {}
    if group.options.bins is not None and group.options.bins[0] in own.columns:
        name, edges = group.options.bins
        bin_of = np.searchsorted(edges, own.columns[name], side="right")
        columns[name] = own.columns[name][np.unique(bin_of, return_index=True)[1]]
    return replace(own.taken(slice(0, 0)), columns=columns), np.array([*own.values[:2], own.epoch])


def _summed(group: RowGroup, factors: Array | None) -> NormalSums:
    problem = group.problem()
    ra, dec = problem.satellite.values[:2]
    cells = sky_cells(ra, dec, DIVISIONS)
    return group_sums(problem, cells, 2 * DIVISIONS**2, factors)


def _discrepancies(group: RowGroup, estimate: Array) -> Array:
    return source_discrepancies(group.problem(), estimate)


def _separations(group: RowGroup) -> Array:
    return np.array(separation(group.problem()))


def _counts(group: RowGroup) -> Array:
    return source_counts(group.problem())


def _heaviest(group: RowGroup, number: int) -> tuple[Array, Indices, NormalSums]:
    """Return the sizes of the largest weights, the sources with them and their sums."""
    problem = group.problem()
    sizes = weight_sizes(problem)
    found = np.argsort(-sizes, kind="stable")[:number]
    return sizes[found], group.first + found, source_sums(problem.only(found))


@dataclass(frozen=True)
class RowGroupTable:
    """The sources of a table that is read by row groups, as `SourceTable` has them."""

    groups: tuple[RowGroup, ...]
    n_sources: int
    run: Map

    @property
    def single(self) -> bool:
        """The sums of single sources are not kept."""
        return False

    @cached_property
    def _last(self) -> list[tuple[Array, NormalSums]]:
        return []

    def cell_sums(self, factors: Array) -> NormalSums:
        """Return the sums of cells of the sky, each source with a factor of its weight."""
        if not self._last or not np.array_equal(self._last[0][0], factors):
            parts: list[Any] = [None if np.all(part == 1.0) else part for part in self._divided(factors)]
            sums = reduce(NormalSums.plus, self.run(_summed, zip(self.groups, parts, strict=True)))
            self._last[:] = [(factors.copy(), sums.taken(sums.count > 0))]
        return self._last[0][1]

    def solve(self, factors: Array) -> Solution:
        """Return the solution with a factor of the weight of each source."""
        labels = (self.groups[0].unknowns or Unknowns(())).labels
        return solve(self.cell_sums(factors), labels)

    def as_sources(self) -> Sources:
        """Return what the clips need."""
        return Sources(self.solve, self._discrepancies, self._filled(_counts))

    def separations(self) -> tuple[Array, Array]:
        """Return the normalised separation and the separation of each source."""
        normalised, plain = self._filled(_separations, rows=2)
        return normalised, plain

    def heaviest(self, number: int) -> tuple[Indices, NormalSums]:
        """Return the sources with the largest weights, and their sums."""
        found = list(self._each(_heaviest, number))
        order = np.argsort(-np.concatenate([sizes for sizes, _, _ in found]), kind="stable")[:number]
        sums = reduce(NormalSums.followed_by, (sums for _, _, sums in found))
        return np.concatenate([places for _, places, _ in found])[order], sums.taken(order)

    def _discrepancies(self, estimate: Array) -> Array:
        return self._filled(_discrepancies, estimate)

    def _filled(self, function: Any, *arguments: Any, rows: int | None = None) -> Array:
        """Return what a function returns of each source, without a second copy of it."""
        found = np.empty(self.n_sources if rows is None else (rows, self.n_sources))
        for group, part in zip(self.groups, self._each(function, *arguments), strict=True):
            found[..., group.first : group.first + part.shape[-1]] = part
        return found

    def _each(self, function: Any, *arguments: Any) -> Iterator[Any]:
        return self.run(function, ((group, *arguments) for group in self.groups))

    def _divided(self, factors: Array) -> list[Array]:
        limits = [*(group.first for group in self.groups), self.n_sources]
        return [factors[low:high] for low, high in pairwise(limits)]


def set_up_row_groups(satellite: str | Path, options: Options, run: Map) -> tuple[Setup, RowGroupTable]:
    """Look through a table once; raises SweepError for whatever is wrong with it or the options."""
    options.check()
    path = Path(satellite).resolve()
    sizes, names = row_groups(path)
    needed = tuple(names if isinstance(options.known_spin, (str, Path)) else _needed(names, options))
    digest = _digest(path)
    firsts = np.concatenate([[0], np.cumsum(sizes)])
    plain = replace(options, missions={}, mission_options={})
    groups = tuple(
        RowGroup(path, digest, number, int(first), needed, plain)
        for number, (first, size) in enumerate(zip(firsts, sizes, strict=False))
        if size
    )
    n = sum(sizes)
    values, epochs = np.zeros((5, n)), np.empty(n)
    samples = []
    for group, (sample, places) in zip(groups, run(_scanned, ((group,) for group in groups)), strict=True):
        part = slice(group.first, group.first + places.shape[1])
        values[:2, part], epochs[part] = places[:2], places[2]
        samples.append(sample)
    epoch = default_epoch(epochs) if options.epoch is None else options.epoch
    notes: list[str] = []
    try:
        unknowns = _unknowns(replace(groups[0], epoch=epoch), samples, notes)
    except ValueError as error:  # LinkError is one
        raise SweepError(str(error)) from error
    groups = tuple(replace(group, epoch=epoch, unknowns=unknowns) for group in groups)
    source = np.arange(n)
    own = Astrometry(values, np.broadcast_to(np.nan, (5, n)), np.broadcast_to(epoch, n))
    problem = Problem(own, zero_motion(n), source, unknowns, epoch, options.weights)
    left = AstrometricTable(str(satellite), digest, own, {})
    matched = Match(source, source, "the satellite's sources", source[:0])
    notes.append(f"read in {len(groups)} row groups; sources are numbers of rows")
    right = AstrometricTable(ZERO_MOTION, "", problem.rows, {})
    return Setup(left, right, matched, problem, source, source + 1, tuple(notes)), RowGroupTable(groups, n, run)


def _needed(names: list[str], options: Options) -> list[str]:
    return columns_needed(names, options.satellite_options, () if options.bins is None else (options.bins[0],))


def _unknowns(group: RowGroup, samples: list[Astrometry], notes: list[str]) -> Unknowns:
    """Return the unknowns of the whole table: what is determined is that of the first rows, the bins those of all."""
    own = group.astrometry()
    few = own.taken(slice(0, min(len(own), 1000)))
    if group.options.bins is not None:
        name = group.options.bins[0]
        columns = {name: np.concatenate([one.columns[name] for one in samples])} if name in own.columns else {}
        few = replace(few, columns=columns)
    rows = zero_motion(len(few))
    try:
        return unknowns_of(group.options, few, rows, np.arange(len(few)), group.epoch, notes)
    except LinkError as error:
        raise LinkError(f"of the first rows: {error}") from error
