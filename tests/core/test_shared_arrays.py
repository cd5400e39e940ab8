"""What nested catalogues share: found by content, computed once, and the same to the last bit as alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linksweep.core.constants import MAS
from linksweep.core.frames import exact_differences, stored_differences, triad
from linksweep.core.setup import PART, Prefixes, parts
from tests.core.reference import design_matrix
from tests.tiers import examples

VECTORS = np.array([3.0, -2.0, 0.5]) * MAS, np.array([-0.7, 1.1, 2.0]) * MAS


def sky(n_obj, seed=1):
    rng = np.random.default_rng(seed)
    pmra, pmdec = 100.0 * MAS * rng.standard_normal((2, n_obj))
    return rng.uniform(0.0, 2.0 * np.pi, n_obj), np.arcsin(rng.uniform(-1.0, 1.0, n_obj)), pmra, pmdec


@pytest.mark.parametrize(
    "of_objects",
    [
        lambda *objects: exact_differences(*objects, *VECTORS),
        lambda *objects: stored_differences(*objects, *VECTORS),
        lambda *objects: np.moveaxis(design_matrix(*objects, glide=True), 1, -1),
        lambda ra, dec, *_: np.array(triad(ra, dec)),
    ],
)
@settings(max_examples=examples(30))
@given(n_obj=st.integers(1, PART))
def test_the_bits_of_an_object_do_not_depend_on_how_many_there_are(of_objects, n_obj):
    objects = sky(PART)
    few, all_of_them = of_objects(*(column[:n_obj].copy() for column in objects)), of_objects(*objects)
    np.testing.assert_array_equal(few, all_of_them[..., :n_obj])


def test_the_beginning_of_known_objects_is_not_computed_again():
    calls = []

    def compute(a, b):
        calls.append(len(a))
        return np.stack([a, b], axis=1)

    shared, (a, b, *_) = Prefixes(), sky(50)
    whole = shared.once("sum", compute, a, b)
    assert np.shares_memory(shared.once("sum", compute, a[:20].copy(), b[:20].copy()), whole)
    assert calls == [50]
    np.testing.assert_array_equal(shared.once("other", compute, a[:3], b[:3]), whole[:3])
    assert calls == [50, 3]


@pytest.mark.parametrize("change", [lambda a: np.nextafter(a, 9.0), lambda a: -0.0 * a])
def test_one_other_bit_is_another_object(change):
    shared, a = Prefixes(), np.abs(sky(10)[0])
    a[4] = 0.0
    b = a.copy()
    b[4] = change(b[4])
    shared.once("twice", lambda x: 2.0 * x, a)
    result = shared.once("twice", lambda x: 2.0 * x, b)
    np.testing.assert_array_equal(np.signbit(result), np.signbit(b))
    np.testing.assert_array_equal(result, 2.0 * b)


@pytest.mark.parametrize("beginning", [lambda a: a[:5], lambda a: a[:5].copy()])
def test_more_objects_than_known_are_computed(beginning):
    shared, (a, *_) = Prefixes(), sky(10)
    shared.once("twice", lambda x: 2.0 * x, beginning(a))
    np.testing.assert_array_equal(shared.once("twice", lambda x: 2.0 * x, a), 2.0 * a)


@pytest.mark.parametrize("n_obj", [1, 30, PART, 2 * PART + 7])
def test_products_of_columns(n_obj):
    """Of a prefix they are those of its objects, whatever has been multiplied before, and the same as alone."""
    columns = np.random.default_rng(2).standard_normal((3 * PART, 4, 7))
    shared = Prefixes()
    for few in (columns, columns[:n_obj]):
        flat = few.reshape(-1, 7)
        np.testing.assert_allclose(shared.products(few), flat.T @ flat, atol=1e-10 * len(flat))
    np.testing.assert_array_equal(shared.products(columns[:n_obj]), Prefixes().products(columns[:n_obj].copy()))


def test_parts_cover_the_objects():
    assert list(parts(2 * PART + 1)) == [slice(0, PART), slice(PART, 2 * PART), slice(2 * PART, 2 * PART + 1)]
