"""The labelled dataset as files, and back: readers see each writing of it, a generation, whole or not at all."""

import json
import math
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import TYPE_CHECKING, Any

import zarr
from zarr.buffer import cpu
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from linksweep.sweep.stores.checksums import SEAL, DamagedError, content_checksum, sealed, unsealed
from linksweep.sweep.stores.chunk_names import ENCODINGS, chunk_key, chunk_places
from linksweep.sweep.stores.document import MOST_VALUES
from linksweep.sweep.stores.manifest import ANOTHER, REVISION, STORE, checked_revision
from linksweep.sweep.stores.root import LEDGER_THEN

if TYPE_CHECKING:
    import xarray as xr

CHECKSUMS = "chunk_checksums"
"""The attribute of the root document with the checksums of the chunks that it refers to."""

CHUNK_VALUES = MOST_VALUES
"""The most values of a chunk, 8 MB of floats.  Values are counted and not bytes, so that results on the same axes have
the same chunks whatever their types, as Dask wants.
"""

TIMES = {"units": "nanoseconds since 1970-01-01", "calendar": "proleptic_gregorian", "dtype": "int64"}
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
        return [content_checksum(self.chunks[place]) for place in chunk_places(self.document)]

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
    checksums = chunk_checksums(root)
    if any(not _is_meant(content, checksums.get(key)) for key, content in contents.items()):
        raise DamagedError(damaged_chunks(root, contents))
    files: dict[str, Any] = {
        key: cpu.Buffer.from_bytes(content) for key, content in contents.items() if content is not None
    }
    files["zarr.json"] = cpu.Buffer.from_bytes(json.dumps(root).encode())
    try:
        with warnings.catch_warnings():  # zarr-python#3709: consolidated metadata is not in the v3 specification yet
            warnings.filterwarnings("ignore", message="Consolidated metadata")
            opened = xr.open_zarr(MemoryStore(files, read_only=True), chunks=None, consolidated=True)
            dataset: xr.Dataset = opened.load()
    except Exception as error:  # each codec of Zarr raises its own
        damaged = damaged_chunks(root, contents)
        raise (DamagedError(damaged) if damaged else ValueError(str(error))) from error
    for name in (CHECKSUMS, LEDGER_THEN, STORE):
        dataset.attrs.pop(name, None)
    return dataset


def damaged_chunks(root: Mapping[str, Any], contents: Mapping[str, bytes | None]) -> dict[str, str]:
    """Return what is wrong, by file, with the ``contents`` of files that `chunk_keys` names."""
    damaged: dict[str, str] = {}
    checksums = chunk_checksums(root)
    for name, document in arrays_of(root).items():
        every = {chunk_key(name, document, place): place for place in chunk_places(document)}
        places = {key: place for key, place in every.items() if key in contents}
        if not places:
            continue
        files: dict[str, Any] = {"zarr.json": cpu.Buffer.from_bytes(json.dumps(document).encode())}
        try:
            array = zarr.open_array(MemoryStore(files), mode="r")
        except Exception as error:  # a document that was forged
            damaged |= dict.fromkeys(places, " ".join(str(error).split()) or type(error).__name__)
            continue
        for key, place in places.items():
            if (content := contents[key]) is None:
                damaged[key] = "it is missing"
                continue
            files[key.removeprefix(f"{name}/")] = cpu.Buffer.from_bytes(content)
            try:
                _ = array.blocks[place] if place else array[...]
            except Exception as error:  # each codec of Zarr raises its own
                damaged[key] = " ".join(str(error).split()) or type(error).__name__
            else:
                if not _is_meant(content, checksums.get(key)):
                    damaged[key] = "it is whole, but not the chunk that the root document means"
    return damaged


def _is_meant(content: bytes | None, checksum: str | None) -> bool:
    return content is not None and checksum == content_checksum(content)


def chunk_checksums(root: Mapping[str, Any]) -> dict[str, str]:
    """Return the checksum of each chunk by the name of its file."""
    by_name = json.loads(root["attributes"].get(CHECKSUMS, "{}"))
    return {
        chunk_key(name, document, place): checksum
        for name, document in arrays_of(root).items()
        if name in by_name
        for place, checksum in zip(chunk_places(document), by_name[name], strict=True)
    }


def root_document(attributes: Mapping[str, Any], documents: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document of the store's root: attributes, and a copy of the documents of all arrays of the dataset."""
    copies = {"kind": "inline", "must_understand": False, "metadata": dict(documents)}
    return {"zarr_format": 3, "node_type": "group", "attributes": dict(attributes), "consolidated_metadata": copies}


def array_document(content: bytes | None, file: str, root: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document that a file ``NAME/zarr.json`` holds, which is for those who read without the root document;
    it may be of a writing that a root document does not know yet.

    Raises ValueError where it is not what was written there, or is of an earlier writing.
    """
    document = unsealed(content, file)
    known = arrays_of(root).get(file.removesuffix("/zarr.json"))
    told = document["attributes"]
    revision = checked_revision(told, root["attributes"][STORE], 1)
    document["attributes"] = {key: value for key, value in told.items() if key not in (SEAL, STORE, REVISION)}
    if document != known and revision <= root["attributes"]["generation"]:
        raise ValueError(ANOTHER)
    return document


def described(document: Mapping[str, Any], file: str, attributes: Mapping[str, Any]) -> bytes:
    """Return the content of a file ``NAME/zarr.json``, written together with a root document of these attributes."""
    own = {STORE: attributes[STORE], REVISION: attributes["generation"]}
    return sealed({**document, "attributes": {**document["attributes"], **own}}, file)


def arrays_of(root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the documents of the dataset's arrays by name."""
    return dict(root.get("consolidated_metadata", {}).get("metadata", {}))


def chunk_shape(variable: "xr.Variable") -> tuple[int, ...]:
    """Return a shape for chunks of at most `CHUNK_VALUES` that are whole in the last dimensions: a point's values stay
    together, and a coordinate is one chunk.
    """
    shape = list(variable.shape)
    for axis in range(variable.ndim):
        rest = math.prod(shape[axis + 1 :])
        shape[axis] = max(1, min(shape[axis], CHUNK_VALUES // max(1, rest)))
        if shape[axis] > 1:
            break
    return tuple(shape)
