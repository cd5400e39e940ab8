"""The random streams of blocks: generators that are children of the study's seed.

A stream comes from NumPy's SeedSequence of the seed and the words that name the stream: the point's stream, the
catalogue and the part of its realisations.  So it does not depend on the grid, the order or the machine.  SFC64 is the
fastest sound bit generator of NumPy.
"""

import struct

import numpy as np

from linksweep.sweep.contract import GeneratorPair
from linksweep.sweep.contract.block import Block


def generators(seed: int, name: bytes, catalogue: int, part: int) -> GeneratorPair:
    """Return the generators of the realisations ``part`` of a catalogue and of the catalogue itself."""
    start = struct.pack("<2Q", seed, 0) + name

    def stream(*place: int) -> np.random.Generator:
        # The words that SeedSequence(seed, spawn_key=...) makes of these: its own way to them takes twice as long.
        words = np.frombuffer(start + struct.pack(f"<{len(place)}I", *place), dtype="<u4")
        return np.random.Generator(np.random.SFC64(np.random.SeedSequence(words)))

    return stream(catalogue, 1, part), stream(catalogue, 0)


def generators_of(seed: int, name: bytes, block: Block) -> list[GeneratorPair]:
    """Return what `generators` returns for each catalogue of a block."""
    catalogues = range(block.first_catalogue, block.first_catalogue + block.n_cat)
    return [generators(seed, name, catalogue, block.part) for catalogue in catalogues]
