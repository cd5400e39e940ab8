"""One row group of a satellite's Parquet table, and what is computed of it, in this process or on a Dask worker."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.tie import sources
from linksweep.core.tie.normal_sums import group_sums
from linksweep.core.tie.problem import Problem
from linksweep.core.tie.sources import DIVISIONS, Heaviest, sky_cells
from linksweep.core.tie.sums import NormalSums
from linksweep.core.unknowns import Unknowns
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.parquet import read_row_group
from linksweep.sweep.tie.options import SIGNS, Options
from linksweep.sweep.tie.reference_rows import known_spin, with_jitter
from linksweep.sweep.tie.setup import zero_motion
from linksweep.sweep.tie.tables import AstrometricTable, astrometric_table, digest_of


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
        rows = with_jitter(zero_motion(len(own)), self.options.jitter_of(None))
        return Problem(own, rows, source, self.unknowns, self.epoch, weights, known)

    def read(self) -> AstrometricTable:
        """Read the rows."""
        if digest_once(self.path) != self.digest:
            raise SweepError("is not the same file on every worker, or was changed", str(self.path))
        table = read_row_group(self.path, self.number, self.columns)
        where = f"{self.path}, the {len(table)} rows from row {self.first + 1} on"
        found = astrometric_table(table, where, self.digest, self.options.satellite_options)
        if not np.all(np.isfinite(found.astrometry.values[:2])):
            raise SweepError("sources without a position", where)
        return found


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


def cell_sums(group: RowGroup, factors: Array | Flags | None) -> NormalSums:
    """Return the sums of all cells of the sky, with the weight of each source times its factor."""
    problem = group.problem()
    ra, dec = problem.satellite.values[:2]
    cells = sky_cells(ra, dec, DIVISIONS)
    return group_sums(problem, cells, 2 * DIVISIONS**2, factors)


def heaviest(group: RowGroup, number: int) -> Heaviest:
    """Return the ``number`` sources with the largest weights."""
    found = sources.heaviest(group.problem(), number)
    return found._replace(places=group.first + found.places)


def heavier(number: int, one: Heaviest, other: Heaviest) -> Heaviest:
    """Return the ``number`` heaviest sources of both; of equal ones the first."""
    sizes = np.concatenate([one.sizes, other.sizes])
    order = np.argsort(-sizes, kind="stable")[:number]
    places, sums = np.concatenate([one.places, other.places]), one.sums.followed_by(other.sums)
    return Heaviest(sizes[order], places[order], sums.taken(order))
