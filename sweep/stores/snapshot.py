"""The labelled dataset as files, and back: readers see each writing of it, a generation, whole or not at all.

An array's chunks can have two sets of names, by two encodings of Zarr's specification, and each generation that changes
the array uses the set that the last one does not.  So the files of the last generation stay as they are until the root
document, replaced in one step, names those of the new one; a reader who opened the last one can read on until the
generation after next begins.
"""

import itertools
import json
import math
import re
import sys
import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from zarr.buffer import cpu
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from linksweep.sweep.contract.reducer import EXACT_INT
from linksweep.sweep.stores.integrity import (
    ANOTHER,
    CHUNKS,
    LEDGER_THEN,
    MOST_VALUES,
    REVISION,
    SEAL,
    STORE,
    DamagedError,
    checksum,
    problem_of,
    sealed,
    unsealed,
)

if TYPE_CHECKING:
    import xarray as xr

FILL = "_FillValue"

MISSING_INT = int(np.iinfo(np.int64).min)
"""What a file has in place of a missing integer or time, and says so: `FILL`."""

SINCE = {"units": "nanoseconds since 1970-01-01", "calendar": "proleptic_gregorian"}
TIMES: Mapping[str, Any] = {**SINCE, "dtype": "int64", FILL: MISSING_INT}
"""The encoding of times, to the last nanosecond."""


class _DaskArrays:
    """Replaces xarray's record of a module of arrays: has the class if it was imported, and imports it for the rest."""

    @property
    def type(self) -> tuple[type, ...]:
        module = sys.modules.get("dask.array")
        return () if module is None or not hasattr(module, "Array") else (module.Array,)

    def __getattr__(self, name: str) -> Any:
        from xarray.namedarray.pycompat import DuckArrayModule

        return getattr(DuckArrayModule("dask"), name)


def dask_arrays_only_where_imported() -> None:
    """Keep xarray from importing dask.array only to see that an array is not one of Dask's."""
    from xarray.namedarray import pycompat

    # Private: saves a quarter of the time of `sweep show`, since no array is Dask's where nobody has imported it.
    # Since pydata/xarray#7179 other imports of xarray wait until they are needed.
    known: Any = getattr(pycompat, "_cached_duck_array_modules", {})  # a version without it does this in another way
    known.setdefault("dask", _DaskArrays())


@dataclass(frozen=True)
class Encoded:
    """An array as Zarr stores it: its document, and the contents of its chunks by their places."""

    document: dict[str, Any]
    chunks: dict[tuple[int, ...], bytes]

    def digest(self) -> bytes:
        """Return a digest of the array, whatever the names of its chunks."""
        plain = {**self.document, "chunk_key_encoding": None}
        found = blake2b(json.dumps(plain, sort_keys=True).encode())
        found.update("".join(self.checksums()).encode())
        return found.digest()

    def checksums(self) -> list[str]:
        """Return the checksums of its chunks, in the order of `chunk_places`."""
        return [checksum(self.chunks[place]) for place in chunk_places(self.document)]

    def named(self, encoding: int) -> "Encoded":
        """Return the same array with its chunks under one of the two sets of names."""
        return replace(self, document={**self.document, "chunk_key_encoding": ENCODINGS[encoding]})

    def files(self, name: str) -> dict[str, bytes]:
        """Return the contents of its chunks by the names of their files."""
        return {chunk_key(name, self.document, place): content for place, content in self.chunks.items()}


def encode(dataset: "xr.Dataset") -> tuple[dict[str, Any], dict[str, Encoded]]:
    """Return the attributes and the arrays of a dataset; every chunk has a checksum, and none is left out for being
    empty, so that a missing one must have been lost.
    """
    files: dict[str, Any] = {}
    encoding: dict[Any, dict[str, Any]] = {}
    for name, variable in dataset.variables.items():
        encoding[name] = {"compressors": [ZstdCodec(level=1), Crc32cCodec()], "chunks": chunk_shape(variable)}
        if variable.dtype.kind == "M":
            encoding[name] |= TIMES
        elif FILL in variable.encoding:
            encoding[name][FILL] = variable.encoding[FILL]
    dataset.drop_encoding().to_zarr(
        MemoryStore(files), mode="w", consolidated=False, zarr_format=3, encoding=encoding, write_empty_chunks=True
    )
    contents = {key: bytes(buffer.to_bytes()) for key, buffer in files.items()}
    arrays = {}
    for name in map(str, dataset.variables):
        document = json.loads(contents[f"{name}/zarr.json"])
        chunks = {place: contents[chunk_key(name, document, place)] for place in chunk_places(document)}
        arrays[name] = Encoded(document, chunks)
    return json.loads(contents["zarr.json"])["attributes"], arrays


def decode(root: Mapping[str, Any], contents: Mapping[str, bytes | None]) -> "xr.Dataset":
    """Return the dataset of a root document and the contents of `chunk_keys`, in memory.

    Raises ValueError that names a file which is missing or not what the root document means.
    """
    import xarray as xr

    dask_arrays_only_where_imported()
    if damaged := damaged_chunks(root, contents):
        raise DamagedError(damaged)
    files: dict[str, Any] = {
        key: cpu.Buffer.from_bytes(content) for key, content in contents.items() if content is not None
    }
    files["zarr.json"] = cpu.Buffer.from_bytes(json.dumps(root).encode())
    try:
        with warnings.catch_warnings():  # zarr-python#3709: consolidated metadata is not in the v3 specification yet
            warnings.filterwarnings("ignore", message="Consolidated metadata")
            opened = xr.open_zarr(MemoryStore(files, read_only=True), chunks=None, consolidated=True)
            dataset: xr.Dataset = opened.load()
            gaps = [n for n, d in arrays_of(root).items() if d["data_type"] == "int64" and dataset[n].dtype.kind == "f"]
            if any((np.abs(dataset[name].values) >= EXACT_INT).any() for name in gaps):  # xarray has rounded them
                stored = xr.open_zarr(MemoryStore(files, read_only=True), chunks=None, mask_and_scale=False)
                dataset = dataset.assign({n: dataset[n].copy(data=with_gaps(stored[n].values)) for n in gaps})
    except Exception as error:  # of forged documents: each codec of Zarr raises its own
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error
    for name in (CHUNKS, LEDGER_THEN, STORE):
        dataset.attrs.pop(name, None)
    return dataset


def with_gaps(whole: NDArray[np.int64]) -> NDArray[Any]:
    """Return integers with NaN in place of missing ones: floats, or objects where a float would round one."""
    missing = whole == MISSING_INT
    floats = np.where(missing, np.nan, whole)
    return np.where(missing, np.nan, whole.astype(object)) if (np.abs(floats) >= EXACT_INT).any() else floats


def damaged_chunks(root: Mapping[str, Any], contents: Mapping[str, bytes | None]) -> dict[str, str]:
    """Return what is wrong, by file, with the ``contents`` of files that `chunk_keys` names."""
    checksums = chunk_checksums(root)
    return {key: text for key, content in contents.items() if (text := problem_of(content, checksums.get(key)))}


def chunk_checksums(root: Mapping[str, Any]) -> dict[str, str]:
    """Return the checksum of each chunk by the name of its file."""
    by_name = json.loads(root["attributes"].get(CHUNKS, "{}"))
    return {
        chunk_key(name, document, place): checksum
        for name, document in arrays_of(root).items()
        if name in by_name
        for place, checksum in zip(chunk_places(document), by_name[name], strict=True)
    }


def array_document(content: bytes | None, file: str, root: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document that a file ``NAME/zarr.json`` holds, which is for those who read without the root document;
    it may be of a writing that a root document does not know yet.

    Raises ValueError where it is not what was written there, or is of an earlier writing.
    """
    document = unsealed(content, file)
    known = arrays_of(root).get(file.removesuffix("/zarr.json"))
    attributes = {key: value for key, value in document["attributes"].items() if key not in (SEAL, STORE, REVISION)}
    revision, same_store = (document["attributes"].get(key) for key in (REVISION, STORE))
    document["attributes"] = attributes
    is_later = type(revision) is int and revision > root["attributes"]["generation"]
    if same_store != root["attributes"][STORE] or not (document == known or is_later):
        raise ValueError(ANOTHER)
    return document


def described(document: Mapping[str, Any], file: str, attributes: Mapping[str, Any]) -> bytes:
    """Return the content of a file ``NAME/zarr.json``, written together with a root document of these attributes."""
    about = {STORE: attributes[STORE], REVISION: attributes["generation"]}
    return sealed({**document, "attributes": {**document["attributes"], **about}}, file)


def arrays_of(root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the documents of the dataset's arrays by name."""
    return dict(root.get("consolidated_metadata", {}).get("metadata", {}))


def chunk_shape(variable: "xr.Variable") -> tuple[int, ...]:
    """Return a shape for chunks of at most `MOST_VALUES` that are whole in the last dimensions: a point's values stay
    together, and a coordinate is one chunk.
    """
    shape = list(variable.shape)
    for axis in range(variable.ndim):
        rest = math.prod(shape[axis + 1 :])
        shape[axis] = max(1, min(shape[axis], MOST_VALUES // max(1, rest)))
        if shape[axis] > 1:
            break
    return tuple(shape)


ENCODINGS = [{"name": name, "configuration": {"separator": "."}} for name in ("default", "v2")]


def chunk_keys(documents: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the names of all files of chunks of arrays, by their documents."""
    return [chunk_key(name, array, place) for name, array in documents.items() for place in chunk_places(array)]


def chunk_key(name: str, document: Mapping[str, Any], place: tuple[int, ...]) -> str:
    """Return the name of a chunk's file, as the array's document asks."""
    encoding = document["chunk_key_encoding"]
    parts = [str(number) for number in place]
    if encoding["name"] == "v2":
        return f"{name}/{encoding['configuration']['separator'].join(parts) or '0'}"
    return f"{name}/{encoding['configuration']['separator'].join(['c', *parts])}"


def chunk_places(document: Mapping[str, Any]) -> Iterator[tuple[int, ...]]:
    """Yield the places of all chunks of an array."""
    chunk = document["chunk_grid"]["configuration"]["chunk_shape"]
    return itertools.product(*(range(-(-n // size)) for n, size in zip(document["shape"], chunk, strict=True)))


def leftovers(keys: Collection[str], documents: Collection[str]) -> set[str]:
    """Return the files of the dataset's arrays, and of arrays that it no longer has, among the names of all files."""
    folders: dict[str, set[str]] = {}
    for key in keys:
        folder, separator, _ = key.partition("/")
        if separator:
            folders.setdefault(folder, set()).add(key)
    chunk = re.compile(r"[^/]+/(c|c\.|\d)[\d.]*")
    known = {name for name in folders if name in documents or all(map(chunk.fullmatch, folders[name]))}
    return {key for name in known for key in folders[name]}


def encoding_of(document: Mapping[str, Any]) -> int:
    """Return which of the two sets of names an array's chunks have."""
    return int(document["chunk_key_encoding"]["name"] == "v2")
