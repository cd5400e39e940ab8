"""A satellite's Parquet table of millions of quasars, one row group at a time: on Dask workers, in little memory.

Each pass over the table reads it again; what is kept between passes is that of `core.tie.solution.StreamedSources`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from linksweep.core.frames import Array, Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Astrometry
from linksweep.core.tie.problem import Problem
from linksweep.core.tie.solution import StreamedSources
from linksweep.core.unknowns import Unknowns
from linksweep.sweep.contract import SweepError
from linksweep.sweep.executing.executor import Map
from linksweep.sweep.tables.reader import is_parquet, read_row_group, row_groups
from linksweep.sweep.tie import setup
from linksweep.sweep.tie.options import Options
from linksweep.sweep.tie.tables import AstrometricTable, astrometric_table, columns_needed, digest_of

# Smaller tables are solved as a whole.
FROM_ROWS = 100_000

# At most so many notes on rows are shown.
MOST_NOTES = 5


def are_enough(satellite: str | Path, reference: str | Path, options: Options) -> bool:
    """Return whether a table is read by row groups: many quasars in Parquet, of which no row needs a match."""
    path = Path(satellite)
    alone = str(reference) == setup.ZERO_MOTION and not (options.missions or options.where or options.epochs)
    return alone and path.is_file() and is_parquet(path) and sum(row_groups(path)[0]) >= FROM_ROWS


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
    unknowns: Unknowns = Unknowns(())  # noqa: RUF009 (it is frozen)

    def problem(self) -> Problem:
        """Return the problem of the rows; raises SweepError for wrong ones, with their numbers in the row group."""
        stars = self.read().astrometry
        known, source = setup.known_unknowns(self.options, stars), np.arange(len(stars))
        jitter = setup.jitter_of(setup.parse_jitter(self.options.jitter), None, ())
        rows = setup.with_jitter(setup.zero_motion(len(stars)), jitter)
        return Problem(stars, rows, source, self.unknowns, self.epoch, self.options.weights, known)

    def read(self) -> AstrometricTable:
        """Read the rows."""
        if digest_once(self.path) != self.digest:
            raise SweepError("is not the same file on every worker, or was changed", str(self.path))
        table = read_row_group(self.path, self.number, self.columns)
        where = f"{self.path}, the {len(table)} rows from row {self.first + 1} on"
        rows = astrometric_table(table, where, self.digest, setup.table_options(self.options)["satellite"])
        if not np.all(np.isfinite(rows.astrometry.values[:2])):
            raise SweepError("sources without a position", where)
        return rows


# Return the SHA-256 of a file, which a process reads only once.
digest_once = lru_cache(maxsize=8)(digest_of)


def look_through(group: RowGroup, per_source: bool) -> tuple[Array, tuple[Array, Indices], Array | None, Sequence[str]]:
    """Return what a first look at a row group finds: one value in each bin of the column of bins; the epochs and how
    many sources have each; the positions of the sources (2, n), rad, if ``per_source``; and notes.
    """
    table = group.read()
    stars, sample = table.astrometry, np.zeros(0)
    name, edges = setup.parse_bins(group.options.bins) if group.options.bins else ("", [])
    if name in stars.columns:
        bin_of = np.searchsorted(edges, stars.columns[name], side="right")
        sample = stars.columns[name][np.unique(bin_of, return_index=True)[1]]
    epochs = np.unique(stars.epoch[np.isfinite(stars.epoch)], return_counts=True)
    return sample, epochs, stars.values[:2] if per_source else None, table.notes


def set_up_row_groups(
    satellite: str | Path, options: Options, run: Map, per_source: bool = True
) -> tuple[setup.Setup, StreamedSources]:
    """Look through a table once; raises SweepError for whatever is wrong with it or the options.

    Without ``per_source`` the result has no positions of the sources, which saves memory.
    """
    path = Path(satellite).resolve()
    sizes, names = row_groups(path)
    if not isinstance(options.known_spin, str):
        further = (setup.parse_bins(options.bins)[0],) if options.bins else ()
        names = columns_needed(names, setup.table_options(options)["satellite"], further)
    digest, n = digest_once(path), sum(sizes)
    firsts = np.cumsum([0, *sizes]).tolist()
    groups = [
        RowGroup(path, digest, number, firsts[number], tuple(names), options)
        for number, size in enumerate(sizes)
        if size
    ]
    values = np.zeros((5, n)) if per_source else np.broadcast_to(np.nan, (5, n))  # takes no memory
    noted: dict[str, int] = {}
    samples, epochs = [], []
    for group, look in zip(groups, run(look_through, ((group, per_source) for group in groups)), strict=True):
        sample, different, places, notes = look
        samples.append(sample)
        epochs.append(different)
        if places is not None:
            values[:2, group.first : group.first + places.shape[1]] = places
        for note in notes:
            noted.setdefault(note, group.first)
    epoch = options.epoch
    if epoch is None:
        epoch = setup.default_epoch(np.concatenate([np.repeat(*one) for one in epochs]))
    said = [f"{path.name}, from row {first + 1} on: {note}" for note, first in noted.items()]
    if (more := len(said) - MOST_NOTES) > 0:
        said[MOST_NOTES:] = [f"{path.name}: {more} more such notes"]
    try:
        unknowns = _unknowns(replace(groups[0], epoch=epoch), np.concatenate(samples), said)
    except ValueError as error:  # LinkError is one
        raise SweepError(str(error)) from error
    problems = [replace(group, epoch=epoch, unknowns=unknowns).problem for group in groups]
    numbers = np.arange(n + 1)  # one array for the sources and, from 1, for their names
    stars = Astrometry(values, np.broadcast_to(np.nan, (5, n)), np.broadcast_to(epoch, n))
    problem = Problem(stars, setup.zero_motion(n), numbers[:-1], unknowns, epoch, options.weights)
    left = AstrometricTable(str(satellite), digest, stars, {})
    right = AstrometricTable(setup.ZERO_MOTION, "", problem.rows, {})
    matched = setup.Match(numbers[:-1], numbers[:-1], setup.EVERY_SOURCE)
    said.append(f"read in {len(groups)} row groups; sources are named by their row numbers")
    whole = setup.Setup(left, right, matched, problem, numbers[1:], tuple(said))
    return whole, StreamedSources(unknowns.labels, problems, [group.first for group in groups], n, run)


def _unknowns(group: RowGroup, sample: Array, notes: list[str]) -> Unknowns:
    """Return the unknowns of the whole table: the first rows say which are determined, all rows which bins are used."""
    stars = group.read().astrometry
    few = stars.taken(slice(0, min(len(stars), 1000)))
    rows = setup.zero_motion(len(few))
    if group.options.bins:
        few = replace(few, columns={setup.parse_bins(group.options.bins)[0]: sample} if len(sample) else {})
    problem = Problem(few, rows, np.arange(len(few)), group.unknowns, group.epoch)
    try:
        return setup.unknowns_for(group.options, problem, notes)
    except LinkError as error:
        raise LinkError(f"of the first rows: {error}") from error
