"""The ledger of finished blocks: ``index`` says who a row is (32 bytes as `plan.ledger_key`) and at which row of
``samples`` its realisations begin (8 bytes), ``sums`` are the block's sums, ``samples`` the realisations themselves,
where a study keeps them.

They are written in the opposite order, so that a process killed at any instant leaves a ledger that is merely shorter.
A chunk that is lost costs the rows in it and no other.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.contract import Experiment
from sweep.stores.chunked_rows import Column, DamagedError, Layout
from sweep.stores.location import Location

KEY_BYTES = 32
START_BYTES = 8
FEWEST_ROWS = 64
CHUNK_BYTES = {"index": 2**20, "sums": 2**21, "samples": 2**22}
"""Few files for many blocks, against what each flush writes again."""

Array = NDArray[np.float64]


def shapes_of(experiment: Experiment, *, keep_samples: bool) -> dict[str, list[int]]:
    """Return rows and width of a chunk of each array, as a new store will remember them."""
    widths = {"index": KEY_BYTES + START_BYTES, "sums": experiment.sums_width}
    if keep_samples:
        widths["samples"] = experiment.samples_width
    return {name: [_rows(name, width), width] for name, width in widths.items()}


def _rows(name: str, width: int) -> int:
    row = width if name == "index" else 8 * max(width, 1)
    return int(max(FEWEST_ROWS, 2 ** int(np.log2(max(1.0, CHUNK_BYTES[name] / row)))))


def columns_of(location: Location, shapes: Mapping[str, Sequence[int]], keys: Collection[str]) -> dict[str, Column]:
    """Return the arrays of a ledger, in the order of writing, with their chunks among the names of all files."""
    return {
        name: Column(
            location,
            Layout(f"blocks/{name}", shapes[name][1], shapes[name][0], *kind),
            [key for key in keys if key.startswith(f"blocks/{name}/")],
        )
        for name, kind in (("samples", ("float64", np.nan)), ("sums", ("float64", np.nan)), ("index", ("uint8", 0)))
        if name in shapes
    }


def damaged_descriptions(columns: Iterable[Column], documents: Mapping[str, bytes | None]) -> dict[str, str]:
    """Return what is wrong with which description of an array; one that is missing was not written yet, unless there
    are chunks.
    """
    damaged: dict[str, str] = {}
    for column in columns:
        try:
            if documents[column.description] is not None or column.chunks:
                column.check_description(documents[column.description])
        except ValueError as error:
            damaged[column.description] = str(error)
    return damaged


class Ledger:
    """Knows the row of every finished block, and appends others."""

    def __init__(self, columns: dict[str, Column]) -> None:
        """Read index and sums; raises DamagedError, OSError."""
        self._columns = columns
        damaged: dict[str, str] = {}
        read: dict[str, NDArray[Any]] = {}
        for name in ("index", "sums"):
            try:
                read[name] = columns[name].read()
            except DamagedError as error:
                damaged |= error.files
        if damaged:
            raise DamagedError(damaged)
        index = read["index"]
        written = np.flatnonzero(index.any(axis=1))
        self._next = int(written[-1]) + 1 if len(written) else 0
        index = index[: self._next]
        self._sums: Array | None = _as_long_as(read["sums"], self._next)
        keys, starts, counts = rows_of(index)
        self._starts = starts.tolist()
        whole = index.any(axis=1) & ~np.isnan(self._sums).all(axis=1) & self._sampled(starts, counts)
        self.rows = {keys[row].tobytes(): int(row) for row in np.flatnonzero(whole)}
        self._samples_end = int((starts + counts).max(initial=0)) if "samples" in columns else 0
        columns["index"].resume(self._next, index)
        columns["sums"].resume(self._next, self._sums)
        if "samples" in columns:
            columns["samples"].resume(self._samples_end)

    @property
    def next_row(self) -> int:
        """The row that the next block gets."""
        return self._next

    def sums(self) -> Array:
        """Return all rows, (rows, width); `rows` says which is whose."""
        self.flush()
        if self._sums is None:
            self._sums = _as_long_as(self._columns["sums"].read(), self._next)
        return self._sums

    def samples(self, key: bytes) -> Array:
        """Return the kept samples of a finished block, (realisations, width)."""
        start = self._starts[self.rows[key]]
        count = int(_realisations(np.frombuffer(key, dtype=np.uint8))[0])
        return np.asarray(self._columns["samples"].part(start, start + count))

    def verify(self) -> None:
        """Raise DamagedError where samples are not what was written; opening did so for the rest."""
        if "samples" in self._columns:
            self._columns["samples"].verify()

    def append(self, keys: Sequence[bytes], sums: Array, samples: Sequence[Array]) -> None:
        """Add finished blocks; durable after `flush`."""
        self._sums = None
        starts = [self._samples_end] * len(keys)
        if samples:
            starts = [self._samples_end + end for end in np.cumsum([0, *map(len, samples)]).tolist()]
            self._samples_end = starts.pop()
            self._columns["samples"].append(np.concatenate(samples))
        self._columns["sums"].append(sums)
        index = b"".join(k + start.to_bytes(START_BYTES, "little") for k, start in zip(keys, starts, strict=True))
        self._columns["index"].append(np.frombuffer(index, dtype=np.uint8).reshape(len(keys), -1))
        self._starts += starts
        self.rows.update(zip(keys, range(self._next, self._next + len(keys)), strict=True))
        self._next += len(keys)

    def flush(self) -> None:
        """Make everything durable, the index last."""
        for column in self._columns.values():
            column.flush()

    def _sampled(self, starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which rows have the chunks of their samples."""
        if "samples" not in self._columns or not len(starts):
            return np.ones(len(starts), dtype=bool)
        column = self._columns["samples"]
        ends = starts + counts
        there = np.zeros(-(-max(len(column), int(ends.max())) // column.layout.rows) + 1, dtype=np.int64)
        there[sorted(column.chunks)] = 1
        before = np.concatenate([[0], np.cumsum(there)])
        first, last = starts // column.layout.rows, -(-ends // column.layout.rows)
        return np.asarray(before[last] - before[first] == last - first)


def rows_of(index: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """Return the keys of rows of the index, where their samples begin and how many these are."""
    keys, starts = index[:, :KEY_BYTES], index[:, KEY_BYTES:].copy().view("<u8")[:, 0].astype(np.int64)
    return keys, starts, _realisations(keys)


def _realisations(keys: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return how many realisations each block of the index has."""
    numbers = np.frombuffer(keys.tobytes(), dtype="<u4").reshape(-1, KEY_BYTES // 4)
    return np.asarray(numbers[:, -2].astype(np.int64) * numbers[:, -1])


def _as_long_as(rows: NDArray[Any], count: int) -> NDArray[Any]:
    """Return the first rows; those of chunks that are not there are NaN."""
    missing = np.full((max(0, count - len(rows)), rows.shape[1]), np.nan)
    return np.concatenate([rows[:count], missing])
