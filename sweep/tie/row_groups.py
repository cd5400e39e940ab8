"""A satellite's Parquet table of millions of quasars, one row group at a time: on Dask workers, in little memory.

Each pass over the table reads it again.  Memory holds sums over cells of the sky, added in the order of the row
groups, so that any workers give the same bits; and for each source whether it is kept, and one number while a clip
examines all sources.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial, reduce
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from linksweep.core.frames import Array, Flags, Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Astrometry
from linksweep.core.tie.clips import DIVISIONS, Heaviest, Sources, heaviest, separation, sky_cells
from linksweep.core.tie.problem import NormalSums, Problem, group_sums, source_counts, source_discrepancies
from linksweep.core.tie.solution import Solution, solve
from linksweep.core.unknowns import Unknowns
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import Map
from linksweep.sweep.tables.reader import is_parquet, read_row_group, row_groups
from linksweep.sweep.tie.matching import Match
from linksweep.sweep.tie.options import SIGNS, Options
from linksweep.sweep.tie.setup import (
    ZERO_MOTION,
    Setup,
    default_epoch,
    known_spin,
    unknowns_for,
    with_jitter,
    zero_motion,
)
from linksweep.sweep.tie.tables import AstrometricTable, astrometric_table, columns_needed, digest_of

FROM_ROWS = 100_000
"""Smaller tables are solved as a whole."""

MOST_NOTES = 5
"""At most so many notes on rows are shown."""


def why_whole(satellite: str | Path, reference: str | Path, options: Options) -> str | None:
    """Return why tables are solved as a whole; None for those that are read by row groups: many quasars in Parquet,
    without a reference.
    """
    path = Path(satellite)
    if options.missions:
        return f"rows of missions are matched with the whole of {path}"
    if str(reference) != ZERO_MOTION:
        return f"rows of a reference are matched with the whole of {path}; only quasars ({ZERO_MOTION}) need no match"
    if not path.is_file() or not is_parquet(path):
        return f"{path} is no Parquet table (as Parquet it could be read by row groups)"
    n = sum(row_groups(path)[0])
    return None if n >= FROM_ROWS else f"{path} has {n:,} rows, and tables of fewer than {FROM_ROWS:,} are read at once"


@dataclass(frozen=True)
class RowGroup:
    """The rows of a table from ``first`` on, and the options; ``unknowns`` are empty until they are known."""

    path: Path
    digest: str
    number: int
    first: int
    columns: tuple[str, ...]
    options: Options
    epoch: float = np.nan
    unknowns: Unknowns = field(default_factory=lambda: Unknowns(()))

    def problem(self) -> Problem:
        """Return the problem of the rows; raises SweepError for wrong ones, with their numbers in the row group."""
        own = self.read().astrometry
        spin = self.options.known_spin
        known = None if spin is None else known_spin(spin, own, SIGNS[self.options.sign])
        source, weights = np.arange(len(own)), self.options.weights
        rows = with_jitter(zero_motion(len(own)), self.options.jitter_in(None))
        return Problem(own, rows, source, self.unknowns, self.epoch, weights, known)

    def read(self) -> AstrometricTable:
        """Read the rows."""
        if digest_once(self.path) != self.digest:
            raise SweepError("is not the same file on every worker, or was changed", str(self.path))
        table = read_row_group(self.path, self.number, self.columns)
        where = f"{self.path}, the {len(table)} rows from row {self.first + 1} on"
        rows = astrometric_table(table, where, self.digest, self.options.satellite_options)
        if not np.all(np.isfinite(rows.astrometry.values[:2])):
            raise SweepError("sources without a position", where)
        return rows


digest_once = lru_cache(maxsize=8)(digest_of)
"""Return the SHA-256 of a file, which a process reads only once."""


class Scanned(NamedTuple):
    """What a first look at a row group finds: one value in each bin, under the name of the column of bins; the epochs
    and how many sources have each; the positions of the sources (2, n), rad, if they are wanted; and notes.
    """

    sample: dict[str, Array]
    epochs: Array
    counts: Indices
    places: Array | None
    notes: Sequence[str]


def look_through(group: RowGroup, per_source: bool) -> Scanned:
    """Return what a first look finds, with the positions of the sources if ``per_source``."""
    table = group.read()
    own = table.astrometry
    columns: dict[str, Array] = {}
    if group.options.bins is not None and group.options.bins[0] in own.columns:
        name, edges = group.options.bins
        bin_of = np.searchsorted(edges, own.columns[name], side="right")
        columns[name] = own.columns[name][np.unique(bin_of, return_index=True)[1]]
    epochs, counts = np.unique(own.epoch[np.isfinite(own.epoch)], return_counts=True)
    places = own.values[:2] if per_source else None
    return Scanned(columns, epochs, counts, places, table.notes)


def computed(group: RowGroup, function: Callable[..., Any], *arguments: Any) -> Any:
    """Apply a function to the problem of a row group."""
    return function(group.problem(), *arguments)


def _cell_sums(problem: Problem, factors: Array | Flags | None) -> NormalSums:
    """Return the sums of all cells of the sky, with the weight of each source times its factor."""
    ra, dec = problem.satellite.values[:2]
    return group_sums(problem, sky_cells(ra, dec, DIVISIONS), 2 * DIVISIONS**2, factors)


@dataclass(frozen=True)
class RowGroupTable:
    """The sources of a table that is read by row groups, with the interface of `SourceTable`."""

    groups: tuple[RowGroup, ...]
    n_sources: int
    run: Map
    _last: list[tuple[Array | Flags, NormalSums]] = field(default_factory=list, repr=False, compare=False)

    kept = None
    """The sums of single sources are not kept."""

    def cell_sums(self, factors: Array | Flags) -> NormalSums:
        """Return the sums of cells of the sky, with the weight of each source times its factor."""
        if not self._last or not np.array_equal(self._last[0][0], factors):
            limits = pairwise([*(group.first for group in self.groups), self.n_sources])
            divided = (factors[low:high] for low, high in limits)
            parts: list[Any] = [None if np.all(part == 1.0) else part for part in divided]
            pieces = ((group, _cell_sums, part) for group, part in zip(self.groups, parts, strict=True))
            sums = reduce(NormalSums.plus, self.run(computed, pieces))
            self._last[:] = [(factors.copy(), sums.taken(sums.count > 0))]
        return self._last[0][1]

    def solve(self, factors: Array | Flags) -> Solution:
        """Return the solution with the weight of each source times its factor."""
        return solve(self.cell_sums(factors), self.groups[0].unknowns.labels)

    def as_sources(self) -> Sources:
        """Return what the clips need."""
        counts = self._filled(source_counts, kind=np.float32)  # whole numbers, exact as float32
        return Sources(self.solve, partial(self._filled, source_discrepancies), counts)

    def separations(self) -> tuple[Array, Array]:
        """Return the normalised separation and the separation of each source."""
        normalised, plain = self._filled(separation, rows=2)
        return normalised, plain

    def heaviest(self, number: int) -> Heaviest:
        """Return the sources with the largest weights, and their sums."""

        def heavier(one: Heaviest, other: Heaviest) -> Heaviest:
            sizes = np.concatenate([one.sizes, other.sizes])
            order = np.argsort(-sizes, kind="stable")[:number]  # of equal ones the first
            places = np.concatenate([one.places, other.places])
            return Heaviest(sizes[order], places[order], one.sums.followed_by(other.sums).taken(order))

        each = zip(self.groups, self._each(heaviest, number), strict=True)
        most: Heaviest = reduce(heavier, (one._replace(places=group.first + one.places) for group, one in each))
        return most

    def _filled(self, function: Any, *arguments: Any, rows: int | None = None, kind: Any = np.float64) -> Any:
        """Return the values of a function of a problem for each source, collected in one array."""
        filled = np.empty(self.n_sources if rows is None else (rows, self.n_sources), dtype=kind)
        for group, part in zip(self.groups, map(np.asarray, self._each(function, *arguments)), strict=True):
            filled[..., group.first : group.first + part.shape[-1]] = part
        return filled

    def _each(self, function: Any, *arguments: Any) -> Iterator[Any]:
        """Yield a function of the problem of each row group."""
        return self.run(computed, ((group, function, *arguments) for group in self.groups))


def set_up_row_groups(
    satellite: str | Path, options: Options, run: Map, per_source: bool = True
) -> tuple[Setup, RowGroupTable]:
    """Look through a table once; raises SweepError for whatever is wrong with it or the options.

    Without ``per_source`` the result has no positions of the sources, which saves memory.
    """
    options.check()
    path = Path(satellite).resolve()
    sizes, names = row_groups(path)
    if not isinstance(options.known_spin, (str, Path)):
        further = () if options.bins is None else (options.bins[0],)
        names = columns_needed(names, options.satellite_options, further)
    digest = digest_once(path)
    firsts = np.concatenate([[0], np.cumsum(sizes)])
    plain = replace(options, missions={}, mission_options={})
    groups = tuple(
        RowGroup(path, digest, number, int(first), tuple(names), plain)
        for number, (first, size) in enumerate(zip(firsts, sizes, strict=False))
        if size
    )
    n = sum(sizes)
    values = np.zeros((5, n)) if per_source else np.broadcast_to(np.nan, (5, n))  # takes no memory
    looks: list[Scanned] = []
    noted: dict[str, int] = {}
    for group, one in zip(groups, run(look_through, ((group, per_source) for group in groups)), strict=True):
        if one.places is not None:
            values[:2, group.first : group.first + one.places.shape[1]] = one.places
        looks.append(one._replace(places=None))
        for note in one.notes:
            noted.setdefault(note, group.first)
    epoch = _median_epoch(looks) if options.epoch is None else options.epoch
    notes = [f"{path.name}, from row {first + 1} on: {note}" for note, first in noted.items()]
    if (more := len(notes) - MOST_NOTES) > 0:
        notes[MOST_NOTES:] = [f"{path.name}: {more} more such notes"]
    try:
        unknowns = _unknowns(replace(groups[0], epoch=epoch), looks, notes)
    except ValueError as error:  # LinkError is one
        raise SweepError(str(error)) from error
    groups = tuple(replace(group, epoch=epoch, unknowns=unknowns) for group in groups)
    numbers = np.arange(n + 1)  # one array for the sources and, from 1, for their names
    source, called = numbers[:-1], numbers[1:]
    own = Astrometry(values, np.broadcast_to(np.nan, (5, n)), np.broadcast_to(epoch, n))
    problem = Problem(own, zero_motion(n), source, unknowns, epoch, options.weights)
    left = AstrometricTable(str(satellite), digest, own, {})
    matched = Match(source, source, "the satellite's sources", source[:0])
    notes.append(f"read in {len(groups)} row groups; sources are named by their row numbers")
    right = AstrometricTable(ZERO_MOTION, "", problem.rows, {})
    return Setup(left, right, matched, problem, source, called, tuple(notes)), RowGroupTable(groups, n, run)


def _median_epoch(looks: Sequence[Scanned]) -> float:
    """Return `default_epoch` of all epochs, from the different ones and how often each occurs."""
    epochs, place = np.unique(np.concatenate([one.epochs for one in looks]), return_inverse=True)
    last = np.cumsum(np.bincount(place, np.concatenate([one.counts for one in looks]), len(epochs)))
    if not len(epochs):
        return default_epoch(epochs)
    middle = [(last[-1] - 1) // 2, last[-1] // 2]  # the middle one twice, or the two around the middle
    return default_epoch(epochs[np.searchsorted(last, middle, side="right")])


def _unknowns(group: RowGroup, looks: Sequence[Scanned], notes: list[str]) -> Unknowns:
    """Return the unknowns of the whole table: the first rows say which are determined, all rows which bins are used."""
    own = group.read().astrometry
    few = own.taken(slice(0, min(len(own), 1000)))
    if group.options.bins is not None:
        name = group.options.bins[0]
        columns = {name: np.concatenate([one.sample[name] for one in looks])} if name in own.columns else {}
        few = replace(few, columns=columns)
    rows = zero_motion(len(few))
    try:
        return unknowns_for(group.options, few, rows, np.arange(len(few)), group.epoch, notes)
    except LinkError as error:
        raise LinkError(f"of the first rows: {error}") from error
