"""Unknowns that are solved for together, and the line that names them: ``orientation,spin,glide,vsh_motion:3``."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.blocks import (
    MOTION,
    PARAMETERS,
    POSITION,
    Block,
    Glide,
    Harmonics,
    Objects,
    Orientation,
    ParallaxZeroPoint,
    Rotation,
    SpinByBin,
    of_mission,
)
from linksweep.core.harmonics import HIGHEST_DEGREE, KINDS, terms


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

        ``years`` (N,) is the epoch of each source minus that of the unknowns: a rate moves positions by its product
        with them.
        """
        shift = np.zeros(1) if years is None else years
        moved = bool(np.any(shift != 0.0))
        acting = {row for block in self.blocks for row in block.rows}
        if moved:
            acting |= {row for block in self.blocks if block.rate for row in _moved(block)}
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
                for row, position in zip(block.rows, _moved(block), strict=True):
                    into[:, rows.index(position)] = shift * values[:, block.rows.index(row)]
            start += len(values)
        return rows, found

    def matrix(self, objects: Objects, years: Array | None = None) -> Array:
        """Return the derivatives of the five parameters of all frames by all unknowns; shape (N, 5 frames, K)."""
        rows, values = self.derivatives(objects, years)
        matrix = np.zeros((len(objects.ra), len(PARAMETERS) * self.frames, len(self)))
        matrix[:, rows] = np.moveaxis(values, -1, 0).swapaxes(1, 2)
        return matrix


def _moved(block: Block) -> list[int]:
    """Return the coordinates of the position that the motions of a rate move, in the order of its rows."""
    return [row - MOTION[0] + POSITION[0] for row in block.rows]


@dataclass(frozen=True)
class Asked:
    """The request for a block: its name, the degrees after it, the names in the line, bins, columns and corrections."""

    name: str
    degrees: str
    beside: Sequence[str]
    bins: tuple[str, Sequence[float]] | None
    columns: Mapping[str, Array]
    corrections: bool

    @property
    def written(self) -> str:
        """The block as the line names it."""
        return f"{self.name}:{self.degrees}" if self.degrees else self.name


KNOWN: dict[str, Callable[[Asked], Block]] = {
    "orientation": lambda asked: Orientation(asked.corrections),
    "position_glide": lambda asked: Glide(
        name="position_glide", labels=tuple(f"position_glide_{axis}" for axis in "xyz"), rows=POSITION, rate=False
    ),
    "spin": lambda asked: Rotation() if asked.bins is None else _spin_by_bin(*asked.bins, asked.columns),
    "glide": lambda asked: Glide(),
    "parallax": lambda asked: ParallaxZeroPoint(),
    "vsh_position:L": lambda asked: _harmonics(asked, "orientation", "position_glide", POSITION),
    "vsh_motion:L": lambda asked: _harmonics(asked, "spin", "glide", MOTION),
}
"""The blocks that a line may name, and the functions that make them; those with ``:L`` have degrees.  To add
a block, add an entry.
"""


def parse_unknowns(
    text: str,
    bins: tuple[str, Sequence[float]] | None = None,
    columns: Mapping[str, Array] | None = None,
    corrections: bool = True,
    missions: Sequence[str] = (),
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
    divided = [name.partition(":") for name in names]
    of = {mission: [block for first, _, block in divided if first == mission] for mission in missions}
    own = [name for name in names if name.partition(":")[0] not in of]
    blocks = list(_blocks(own, bins, columns or {}, corrections))
    for number, (mission, some) in enumerate(of.items(), 1):
        blocks += [of_mission(block, mission, number) for block in _blocks(some, None, {}, corrections)]
    if bins is not None and not any(isinstance(block, SpinByBin) for block in blocks):
        raise ValueError("bins divide the spin, which is not among the unknowns")
    return Unknowns(tuple(blocks))


def require_mission_name(name: str) -> None:
    """Raise ValueError for a name of a mission that cannot stand before unknowns."""
    known = {one.partition(":")[0] for one in KNOWN}
    if not (name.isascii() and name.replace("-", "_").isidentifier()) or name in known:
        raise ValueError(
            f"mission {name!r}: a name is letters, digits, _ and -, no digit first, and none of the unknowns"
        )


def _blocks(
    names: Sequence[str], bins: tuple[str, Sequence[float]] | None, columns: Mapping[str, Array], corrections: bool
) -> Iterator[Block]:
    """Yield the blocks of one frame."""
    plain = [name.partition(":")[0] for name in names]
    if repeated := sorted({name for name in plain if plain.count(name) > 1}):
        raise ValueError(f"unknowns {', '.join(repeated)} twice")
    for name in names:
        kind, _, degrees = name.partition(":")
        yield _block(Asked(kind, degrees, plain, bins, columns, corrections))


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
    parts = tuple((k, d) for d in range(first, last + 1) for k in KINDS if not covered.get((k, d)))
    if not parts:
        raise ValueError(f"unknowns {name!r}: {rotation} and {glide} are these already")
    labels = tuple(f"{asked.name}_{term.label}" for kind, degree in parts for term in terms(kind, degree))
    return Harmonics(name=asked.name, labels=labels, rows=rows, rate=rows == MOTION, parts=parts)


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
    return SpinByBin(column=column, edges=tuple(map(float, edges)), used=tuple(used.tolist()))
