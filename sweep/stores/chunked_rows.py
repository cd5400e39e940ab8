"""An append-only Zarr array of rows, in chunks that are whole files and replace their predecessors in one step."""

import json
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.buffer import cpu
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from sweep.stores.checksums import sealed, unsealed
from sweep.stores.location import Location

RECENT = 4
"""Chunks kept in memory for who reads rows in about their order."""


class DamagedError(Exception):
    """Files that are not what was written; ``files`` maps their names to what is wrong."""

    def __init__(self, files: dict[str, str]) -> None:
        super().__init__("; ".join(f"{file}: {problem}" for file, problem in files.items()))
        self.files = files


@dataclass(frozen=True)
class Layout:
    """Width, rows of a chunk, kind and fill value of an array in a folder of the store."""

    folder: str
    width: int
    rows: int
    dtype: str
    fill: float


class Column:
    """One such array.  Its last, unfinished chunk is in memory too, so that only whole chunks are written."""

    def __init__(self, location: Location, layout: Layout, keys: Collection[str]) -> None:
        """Find the chunks among the names of all files of the store."""
        self.layout, self._location = layout, location
        self._codec = _Codec(layout)
        self.chunks = {n for key in keys if (n := self.number(key)) is not None}
        self._described = len(self) // layout.rows if self.description in keys else 0
        self._recent: dict[int, NDArray[Any]] = {}
        self.resume(0)

    def __len__(self) -> int:
        """Rows up to the end of the last chunk."""
        return (max(self.chunks, default=-1) + 1) * self.layout.rows

    @property
    def description(self) -> str:
        """The name of the file that describes the array to Zarr."""
        return f"{self.layout.folder}/zarr.json"

    def key(self, number: int) -> str:
        """Return the name of a chunk's file."""
        return f"{self.layout.folder}/c/{number}/0"

    def read(self) -> NDArray[Any]:
        """Return all rows, those of chunks that are not there as fill values; raises DamagedError, OSError."""
        rows, size = self._empty(len(self)), self.layout.rows
        for number, chunk in self._decoded(self.chunks).items():
            rows[number * size : (number + 1) * size] = chunk
        return rows

    def verify(self) -> None:
        """Raise DamagedError where a chunk is not what was written."""
        numbers = sorted(self.chunks)
        damaged: dict[str, str] = {}
        for start in range(0, len(numbers), RECENT):  # never all of a large array in memory
            try:
                self._decoded(numbers[start : start + RECENT])
            except DamagedError as error:
                damaged |= error.files
        if damaged:
            raise DamagedError(damaged)

    def part(self, start: int, stop: int) -> NDArray[Any]:
        """Return some rows that were flushed; raises DamagedError, OSError."""
        size = self.layout.rows
        first = start // size
        chunks = [self._chunk(number) for number in range(first, -(-stop // size))]
        return np.concatenate([self._empty(0), *chunks])[start - first * size : stop - first * size]

    def resume(self, count: int, rows: NDArray[Any] | None = None) -> None:
        """Go on after so many rows, which may be given if they were read; raises DamagedError, OSError."""
        self._start = count // self.layout.rows * self.layout.rows
        self._tail = self.part(self._start, count) if rows is None else rows[self._start : count].copy()
        self._new: list[NDArray[Any]] = []

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows, which `flush` will write."""
        self._new.append(rows)

    def flush(self) -> None:
        """Write the chunks that have new rows."""
        if not self._new:
            return
        size = self.layout.rows
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
        padded = np.concatenate([rows, self._empty(self.layout.rows - len(rows))])
        self._location.put(self.key(number), self._codec.encode(padded))
        self.chunks.add(number)
        self._recent.pop(number, None)

    def described(self, chunks: int) -> bytes:
        """Return the description of the array with so many chunks."""
        document = {**self._codec.document, "shape": [chunks * self.layout.rows, self.layout.width]}
        return sealed(document, self.description)

    def check_description(self, content: bytes | None) -> None:
        """Raise ValueError unless this describes the array with all its chunks."""
        document = unsealed(content, self.description)
        try:
            grid = document["chunk_grid"]["configuration"]["chunk_shape"]
            fits = grid == [self.layout.rows, self.layout.width] and document["shape"][0] >= len(self)
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError("it does not describe an array") from error
        if not fits:
            raise ValueError("it describes another array")

    @property
    def none(self) -> NDArray[Any]:
        """No rows."""
        return self._empty(0)

    def number(self, key: str) -> int | None:
        """Return which chunk a file holds, None for another file."""
        number = key.removeprefix(f"{self.layout.folder}/c/").removesuffix("/0")
        return int(number) if number.isdecimal() and key == self.key(int(number)) else None

    def _empty(self, rows: int) -> NDArray[Any]:
        return np.full((rows, self.layout.width), self.layout.fill, dtype=self.layout.dtype)

    def _chunk(self, number: int) -> NDArray[Any]:
        if number not in self.chunks:
            return self._empty(self.layout.rows)
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
                found[number] = self._codec.decode(content)
            except Exception as error:  # each codec of Zarr has its own
                damaged[self.key(number)] = " ".join(str(error).split()) or type(error).__name__
        if damaged:
            raise DamagedError(damaged)
        return found


class _Codec:
    """Turns a chunk into the content of its file and back, by way of a Zarr array in memory: Zstandard, CRC-32C."""

    def __init__(self, layout: Layout) -> None:
        self._files: dict[str, Any] = {}
        shape = (layout.rows, layout.width)
        self._array = zarr.create_array(
            MemoryStore(self._files),
            shape=shape,
            chunks=shape,
            dtype=layout.dtype,
            fill_value=layout.fill,
            compressors=[ZstdCodec(level=1), Crc32cCodec()],
            config={"write_empty_chunks": True},
        )
        self.document = json.loads(self._files["zarr.json"].to_bytes())

    def encode(self, values: NDArray[Any]) -> bytes:
        self._array[...] = values
        return bytes(self._files["c/0/0"].to_bytes())

    def decode(self, content: bytes) -> NDArray[Any]:
        self._files["c/0/0"] = cpu.Buffer.from_bytes(content)
        return np.asarray(self._array[...])
