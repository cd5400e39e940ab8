"""The tables of a link and what is asked of them, and the rows of some sources eliminated."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from linksweep.core.arrays import Array, Indices
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import Astrometry
from linksweep.core.tie.differences import differences
from linksweep.core.tie.elimination import Eliminated, Weights, eliminate, eliminate_simple
from linksweep.core.unknowns import Objects, Unknowns


@dataclass(frozen=True)
class Problem:
    """The tables of a link and what is asked of them.

    ``source`` (R,) is the satellite's source of each row of the reference.  ``epoch`` (Julian years) is that of the
    unknowns.  ``known`` holds unknowns with known values, whose effect is taken out before the solution.
    """

    satellite: Astrometry
    rows: Astrometry
    source: Indices
    unknowns: Unknowns
    epoch: float
    weights: Weights = "covariance"
    known: tuple[Unknowns, Array] | None = None

    def sources(self, part: Indices) -> tuple[Objects, Array, Eliminated]:
        """Return the objects, years and eliminated rows of some sources."""
        chosen = _as_slice(part)
        own = self._needed.taken(chosen)
        if self._one_each:
            rows, source = self.rows.taken(chosen), np.arange(len(part))
        else:
            rows_of, counts = self._rows_of(part)
            rows, source = self.rows.taken(rows_of), np.repeat(np.arange(len(part)), counts)
        objects, years = self.objects(own)
        taken_out = self.taken_out(own)
        if self.weights == "covariance" and len(rows) == len(part) and np.array_equal(source, np.arange(len(part))):
            simple = eliminate_simple(own, rows, taken_out)
            if simple is not None:
                return objects, years, simple
        found = differences(own, rows, source, taken_out, self.unknowns.frames)
        try:
            left = eliminate(found, source, own.covariance(), ~own.present.T, self.weights)
        except LinkError as error:
            raise LinkError(_named(str(error), self.satellite, part)) from None
        return objects, years, left

    def only(self, sources: Indices) -> "Problem":
        """Return the problem of some sources, in any order, and their rows."""
        place = np.full(len(self.satellite), -1)
        place[sources] = np.arange(len(sources))
        rows = np.flatnonzero(place[self.source] >= 0)
        return replace(
            self, satellite=self.satellite.taken(sources), rows=self.rows.taken(rows), source=place[self.source[rows]]
        )

    def objects(self, own: Astrometry) -> tuple[Objects, Array]:
        """Return the data for derivatives, and the epoch of each source minus that of the unknowns."""
        ra, dec = own.values[:2]
        pmra, pmdec = np.nan_to_num(own.values[3:])
        objects = Objects(ra, dec, pmra, pmdec, own.columns)
        return objects, np.where(np.isfinite(own.epoch), own.epoch - self.epoch, 0.0)

    def taken_out(self, own: Astrometry) -> Array | None:
        """Return what the known unknowns do to the parameters of sources; shape (5, S)."""
        if self.known is None:
            return None
        known, values = self.known
        return np.asarray(np.einsum("nik,k->in", known.matrix(*self.objects(own)), values))

    @cached_property
    def _needed(self) -> Astrometry:
        """The satellite without names and without columns that nothing depends on."""
        wanted = self.unknowns.columns | (self.known[0].columns if self.known is not None else frozenset())
        columns = {name: column for name, column in self.satellite.columns.items() if name in wanted}
        return replace(self.satellite, names=None, columns=columns)

    @cached_property
    def _one_each(self) -> bool:
        """True if row i is the only one of source i."""
        return len(self.source) == len(self.satellite) and np.array_equal(self.source, np.arange(len(self.source)))

    @cached_property
    def _order(self) -> tuple[Indices, Indices]:
        """Rows sorted by source, and where those of each source begin."""
        n_rows = np.bincount(self.source, minlength=len(self.satellite))
        return np.argsort(self.source, kind="stable"), np.concatenate([[0], np.cumsum(n_rows)])

    def _rows_of(self, part: Indices) -> tuple[Indices, Indices]:
        """Return the rows of some sources, source by source, and how many each has."""
        order, first = self._order
        counts = first[part + 1] - first[part]
        ends = np.cumsum(counts)
        inside = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)
        return order[np.repeat(first[part], counts) + inside], counts


def _as_slice(part: Indices) -> Indices | slice:
    """Return consecutive rising indices as a slice, which needs no copy."""
    if len(part) and part[-1] - part[0] == len(part) - 1 and np.all(np.diff(part) == 1):
        return slice(int(part[0]), int(part[-1]) + 1)
    return part


def _named(message: str, own: Astrometry, part: Indices) -> str:
    """Replace the number of a source within a block by its name, or its number in the table."""
    words = message.split()
    at = words.index("source") + 1
    number = int(words[at])
    words[at] = repr(str(own.names[part[number]])) if own.names is not None else str(part[number] + 1)
    return " ".join(words)
