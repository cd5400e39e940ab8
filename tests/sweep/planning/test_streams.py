"""Random streams are those of NumPy's SeedSequence, by the names of point, catalogue and part."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from linksweep.sweep.contract.block import Block
from linksweep.sweep.planning.plan import generators, generators_of

SEEDS = st.sampled_from([0, 5, 2**32, 2**64 - 1]) | st.integers(0, 2**64 - 1)


def state(rng):
    return rng.bit_generator.state["state"]["state"].tolist()


def numpys(seed, name, *place):
    """The generator of NumPy's own child of the seed."""
    words = np.frombuffer(name, "<u4").tolist()
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(*words, *place))))


@given(
    seed=SEEDS,
    name=st.binary(min_size=16, max_size=16),
    first=st.integers(0, 2**32 - 40),
    n_cat=st.sampled_from([1, 2, 16]),
    part=st.integers(0, 2**32 - 1),
)
def test_streams_are_numpys_own_children_of_the_seed(seed, name, first, n_cat, part):
    """And so are those that spawn from them."""
    pairs = generators_of(seed, name, Block(0, part, first, n_cat, 10))
    assert len(pairs) == n_cat
    for catalogue, pair in enumerate(pairs, first):
        for ours, place in zip(pair, [(catalogue, 1, part), (catalogue, 0)], strict=True):
            theirs = numpys(seed, name, *place)
            assert state(ours) == state(theirs)
            for _ in range(2):  # the second time other children
                for child, other in zip(ours.spawn(2), theirs.spawn(2), strict=True):
                    assert state(child) == state(other)
                    assert state(child.spawn(1)[0]) == state(other.spawn(1)[0])


def test_streams_of_different_points_catalogues_and_parts_differ():
    first = [
        generators(seed, digest, catalogue, part)[which].integers(0, 2**63)
        for seed in (0, 1)
        for digest in (bytes(16), b"\1" + bytes(15))
        for catalogue in (0, 1)
        for part, which in ((0, 0), (1, 0), (0, 1))
    ]
    assert len(set(first)) == len(first)


def test_streams_of_neighbours_are_uncorrelated():
    draws = np.stack([generators(3, bytes(16), c, p)[0].standard_normal(20_000) for c in range(8) for p in range(4)])
    correlation = np.corrcoef(draws)[np.triu_indices(32, 1)]
    assert np.abs(correlation).max() < 5 / np.sqrt(20_000)  # 496 pairs: 5 sigma
