"""A satellite's Parquet table of millions of quasars, one row group at a time: on Dask workers, in little memory.

Each pass over the table reads it again.  Memory holds sums over cells of the sky, added in the order of the row
groups, so that any workers give the same bits; and for each source whether it is kept, and one number while a clip
examines all sources.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Astrometry
from linksweep.core.tie.clips import Sources, separation
from linksweep.core.tie.normal_sums import source_counts, source_discrepancies
from linksweep.core.tie.problem import Problem
from linksweep.core.tie.solution import Solution, solve
from linksweep.core.tie.sources import Heaviest
from linksweep.core.tie.sums import NormalSums
from linksweep.core.unknowns import Unknowns
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import Map
from linksweep.sweep.tables.parquet import is_parquet, row_groups
from linksweep.sweep.tie import row_group
from linksweep.sweep.tie.column_names import columns_needed
from linksweep.sweep.tie.matching import Match
from linksweep.sweep.tie.options import Options
from linksweep.sweep.tie.row_group import RowGroup
from linksweep.sweep.tie.setup import ZERO_MOTION, Setup, default_epoch, zero_motion
from linksweep.sweep.tie.tables import AstrometricTable
from linksweep.sweep.tie.unknowns_of import unknowns_of

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
            sums = reduce(NormalSums.plus, self.run(row_group.cell_sums, zip(self.groups, parts, strict=True)))
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
        found: Heaviest = reduce(partial(row_group.heavier, number), self._each(row_group.heaviest, number))
        return found

    def _filled(self, function: Any, *arguments: Any, rows: int | None = None, kind: Any = np.float64) -> Any:
        """Return the values of a function of a problem for each source, collected in one array."""
        found = np.empty(self.n_sources if rows is None else (rows, self.n_sources), dtype=kind)
        pieces = self._each(row_group.computed, function, *arguments)
        for group, part in zip(self.groups, map(np.asarray, pieces), strict=True):
            found[..., group.first : group.first + part.shape[-1]] = part
        return found

    def _each(self, function: Any, *arguments: Any) -> Iterator[Any]:
        return self.run(function, ((group, *arguments) for group in self.groups))


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
    digest = row_group.digest_once(path)
    firsts = np.concatenate([[0], np.cumsum(sizes)])
    plain = replace(options, missions={}, mission_options={})
    groups = tuple(
        RowGroup(path, digest, number, int(first), tuple(names), plain)
        for number, (first, size) in enumerate(zip(firsts, sizes, strict=False))
        if size
    )
    n = sum(sizes)
    values = np.zeros((5, n)) if per_source else np.broadcast_to(np.nan, (5, n))  # takes no memory
    samples, of_epochs = [], []
    noted: dict[str, int] = {}
    for group, one in zip(groups, run(row_group.look_through, ((group, per_source) for group in groups)), strict=True):
        if one.places is not None:
            values[:2, group.first : group.first + one.places.shape[1]] = one.places
        samples.append(one.sample)
        of_epochs.append((one.epochs, one.counts))
        for note in one.notes:
            noted.setdefault(note, group.first)
    epoch = _median_epoch(of_epochs) if options.epoch is None else options.epoch
    notes = _listed(path.name, noted)
    try:
        unknowns = _unknowns(replace(groups[0], epoch=epoch), samples, notes)
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


def _listed(name: str, noted: Mapping[str, int]) -> list[str]:
    """Return the first notes of row groups, each with the first row of the first group that has it."""
    notes = [f"{name}, from row {first + 1} on: {note}" for note, first in noted.items()]
    more = len(notes) - MOST_NOTES
    return notes if more <= 0 else [*notes[:MOST_NOTES], f"{name}: {more} more such notes"]


def _median_epoch(found: Sequence[tuple[Array, Indices]]) -> float:
    """Return `default_epoch` of all epochs, from the different ones and how often each occurs."""
    epochs, place = np.unique(np.concatenate([epochs for epochs, _ in found]), return_inverse=True)
    last = np.cumsum(np.bincount(place, np.concatenate([counts for _, counts in found]), len(epochs)))
    if not len(epochs):
        return default_epoch(epochs)
    middle = [(last[-1] - 1) // 2, last[-1] // 2]  # the middle one twice, or the two around the middle
    return default_epoch(epochs[np.searchsorted(last, middle, side="right")])


def _unknowns(group: RowGroup, samples: list[dict[str, Array]], notes: list[str]) -> Unknowns:
    """Return the unknowns of the whole table: the first rows say which are determined, all rows which bins are used."""
    own = group.read().astrometry
    few = own.taken(slice(0, min(len(own), 1000)))
    if group.options.bins is not None:
        name = group.options.bins[0]
        columns = {name: np.concatenate([one[name] for one in samples])} if name in own.columns else {}
        few = replace(few, columns=columns)
    rows = zero_motion(len(few))
    try:
        return unknowns_of(group.options, few, rows, np.arange(len(few)), group.epoch, notes)
    except LinkError as error:
        raise LinkError(f"of the first rows: {error}") from error
