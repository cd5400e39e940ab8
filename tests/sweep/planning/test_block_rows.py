"""Rows of a ledger are found as a dictionary finds them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from linksweep.sweep.contract.block import KEY_BYTES, BlockRows

KEYS = st.integers(1, 6).map(lambda number: number.to_bytes(KEY_BYTES, "little"))


def rows_of(keys, counted):
    return BlockRows([key if counts else bytes(KEY_BYTES) for key, counts in zip(keys, counted, strict=True)])


@given(st.lists(st.tuples(KEYS, st.booleans()), max_size=12), st.lists(KEYS, max_size=5), st.lists(KEYS, max_size=9))
def test_it_is_the_dictionary_of_the_last_row_of_each_key(first, further, wanted):
    rows = rows_of([key for key, _ in first], [counted for _, counted in first])
    expected = {key: row for row, (key, counted) in enumerate(first) if counted}
    assert (bool(rows), len(rows)) == (bool(expected), len(expected))
    rows.extend(further)
    expected |= {key: len(first) + number for number, key in enumerate(further)}
    assert rows.find(wanted).tolist() == [expected.get(key, -1) for key in wanted]
    assert len(rows) == len(expected)
    assert rows == expected  # makes the dictionary
    rows.extend(further)
    assert all(rows[key] >= len(first) + len(further) for key in further)


def test_keys_of_one_hash_are_told_apart():
    same = [bytes(8) + bytes([number]) + bytes(23) for number in range(1, 5)]  # the hash leaves out these bytes
    rows = rows_of(same[:3], [True, True, True])
    assert rows.find(same).tolist() == [0, 1, 2, -1]
    assert len(rows) == 3


def test_what_is_removed_is_missing():
    keys = [number.to_bytes(KEY_BYTES, "little") for number in range(1, 4)]
    rows = rows_of(keys, [True, True, True])
    assert rows.find(keys).tolist() == [0, 1, 2]
    rows.remove([keys[1]])
    assert rows.find(keys).tolist() == [0, -1, 2]
    assert len(rows) == 2
    with pytest.raises(KeyError):
        rows[keys[1]]
