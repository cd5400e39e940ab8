"""The ledger of finished blocks: one row of typed fields for each, with its key and its kept realisations.

Rows are in parts of some megabytes: a file of rows and, where realisations are kept, one of samples.  A file is
written once and then only removed: new rows go into a new part together with those of the last, unfinished one, which
then no longer counts.  The failed points and a copy of the root's attributes are documents beside them.  The manifest
names all files that count, with their checksums, and is written last.

Large arrays of results are written by the process that has computed one, and no other.  The files of their chunks are
encoded as those of the dataset, and have their checksums as names.  Rows refer to them; a chunk of the dataset is
another name of such a file where the place has links, else a copy.  A file to which no row refers is of a point that
was not finished, or was computed again.
"""

import json
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, islice
from typing import TYPE_CHECKING, Any

import numpy as np
from numcodecs import zstd
from numpy.typing import ArrayLike, NDArray

from linksweep.sweep.contract import NO_KEY, Array, BlockRows, Outcome, Rows, SweepError, refused
from linksweep.sweep.contract.rows import KEY_BYTES, REFERENCE, absent, chunk_grid, chunk_shape, converted
from linksweep.sweep.stores import integrity
from linksweep.sweep.stores.integrity import MANIFEST, ROOT, STORE, File, LedgerPart, Manifest, noting
from linksweep.sweep.stores.location import Location, located, reading, writing

if TYPE_CHECKING:
    import xarray as xr
    import zarr

CODECS = ({"name": "zstd", "configuration": {"level": 1}}, {"name": "crc32c"})

# Two sets of names that chunks can have.
CHUNK_NAMES = ({"name": "default", "separator": "."}, {"name": "v2", "separator": "."})

FOLDER = MANIFEST.rpartition("/")[0]

FILE = re.compile(rf"{FOLDER}/large\.[0-9a-f]{{32}}")

ARRAY = "array"


def file_of(reference: bytes) -> str:
    """Return the name of the file of a chunk."""
    return f"{FOLDER}/large.{reference.hex()}"


def chunk_name(array: str, names: Mapping[str, str], place: tuple[int, ...]) -> str:
    """Return the name of a chunk of an array, by one of `CHUNK_NAMES`."""
    return f"{array}/{'c.' if names is CHUNK_NAMES[0] else ''}{'.'.join(map(str, place))}"


def new_array(files: dict[str, Any], name: str, values: "NDArray[Any] | Stored", **how: Any) -> "zarr.Array[Any]":
    """Return a new array of Zarr, encoded as all of a store, whose files are put among others in memory; those of
    values that are stored are not written.
    """
    import zarr
    from zarr.storage import MemoryStore

    how = {"chunk_key_encoding": CHUNK_NAMES[0], "chunks": chunk_shape(values.shape), "compressors": CODECS, **how}
    # with its data: a second call of Zarr takes a sixth of the time to encode the results of a short run
    how |= {"shape": values.shape, "dtype": values.dtype} if isinstance(values, Stored) else {"data": values}
    return zarr.create_array(MemoryStore(files), name=name, config={"write_empty_chunks": True}, **how)


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
    new_array(files, ARRAY, array, fill_value=absent(array.dtype))
    chunks: list[bytes] = []
    for place in np.ndindex(chunk_grid(array.shape)):
        content = files.pop(chunk_name(ARRAY, CHUNK_NAMES[0], place)).to_bytes()
        chunks.append(bytes.fromhex(integrity.checksum(content)))
        location.put(file_of(chunks[-1]), content)
    return np.array(chunks, dtype=REFERENCE)


def written_if_seen(place: str, store_id: str, outcomes: dict[int, Outcome]) -> dict[int, Outcome]:
    """Return outcomes as `written`, if the store with this identity is to be seen at the place from here; as they are
    where it is not, or cannot be written.
    """
    if any(getattr(one.layout, "large", ()) for one in outcomes.values()):
        # Each time: the store may be moved, and must not be begun anew at its old place.
        with suppress(SweepError, OSError, ValueError, LookupError, TypeError):
            location = located(place)
            if json.loads(location.get(ROOT) or b"")["attributes"][STORE] == store_id:
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
    def nbytes(self) -> int:
        """The bytes of references, which are all that is in memory."""
        return self.chunks.nbytes

    def used(self) -> set[bytes]:
        """Return the references to its chunks."""
        return {bytes(chunk) for chunk in self.chunks.reshape(-1).tolist()} - {bytes(REFERENCE.itemsize)}

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
        how = {"fill_value": absent(self.dtype), "dimension_names": dims}
        return new_array(Files(self.location, chunks, {}), ARRAY, self, **how)

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
    """Files in memory, by their ``contents``, but for ``chunks`` of a store, by their references, which are read as
    they are used.
    """

    def __init__(self, location: Location, chunks: Mapping[str, bytes], contents: Mapping[str, bytes]) -> None:
        from zarr.buffer import cpu

        self._location, self._chunks, self._buffer = location, chunks, cpu.Buffer.from_bytes
        super().__init__({file: self._buffer(content) for file, content in contents.items()})

    def __missing__(self, key: str) -> Any:
        return self._buffer(read_chunk(self._location, self._chunks[key]))


def read_chunk(location: Location, reference: bytes) -> bytes:
    """Return the content of a chunk; raises SweepError where it is missing, damaged or cannot be read."""
    file = file_of(reference)
    with reading(location), refused(ValueError, said=f"{file} cannot be read: ", where=location):
        return integrity.whole_chunk(location.get(file), reference.hex())


# Bytes from which on a part is finished: a compromise between few files for many blocks and what each flush writes
# again.
PART_BYTES = 2**22

# Parts whose samples are kept in memory for those who read them more or less in order.
RECENT = 4

# Bytes of rows and samples that may wait for the next flush, which all go into one part.
MOST_UNWRITTEN = 2**24

# The most failed points whose traceback is kept.
MAX_TRACEBACKS = 1000

CHANGED = "its ledger was removed, or changed by others, during this run"

REPAIR = "`sweep check STORE --repair` repairs what can be repaired"

# The record of a failed point: kind, message, traceback, host, when.
Record = dict[str, str]

# Rows with their keys, and the samples of them all one after the other.
Blocks = tuple[NDArray[Any], NDArray[Any]]


def damage(location: Location, files: Mapping[str, str]) -> SweepError:
    """Return the error for files of a ledger that are not what was written, by their names with what is wrong."""
    problems = [f"{file} is damaged ({problem})" for file, problem in files.items()]
    problems[-1] += f"; {REPAIR}, and the next `sweep run` computes again what is lost"
    return SweepError(problems, str(location))


class Ledger:
    """Knows the row of every finished block, and appends others; raises SweepError where files are damaged, and
    where they cannot be read or written.
    """

    def __init__(self, location: Location, of_root: Manifest, writes: bool = False) -> None:
        """Read all but the samples; ``damaged`` has what is wrong with which file, and ``is_ahead`` says whether there
        are files that the manifest does not know, since a run ended while it wrote them.

        ``of_root`` is the manifest that the root document knows; only who holds the lock ``writes``.
        """
        self._location, self.writes = location, writes
        self._unwritten_files: dict[str, bytes] = {}  # of one that only looks
        self.damaged: dict[str, str] = {}
        with reading(location):
            self.keys = frozenset(location.keys())
            content = location.get(MANIFEST)
        # Manifests of ours: any other content means that others write.
        self._contents: tuple[bytes | None, ...] = (content,)
        self.manifest = of_root
        with noting(self.damaged, MANIFEST):
            self.manifest = integrity.newest(content, of_root)
        self.dtype, self.samples_width = integrity.row_type(self.manifest.row), self.manifest.samples_width
        self.parts = list(self.manifest.parts)
        missing = {path_of(part.samples) for part in self.parts if part.samples} - self.keys
        self.damaged |= dict.fromkeys(missing, integrity.MISSING)
        documents = self.manifest.documents
        with reading(location):
            contents = location.get_all(map(path_of, [*documents.values(), *(part.rows for part in self.parts)]))
        self._documents: dict[str, dict[str, Any]] = {}
        self.failures: dict[bytes, Record] = {}
        for kind, file in documents.items():
            with noting(self.damaged, path_of(file)):
                self._documents[kind] = dict(json.loads(integrity.whole(contents[path_of(file)], file.checksum)))
        with noting(self.damaged, path_of(documents.get("failures"))):
            self.failures = _failures(self._documents.get("failures", {"failures": {}}))
        records = self._records(contents, self.damaged)
        # Kept for the one who opens the store; gone with the first new rows, since it may be as large as all results.
        self._rows: Rows | None = np.ascontiguousarray(records["row"])
        self.rows = BlockRows(records["key"].tolist())
        self.chunks = references(records["row"])
        self.damaged |= dict.fromkeys({*map(file_of, self.chunks)} - self.keys, integrity.MISSING)
        self._seconds = [records["seconds"].copy()]
        self._new: list[Blocks] = []
        self._unwritten = 0
        self._new_documents: set[str] = set()
        self._recent: dict[str, tuple[Blocks, NDArray[np.uint64]]] = {}
        ours = re.compile(rf"{FOLDER}/(rows|samples|failures|study)\.\d+\.\d+")
        # Left by a run that was killed.
        self._old = {key for key in self.keys if ours.fullmatch(key)} - set(self.files)
        self.is_ahead = bool(self._old)

    @property
    def copy(self) -> dict[str, Any] | None:
        """The copy of what the root document says of the study, None where there is none."""
        return self._documents.get("study")

    @property
    def files(self) -> list[str]:
        """The names of the files that count."""
        files = [*self.manifest.documents.values(), *(file for part in self.manifest.parts for file in part.files)]
        return [*([MANIFEST] if self.manifest.revision else []), *map(path_of, files)]

    def read(self) -> Rows:
        """Return all rows; `rows` has the place of each block in them."""
        if self.writes:
            self.flush()
        if self._rows is None:
            damaged: dict[str, str] = {}
            with reading(self._location):
                contents = self._location.get_all([path_of(part.rows) for part in self.parts]) | self._unwritten_files
            self._rows = np.ascontiguousarray(self._records(contents, damaged)["row"])
            if damaged:
                raise damage(self._location, damaged)
        return self._rows

    def seconds(self) -> Array:
        """Return how long each row took to compute, which says nothing of what is in it."""
        return np.concatenate(self._seconds)

    def samples(self, key: bytes) -> Array:
        """Return the kept samples of a finished block that was flushed, (realisations, width)."""
        # Samples have no index: the key of a block says how many realisations it has, and a lost row has the key zero.
        starts = [0, *accumulate(part.records for part in self.parts)]
        number = bisect_right(starts, self.rows[key]) - 1
        _, samples = self._part(self.parts[number])
        ends = self._recent[self.parts[number].rows.name][1]
        row = self.rows[key] - starts[number]
        return np.asarray(samples[ends[row - 1] if row else 0 : ends[row]])

    def verify(self) -> None:
        """Add to ``damaged`` the samples and chunks that are not what was written; opening has checked the rest."""
        checksums = {file_of(chunk): chunk.hex() for chunk in self.chunks}
        checksums |= {path_of(part.samples): part.samples.checksum for part in self.parts if part.samples}
        for file, checksum in checksums.items():
            with reading(self._location), noting(self.damaged, file):
                integrity.whole(self._location.get(file), checksum)

    def append(
        self, keys: Sequence[bytes], rows: Rows, samples: Sequence[Array] = (), seconds: ArrayLike = np.nan
    ) -> None:
        """Add finished blocks, with their samples if these are kept, and how long they took; durable after `flush`."""
        if not keys:
            return
        if (half := len(keys) // 2) and rows.nbytes + sum(one.nbytes for one in samples) > MOST_UNWRITTEN:
            each = np.broadcast_to(seconds, len(keys))
            for some in (slice(half), slice(half, None)):  # else a file might be larger than files may be
                self.append(keys[some], rows[some], samples[some], each[some])
            return
        records = np.zeros(len(keys), dtype=_record_type(self.dtype))
        records["key"] = np.frombuffer(b"".join(keys), dtype=f"V{KEY_BYTES}")
        records["row"], records["seconds"] = rows, seconds
        self._seconds.append(records["seconds"].copy())
        self._new.append((records, np.concatenate([np.zeros((0, self.samples_width)), *samples])))
        self.rows.extend(keys)
        self.chunks |= references(rows)
        self._rows = None
        self._unwritten += sum(array.nbytes for array in self._new[-1])
        if self._unwritten > MOST_UNWRITTEN:
            self.flush()

    def fail(self, digest: bytes, record: Record) -> None:
        """Remember that a point failed; durable after `flush`."""
        self.failures[digest] = record if len(self.failures) < MAX_TRACEBACKS else {**record, "traceback": ""}
        self.put("failures", {})

    def clear_failures(self, digests: Iterable[bytes]) -> None:
        """Forget failures of points, if there are any, so that they are computed again; durable after `flush`."""
        for digest in self.failures.keys() & set(digests):
            del self.failures[digest]
            self.put("failures", {})

    def retype(self, dtype: np.dtype[np.void], samples_width: int, drop: Iterable[bytes]) -> None:
        """Give rows another type, those that are there without the blocks to ``drop``; durable after `flush`."""
        if self.writes:
            self.flush()
        revision, gone = self.manifest.revision + 1, {NO_KEY, *drop}
        before, self.parts, self.chunks = self.parts, [], set()
        for number, part in enumerate(before):
            # One by one: samples may not fit into memory together.
            records, samples = self._part(part)
            # A dropped row stays, with the key zero.
            changed = np.zeros(len(records), dtype=_record_type(dtype))
            kept = np.array([key.tobytes() not in gone for key in records["key"]], dtype=bool)
            changed["key"][kept], changed["seconds"] = records["key"][kept], records["seconds"]
            if kept.any():  # else results may be of another kind
                changed["row"][kept] = converted(records["row"][kept], dtype)
            self.chunks |= references(changed["row"])
            samples = samples[np.repeat(kept, _counts(records).astype(np.intp))] if part.samples else samples
            samples = samples.reshape(len(samples), samples_width)
            self.parts.append(self._put((changed, samples), revision, 10**6 + number))
        for key in gone & self.rows.keys():
            del self.rows[key]
        self.dtype, self.samples_width, self._rows = dtype, samples_width, None

    def put(self, kind: str, attributes: Mapping[str, Any]) -> None:
        """Replace a document; it counts after the next `flush`."""
        self._documents[kind] = dict(attributes)
        self._new_documents.add(kind)

    def is_unchanged(self) -> bool:
        """Return whether the manifest is as it was read or written last; raises OSError."""
        return self._location.get(MANIFEST) in self._contents

    def flush(self, *, again: bool = False) -> None:
        """Make everything durable, the manifest last, that too if nothing is new but ``again`` is set.

        Raises SweepError too where others have changed or removed the ledger meanwhile.
        """
        if self._new or self._new_documents or self.parts != self.manifest.parts or again:
            with self.writing():
                self._flush()

    def writing(self) -> AbstractContextManager[None]:
        """Return a context as `writing` in which the store is written; nobody has one who only looks at it."""
        if not self.writes:
            raise RuntimeError("a store that was opened to look at is not written")
        return writing(self._location)

    def _flush(self) -> None:
        if not self.is_unchanged():
            raise SweepError(CHANGED, str(self._location))
        if "failures" in self._new_documents:
            self._documents["failures"] = {"failures": {one.hex(): record for one, record in self.failures.items()}}
        retyped = {path_of(file) for part in self.parts for file in part.files}
        revision, before = self.manifest.revision + 1, {*self.files, *retyped}
        parts = self._with_new(revision)
        documents: Any = {k: file for k, file in self.manifest.documents.items() if k in self._documents}
        for kind in self._new_documents:
            # Under new names: the old ones count until the manifest is replaced.
            documents[kind] = self._file(f"{kind}.{revision}.0", json.dumps(self._documents[kind]).encode())
        manifest = Manifest(
            store=self.manifest.store,
            revision=revision,
            row=json.loads(json.dumps(self.dtype.descr if self.dtype.names else [])),
            samples_width=self.samples_width,
            parts=parts,
            documents=documents,
        )
        content = manifest.sealed()
        # It may be written although the answer is lost.
        self._contents = (*self._contents, content)
        self._location.put(MANIFEST, content)
        # Only now do the new files count: after an error all of this is written again.
        self.manifest, self._contents, self.parts = manifest, (content,), parts
        self._new, self._unwritten, self._new_documents = [], 0, set()
        self._delete_old()
        # Kept until the next flush, for those who read the store meanwhile.
        self._old = before - set(self.files)

    def tidy(self) -> None:
        """Remove the files that did not count any more at the last flush, and chunks to which no row refers: at the end
        of a run, since workers write them before their rows come.
        """
        with self.writing():
            self._delete_old()
            there = self._location.keys(f"{FOLDER}/") if self.chunks else ()
            self._location.delete(*({key for key in there if FILE.fullmatch(key)} - {*map(file_of, self.chunks)}))

    def _delete_old(self) -> None:
        self._location.delete(*(self._old - set(self.files)))
        self._old = set()

    def mend(self, damaged: Iterable[str]) -> None:
        """Write a ledger that is whole, without the parts, chunks and documents in damaged files: what was in them is
        missing.

        The rows of a lost part are zero from now on, so that all others keep their numbers.
        """
        for number, part in enumerate(self.parts):
            if not {path_of(file) for file in part.files}.isdisjoint(damaged):
                empty = np.zeros(part.records, dtype=_record_type(self.dtype)), np.zeros((0, self.samples_width))
                self.parts[number] = self._put(empty, self.manifest.revision + 1, 10**6 + number)
        for kind, file in self.manifest.documents.items():
            if path_of(file) in damaged:
                self._documents.pop(kind, None)
        if lost := {chunk for chunk in self.chunks if file_of(chunk) in damaged}:
            keys, rows = self.rows.keys_of_rows(), self.read()
            gone = [key for number, key in enumerate(keys) if references(rows[number : number + 1]) & lost]
            self.retype(self.dtype, self.samples_width, gone)
        self.flush(again=True)

    def _with_new(self, revision: int) -> list[LedgerPart]:
        """Return all parts after writing one with the new rows, which takes up the last one unless that is finished."""
        if not self._new:
            return self.parts
        # A part below its size is written again with what is new, so that few files hold many small flushes.
        is_open = bool(self.parts) and sum(file.size for file in self.parts[-1].files) < PART_BYTES
        kept = self.parts[:-1] if is_open else self.parts
        blocks = [*map(self._part, self.parts[len(kept) :]), *self._new]
        records, samples = (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
        return [*kept, self._put((records, samples), revision, 0)]

    def _put(self, blocks: Blocks, revision: int, number: int) -> LedgerPart:
        records, samples = blocks
        rows = self._file(f"rows.{revision}.{number}", _packed(records), pack=True)
        kept = self._file(f"samples.{revision}.{number}", samples.tobytes(), pack=True) if samples.size else None
        part = LedgerPart(records=len(records), rows=rows, samples=kept)
        self._remember(part, blocks)
        return part

    def _file(self, name: str, content: bytes, pack: bool = False) -> File:
        written = bytes(zstd.compress(content, 1)) if pack else content
        file = File(name=name, checksum=integrity.checksum(written), size=len(content))
        if self.writes:
            with self.writing():
                self._location.put(path_of(file), written)
        else:
            self._unwritten_files[path_of(file)] = written
        return file

    def _raw(self, file: File) -> bytes:
        name = path_of(file)
        return _raw(file, self._unwritten_files.get(name) or self._location.get(name))

    def _records(self, contents: dict[str, bytes | None], damaged: dict[str, str]) -> NDArray[Any]:
        """Return all rows with their keys; those of ``damaged`` files, which are added to that, are zero."""
        records = np.zeros(sum(part.records for part in self.parts), dtype=_record_type(self.dtype))
        start = 0
        for part in self.parts:
            with noting(damaged, path_of(part.rows)):
                content = _raw(part.rows, contents.pop(path_of(part.rows)))
                records[start : start + part.records] = _unpacked(content, part.records, self.dtype)
            start += part.records
        return records

    def _part(self, part: LedgerPart) -> Blocks:
        """Return the rows and samples of a part that was written."""
        if part.rows.name in self._recent:
            return self._recent[part.rows.name][0]
        damaged: dict[str, str] = {}
        samples = np.zeros((0, self.samples_width))
        with reading(self._location), noting(damaged, path_of(part.rows)):
            records = _unpacked(self._raw(part.rows), part.records, self.dtype)
        with reading(self._location), noting(damaged, path_of(part.samples)):
            if part.samples is not None and not damaged:
                shape = int(_counts(records).sum()), self.samples_width
                samples = np.frombuffer(self._raw(part.samples)).reshape(shape)
        if damaged:
            raise damage(self._location, damaged)
        self._remember(part, (records, samples))
        return records, samples

    def _remember(self, part: LedgerPart, blocks: Blocks) -> None:
        while len(self._recent) >= RECENT:
            del self._recent[next(iter(self._recent))]
        # Where the samples of each row end: added up once, not for each block that is read.
        self._recent[part.rows.name] = blocks, np.cumsum(_counts(blocks[0]))


def read_keys(location: Location, parts: Sequence[LedgerPart]) -> list[tuple[NDArray[np.uint64], Array]]:
    """Return the keys of the rows of each part, (records, 4) numbers of 8 bytes, zeros for a row that was lost, and how
    long each row took.

    Nothing else of the rows is looked at.  Raises ValueError where a file is missing or not what was written.
    """
    contents = location.get_all([path_of(part.rows) for part in parts])
    nothing = np.dtype([])
    rows = [_unpacked(_raw(part.rows, contents.pop(path_of(part.rows))), part.records, nothing) for part in parts]
    return [(one["key"].copy().view("<u8").reshape(-1, KEY_BYTES // 8), one["seconds"]) for one in rows]


def read_failures(location: Location, manifest: Manifest) -> dict[bytes, Record]:
    """Return the records of failed points by their digests; raises ValueError as `read_keys`."""
    if (file := manifest.documents.get("failures")) is None:
        return {}
    return _failures(json.loads(integrity.whole(location.get(path_of(file)), file.checksum)))


def _failures(document: Mapping[str, Any]) -> dict[bytes, Record]:
    recorded = integrity.checked(integrity.Failures, document).failures
    return {bytes.fromhex(digest): record for digest, record in recorded.items()}


def path_of(file: File | None) -> str:
    """Return the name of a file of the ledger in its store."""
    return "" if file is None else f"{FOLDER}/{file.name}"


def _record_type(dtype: np.dtype[np.void]) -> np.dtype[np.void]:
    return np.dtype([("key", f"V{KEY_BYTES}"), ("seconds", "<f8"), ("row", dtype)])


def _columns(records: NDArray[Any]) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
    """Return the keys, seconds and fields of rows, as views: those of fixed width, and those of texts."""
    row = records["row"]
    columns = [records["key"], records["seconds"], *(row[name] for name in row.dtype.names or ())]
    return [c for c in columns if not c.dtype.hasobject], [c for c in columns if c.dtype.hasobject]


def _packed(records: NDArray[Any]) -> bytes:
    """Return rows with their keys as bytes: column by column, then all texts as JSON."""
    fixed, texts = _columns(records)
    # A lost row has 0 in place of a text.
    listed = [text or "" for column in texts for text in column.reshape(-1).tolist()]
    # Column by column, since bytes that are alike stand together there and compress.
    return b"".join([*(column.tobytes() for column in fixed), *([json.dumps(listed).encode()] if texts else [])])


def _unpacked(content: bytes, count: int, dtype: np.dtype[np.void]) -> NDArray[Any]:
    """Return so many rows of a type with their keys; raises ValueError for bytes that are not these."""
    records = np.zeros(count, dtype=_record_type(dtype))
    fixed, texts = _columns(records)
    at = 0
    for column in fixed:
        column[...] = np.frombuffer(content, column.dtype, column.size, at).reshape(column.shape)
        at += column.nbytes
    listed = json.loads(content[at:]) if texts else []
    if sum(column.size for column in texts) != len(listed) or not all(isinstance(text, str) for text in listed):
        raise ValueError("it has other texts than rows")
    known: dict[str, str] = {}
    shared = (known.setdefault(text, text) for text in listed)  # equal texts are one object
    for column in texts:
        column.flat[:] = list(islice(shared, column.size))
    return records


def _raw(file: File, content: bytes | None) -> bytes:
    """Return the unpacked ``content`` of a file; raises ValueError, RuntimeError where it is not what was written."""
    packed, raw = integrity.whole(content, file.checksum), bytearray(file.size)
    if len(zstd.decompress(packed, raw)) != len(raw):
        # Of a forged file no more is unpacked than it should have.
        raise ValueError("it has fewer records than it should")
    return bytes(raw)


def _counts(records: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the realisations of blocks, from the end of their keys: catalogues, and realisations of each."""
    numbers = np.frombuffer(records["key"].tobytes(), dtype="<u4").reshape(len(records), KEY_BYTES // 4)[:, -2:]
    return numbers[:, 0].astype(np.uint64) * numbers[:, 1].astype(np.uint64)
