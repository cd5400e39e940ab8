"""The row of each finished block in a ledger, by its key: 48 bytes a block, looked up many at once."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

KEY_BYTES = 32
"""Bytes in a `ledger_key`."""


class BlockRows(Mapping[bytes, int]):
    """The rows of a ledger by the keys of their blocks; the last row of a key counts.

    A dictionary of a million keys takes 200 MB and seconds to make, so it is made only where a single key is looked up.
    """

    def __init__(self, keys: NDArray[np.uint8], counted: NDArray[np.bool_]) -> None:
        """Start with the keys of all rows, (rows, `KEY_BYTES`), and which of these rows count, (rows,)."""
        self._keys = bytearray(keys.tobytes())
        self._counted = bytearray(counted.tobytes())
        self._number: dict[bytes, int] | None = None
        self._sorted: tuple[NDArray[np.uint64], NDArray[np.intp]] | None = None

    @classmethod
    def of(cls, rows: Mapping[bytes, int]) -> "BlockRows":
        """Return a mapping as `BlockRows`."""
        if isinstance(rows, cls):
            return rows
        keys = np.zeros((max(rows.values(), default=-1) + 1, KEY_BYTES), dtype=np.uint8)
        counted = np.zeros(len(keys), dtype=bool)
        for key, row in rows.items():
            keys[row] = np.frombuffer(key, dtype=np.uint8)
            counted[row] = True
        return cls(keys, counted)

    def extend(self, keys: Sequence[bytes]) -> None:
        """Add the rows that follow the last one."""
        if self._number is not None:
            first = len(self._counted)
            self._number.update(zip(keys, range(first, first + len(keys)), strict=True))
        self._keys += b"".join(keys)
        self._counted += b"\1" * len(keys)
        self._sorted = None

    def remove(self, keys: Iterable[bytes]) -> None:
        """Make blocks count as missing."""
        for key in keys:
            self._counted[self._numbers.pop(key)] = 0
        self._sorted = None

    def find(self, keys: Sequence[bytes]) -> NDArray[np.intp]:
        """Return the row of each key, -1 where there is none."""
        hashes, rows = self._by_hash()
        wanted = np.frombuffer(b"".join(keys), dtype="<u8").reshape(-1, KEY_BYTES // 8)
        if not len(hashes) or not len(wanted):
            return np.full(len(wanted), -1)
        own = _hashes(wanted)
        places = np.searchsorted(hashes, own, side="right") - 1  # the last row with this hash
        found = np.where(hashes[places] == own, rows[places], -1)
        same = (self._words()[found] == wanted).all(axis=1)
        for place in np.flatnonzero(~same & (found >= 0)).tolist():  # another key has the same hash
            found[place] = self._numbers.get(keys[place], -1)
        return found

    def __getitem__(self, key: bytes) -> int:
        return self._numbers[key]

    def __iter__(self) -> Iterator[bytes]:
        return iter(self._numbers)

    def __len__(self) -> int:
        if self._number is not None:
            return len(self._number)
        hashes, rows = self._by_hash()
        again = np.flatnonzero(hashes[1:] == hashes[:-1])
        return len(self._numbers) if len(again) else len(rows)

    def __bool__(self) -> bool:
        return 1 in self._counted

    @property
    def _numbers(self) -> dict[bytes, int]:
        if self._number is None:
            keys, rows = bytes(self._keys), np.flatnonzero(self._flags()).tolist()
            self._number = {keys[KEY_BYTES * row : KEY_BYTES * (row + 1)]: row for row in rows}
        return self._number

    def _by_hash(self) -> tuple[NDArray[np.uint64], NDArray[np.intp]]:
        """Return the hashes of the keys that count, sorted, and the row of each; equal hashes stay in order of rows."""
        if self._sorted is None:
            rows = np.flatnonzero(self._flags())
            hashes = _hashes(self._words()[rows])
            order = np.argsort(hashes, kind="stable")
            self._sorted = hashes[order], rows[order]
        return self._sorted

    def _flags(self) -> NDArray[np.bool_]:
        return np.frombuffer(bytes(self._counted), dtype=bool)

    def _words(self) -> NDArray[np.uint64]:
        return np.frombuffer(bytes(self._keys), dtype="<u8").reshape(-1, KEY_BYTES // 8)


def _hashes(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return a hash of each key, nearly always a different one: digests are as good as random, counts are small."""
    mixed: NDArray[np.uint64] = (
        words[:, 0] ^ (words[:, 2] * np.uint64(0x9E3779B97F4A7C15)) ^ (words[:, 3] * np.uint64(0xC2B2AE3D27D4EB4F))
    )
    return mixed
