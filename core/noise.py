"""Unit normals in the order that every link draws them.

Realisations come in chunks of `ROWS`, each with a stream of its own for the satellite and one for the reference.  A
stream runs through the objects: 4 observables of object 0 in all realisations of the chunk, then object 1.  So what
object i gets depends neither on how many objects follow nor on what the other side or another point needs.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from linksweep.core.catalogue import Catalogue
from linksweep.core.frames import Array, Stack

ROWS = 512
"""Realisations drawn at a time."""

TILE = 65536
"""Normals drawn at a time: 512 KiB stay in a core's own cache."""


def chunks(n_sim: int) -> Iterator[int]:
    """Yield the numbers of realisations of each chunk."""
    for start in range(0, n_sim, ROWS):
        yield min(ROWS, n_sim - start)


def tile_objects(rows: int) -> int:
    """Return how many objects a tile holds; it depends on ``rows`` alone, so other points do not change the tiles."""
    return max(1, TILE // (4 * rows))


@dataclass(frozen=True)
class Tile:
    """Unit normals (..., objects, 4, rows) of one side, for the objects from ``start`` on; for a stack of catalogues
    the first axis is that of the catalogues.
    """

    start: int
    normals: Array

    def head(self, n_obj: int) -> Array:
        """Return the part that belongs to a catalogue of ``n_obj`` objects."""
        return self.normals[..., : max(0, n_obj - self.start), :, :]


def tiles(rngs: Sequence[np.random.Generator], stack: Stack, rows: int, n_obj: int) -> Iterator[Tile]:
    """Yield the unit normals of ``n_obj`` objects of the catalogues of a stack, from a generator of each; a tile is
    valid until the next one.
    """
    objects = tile_objects(rows)
    # full size even for few objects: where an array begins in memory must not depend on the points that share it
    buffer = np.empty((*stack, min(objects, n_obj) if stack else objects, 4, rows))
    for start in range(0, n_obj, objects):
        part = buffer[..., : n_obj - start, :, :]
        for rng, normals in zip(rngs, part if stack else [part], strict=True):
            rng.standard_normal(out=normals)
        yield Tile(start, part)


class Generators:
    """Several generators as one: the arrays that a method returns have a first axis of generators."""

    def __init__(self, generators: Sequence[np.random.Generator]) -> None:
        self._generators = generators

    def __getattr__(self, name: str) -> Callable[..., Array]:
        methods = [getattr(generator, name) for generator in self._generators]
        return lambda *arguments, **options: np.stack([method(*arguments, **options) for method in methods])


def stacked_catalogue(
    draw: Callable[[np.random.Generator], Catalogue], generators: Sequence[np.random.Generator]
) -> Catalogue:
    """Return the objects of a catalogue from each generator, one catalogue after the other."""
    several: Any = Generators(generators)
    drawn = draw(cast(np.random.Generator, several))
    return (drawn.repeated(len(generators)) if drawn.ra.ndim == 1 else drawn).flattened()
