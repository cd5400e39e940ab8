"""The random streams of blocks: generators that are children of the study's seed, made for many catalogues at once.

A stream comes from NumPy's SeedSequence of the seed and the words that name the stream: the point's stream, the
catalogue and the part of its realisations.  So it does not depend on the grid, the order or the machine.  SFC64 is the
fastest sound bit generator of NumPy.

To make one SeedSequence with its first children takes as long as to draw thousands of random numbers.  So its hash,
which NumPy promises to keep (NEP 19), is computed here for all streams of a task together; a test compares it with
NumPy's own.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.random.bit_generator import ISpawnableSeedSequence
from numpy.typing import NDArray

from linksweep.sweep.contract import GeneratorPair
from linksweep.sweep.planning.block import Block

Words = NDArray[np.uint32]

Place = tuple[bytes, int, int]

POOL, STATE = 4, 3
"""Words of 32 bits in the pool of a SeedSequence, numbers of 64 bits that it gives an SFC64."""

CHILDREN = 2
"""Children of a generator of errors whose states are computed with its own: the link draws from as many."""

FEWEST_AT_ONCE, MOST_AT_ONCE = 8, 256
"""Catalogues whose generators are made together: for fewer NumPy itself is faster, more gain nothing."""

HASHES = 64
"""Steps of the hash that may be needed: four for each word of a name."""


def generators(seed: int, name: bytes, catalogue: int, part: int) -> GeneratorPair:
    """Return the generators of the realisations ``part`` of a catalogue and of the catalogue itself."""

    def stream(*place: int) -> np.random.Generator:
        # The words that SeedSequence(seed, spawn_key=...) makes of these: its own way to them takes twice as long.
        words = _start(seed, name) + struct.pack(f"<{len(place)}I", *place)
        return _generator(np.random.SeedSequence(np.frombuffer(words, dtype="<u4")))

    return stream(catalogue, 1, part), stream(catalogue, 0)


def generators_of(seed: int, name: bytes, block: Block) -> list[GeneratorPair]:
    """Return what `generators` returns for each catalogue of a block."""
    (pairs,) = block_generators(seed, [(name, block)])
    return pairs


def block_generators(seed: int, blocks: Iterable[tuple[bytes, Block]]) -> Iterator[list[GeneratorPair]]:
    """Yield what `generators` returns for each catalogue of each block; ``blocks`` are pairs (stream, block)."""
    group: list[list[Place]] = []
    for name, block in blocks:
        last = block.first_catalogue + block.n_cat
        group.append([(name, catalogue, block.part) for catalogue in range(block.first_catalogue, last)])
        if sum(map(len, group)) >= MOST_AT_ONCE:
            yield from _grouped(seed, group)
            group = []
    yield from _grouped(seed, group)


def _grouped(seed: int, group: Sequence[Sequence[Place]]) -> Iterator[list[GeneratorPair]]:
    places = [place for block in group for place in block]
    found = iter(_many(seed, places) if len(places) >= FEWEST_AT_ONCE else [generators(seed, *p) for p in places])
    for block in group:
        yield [next(found) for _ in block]


def _many(seed: int, places: Sequence[Place]) -> list[GeneratorPair]:
    """Return the generators of each place, from hashes of all together."""
    starts = [_start(seed, name) + struct.pack("<I", catalogue) for name, catalogue, _ in places]
    words = np.frombuffer(b"".join(starts), "<u4").reshape(len(starts), -1).T.astype(np.uint32)
    pool = _Pool.of(words[:POOL])
    for word in words[POOL:]:
        pool = pool.then(word)
    catalogues = pool.then(np.uint32(0))
    errors = pool.then(np.uint32(1)).then(np.array([part for *_, part in places], dtype=np.uint32))
    states = errors.states(), np.stack([errors.then(np.uint32(k)).states() for k in range(CHILDREN)], axis=1)
    none, found = states[1][0, :0], []
    for (_, _, part), start, own, children, state in zip(places, starts, *states, catalogues.states(), strict=True):
        of_errors = _Seed(start + struct.pack("<2I", 1, part), own, children)
        of_catalogue = _Seed(start + struct.pack("<I", 0), state, none)
        found.append((_generator(of_errors), _generator(of_catalogue)))
    return found


def _start(seed: int, name: bytes) -> bytes:
    return struct.pack("<2Q", seed, 0) + name


def _generator(seed: Any) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(seed))


class _Seed(ISpawnableSeedSequence):
    """The SeedSequence of some words, with known states of its SFC64 and of those of its first children."""

    def __init__(self, words: bytes, state: NDArray[np.uint64], children: NDArray[np.uint64]) -> None:
        self.words, self.state, self.children, self.spawned = words, state, children, 0

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> Any:
        """Return the state for an SFC64; any other is computed by NumPy."""
        if n_words == STATE and dtype is np.uint64:
            return self.state
        return self._sequence().generate_state(n_words, dtype)

    def spawn(self, n_children: int) -> list[Any]:
        """Return the next children."""
        first, self.spawned = self.spawned, self.spawned + n_children
        return [self._child(k) for k in range(first, self.spawned)]

    def _child(self, k: int) -> Any:
        if k < len(self.children):
            return _Seed(self.words + struct.pack("<I", k), self.children[k], self.children[:0])
        return self._sequence(spawn_key=(k,))

    def _sequence(self, **options: Any) -> np.random.SeedSequence:
        return np.random.SeedSequence(np.frombuffer(self.words, "<u4"), **options)


def _powers(first: int, factor: int) -> Words:
    """Return ``first`` times the powers of ``factor``, modulo 2^32."""
    return np.array([first * pow(factor, k, 2**32) % 2**32 for k in range(HASHES + 1)], dtype=np.uint32)[:, None]


HASH, OUTPUT = _powers(0x43B0D7E5, 0x931E8875), _powers(0x8B51F9DD, 0x58F38DED)
LEFT, RIGHT = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)


class _Pool:
    """The pools (4, B) of B SeedSequences after as many words, and the step of the hash."""

    def __init__(self, words: Words, step: int) -> None:
        self.words, self.step = words, step

    @staticmethod
    def of(words: Words) -> "_Pool":
        """Return the pools of the first words, (4, B)."""
        pool, step = _hashed(words, HASH, 0, POOL), POOL
        for source in range(POOL):
            others = [k for k in range(POOL) if k != source]
            pool[others] = _mixed(pool[others], _hashed(pool[source], HASH, step, len(others)))
            step += len(others)
        return _Pool(pool, step)

    def then(self, words: Words | np.uint32) -> "_Pool":
        """Return the pools after one more word each, (B,), or the same for all."""
        return _Pool(_mixed(self.words, _hashed(words, HASH, self.step, POOL)), self.step + POOL)

    def states(self) -> NDArray[np.uint64]:
        """Return the states that they give an SFC64, (B, 3)."""
        turn = np.arange(2 * STATE) % POOL
        return np.ascontiguousarray(_hashed(self.words[turn], OUTPUT, 0, 2 * STATE).T, "<u4").view("<u8")


def _hashed(words: Words | np.uint32, constants: Words, step: int, number: int) -> Words:
    found = (words ^ constants[step : step + number]) * constants[step + 1 : step + number + 1]
    return np.asarray(found ^ (found >> 16))


def _mixed(words: Words, others: Words) -> Words:
    found = words * LEFT - others * RIGHT
    return np.asarray(found ^ (found >> 16))
