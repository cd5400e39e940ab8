"""The ledger of finished blocks: ``index`` says which block a row is (32 bytes as `ledger_key`) and at which row of
``samples`` its realisations begin (8 bytes), ``sums`` are the block's sums, ``samples`` the realisations themselves,
where a study keeps them.  ``digests`` tie them together: the digest of a row of the index with its sums (16 bytes), and
that of the same row with its samples, so that a chunk in the place of another is found.

The index is written last, so that a process killed at any instant leaves a ledger that is merely shorter.  A lost chunk
costs only the rows in it.
"""

from array import array
from collections.abc import Iterator, Sequence
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Array
from sweep.planning.block_rows import KEY_BYTES, BlockRows
from sweep.stores.checksums import DamagedError, noting
from sweep.stores.ledger_arrays import DIGEST_BYTES, KINDS, START_BYTES, Column

ROW = np.dtype([("key", f"V{KEY_BYTES - 8}"), ("n_cat", "<u4"), ("n_sim", "<u4"), ("start", "<u8")])
"""A row of the index: the key ends with the number of catalogues and the number of realisations of each."""

AT_ONCE = 2**16
"""Rows that are compared with their digests at a time."""

ELSEWHERE = "its rows are not those that blocks/index and blocks/digests name there"


class Ledger:
    """Knows the row of every finished block, and appends others."""

    def __init__(self, columns: dict[str, Column], compared: bool = True) -> None:
        """Read all but the samples, and unless ``compared`` is False compare each row with its digest, which takes most
        of the time; raises DamagedError, OSError.
        """
        self._columns = columns
        damaged: dict[str, str] = {}
        read: dict[str, NDArray[Any]] = {}
        for name in columns.keys() - {"samples"}:
            with noting(damaged):
                read[name] = columns[name].read()
        if damaged:
            raise DamagedError(damaged)
        index = read["index"]
        written = np.flatnonzero(index.any(axis=1))
        self.next_row = int(written[-1]) + 1 if len(written) else 0  # that of the next block
        index = index[: self.next_row]
        sums = _as_long_as(read["sums"], self.next_row)
        self._sums: Array | None = sums
        keys, starts, counts = rows_of(index)
        self._starts = array("q", starts.tobytes())
        whole = index.any(axis=1) & self._sampled(starts, counts)
        known = ~np.isnan(sums).all(axis=1)
        if "digests" in columns:
            digests = _as_long_as(read["digests"], self.next_row)
            columns["digests"].resume(self.next_row, digests)
            if compared:
                known = self._bound(index, sums, digests)
        self.rows = BlockRows(keys, whole & known)
        columns["index"].resume(self.next_row, index)
        columns["sums"].resume(self.next_row, sums)
        self._samples_end = 0
        if "samples" in columns:
            self._samples_end = int((starts + counts).max(initial=0))
            columns["samples"].resume(self._samples_end)

    def _bound(self, index: NDArray[np.uint8], sums: Array, digests: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return which rows have their own sums; raises DamagedError where a row has those of another.

        A row whose sums or digest were not written, or were lost, merely does not count.
        """
        same = (_digests(index, sums) == digests[:, :DIGEST_BYTES]).all(axis=1)
        there = index.any(axis=1) & digests.any(axis=1) & ~np.isnan(sums).all(axis=1)
        if len(wrong := np.flatnonzero(there & ~same)):
            numbers = sorted(set((wrong // self._columns["sums"].chunk_rows).tolist()))
            raise DamagedError({self._columns["sums"].key(number): ELSEWHERE for number in numbers})
        return np.asarray(same)

    def sums(self) -> Array:
        """Return the sums of all rows, (rows, width); `rows` has the row of each block."""
        self.flush()
        if self._sums is None:
            self._sums = _as_long_as(self._columns["sums"].read(), self.next_row)
        return self._sums

    def samples(self, key: bytes) -> Array:
        """Return the kept samples of a finished block that was flushed, (realisations, width); raises DamagedError,
        OSError.
        """
        row = self.rows[key]
        column, start = self._columns["samples"], self._starts[row]
        index = _index_rows([key], [start])
        count = int(rows_of(index)[2][0])
        samples = np.asarray(column.part(start, start + count))
        if "digests" in self._columns:
            digest = self._columns["digests"].part(row, row + 1)[0, DIGEST_BYTES:]
            if not np.array_equal(digest, _digests(index, [samples])[0]):
                raise DamagedError({column.key(n): ELSEWHERE for n in column.numbers(start, start + count)})
        return samples

    def verify(self) -> None:
        """Raise DamagedError where samples are not what was written; opening has checked the rest."""
        if "samples" not in self._columns:
            return
        self._columns["samples"].verify()
        damaged: dict[str, str] = {}
        for key in sorted(self.rows, key=self.rows.__getitem__):  # in the order of the samples
            with noting(damaged):
                self.samples(key)
        if damaged:
            raise DamagedError(damaged)

    def append(self, keys: Sequence[bytes], sums: Array, samples: Sequence[Array]) -> None:
        """Add finished blocks; durable after `flush`."""
        self._sums = None
        starts = [self._samples_end] * len(keys)
        if samples:
            starts = [self._samples_end + end for end in np.cumsum([0, *map(len, samples)]).tolist()]
            self._samples_end = starts.pop()
            self._columns["samples"].append(np.concatenate(samples))
        index = _index_rows(keys, starts)
        self._columns["sums"].append(sums)
        if "digests" in self._columns:
            bound = [_digests(index, sums), *([_digests(index, samples)] if samples else [])]
            self._columns["digests"].append(np.concatenate(bound, axis=1))
        self._columns["index"].append(index)
        self._starts.extend(starts)
        self.rows.extend(keys)
        self.next_row += len(keys)

    def bind(self, digests: Column) -> None:
        """Write all digests durably into ``digests``, an array that the ledgers of format 2 do not have."""
        self.flush()
        index, sums = self._columns["index"].read(), self.sums()
        rows = np.zeros((self.next_row, digests.width), dtype=np.uint8)
        for key, row in sorted(self.rows.items(), key=lambda item: item[1]):
            rows[row, :DIGEST_BYTES] = _digests(index[row : row + 1], sums[row : row + 1])
            if "samples" in self._columns:
                rows[row, DIGEST_BYTES:] = _digests(index[row : row + 1], [self.samples(key)])
        digests.resume(0)
        digests.append(rows)
        digests.flush()
        columns = self._columns | {"digests": digests}
        self._columns = {name: columns[name] for name in KINDS if name in columns}

    def flush(self) -> None:
        """Make everything durable, the index last."""
        for column in self._columns.values():
            column.flush()

    def _sampled(self, starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which rows have all chunks of their samples."""
        if "samples" not in self._columns or not len(starts):
            return np.ones(len(starts), dtype=bool)
        column = self._columns["samples"]
        ends = starts + counts
        there = np.zeros(-(-max(len(column), int(ends.max())) // column.chunk_rows) + 1, dtype=np.int64)
        there[sorted(column.chunks)] = 1
        before = np.concatenate([[0], np.cumsum(there)])
        first, last = starts // column.chunk_rows, -(-ends // column.chunk_rows)
        return np.asarray(before[last] - before[first] == last - first)


def rows_of(index: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """Return the keys of rows of the index, where their samples begin and how many there are."""
    rows = index.view(ROW)[:, 0]
    return index[:, :KEY_BYTES], rows["start"].astype(np.int64), rows["n_cat"].astype(np.int64) * rows["n_sim"]


def _index_rows(keys: Sequence[bytes], starts: Sequence[int]) -> NDArray[np.uint8]:
    index = b"".join(k + start.to_bytes(START_BYTES, "little") for k, start in zip(keys, starts, strict=True))
    return np.frombuffer(index, dtype=np.uint8).reshape(len(keys), KEY_BYTES + START_BYTES)


def _digests(index: NDArray[np.uint8], values: Sequence[Array] | Array) -> NDArray[np.uint8]:
    """Return the digest of each row of the index together with its sums or samples, (rows, `DIGEST_BYTES`)."""
    found = np.empty((len(index), DIGEST_BYTES), dtype=np.uint8)
    for start in range(0, len(index), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        rows, width = index[part].tobytes(), index.shape[1]
        digests = (
            blake2b(rows[width * row : width * (row + 1)] + own, digest_size=DIGEST_BYTES).digest()
            for row, own in enumerate(_contents(values[part]))
        )
        found[part] = np.frombuffer(b"".join(digests), dtype=np.uint8).reshape(-1, DIGEST_BYTES)
    return found


def _contents(values: Sequence[Array] | Array) -> Iterator[bytes]:
    """Yield the bytes of each row, or of each array of a list."""
    if not isinstance(values, np.ndarray):
        yield from (np.asarray(own, dtype="<f8").tobytes() for own in values)
        return
    size, content = 8 * values.shape[1], np.asarray(values, dtype="<f8").tobytes()
    yield from (content[size * row : size * (row + 1)] for row in range(len(values)))


def _as_long_as(rows: NDArray[Any], count: int) -> NDArray[Any]:
    """Return the first ``count`` rows; those of missing chunks are NaN, or 0 for integers."""
    fill = np.nan if rows.dtype.kind == "f" else 0
    if len(rows) >= count:
        return rows[:count]
    return np.concatenate([rows, np.full((count - len(rows), rows.shape[1]), fill, dtype=rows.dtype)])
