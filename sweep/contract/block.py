"""A block of a point: what a worker computes in one piece, its key in the ledger, and an index of such keys."""

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Bytes in a `ledger_key`.
KEY_BYTES = 32

# Bytes of the digest of a point, with which a key begins.
DIGEST_BYTES = 16


class Block(NamedTuple):
    """A point's realisations ``part`` of the catalogues of one ``group``: the unit of work, ledger and resuming.

    Catalogues are numbered from ``first_catalogue``; each gets ``n_sim`` realisations from a stream of its own.

    >>> Block(group=0, part=1, first_catalogue=0, n_cat=16, n_sim=512).realisations
    8192
    """

    group: int
    part: int
    first_catalogue: int
    n_cat: int
    n_sim: int

    @property
    def realisations(self) -> int:
        """Realisations in this block."""
        return self.n_cat * self.n_sim


def ledger_key(digest: bytes, block: Block) -> bytes:
    """Return the key of a block in the ledger, 32 bytes: digest, group, part, catalogues, realisations of each.

    Two runs agree on a key if and only if the block leaves the same numbers.
    """
    return digest + struct.pack("<4I", block.group, block.part, block.n_cat, block.n_sim)


class BlockRows(Mapping[bytes, int]):
    """The rows of a ledger by the keys of their blocks; the last row of a key counts.

    A dictionary of a million keys takes 200 MB and seconds to make, so it is made only where a single key is looked up.
    """

    def __init__(self, keys: Sequence[bytes] | bytes) -> None:
        """Start with the keys of all rows; one of zeros alone is that of a row that was lost."""
        self._keys = bytearray(keys if isinstance(keys, bytes) else b"".join(keys))
        self._number: dict[bytes, int] | None = None
        self._sorted: tuple[NDArray[np.uint64], NDArray[np.intp]] | None = None

    def extend(self, keys: Sequence[bytes]) -> None:
        """Add the rows that follow the last one."""
        if self._number is not None:
            first = self.end
            self._number.update(zip(keys, range(first, first + len(keys)), strict=True))
        self._keys += b"".join(keys)
        self._sorted = None

    @property
    def end(self) -> int:
        """The row that the next key gets."""
        return len(self._keys) // KEY_BYTES

    def keys_of_rows(self) -> list[bytes]:
        """Return the key of each row, zeros for one that does not count."""
        whole = bytes(self._keys)
        return [whole[start : start + KEY_BYTES] for start in range(0, len(whole), KEY_BYTES)]

    def remove(self, keys: Iterable[bytes]) -> None:
        """Make blocks count as missing, also where earlier rows have their keys."""
        gone = set(keys)
        self._keys = bytearray().join(bytes(KEY_BYTES) if key in gone else key for key in self.keys_of_rows())
        self._number = self._sorted = None

    def find(self, keys: Sequence[bytes]) -> NDArray[np.intp]:
        """Return the row of each key, -1 where there is none."""
        hashes, rows = self._by_hash()
        wanted = np.frombuffer(b"".join(keys), dtype="<u8").reshape(-1, KEY_BYTES // 8)
        if not len(hashes) or not len(wanted):
            return np.full(len(wanted), -1)
        sought = _hashes(wanted)
        places = np.searchsorted(hashes, sought, side="right") - 1  # the last row with this hash
        known = np.where(hashes[places] == sought, rows[places], -1)
        same = (self._words()[known] == wanted).all(axis=1)
        for place in np.flatnonzero(~same & (known >= 0)).tolist():  # another key has the same hash
            known[place] = self._numbers.get(keys[place], -1)
        return known

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
        return bool(self._number) if self._number is not None else any(self._keys)

    @property
    def _numbers(self) -> dict[bytes, int]:
        if self._number is None:
            keys, rows = bytes(self._keys), np.flatnonzero(self._words().any(axis=1)).tolist()
            self._number = {keys[KEY_BYTES * row : KEY_BYTES * (row + 1)]: row for row in rows}
        return self._number

    def _by_hash(self) -> tuple[NDArray[np.uint64], NDArray[np.intp]]:
        """Return the hashes of the keys that count, sorted, and the row of each; equal hashes stay in order of rows."""
        if self._sorted is None:
            words = self._words()
            rows = np.flatnonzero(words.any(axis=1))
            hashes = _hashes(words[rows])
            order = np.argsort(hashes, kind="stable")
            self._sorted = hashes[order], rows[order]
        return self._sorted

    def _words(self) -> NDArray[np.uint64]:
        return np.frombuffer(bytes(self._keys), dtype="<u8").reshape(-1, KEY_BYTES // 8)


def _hashes(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return a hash of each key, nearly always a different one: digests are as good as random, counts are small."""
    mixed: NDArray[np.uint64] = (
        words[:, 0] ^ (words[:, 2] * np.uint64(0x9E3779B97F4A7C15)) ^ (words[:, 3] * np.uint64(0xC2B2AE3D27D4EB4F))
    )
    return mixed
