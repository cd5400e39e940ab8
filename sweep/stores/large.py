"""Large arrays of results, which the process that has computed one writes into the store, and no other.

The files of its chunks are encoded as those of the dataset, and have their checksums as names.  Rows of the ledger
refer to them; a chunk of the dataset is another name of such a file where the place has links, else a copy.  A file to
which no row refers is of a point that was not finished, or was computed again.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Outcome, Rows, SweepError
from linksweep.sweep.contract.rows import MISSING_INT, REFERENCE, chunk_grid, chunk_shape
from linksweep.sweep.stores import integrity
from linksweep.sweep.stores.integrity import MANIFEST, ROOT, STORE
from linksweep.sweep.stores.location import Location, located, reading

if TYPE_CHECKING:
    import xarray as xr
    import zarr

CODECS = ({"name": "zstd", "configuration": {"level": 1}}, {"name": "crc32c"})

CHUNK_NAMES = ({"name": "default", "separator": "."}, {"name": "v2", "separator": "."})
"""Two sets of names that chunks can have."""

FOLDER = MANIFEST.rpartition("/")[0]

FILE = re.compile(rf"{FOLDER}/large\.[0-9a-f]{{32}}")

ARRAY = "array"


def file_of(reference: bytes) -> str:
    """Return the name of the file of a chunk."""
    return f"{FOLDER}/large.{reference.hex()}"


def chunk_name(array: str, names: Mapping[str, str], place: tuple[int, ...]) -> str:
    """Return the name of a chunk of an array, by one of `CHUNK_NAMES`."""
    return f"{array}/{'c.' if names is CHUNK_NAMES[0] else ''}{'.'.join(map(str, place))}"


def new_array(files: dict[str, Any], name: str, shape: tuple[int, ...], **how: Any) -> "zarr.Array[Any]":
    """Return a new array of Zarr, encoded as all of a store, whose files are put among others in memory."""
    import zarr
    from zarr.storage import MemoryStore

    how = {"chunk_key_encoding": CHUNK_NAMES[0], **how}
    how |= {"chunks": chunk_shape(shape), "compressors": CODECS, "config": {"write_empty_chunks": True}}
    return zarr.create_array(MemoryStore(files), name=name, shape=shape, **how)


def references(rows: Rows) -> set[bytes]:
    """Return the references in some rows."""
    names = [name for name in rows.dtype.names or () if rows.dtype[name].base == REFERENCE]
    return {one for name in names for one in rows[name].reshape(-1).tolist()} - {bytes(REFERENCE.itemsize)}


def written(outcomes: Mapping[int, Outcome], location: Location) -> dict[int, Outcome]:
    """Return outcomes with references in place of their large arrays, which are in the store then; raises OSError."""

    def small(one: Outcome) -> Outcome:
        if not (large := getattr(one.layout, "large", ())):
            return one
        pairs = zip(one.layout.fields, one.row, strict=True)
        return one._replace(row=tuple(_put(value, location) if f.name in large else value for f, value in pairs))

    return {row: small(one) for row, one in outcomes.items()}


def _put(array: NDArray[Any], location: Location) -> NDArray[np.void]:
    """Write the chunks of an array, unless that was done, and return the references to them in order."""
    if array.dtype == REFERENCE:
        return array
    files: dict[str, Any] = {}
    new_array(files, ARRAY, array.shape, dtype=array.dtype, fill_value=missing(array.dtype))[...] = array
    chunks: list[bytes] = []
    for place in np.ndindex(chunk_grid(array.shape)):
        content = files.pop(chunk_name(ARRAY, CHUNK_NAMES[0], place)).to_bytes()
        chunks.append(bytes.fromhex(integrity.checksum(content)))
        location.put(file_of(chunks[-1]), content)
    return np.array(chunks, dtype=REFERENCE)


def missing(dtype: np.dtype[Any]) -> float:
    """Return what a large array of numbers has where they are missing."""
    return np.nan if dtype.kind == "f" else MISSING_INT


@dataclass(frozen=True)
class ToStore:
    """Writes large arrays into the store with an identity, if it is to be seen at the place from where this is used."""

    place: str
    store_id: str

    def __call__(self, outcomes: dict[int, Outcome]) -> dict[int, Outcome]:
        """Return outcomes as `written`; as they are where the store is not seen, or cannot be written."""
        if any(getattr(one.layout, "large", ()) for one in outcomes.values()):
            # Each time: the store may be moved, and must not be begun anew at its old place.
            with suppress(SweepError, OSError, ValueError, LookupError, TypeError):
                location = located(self.place)
                if json.loads(location.get(ROOT) or b"")["attributes"][STORE] == self.store_id:
                    return written(outcomes, location)
        return outcomes


@dataclass
class Stored:
    """A large array in a store, which is read as it is used: the references to the ``chunks`` of each point, (*points,
    chunks), none of a point that is missing; the ``shape``, (*points, *that at a point), and the type of the values.
    """

    location: Location
    chunks: NDArray[np.void]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        """The number of values."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """The bytes of references, which are all that is in memory."""
        return self.chunks.nbytes

    def files(self, array: str, names: Mapping[str, str]) -> Iterator[tuple[str, str, bytes]]:
        """Yield the name of each chunk, that of the same chunk of the first point, and its reference."""
        axes = self.chunks.ndim - 1
        inner = list(np.ndindex(chunk_grid(self.shape[axes:])))
        for point in np.ndindex(self.chunks.shape[:-1]):
            for place, chunk in zip(inner, self.chunks[point].tolist(), strict=True):
                name, first = (chunk_name(array, names, (*p, *place)) for p in (point, (0,) * axes))
                yield name, first, chunk

    @cached_property
    def array(self) -> "zarr.Array[Any]":
        """The array of Zarr, whose chunks are read from the store."""
        chunks = {file: chunk for file, _, chunk in self.files(ARRAY, CHUNK_NAMES[0]) if any(chunk)}
        dims = [f"dim_{k}" for k in range(len(self.shape))]
        how = {"dtype": self.dtype, "fill_value": missing(self.dtype), "dimension_names": dims}
        return new_array(Files(lambda key: read(self.location, chunks[key])), ARRAY, self.shape, **how)

    def __getitem__(self, index: Any) -> Any:
        return self.array[index]

    def __array__(self, *_how: Any, **_named: Any) -> NDArray[Any]:
        return np.asarray(self.array[...])

    def to_xarray(self) -> "xr.Variable":
        """Return the array as xarray has arrays of files."""
        import xarray as xr

        dataset: xr.Dataset = xr.open_zarr(self.array.store, chunks=None, consolidated=False)
        return dataset[ARRAY].variable


class Files(dict[str, Any]):
    """Files in memory, but for those that ``read`` returns as they are used; it raises KeyError for others."""

    def __init__(self, read: Callable[[str], bytes]) -> None:
        super().__init__()
        self._read = read

    def __missing__(self, key: str) -> Any:
        from zarr.buffer import cpu

        return cpu.Buffer.from_bytes(self._read(key))


def read(location: Location, reference: bytes) -> bytes:
    """Return the content of a chunk; raises SweepError where it is missing, damaged or cannot be read."""
    file = file_of(reference)
    with reading(location):
        try:
            return integrity.whole(location.get(file), reference.hex())
        except ValueError as error:
            raise SweepError(f"{file} cannot be read: {error}", str(location)) from error
