"""Catalogues of one size that are drawn together, each from a generator of its own."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import Catalogue


class Generators:
    """Several generators as one: the arrays that a method returns have a first axis of generators."""

    def __init__(self, generators: Sequence[np.random.Generator]) -> None:
        self._generators = generators

    def __getattr__(self, name: str) -> Callable[..., Array]:
        """Return a method that calls that of every generator."""
        methods = [getattr(generator, name) for generator in self._generators]

        def draw(*arguments: Any, **options: Any) -> Array:
            return np.stack([method(*arguments, **options) for method in methods])

        return draw


def stacked_catalogue(
    draw: Callable[[np.random.Generator], Catalogue], generators: Sequence[np.random.Generator]
) -> Catalogue:
    """Return the objects of a catalogue from each generator, one catalogue after the other."""
    drawn = draw(cast(np.random.Generator, Generators(generators)))
    return (drawn.repeated(len(generators)) if drawn.ra.ndim == 1 else drawn).flattened()
