"""The arrays of a ledger: append-only Zarr arrays of rows, whose chunks are whole files, each replaced in one step."""

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.buffer import cpu
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from sweep.contract import Experiment
from sweep.planning.block_rows import KEY_BYTES
from sweep.stores.checksums import DamagedError, noting, sealed, unsealed
from sweep.stores.location import Location

START_BYTES = 8
DIGEST_BYTES = 16
FEWEST_ROWS = 64
CHUNK_BYTES = {"index": 2**20, "digests": 2**20, "sums": 2**21, "samples": 2**22}
"""Bytes of a chunk: a compromise between few files for many blocks and what each flush writes again."""

KINDS = {"samples": "float64", "sums": "float64", "digests": "uint8", "index": "uint8"}
"""The type of each array, in the order of writing."""

RECENT = 4
"""Chunks kept in memory for those who read rows more or less in order."""


class Column:
    """One array of a ledger: a chunk has ``chunk_rows`` rows of ``width`` numbers, filled up with NaN, integers with 0.

    The last, unfinished chunk is kept in memory too, so that only whole chunks are written.
    """

    def __init__(
        self, location: Location, folder: str, shape: Sequence[int], dtype: str, keys: Collection[str]
    ) -> None:
        """Find the chunks, each of this ``shape``, among ``keys``, the names of all files of the store."""
        self.chunk_rows, self.width = shape
        self._location, self._folder, self._dtype = location, folder, dtype
        self._fill = np.nan if dtype == "float64" else 0
        self._files: dict[str, Any] = {}
        self._zarr = zarr.create_array(  # in memory: turns a chunk into the content of its file and back
            MemoryStore(self._files),
            shape=tuple(shape),
            chunks=tuple(shape),
            dtype=dtype,
            fill_value=self._fill,
            compressors=[ZstdCodec(level=1), Crc32cCodec()],
            config={"write_empty_chunks": True},
        )
        self.chunks = {n for key in keys if key.startswith(folder) and (n := self.number(key)) is not None}
        self._described = self.end if self.description in keys else 0
        self._recent: dict[int, NDArray[Any]] = {}
        self.resume(0)

    @property
    def end(self) -> int:
        """The number after that of the last chunk."""
        return max(self.chunks, default=-1) + 1

    def __len__(self) -> int:
        """Rows up to the end of the last chunk."""
        return self.end * self.chunk_rows

    @property
    def description(self) -> str:
        """The name of the file that describes the array to Zarr."""
        return f"{self._folder}/zarr.json"

    def key(self, number: int) -> str:
        """Return the name of a chunk's file."""
        return f"{self._folder}/c/{number}/0"

    def numbers(self, start: int, stop: int) -> range:
        """Return the numbers of the chunks that some rows are in."""
        return range(start // self.chunk_rows, -(-stop // self.chunk_rows))

    def empty(self, rows: int = 0) -> NDArray[Any]:
        """Return so many rows of fill values."""
        return np.full((rows, self.width), self._fill, dtype=self._dtype)

    def read(self) -> NDArray[Any]:
        """Return all rows, those of missing chunks as fill values; raises DamagedError, OSError."""
        rows, size = self.empty(len(self)), self.chunk_rows
        for number, chunk in self._decoded(self.chunks).items():
            rows[number * size : (number + 1) * size] = chunk
        return rows

    def verify(self) -> None:
        """Raise DamagedError where a chunk is not what was written."""
        numbers = sorted(self.chunks)
        damaged: dict[str, str] = {}
        for start in range(0, len(numbers), RECENT):  # never all of a large array in memory
            with noting(damaged):
                self._decoded(numbers[start : start + RECENT])
        if damaged:
            raise DamagedError(damaged)

    def part(self, start: int, stop: int) -> NDArray[Any]:
        """Return some rows that were flushed; raises DamagedError, OSError."""
        chunks = [self._chunk(number) for number in self.numbers(start, stop)]
        before = start // self.chunk_rows * self.chunk_rows
        return np.concatenate([self.empty(), *chunks])[start - before : stop - before]

    def resume(self, count: int, rows: NDArray[Any] | None = None) -> None:
        """Go on after so many rows; ``rows`` are given if they were read already; raises DamagedError, OSError."""
        self._start = count // self.chunk_rows * self.chunk_rows
        self._tail = self.part(self._start, count) if rows is None else rows[self._start : count].copy()
        self._new: list[NDArray[Any]] = []

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows, which `flush` will write."""
        self._new.append(rows)

    def flush(self) -> None:
        """Write the chunks that have new rows."""
        if not self._new:
            return
        size = self.chunk_rows
        rows = np.concatenate([self._tail, *self._new])
        for offset in range(0, len(rows), size):
            number = (self._start + offset) // size
            if number >= self._described:
                self._location.put(self.description, self.described(number + 1))
                self._described = number + 1
            self.write(number, rows[offset : offset + size])
        whole = len(rows) // size * size
        self._start += whole
        self._tail, self._new = rows[whole:].copy(), []

    def write(self, number: int, rows: NDArray[Any]) -> None:
        """Replace a chunk; fewer rows than it has are followed by fill values."""
        self._zarr[...] = np.concatenate([rows, self.empty(self.chunk_rows - len(rows))])
        self._location.put(self.key(number), bytes(self._files["c/0/0"].to_bytes()))
        self.chunks.add(number)
        self._recent.pop(number, None)

    def described(self, chunks: int) -> bytes:
        """Return the description of the array with so many chunks."""
        document = json.loads(self._files["zarr.json"].to_bytes())
        return sealed({**document, "shape": [chunks * self.chunk_rows, self.width]}, self.description)

    def check_description(self, content: bytes | None) -> None:
        """Raise ValueError unless this describes the array with all its chunks, or neither it nor a chunk is there."""
        if content is None and not self.chunks:
            return
        document = unsealed(content, self.description)
        try:
            grid = document["chunk_grid"]["configuration"]["chunk_shape"]
            fits = grid == [self.chunk_rows, self.width] and document["shape"][0] >= len(self)
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError("it does not describe an array") from error
        if not fits:
            raise ValueError("it describes another array")

    def number(self, key: str) -> int | None:
        """Return which chunk a file holds, None for another file."""
        number = key.removeprefix(f"{self._folder}/c/").removesuffix("/0")
        return int(number) if number.isdecimal() and key == self.key(int(number)) else None

    def _chunk(self, number: int) -> NDArray[Any]:
        if number not in self.chunks:
            return self.empty(self.chunk_rows)
        if number not in self._recent:
            while len(self._recent) >= RECENT:
                del self._recent[next(iter(self._recent))]
            self._recent |= self._decoded([number])
        return self._recent[number]

    def _decoded(self, numbers: Iterable[int]) -> dict[int, NDArray[Any]]:
        contents = self._location.get_all([self.key(number) for number in sorted(numbers)])
        found: dict[int, NDArray[Any]] = {}
        damaged: dict[str, str] = {}
        for number in sorted(numbers):
            content = contents.pop(self.key(number))
            try:
                if content is None:
                    raise ValueError("it has just been removed")
                self._files["c/0/0"] = cpu.Buffer.from_bytes(content)
                found[number] = np.asarray(self._zarr[...])
            except Exception as error:  # each codec of Zarr raises its own
                damaged[self.key(number)] = " ".join(str(error).split()) or type(error).__name__
        if damaged:
            raise DamagedError(damaged)
        return found


def shapes_of(experiment: Experiment, *, keep_samples: bool) -> dict[str, list[int]]:
    """Return the rows and the width of a chunk of each array, for a new store to record."""
    widths = {"index": KEY_BYTES + START_BYTES, "sums": experiment.sums_width, "digests": DIGEST_BYTES}
    if keep_samples:
        widths["digests"] = 2 * DIGEST_BYTES
        widths["samples"] = experiment.samples_width
    return {name: [_rows(name, width), width] for name, width in widths.items()}


def _rows(name: str, width: int) -> int:
    row = width if KINDS[name] == "uint8" else 8 * max(width, 1)
    return int(max(FEWEST_ROWS, 2 ** int(np.log2(max(1.0, CHUNK_BYTES[name] / row)))))


def columns_of(location: Location, shapes: Mapping[str, Sequence[int]], keys: Collection[str]) -> dict[str, Column]:
    """Return the arrays of a ledger, in the order of writing, with their chunks among the names of all files."""
    return {
        name: Column(location, f"blocks/{name}", shapes[name], dtype, keys)
        for name, dtype in KINDS.items()
        if name in shapes
    }
