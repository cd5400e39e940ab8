"""Named blocks of unknowns: each is a value that knows its labels, units and derivatives.

The derivatives are those of the five parameters (alpha*, dec, parallax, pmra, pmdec) of a source, reference -
satellite.  A list of blocks is written as one line: ``orientation,spin,glide,vsh_motion:3``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from core.arrays import Array
from core.frames import Triad, triad
from core.harmonics import Kind, Term, fill_toroidal, terms, turned
from core.link import require_off_poles

RA, DEC, PARALLAX, PMRA, PMDEC = range(5)
PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")
POSITION, MOTION = (RA, DEC), (PMRA, PMDEC)
HIGHEST_DEGREE = 50


@dataclass(frozen=True)
class Objects:
    """What derivatives depend on, of N sources: positions (rad), proper motions (rad/yr) and further columns, (N,)."""

    ra: Array
    dec: Array
    pmra: Array
    pmdec: Array
    columns: Mapping[str, Array] = field(default_factory=dict)

    def taken(self, part: slice) -> "Objects":
        """Return some of the sources."""
        columns = {name: column[part] for name, column in self.columns.items()}
        return Objects(self.ra[part], self.dec[part], self.pmra[part], self.pmdec[part], columns)

    @cached_property
    def triad(self) -> Triad:
        """The unit vectors east, north and to each source."""
        return triad(self.ra, self.dec)


class Block(Protocol):
    """A few unknowns that belong together.

    ``rows`` are the parameters that they act on.  A ``rate`` is per year: it moves the position of a source whose
    epoch is not that of the unknowns.
    """

    @property
    def name(self) -> str:
        """The name by which the block is asked for."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of its unknowns."""
        ...

    @property
    def rows(self) -> tuple[int, ...]:
        """The parameters that it acts on."""
        ...

    @property
    def rate(self) -> bool:
        """Whether it is per year."""
        ...

    def derivatives(self, objects: Objects) -> Array:
        """Return the derivatives of the parameters ``rows``; shape (k, len(rows), N)."""
        ...


@dataclass(frozen=True)
class Orientation:
    """The rotation epsilon: d alpha* = q.eps, d dec = -p.eps, and the terms A21 in the motions."""

    corrections: bool = True
    name: str = "orientation"
    labels: tuple[str, ...] = ("epsilon_x", "epsilon_y", "epsilon_z")
    rate: bool = False

    @property
    def rows(self) -> tuple[int, ...]:
        """Positions, and with the terms A21 motions too."""
        return (RA, DEC, PMRA, PMDEC) if self.corrections else POSITION

    def derivatives(self, objects: Objects) -> Array:
        """Return q, -p, -pmdec eta and pmra eta with eta = (cos ra, sin ra, 0)/cos dec; shape (3, 4 or 2, N)."""
        p, q, _ = objects.triad
        found = np.zeros((len(self.labels), len(self.rows), *np.shape(objects.ra)))
        found[:, 0], found[:, 1] = q, -p
        if self.corrections:
            require_off_poles(objects.dec, q[2])
            eta_x, eta_y = p[1] / q[2], -p[0] / q[2]
            found[0, 2], found[1, 2] = -objects.pmdec * eta_x, -objects.pmdec * eta_y
            found[0, 3], found[1, 3] = objects.pmra * eta_x, objects.pmra * eta_y
        return found


@dataclass(frozen=True)
class Rotation:
    """A rotation of positions or motions: q and -p.  The spin is that of motions."""

    name: str = "spin"
    labels: tuple[str, ...] = ("omega_x", "omega_y", "omega_z")
    rows: tuple[int, ...] = MOTION
    rate: bool = True

    def derivatives(self, objects: Objects) -> Array:
        """Return q and -p; shape (3, 2, N)."""
        return np.stack([objects.triad.q, -objects.triad.p], axis=1)


@dataclass(frozen=True)
class Glide:
    """A flow towards a point of the sky: p and q, in the motions or the positions."""

    name: str = "glide"
    labels: tuple[str, ...] = ("glide_x", "glide_y", "glide_z")
    rows: tuple[int, ...] = MOTION
    rate: bool = True

    def derivatives(self, objects: Objects) -> Array:
        """Return p and q; shape (3, 2, N)."""
        return np.stack([objects.triad.p, objects.triad.q], axis=1)


@dataclass(frozen=True)
class ParallaxZeroPoint:
    """One constant in all parallaxes, reference - satellite."""

    name: str = "parallax"
    labels: tuple[str, ...] = ("parallax_zero_point",)
    rows: tuple[int, ...] = (PARALLAX,)
    rate: bool = False

    def derivatives(self, objects: Objects) -> Array:
        """Return ones; shape (1, 1, N)."""
        return np.ones((1, 1, len(objects.ra)))


@dataclass(frozen=True)
class Harmonics:
    """Vector spherical harmonics of given kinds and degrees, in the positions or the motions."""

    name: str
    rows: tuple[int, ...]
    rate: bool
    parts: tuple[tuple[Kind, int], ...]

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        """The coefficients in their order."""
        return tuple(term for kind, degree in self.parts for term in terms(kind, degree))

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """For example vsh_motion_t_2_1_re."""
        return tuple(f"{self.name}_{term.label}" for term in self.terms)

    def derivatives(self, objects: Objects) -> Array:
        """Return the fields of all terms; shape (k, 2, N)."""
        found = np.empty((sum(2 * degree + 1 for _, degree in self.parts), 2, len(objects.ra)))
        place, start = {}, 0
        for kind, degree in self.parts:
            place[kind, degree] = found[start : start + 2 * degree + 1]
            start += 2 * degree + 1
        fields: dict[int, Array] = {}  # a spheroidal field without the toroidal one is turned in its own place
        for kind, degree in self.parts:
            fields[degree] = place.get(("t", degree), place[kind, degree])
        fill_toroidal(fields, objects.ra, objects.dec)
        for kind, degree in self.parts:
            if kind == "s":
                turned(fields[degree], out=place[kind, degree])
        return found


@dataclass(frozen=True)
class SpinByBin:
    """A spin for each bin of a column, with the lowest and the highest bin open."""

    column: str
    edges: tuple[float, ...]
    used: tuple[int, ...]
    name: str = "spin"
    rows: tuple[int, ...] = MOTION
    rate: bool = True

    @property
    def bins(self) -> tuple[tuple[float, float], ...]:
        """The limits of the bins that have sources."""
        limits = (-np.inf, *self.edges, np.inf)
        return tuple((limits[b], limits[b + 1]) for b in self.used)

    @property
    def labels(self) -> tuple[str, ...]:
        """For example omega_x[6,8)."""
        return tuple(f"{label}[{low:g},{high:g})" for low, high in self.bins for label in Rotation().labels)

    def derivatives(self, objects: Objects) -> Array:
        """Return q and -p in the bin of each source, zero in the others; shape (3 bins, 2, N)."""
        spin = Rotation().derivatives(objects)
        bin_of = np.searchsorted(self.edges, objects.columns[self.column], side="right")
        return np.concatenate([np.where(bin_of == b, spin, 0.0) for b in self.used])


@dataclass(frozen=True)
class Unknowns:
    """The blocks that are solved for together."""

    blocks: tuple[Block, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of all unknowns."""
        return tuple(label for block in self.blocks for label in block.labels)

    @property
    def units(self) -> tuple[str, ...]:
        """The units in which unknowns are shown; inside they are rad and rad/yr."""
        return tuple("mas/yr" if block.rate else "mas" for block in self.blocks for _ in block.labels)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the blocks."""
        return tuple(block.name for block in self.blocks)

    @property
    def columns(self) -> frozenset[str]:
        """The columns of the sources that the unknowns depend on."""
        return frozenset(block.column for block in self.blocks if isinstance(block, SpinByBin))

    def __len__(self) -> int:
        return self._length

    @cached_property
    def _length(self) -> int:
        return sum(len(block.labels) for block in self.blocks)

    def part(self, name: str) -> slice:
        """Return where the unknowns of a block stand; raises ValueError where there is no such block."""
        start = 0
        for block in self.blocks:
            if block.name == name:
                return slice(start, start + len(block.labels))
            start += len(block.labels)
        raise ValueError(f"no unknowns {name!r}; there are {', '.join(self.names)}")

    def derivatives(self, objects: Objects, years: Array | None = None) -> tuple[tuple[int, ...], Array]:
        """Return the parameters that the unknowns act on, and the derivatives of those; shape (K, rows, N).

        ``years`` (N,) is the epoch of each source minus that of the unknowns: a rate moves positions by as much.
        """
        shift = np.zeros(1) if years is None else years
        moved = bool(np.any(shift != 0.0))
        acting = {row for block in self.blocks for row in block.rows}
        if moved and any(block.rate for block in self.blocks):
            acting |= set(POSITION)
        rows = tuple(sorted(acting))
        if len(self.blocks) == 1 and rows == self.blocks[0].rows:
            return rows, self.blocks[0].derivatives(objects)
        found = np.zeros((len(self), len(rows), *np.shape(objects.ra)))
        start = 0
        for block in self.blocks:
            values = block.derivatives(objects)
            into = found[start : start + len(values)]
            for i, row in enumerate(block.rows):
                into[:, rows.index(row)] = values[:, i]
            if moved and block.rate:
                for position, motion in zip(POSITION, MOTION, strict=True):
                    into[:, rows.index(position)] = shift * values[:, block.rows.index(motion)]
            start += len(values)
        return rows, found

    def matrix(self, objects: Objects, years: Array | None = None) -> Array:
        """Return the derivatives of all five parameters by all unknowns; shape (N, 5, K)."""
        rows, values = self.derivatives(objects, years)
        matrix = np.zeros((len(objects.ra), 5, len(self)))
        matrix[:, rows] = np.moveaxis(values, -1, 0).swapaxes(1, 2)
        return matrix


@dataclass(frozen=True)
class Asked:
    """How a block is asked for: its name, the degrees behind it, the names beside it, bins, columns and corrections."""

    name: str
    degrees: str
    beside: Sequence[str]
    bins: tuple[str, Sequence[float]] | None
    columns: Mapping[str, Array]
    corrections: bool

    @property
    def written(self) -> str:
        """As the line has it."""
        return f"{self.name}:{self.degrees}" if self.degrees else self.name


KNOWN: dict[str, Callable[[Asked], Block]] = {
    "orientation": lambda asked: Orientation(asked.corrections),
    "position_glide": lambda asked: Glide(
        name="position_glide",
        labels=("position_glide_x", "position_glide_y", "position_glide_z"),
        rows=POSITION,
        rate=False,
    ),
    "spin": lambda asked: Rotation() if asked.bins is None else _spin_by_bin(*asked.bins, asked.columns),
    "glide": lambda asked: Glide(),
    "parallax": lambda asked: ParallaxZeroPoint(),
    "vsh_position:L": lambda asked: _harmonics(asked, "orientation", "position_glide", POSITION),
    "vsh_motion:L": lambda asked: _harmonics(asked, "spin", "glide", MOTION),
}
"""The blocks that a line may name, and what makes them; those with ``:L`` have degrees.  A further one is an entry."""


def parse_unknowns(
    text: str,
    bins: tuple[str, Sequence[float]] | None = None,
    columns: Mapping[str, Array] | None = None,
    corrections: bool = True,
) -> Unknowns:
    """Return the blocks of a line like ``orientation,spin,vsh_motion:3``.

    ``vsh_motion:3`` has all degrees from 1 to 3, ``vsh_motion:2-3`` those two; what the blocks spin, glide, orientation
    and position_glide already are (degree 1) is left out beside them.  With ``bins`` = (column, edges) the spin is one
    for each bin of a column of ``columns`` that has sources.  Raises ValueError that says what is wrong and what is
    known.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise ValueError(f"no unknowns; known are {', '.join(KNOWN)}")
    plain = [name.partition(":")[0] for name in names]
    if repeated := sorted({name for name in plain if plain.count(name) > 1}):
        raise ValueError(f"unknowns {', '.join(repeated)} twice")
    if bins is not None and "spin" not in plain:
        raise ValueError("bins divide the spin, which is not among the unknowns")
    return Unknowns(
        tuple(
            _block(Asked(kind, name.partition(":")[2], plain, bins, columns or {}, corrections))
            for kind, name in zip(plain, names, strict=True)
        )
    )


def _block(asked: Asked) -> Block:
    make = KNOWN.get(asked.name)
    if make is None and f"{asked.name}:L" in KNOWN:
        return KNOWN[f"{asked.name}:L"](asked)
    if asked.degrees:
        with_degrees = " and ".join(name.removesuffix(":L") for name in KNOWN if name.endswith(":L"))
        raise ValueError(f"unknowns {asked.written!r}: only {with_degrees} have a degree")
    if make is None:
        raise ValueError(f"unknowns {asked.written!r} are not known; known are {', '.join(KNOWN)}")
    return make(asked)


def _harmonics(asked: Asked, rotation: str, glide: str, rows: tuple[int, ...]) -> Harmonics:
    name = asked.written
    low, dash, high = asked.degrees.partition("-")
    try:
        first, last = (int(low), int(high)) if dash else (1, int(low))
    except ValueError:
        raise ValueError(
            f"unknowns {name!r}: give a degree or a range of them, like vsh_motion:3, vsh_motion:2-3"
        ) from None
    if not 1 <= first <= last <= HIGHEST_DEGREE:
        raise ValueError(f"unknowns {name!r}: degrees are from 1 to {HIGHEST_DEGREE}, the lower one first")
    covered = {("t", 1): rotation in asked.beside, ("s", 1): glide in asked.beside}
    kinds: tuple[Kind, Kind] = ("t", "s")
    parts = tuple((k, d) for d in range(first, last + 1) for k in kinds if not covered.get((k, d)))
    if not parts:
        raise ValueError(f"unknowns {name!r}: {rotation} and {glide} are these already")
    return Harmonics(asked.name, rows, rows == MOTION, parts)


def _spin_by_bin(column: str, edges: Sequence[float], columns: Mapping[str, Array]) -> SpinByBin:
    if not len(edges) or not np.all(np.isfinite(edges)) or np.any(np.diff(edges) <= 0.0):
        raise ValueError(f"bins of {column}: the edges must be finite and increase")
    if column not in columns:
        raise ValueError(
            f"bins: the satellite table has no numbers {column!r}; there are {', '.join(columns) or 'none'}"
        )
    values = columns[column]
    if np.any(missing := ~np.isfinite(values)):
        raise ValueError(f"bins: {column} is missing in {np.count_nonzero(missing)} of {len(values)} matched sources")
    used = np.unique(np.searchsorted(edges, values, side="right"))
    return SpinByBin(column, tuple(map(float, edges)), tuple(used.tolist()))
