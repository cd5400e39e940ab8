"""The arrays of a ledger: append-only Zarr arrays of rows, whose chunks are whole files, each replaced in one step."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.buffer import cpu
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from linksweep.sweep.contract import Experiment
from linksweep.sweep.planning.block_rows import KEY_BYTES
from linksweep.sweep.stores.checksums import SEAL, DamagedError, content_checksum, noting, sealed, unsealed
from linksweep.sweep.stores.location import Location
from linksweep.sweep.stores.manifest import ANOTHER, Part

START_BYTES = 8
FEWEST_ROWS = 64
CHUNK_BYTES = {"index": 2**20, "sums": 2**21, "samples": 2**22}
"""Bytes of a chunk: a compromise between few files for many blocks and what each flush writes again."""

KINDS = {"samples": "float64", "sums": "float64", "index": "uint8"}
"""The type of each array."""

RECENT = 4
"""Chunks kept in memory for those who read rows more or less in order."""


class Column:
    """One array of a ledger: a chunk has ``chunk_rows`` rows of ``width`` numbers, filled up with NaN, integers with 0.

    The last, unfinished chunk is kept in memory too, so that only whole chunks are written.
    """

    def __init__(self, location: Location, folder: str, shape: Sequence[int], dtype: str, part: Part) -> None:
        """Know the rows that a manifest says there are, in chunks of this ``shape``."""
        self.chunk_rows, self.width = shape
        self.rows, self.checksums = part.rows, list(part.chunks)
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
        self._described = len(self.checksums)
        self._recent: dict[int, NDArray[Any]] = {}
        self._tail: NDArray[Any] | None = None
        self._new: list[NDArray[Any]] = []

    @property
    def part(self) -> Part:
        """What the manifest says of this array."""
        return Part(rows=self.rows, chunks=self.checksums)

    @property
    def description(self) -> str:
        """The name of the file that describes the array to Zarr."""
        return f"{self._folder}/zarr.json"

    @property
    def keys(self) -> list[str]:
        """The names of the files of all chunks."""
        return [self.key(number) for number in range(len(self.checksums))]

    @property
    def end(self) -> int:
        """How many rows there are, with those that `flush` will write."""
        return self.rows + sum(map(len, self._new))

    def key(self, number: int) -> str:
        """Return the name of a chunk's file."""
        return f"{self._folder}/c/{number}/0"

    def empty(self, rows: int) -> NDArray[Any]:
        """Return so many rows of fill values."""
        return np.full((rows, self.width), self._fill, dtype=self._dtype)

    def read(self, damaged: dict[str, str]) -> NDArray[Any]:
        """Return all rows; those of ``damaged`` chunks, which are added to that, are zero.  Raises OSError."""
        contents = self._location.get_all(self.keys)
        rows = np.zeros((self.rows, self.width), dtype=self._dtype)
        for number, key in enumerate(self.keys):
            with noting(damaged, key):
                rows[slice(*self.place(number))] = self._decoded(number, contents.pop(key))
        self._tail = rows[self._whole :].copy()
        return rows

    def verify(self, damaged: dict[str, str]) -> None:
        """Add to ``damaged`` the chunks that are not what was written, never with all of them in memory."""
        for start in range(0, len(self.checksums), RECENT):
            contents = self._location.get_all(self.keys[start : start + RECENT])
            for number, (key, content) in enumerate(contents.items(), start):
                with noting(damaged, key):
                    self._decoded(number, content)

    def rows_between(self, start: int, stop: int) -> NDArray[Any]:
        """Return some rows that were flushed; raises DamagedError, OSError."""
        first, last = start // self.chunk_rows, -(-stop // self.chunk_rows)
        chunks = [self._chunk(number) for number in range(first, last)]
        before = first * self.chunk_rows
        return np.concatenate([self.empty(0), *chunks])[start - before : stop - before]

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows, which `flush` will write."""
        self._new.append(rows)

    def flush(self) -> None:
        """Write the chunks that have new rows."""
        if not self._new:
            return
        if self._tail is None:
            self._tail = self.rows_between(self._whole, self.rows)
        start, rows = self._whole, np.concatenate([self._tail, *self._new])
        for offset in range(0, len(rows), self.chunk_rows):
            number = (start + offset) // self.chunk_rows
            if number >= self._described:
                self._location.put(self.description, self.described(number + 1))
                self._described = number + 1
            self.write(number, rows[offset : offset + self.chunk_rows])
        self.rows, self._new = start + len(rows), []  # only now: after an error all of it is written again
        self._tail = rows[self._whole - start :].copy()

    def write(self, number: int, rows: NDArray[Any]) -> None:
        """Replace a chunk; fewer rows than it has are followed by fill values."""
        self._zarr[...] = np.concatenate([rows, self.empty(self.chunk_rows - len(rows))])
        self._location.put(self.key(number), bytes(self._files["c/0/0"].to_bytes()))
        self.checksums[number : number + 1] = [content_checksum(rows.tobytes())]
        self._recent.pop(number, None)

    def described(self, chunks: int) -> bytes:
        """Return the description of the array with so many chunks."""
        document = json.loads(self._files["zarr.json"].to_bytes())
        return sealed({**document, "shape": [chunks * self.chunk_rows, self.width]}, self.description)

    def check_description(self, content: bytes | None) -> None:
        """Raise ValueError unless this describes the array with all its chunks; there may be none without a chunk."""
        if content is None and not self.checksums:
            return
        document = unsealed(content, self.description)
        document["attributes"].pop(SEAL)
        fitting = json.loads(self.described(0))
        fitting["attributes"].pop(SEAL)
        shape = document.pop("shape")
        del fitting["shape"]
        if document != fitting or shape[1] != self.width or not self.rows <= shape[0]:
            raise ValueError("it describes another array")

    @property
    def _whole(self) -> int:
        """The rows in chunks that are full."""
        return self.rows // self.chunk_rows * self.chunk_rows

    def place(self, number: int) -> tuple[int, int]:
        """Return the first row of a chunk, and the one after its last."""
        return number * self.chunk_rows, min(self.rows, (number + 1) * self.chunk_rows)

    def _chunk(self, number: int) -> NDArray[Any]:
        if number not in self._recent:
            while len(self._recent) >= RECENT:
                del self._recent[next(iter(self._recent))]
            self._recent[number] = self._decoded(number, self._location.get(self.key(number)))
        return self._recent[number]

    def _decoded(self, number: int, content: bytes | None) -> NDArray[Any]:
        """Return the rows in the ``content`` of a chunk's file; raises DamagedError."""
        key = self.key(number)
        if content is None:
            raise DamagedError({key: "it is missing"})
        self._files["c/0/0"] = cpu.Buffer.from_bytes(content)
        try:
            chunk = np.asarray(self._zarr[...])
        except Exception as error:  # each codec of Zarr raises its own
            raise DamagedError({key: " ".join(str(error).split()) or type(error).__name__}) from error
        start, stop = self.place(number)
        rows = chunk[: stop - start]
        if content_checksum(rows.tobytes()) != self.checksums[number]:
            raise DamagedError({key: ANOTHER})
        return rows


def shapes_of(experiment: Experiment, *, keep_samples: bool) -> dict[str, list[int]]:
    """Return the rows and the width of a chunk of each array, for a new store to record."""
    widths = {"index": KEY_BYTES + START_BYTES, "sums": experiment.sums_width}
    if keep_samples:
        widths["samples"] = experiment.samples_width
    return {name: [_rows(name, width), width] for name, width in widths.items()}


def _rows(name: str, width: int) -> int:
    row = width if KINDS[name] == "uint8" else 8 * max(width, 1)
    return int(max(FEWEST_ROWS, 2 ** int(np.log2(max(1.0, CHUNK_BYTES[name] / row)))))
