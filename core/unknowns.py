"""Unknowns that are solved for together, in blocks: each block knows its labels, units and derivatives.

The derivatives are those of the five parameters (alpha*, dec, parallax, pmra, pmdec) of a source, reference -
satellite.  A line like ``orientation,spin,glide,vsh_motion:3`` names blocks; a new one is a function for its
derivatives and its entry in `KNOWN`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from linksweep.core.fields import HIGHEST_DEGREE, KINDS, Kind, fill_toroidal, terms, turned
from linksweep.core.frames import Array, Indices, Triad, require_off_poles, triad

RA, DEC, PARALLAX, PMRA, PMDEC = range(5)
PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")
POSITION, MOTION = (RA, DEC), (PMRA, PMDEC)
QUADRUPOLE = ("20", "21_re", "21_im", "22_re", "22_im")


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


@dataclass(frozen=True)
class Block:
    """A few unknowns that belong together.

    ``name`` is the name of the block, ``labels`` are those of its unknowns, and ``rows`` the parameters that they act
    on.  A ``rate`` is per year: it moves the position of a source whose epoch is not that of the unknowns.
    ``derivatives`` are those of the parameters by the unknowns: a function of objects, whose result has the shape (k,
    len(rows), N).
    """

    name: str
    labels: tuple[str, ...]
    rows: tuple[int, ...]
    rate: bool
    derivatives: Callable[[Objects], Array]


def rotation(objects: Objects) -> Array:
    """Return the derivatives of positions or motions by a rotation, q and -p; shape (3, 2, N)."""
    return np.stack([objects.triad.q, -objects.triad.p], axis=1)


def flow(objects: Objects) -> Array:
    """Return those by a flow towards a point of the sky, p and q; shape (3, 2, N)."""
    return np.stack([objects.triad.p, objects.triad.q], axis=1)


def turn(objects: Objects) -> Array:
    """Return those of positions and motions by a rotation of positions, which turns the axes of motions too: q, -p, and
    the terms A21 -pmdec eta and pmra eta with eta = (cos ra, sin ra, 0)/cos dec; shape (3, 4, N).
    """
    p, q, _ = objects.triad
    require_off_poles(objects.dec, q[2])  # eta grows as 1/cos dec
    eta_x, eta_y = p[1] / q[2], -p[0] / q[2]
    values = np.zeros((3, 4, *np.shape(objects.ra)))
    values[:, 0], values[:, 1] = q, -p
    values[0, 2], values[1, 2] = -objects.pmdec * eta_x, -objects.pmdec * eta_y
    values[0, 3], values[1, 3] = objects.pmra * eta_x, objects.pmra * eta_y
    return values


def constant(objects: Objects) -> Array:
    """Return those of a parameter by a constant in it; shape (1, 1, N)."""
    return np.ones((1, 1, len(objects.ra)))


def _xyz(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in "xyz")


# The motions, reference - satellite, are those of a rotation, and those of a flow.
SPIN_BLOCK = Block("spin", _xyz("omega"), MOTION, True, rotation)
GLIDE_BLOCK = Block("glide", _xyz("glide"), MOTION, True, flow)


@dataclass(frozen=True)
class Harmonics(Block):
    """Vector spherical harmonics of given kinds and degrees, in the positions or the motions."""

    parts: tuple[tuple[Kind, int], ...]


def _fields(parts: tuple[tuple[Kind, int], ...], objects: Objects) -> Array:
    """Return the fields of all terms of some kinds and degrees; shape (k, 2, N)."""
    ends = np.cumsum([2 * degree + 1 for _, degree in parts]).tolist()
    values = np.empty((ends[-1], 2, len(objects.ra)))
    place = dict(zip(parts, np.split(values, ends[:-1]), strict=True))
    fields = {degree: place.get(("t", degree), np.empty_like(place[kind, degree])) for kind, degree in parts}
    fill_toroidal(fields, objects.ra, objects.dec)
    for kind, degree in parts:
        if kind == "s":
            turned(fields[degree], out=place[kind, degree])
    return values


def electric_quadrupole(objects: Objects) -> Array:
    """Return the electric fields of degree 2 with amplitude 1, in the order of `QUADRUPOLE`; shape (5, 2, N).

    Turned by 90 degrees they are the magnetic ones.  Source: Charlot et al. 2020 (A&A 644, A159), Eq. 5.
    """
    ra, dec = objects.ra, objects.dec
    sin, cos = np.sin, np.cos
    east = [0.0 * ra, sin(ra) * sin(dec), cos(ra) * sin(dec), -2 * sin(2 * ra) * cos(dec), -2 * cos(2 * ra) * cos(dec)]
    north = [sin(2 * dec), *(np.array([-cos(ra), sin(ra)]) * cos(2 * dec))]
    north += [*(np.array([-cos(2 * ra), sin(2 * ra)]) * sin(2 * dec))]
    return np.stack([np.array(east), np.array(north)], axis=1)


def amplitudes(block: Harmonics) -> tuple[list[str], Array]:
    """Return the names of the rotation R, the glide G and the quadrupoles E and M that the terms of degree 1 and 2
    are, and the matrix that makes these of all terms; (names, terms).
    """
    # Both sets of fields span the same ones: some places on the sky tell how.
    sky = Objects(2.4 * np.arange(40.0), np.arcsin(np.linspace(-0.95, 0.95, 40)), *np.zeros((2, 40)))
    electric = electric_quadrupole(sky)
    magnetic = np.stack([electric[:, 1], -electric[:, 0]], axis=1)
    known: dict[tuple[Kind, int], tuple[str, Sequence[str], Array]] = {}
    known |= {("t", 1): ("R", "xyz", rotation(sky)), ("s", 1): ("G", "xyz", flow(sky))}
    known |= {("t", 2): ("M", QUADRUPOLE, magnetic), ("s", 2): ("E", QUADRUPOLE, electric)}
    names, rows, start = list[str](), [np.zeros((0, len(block.labels)))], 0
    fields = block.derivatives(sky)
    for kind, degree in block.parts:
        end = start + 2 * degree + 1
        if (kind, degree) in known:
            letter, ends, basis = known[kind, degree]
            names += [f"{'motion' if block.rate else 'position'} {letter}_{one}" for one in ends]
            rows.append(np.zeros((len(basis), len(block.labels))))
            there = fields[start:end].reshape(end - start, -1).T
            rows[-1][:, start:end] = np.linalg.lstsq(basis.reshape(len(basis), -1).T, there, rcond=None)[0]
        start = end
    return names, np.concatenate(rows)


@dataclass(frozen=True)
class SpinByBin(Block):
    """A spin for each of some bins of a column, with the lowest and the highest bin open; labels like omega_x[6,8)."""

    column: str
    edges: tuple[float, ...]
    used: tuple[int, ...]
    # The limits of the bins that are used.
    bins: tuple[tuple[float, float], ...]


def spin_by_bin(column: str, edges: tuple[float, ...], used: tuple[int, ...]) -> SpinByBin:
    """Return the spins of some of the bins that edges make."""
    limits = list(pairwise((-np.inf, *edges, np.inf)))
    bins = tuple(limits[b] for b in used)
    labels = tuple(f"{label}[{low:g},{high:g})" for low, high in bins for label in SPIN_BLOCK.labels)
    return SpinByBin("spin", labels, MOTION, True, partial(_in_bins, column, edges, used), column, edges, used, bins)


def _in_bins(column: str, edges: tuple[float, ...], used: tuple[int, ...], objects: Objects) -> Array:
    """Return q and -p in the bin of each source, zero in the others; shape (3 bins, 2, N)."""
    bin_of = np.searchsorted(edges, objects.columns[column], side="right")
    return np.concatenate([np.where(bin_of == b, rotation(objects), 0.0) for b in used])


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
        """The units in which unknowns are shown; internally they are rad and rad/yr."""
        return tuple("mas/yr" if block.rate else "mas" for block in self.blocks for _ in block.labels)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the blocks."""
        return tuple(block.name for block in self.blocks)

    @property
    def frames(self) -> int:
        """How many frames they act on: the satellite's, and those of missions."""
        return 1 + max(row for block in self.blocks for row in block.rows) // len(PARAMETERS)

    @property
    def columns(self) -> frozenset[str]:
        """The columns of the sources that the unknowns depend on."""
        return frozenset(block.column for block in self.blocks if isinstance(block, SpinByBin))

    def __len__(self) -> int:
        return len(self.labels)

    def part(self, name: str) -> slice:
        """Return where the unknowns of a block stand; raises ValueError where there is no such block."""
        if name not in self.names:
            raise ValueError(f"no unknowns {name!r}; there are {', '.join(self.names)}")
        k = self.names.index(name)
        start = sum(len(block.labels) for block in self.blocks[:k])
        return slice(start, start + len(self.blocks[k].labels))

    def derivatives(self, objects: Objects, years: Array | None = None) -> tuple[tuple[int, ...], Array]:
        """Return the parameters that the unknowns act on, and the derivatives of those; shape (K, rows, N).

        ``years`` (N,) is the epoch of each source minus that of the unknowns: a rate moves positions by its product
        with them.
        """
        shift = np.zeros(1) if years is None else years
        moved = bool(np.any(shift != 0.0))
        acting = {row for block in self.blocks for row in block.rows}
        if moved:  # a rate of a motion moves the coordinate of its position, of the same frame
            acting |= {row - PMRA + RA for block in self.blocks if block.rate for row in block.rows}
        rows = tuple(sorted(acting))
        if len(self.blocks) == 1 and rows == self.blocks[0].rows:  # no copy of what may be the largest array of a tie
            return rows, self.blocks[0].derivatives(objects)
        whole = np.zeros((len(self), len(rows), *np.shape(objects.ra)))
        start = 0
        for block in self.blocks:
            values = block.derivatives(objects)
            into = whole[start : start + len(values)]
            for i, row in enumerate(block.rows):
                into[:, rows.index(row)] = values[:, i]
                if moved and block.rate:
                    into[:, rows.index(row - PMRA + RA)] = shift * values[:, i]
            start += len(values)
        return rows, whole

    def matrix(self, objects: Objects, years: Array | None = None) -> Array:
        """Return the derivatives of the five parameters of all frames by all unknowns; shape (N, 5 frames, K)."""
        rows, values = self.derivatives(objects, years)
        matrix = np.zeros((len(objects.ra), len(PARAMETERS) * self.frames, len(self)))
        matrix[:, rows] = np.moveaxis(values, -1, 0).swapaxes(1, 2)
        return matrix


def link_unknowns(with_glide: bool = False, corrections: bool = True) -> Unknowns:
    """Return the unknowns of the simulated link: orientation (rad), spin (rad/yr), and the glide (rad/yr) on request.

    The observables are ``d alpha* = q.eps``, ``d dec = -p.eps``, ``d pmra = -pmdec eta.eps + q.omega`` and ``d pmdec =
    pmra eta.eps - p.omega`` with ``eta = (cos ra, sin ra, 0)/cos dec``, in the positions and proper motions of the
    reference: the triad turns by eta.eps about the line of sight, which is what the paper's A21 says for mu_alpha*
    (Metz & Geffert 2004, Eqs. 11-13).  ``corrections=False`` drops these terms; the glide g adds ``d pmra = p.g`` and
    ``d pmdec = q.g``.
    """
    rows, derivatives = ((*POSITION, *MOTION), turn) if corrections else (POSITION, rotation)
    orientation = Block("orientation", _xyz("epsilon"), rows, False, derivatives)
    return Unknowns((orientation, SPIN_BLOCK, *([GLIDE_BLOCK] if with_glide else [])))


# The unknowns that are always solved for, in their order.
LABELS = link_unknowns().labels
GLIDE_LABELS = GLIDE_BLOCK.labels
ALWAYS = slice(0, len(LABELS))
# Where the blocks stand among the unknowns.
ORIENTATION, SPIN, GLIDE = (link_unknowns(with_glide=True).part(name) for name in link_unknowns(with_glide=True).names)


# A column and the edges of its bins.
Bins = tuple[str, Sequence[float]]


class Asked(NamedTuple):
    """A block of a line as it is written, its name, degrees and the names beside it; bins and columns."""

    written: str
    name: str
    degrees: str
    beside: Sequence[str]
    bins: Bins | None
    columns: Mapping[str, Array]


# The blocks that a line may name, and the functions that make them; those with ``:L`` have degrees.  To add
# a block, add an entry.
KNOWN: dict[str, Callable[[Asked], Block]] = {
    "orientation": lambda asked: link_unknowns().blocks[0],
    "position_glide": lambda asked: Block("position_glide", _xyz("position_glide"), POSITION, False, flow),
    "spin": lambda asked: SPIN_BLOCK if asked.bins is None else _spin_by_bin(*asked.bins, asked.columns),
    "glide": lambda asked: GLIDE_BLOCK,
    "parallax": lambda asked: Block("parallax", ("parallax_zero_point",), (PARALLAX,), False, constant),
    "vsh_position:L": lambda asked: _harmonics(asked, "orientation", "position_glide", POSITION),
    "vsh_motion:L": lambda asked: _harmonics(asked, "spin", "glide", MOTION),
}


def parse_unknowns(
    text: str, bins: Bins | None = None, columns: Mapping[str, Array] | None = None, missions: Sequence[str] = ()
) -> Unknowns:
    """Return the blocks of a line like ``orientation,spin,vsh_motion:3``.

    ``vsh_motion:3`` has all degrees from 1 to 3, ``vsh_motion:2-3`` those two; terms of degree 1 are left out if the
    line also names the block that equals them (spin, glide, orientation or position_glide).  With ``bins`` = (column,
    edges) there is one spin for each bin of that column of ``columns`` that has sources.  ``hipparcos:spin`` is the
    spin of the frame of one of ``missions``.  Raises ValueError that says what is wrong and what is known.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise ValueError(f"no unknowns; known are {', '.join(KNOWN)}")
    blocks = _blocks([name for name in names if name.partition(":")[0] not in missions], bins, columns or {})
    for number, mission in enumerate(missions, 1):
        inside = [name.partition(":")[2] for name in names if name.partition(":")[0] == mission]
        for block in _blocks(inside, None, {}):
            labels = tuple(f"{mission}:{label}" for label in block.labels)
            rows = tuple(len(PARAMETERS) * number + row for row in block.rows)
            blocks.append(Block(f"{mission}:{block.name}", labels, rows, block.rate, block.derivatives))
    if bins is not None and not any(isinstance(block, SpinByBin) for block in blocks):
        raise ValueError("bins divide the spin, which is not among the unknowns")
    return Unknowns(tuple(blocks))


def require_mission_name(name: str) -> None:
    """Raise ValueError for a name of a mission that cannot stand before unknowns."""
    known = {one.removesuffix(":L") for one in KNOWN} | {"satellite", "reference"}
    if not (name.isascii() and name.replace("-", "_").isidentifier()) or name in known:
        others = "no side, none of the unknowns"
        raise ValueError(f"mission {name!r}: a name is letters, digits (not first), _, -; {others}")


def _blocks(names: Sequence[str], bins: Bins | None, columns: Mapping[str, Array]) -> list[Block]:
    """Return the blocks of one frame."""
    plain, blocks = [name.partition(":")[0] for name in names], []
    if len(set(plain)) < len(plain):
        raise ValueError(f"unknowns {max(plain, key=plain.count)} twice")
    for written, name in zip(names, plain, strict=True):
        degrees = written.partition(":")[2]
        make = KNOWN.get(f"{name}:L") or (None if degrees else KNOWN.get(name))
        if make is None:
            raise ValueError(f"unknowns {written!r} are not known; known are {', '.join(KNOWN)}")
        blocks.append(make(Asked(written, name, degrees, plain, bins, columns)))
    return blocks


def _harmonics(asked: Asked, rotation: str, glide: str, rows: tuple[int, ...]) -> Harmonics:
    ends = re.fullmatch(r"(?:(\d+)-)?(\d+)", asked.degrees)
    first, last = (int(ends[1] or 1), int(ends[2])) if ends else (0, 0)
    if not 1 <= first <= last <= HIGHEST_DEGREE:
        said = f"unknowns {asked.written!r}: give a degree or a range of them, from 1 to {HIGHEST_DEGREE}, the lower"
        raise ValueError(f"{said} one first, like vsh_motion:3 or vsh_motion:2-3")
    # one line may name both, but the same unknown twice would make the link rank deficient
    covered = {("t", 1): rotation in asked.beside, ("s", 1): glide in asked.beside}
    parts = tuple((k, d) for d in range(first, last + 1) for k in KINDS if not covered.get((k, d)))
    if not parts:
        raise ValueError(f"unknowns {asked.written!r}: {rotation} and {glide} are these already")
    labels = tuple(f"{asked.name}_{term.label}" for kind, degree in parts for term in terms(kind, degree))
    return Harmonics(asked.name, labels, rows, rows == MOTION, partial(_fields, parts), parts)


def _spin_by_bin(column: str, edges: Sequence[float], columns: Mapping[str, Array]) -> SpinByBin:
    if not len(edges) or not np.all(np.isfinite(edges)) or np.any(np.diff(edges) <= 0.0):
        raise ValueError(f"bins of {column}: the edges must be finite and increase")
    if column not in columns:
        there = ", ".join(columns) or "none"
        raise ValueError(f"bins: the satellite table has no numbers {column!r}; there are {there}")
    values = columns[column]
    if np.any(missing := ~np.isfinite(values)):
        raise ValueError(f"bins: {column} is missing in {np.count_nonzero(missing)} of {len(values)} matched sources")
    used = np.unique(np.searchsorted(edges, values, side="right"))  # a bin without sources would have no weight
    return spin_by_bin(column, tuple(map(float, edges)), tuple(used.tolist()))
