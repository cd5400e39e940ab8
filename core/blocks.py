"""Blocks of unknowns: each is a value that knows its labels, units and derivatives.

The derivatives are those of the five parameters (alpha*, dec, parallax, pmra, pmdec) of a source, reference -
satellite.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from linksweep.core.arrays import Array, Indices
from linksweep.core.frames import Triad, triad
from linksweep.core.harmonics import Kind, fill_toroidal, turned
from linksweep.core.link import require_off_poles

RA, DEC, PARALLAX, PMRA, PMDEC = range(5)
PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")
POSITION, MOTION = (RA, DEC), (PMRA, PMDEC)


@dataclass(frozen=True)
class Objects:
    """The data of N sources for derivatives: positions (rad), proper motions (rad/yr) and further columns, (N,)."""

    ra: Array
    dec: Array
    pmra: Array
    pmdec: Array
    columns: Mapping[str, Array] = field(default_factory=dict)

    def taken(self, part: slice | Indices) -> "Objects":
        """Return some of the sources."""
        columns = {name: column[part] for name, column in self.columns.items()}
        return Objects(self.ra[part], self.dec[part], self.pmra[part], self.pmdec[part], columns)

    @cached_property
    def triad(self) -> Triad:
        """The unit vectors east, north and to each source."""
        return triad(self.ra, self.dec)


@dataclass(frozen=True, kw_only=True)
class Block:
    """A few unknowns that belong together.

    ``name`` is the name of the block, ``labels`` are those of its unknowns, and ``rows`` the parameters that they act
    on.  A ``rate`` is per year: it moves the position of a source whose epoch is not that of the unknowns.
    """

    name: str
    labels: tuple[str, ...]
    rows: tuple[int, ...]
    rate: bool

    def derivatives(self, objects: Objects) -> Array:
        """Return the derivatives of the parameters ``rows``; shape (k, len(rows), N)."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Orientation(Block):
    """The rotation epsilon: d alpha* = q.eps, d dec = -p.eps and, if ``corrections``, the terms A21 in the motions."""

    corrections: bool = field(default=True, kw_only=False)
    name: str = "orientation"
    labels: tuple[str, ...] = ("epsilon_x", "epsilon_y", "epsilon_z")
    rows: tuple[int, ...] = field(init=False)
    rate: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "rows", (RA, DEC, PMRA, PMDEC) if self.corrections else POSITION)

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


@dataclass(frozen=True, kw_only=True)
class Rotation(Block):
    """A rotation of positions or motions: q and -p.  The spin is that of motions."""

    name: str = "spin"
    labels: tuple[str, ...] = ("omega_x", "omega_y", "omega_z")
    rows: tuple[int, ...] = MOTION
    rate: bool = True

    def derivatives(self, objects: Objects) -> Array:
        """Return q and -p; shape (3, 2, N)."""
        return np.stack([objects.triad.q, -objects.triad.p], axis=1)


@dataclass(frozen=True, kw_only=True)
class Glide(Block):
    """A flow towards a point of the sky: p and q, in the motions or the positions."""

    name: str = "glide"
    labels: tuple[str, ...] = ("glide_x", "glide_y", "glide_z")
    rows: tuple[int, ...] = MOTION
    rate: bool = True

    def derivatives(self, objects: Objects) -> Array:
        """Return p and q; shape (3, 2, N)."""
        return np.stack([objects.triad.p, objects.triad.q], axis=1)


@dataclass(frozen=True, kw_only=True)
class ParallaxZeroPoint(Block):
    """One constant in all parallaxes, reference - satellite."""

    name: str = "parallax"
    labels: tuple[str, ...] = ("parallax_zero_point",)
    rows: tuple[int, ...] = (PARALLAX,)
    rate: bool = False

    def derivatives(self, objects: Objects) -> Array:
        """Return ones; shape (1, 1, N)."""
        return np.ones((1, 1, len(objects.ra)))


@dataclass(frozen=True, kw_only=True)
class Harmonics(Block):
    """Vector spherical harmonics of given kinds and degrees, in the positions or the motions."""

    parts: tuple[tuple[Kind, int], ...]

    def derivatives(self, objects: Objects) -> Array:
        """Return the fields of all terms; shape (k, 2, N)."""
        found = np.empty((sum(2 * degree + 1 for _, degree in self.parts), 2, len(objects.ra)))
        place, start = {}, 0
        for kind, degree in self.parts:
            place[kind, degree] = found[start : start + 2 * degree + 1]
            start += 2 * degree + 1
        fields: dict[int, Array] = {}  # without the toroidal field, the spheroidal one is turned in place
        for kind, degree in self.parts:
            fields[degree] = place.get(("t", degree), place[kind, degree])
        fill_toroidal(fields, objects.ra, objects.dec)
        for kind, degree in self.parts:
            if kind == "s":
                turned(fields[degree], out=place[kind, degree])
        return found


@dataclass(frozen=True, kw_only=True)
class SpinByBin(Block):
    """A spin for each bin of a column, with the lowest and the highest bin open; labels like omega_x[6,8)."""

    column: str
    edges: tuple[float, ...]
    used: tuple[int, ...]
    name: str = "spin"
    labels: tuple[str, ...] = field(init=False)
    rows: tuple[int, ...] = MOTION
    rate: bool = True

    def __post_init__(self) -> None:
        labels = (f"{label}[{low:g},{high:g})" for low, high in self.bins for label in Rotation().labels)
        object.__setattr__(self, "labels", tuple(labels))

    @property
    def bins(self) -> tuple[tuple[float, float], ...]:
        """The limits of the bins that have sources."""
        limits = (-np.inf, *self.edges, np.inf)
        return tuple((limits[b], limits[b + 1]) for b in self.used)

    def derivatives(self, objects: Objects) -> Array:
        """Return q and -p in the bin of each source, zero in the others; shape (3 bins, 2, N)."""
        spin = Rotation().derivatives(objects)
        bin_of = np.searchsorted(self.edges, objects.columns[self.column], side="right")
        return np.concatenate([np.where(bin_of == b, spin, 0.0) for b in self.used])


@dataclass(frozen=True, kw_only=True)
class OfMission(Block):
    """A block of the frame of a further mission, whose five parameters follow those of the frames before it."""

    block: Block

    def derivatives(self, objects: Objects) -> Array:
        """Return the derivatives of the block; shape (k, len(rows), N)."""
        return self.block.derivatives(objects)


def of_mission(block: Block, mission: str, number: int) -> OfMission:
    """Return the block of a mission, like hipparcos:spin; missions are counted from 1."""
    return OfMission(
        name=f"{mission}:{block.name}",
        labels=tuple(f"{mission}:{label}" for label in block.labels),
        rows=tuple(len(PARAMETERS) * number + row for row in block.rows),
        rate=block.rate,
        block=block,
    )
