"""The ledger of finished blocks: one row of typed fields for each, with its key and its kept realisations.

Three columns of records, in files that are written once and then only removed: ``rows`` (key of the block, where its
samples begin, what it left), ``samples`` (realisations, where they are kept) and ``texts`` (bytes; a text is a place in
them).  New records go into new files together with those of the last, unfinished one, which then no longer counts.  The
failed points and a copy of the root's attributes are documents beside them.  The manifest names all files that count,
with their checksums, and is written last.
"""

import json
import re
from array import array
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numcodecs import zstd
from numpy.typing import NDArray

from linksweep.sweep.contract import Array, Rows, SweepError
from linksweep.sweep.contract.block import DIGEST_BYTES, KEY_BYTES, BlockRows
from linksweep.sweep.contract.reducer import converted
from linksweep.sweep.stores.integrity import (
    MANIFEST,
    MISSING,
    MOST_BYTES,
    ROOT,
    DamagedError,
    File,
    Manifest,
    checksum,
    newest,
    noting,
    problem_of,
)
from linksweep.sweep.stores.location import Location

FOLDER = MANIFEST.rpartition("/")[0]

PART_BYTES = {"rows": 2**21, "samples": 2**22, "texts": 2**20}
"""Bytes of a file: a compromise between few files for many blocks and what each flush writes again."""

FEWEST_RECORDS = 64

TEXT = np.dtype([("start", "<u8"), ("bytes", "<u4")])
"""How a file of rows holds a text."""

TYPES = ("<f8", "<i8", "|b1", "<M8[ns]", "|O")
"""Types of the fields of a row."""

RECENT = 4
"""Files kept in memory for those who read samples more or less in order."""

MAX_TRACEBACKS, TRACEBACK_BYTES = 1000, 4096

CHANGED = "its ledger was removed, or changed by others, during this run"

Record = dict[str, str]
"""The record of a failed point: place, kind, message, traceback, host, when."""


class Column:
    """A sequence of records of one type in the files that a manifest names."""

    def __init__(self, location: Location, name: str, dtype: np.dtype[Any], files: Sequence[File]) -> None:
        """Know the records that there are; raises ValueError for files larger than any that is written."""
        self.name, self.dtype, self.files = name, dtype, list(files)
        self.size = max(FEWEST_RECORDS, PART_BYTES[name] // max(1, dtype.itemsize))
        self._location = location
        self._new: list[NDArray[Any]] = []
        self._recent: dict[str, NDArray[Any]] = {}
        self._written: list[File] | None = None
        if any(file.records * dtype.itemsize > MOST_BYTES for file in files):
            raise ValueError("files of its ledger are too large")

    @property
    def records(self) -> int:
        """How many records the files have."""
        return sum(file.records for file in self.files)

    @property
    def end(self) -> int:
        """How many records there are with those that were appended since."""
        return self.records + sum(map(len, self._new))

    @property
    def starts(self) -> list[int]:
        """The first record of each file, and the one after the last."""
        return list(accumulate((file.records for file in self.files), initial=0))

    def read(self, damaged: dict[str, str]) -> NDArray[Any]:
        """Return all records; those of ``damaged`` files, which are added to that, are zero.  Raises OSError."""
        contents = self._location.get_all([path_of(file) for file in self.files])
        records = np.zeros(self.records, dtype=self.dtype)
        for file, start in zip(self.files, self.starts, strict=False):
            with noting(damaged, path_of(file)):
                records[start : start + file.records] = self._decoded(file, contents.pop(path_of(file)))
        return records

    def verify(self, damaged: dict[str, str]) -> None:
        """Add to ``damaged`` the files that are not what was written, never with all of them in memory."""
        for file in self.files:
            if problem := problem_of(self._location.get(path_of(file)), file.checksum):
                damaged[path_of(file)] = problem

    def between(self, start: int, stop: int) -> NDArray[Any]:
        """Return some records that were flushed; raises DamagedError, OSError."""
        parts = [np.zeros(0, dtype=self.dtype)]
        for file, first in zip(self.files, self.starts, strict=False):
            if first < stop and first + file.records > start:
                parts.append(self._part(file)[max(0, start - first) : stop - first])
        return np.concatenate(parts)

    def append(self, records: NDArray[Any]) -> None:
        """Add records, which `write` will write."""
        if len(records):
            self._new.append(records)

    def write(self, revision: int) -> list[File]:
        """Return the files of all records after writing those with new ones; they count after `commit`."""
        if not self._new:
            return self.files
        kept = self.files if not self.files or self.files[-1].records >= self.size else self.files[:-1]
        tail = [self._part(file) for file in self.files[len(kept) :]]
        records = np.concatenate([*tail, *self._new])
        self._written = list(kept)
        for number, first in enumerate(range(0, len(records), self.size)):
            self._written.append(self.put(records[first : first + self.size], revision, number))
        return self._written

    def commit(self) -> None:
        """Let the files that were written count: only now, after an error all of it is written again."""
        if self._written is not None:
            self.files, self._new, self._written = self._written, [], None

    def put(self, records: NDArray[Any], revision: int, number: int) -> File:
        """Write a file of records."""
        content = bytes(zstd.compress(records.tobytes(), 1))
        file = File(name=f"{self.name}.{revision}.{number}", checksum=checksum(content), records=len(records))
        self._location.put(path_of(file), content)
        self._keep(file, records)
        return file

    def _part(self, file: File) -> NDArray[Any]:
        if file.name not in self._recent:
            self._keep(file, self._decoded(file, self._location.get(path_of(file))))
        return self._recent[file.name]

    def _keep(self, file: File, records: NDArray[Any]) -> None:
        self._recent.pop(file.name, None)
        while len(self._recent) >= RECENT:
            del self._recent[next(iter(self._recent))]
        self._recent[file.name] = records

    def _decoded(self, file: File, content: bytes | None) -> NDArray[Any]:
        """Return the records in the ``content`` of a file; raises DamagedError."""
        problem, whole = problem_of(content, file.checksum), bytearray(file.records * self.dtype.itemsize)
        if problem is None and content is not None:
            try:
                if len(zstd.decompress(content, whole)) != len(whole):
                    problem = "it has fewer records than it should"
            except (ValueError, RuntimeError) as error:  # a forged file; no more is ever unpacked than it should have
                problem = str(error)
        if problem is not None:
            raise DamagedError({path_of(file): problem})
        return np.frombuffer(whole, dtype=self.dtype)


class Ledger:
    """Knows the row of every finished block, and appends others."""

    def __init__(self, location: Location, of_root: Manifest) -> None:
        """Read all but the samples; ``damaged`` has what is wrong with which file.  Raises OSError.

        ``of_root`` is the manifest that the root document knows.
        """
        self._location = location
        self.damaged: dict[str, str] = {}
        self.keys = frozenset(location.keys())
        content = location.get(MANIFEST)
        self.manifest = of_root
        self._contents: tuple[bytes | None, ...] = (content,)
        with noting(self.damaged, MANIFEST):
            manifest = newest(content, of_root)
            self._set(manifest)
            self.manifest = manifest
        if MANIFEST in self.damaged:
            try:
                self._set(of_root)
            except (ValueError, LookupError, TypeError) as error:
                raise DamagedError({ROOT: str(error)}) from error
        self.damaged |= {path_of(f): MISSING for f in self.columns["samples"].files if path_of(f) not in self.keys}
        self._documents: dict[str, dict[str, Any]] = {}
        self._new_documents: set[str] = set()
        contents = location.get_all([path_of(file) for file in self.manifest.documents.values()])
        for kind, file in self.manifest.documents.items():
            with noting(self.damaged, path_of(file)):
                if problem := problem_of(contents[path_of(file)], file.checksum):
                    raise ValueError(problem)
                self._documents[kind] = dict(json.loads(contents[path_of(file)] or b""))
        self.failures: dict[bytes, Record] = {}
        with noting(self.damaged, path_of(self.manifest.documents.get("failures"))):
            self.failures = _failures(self._documents.get("failures", {}))
        records = self.columns["rows"].read(self.damaged)
        self._texts = self.columns["texts"].read(self.damaged).tobytes()
        self._rows: Rows | None = None
        if (records["start"] + _counts(records) * bool(self.samples_width) > self.columns["samples"].records).any():
            self.damaged[MANIFEST] = "it has fewer samples than rows"
        with noting(self.damaged, MANIFEST):
            self._rows = self._in_memory(records)
        self._starts = array("q", records["start"].astype(np.int64).tobytes())
        self.rows = BlockRows(records["key"].tobytes())
        self._changed = False
        self._old = self._strangers()  # left by a run that was killed

    def _set(self, manifest: Manifest) -> None:
        """Take the types of the columns from a manifest; raises ValueError for one that does not fit."""
        self.dtype = _dtype(manifest.row)
        self.samples_width = manifest.samples_width
        self.columns = {
            name: Column(self._location, name, dtype, manifest.columns.get(name, []))  # type: ignore[call-overload]
            for name, dtype in self._dtypes().items()
        }

    def _dtypes(self) -> dict[str, np.dtype[Any]]:
        """Return the type of a record of each column."""
        fields = [(n, TEXT if k.base.kind == "O" else k.base, k.shape) for n, k in _fields(self.dtype)]
        return {
            "rows": np.dtype([("key", f"V{KEY_BYTES}"), ("start", "<u8"), ("row", np.dtype(fields))]),
            "samples": np.dtype(("<f8", (self.samples_width,))) if self.samples_width else np.dtype("<f8"),
            "texts": np.dtype("u1"),
        }

    @property
    def copy(self) -> dict[str, Any] | None:
        """The copy of what the root document says of the study, None where there is none."""
        return self._documents.get("study")

    @property
    def files(self) -> list[str]:
        """The names of the files that count."""
        parts = [file for column in self.columns.values() for file in column.files]
        return [
            *([MANIFEST] if self.manifest.revision else []),
            *map(path_of, [*self.manifest.documents.values(), *parts]),
        ]

    @property
    def is_ahead(self) -> bool:
        """Whether there are files that the manifest does not know: a run ended while it wrote them."""
        return bool(self._strangers())

    def _strangers(self) -> set[str]:
        own = re.compile(rf"{FOLDER}/(rows|samples|texts|failures|study)\.\d+\.\d+")
        return {key for key in self.keys if own.fullmatch(key)} - set(self.files)

    def read(self) -> Rows:
        """Return all rows; `rows` has the place of each block in them.  Raises DamagedError, OSError."""
        self.flush()
        if self._rows is None:
            damaged: dict[str, str] = {}
            self._texts = self.columns["texts"].read(damaged).tobytes()
            self._rows = self._in_memory(self.columns["rows"].read(damaged))
            if damaged:
                raise DamagedError(damaged)
        return self._rows

    def samples(self, key: bytes) -> Array:
        """Return the kept samples of a finished block that was flushed, (realisations, width); raises DamagedError,
        OSError.
        """
        start = self._starts[self.rows[key]]
        count = int(_counts(np.frombuffer(key, dtype=f"V{KEY_BYTES}"))[0])
        return np.asarray(self.columns["samples"].between(start, start + count))

    def verify(self) -> None:
        """Add to ``damaged`` the samples that are not what was written; opening has checked the rest."""
        self.columns["samples"].verify(self.damaged)

    def append(self, keys: Sequence[bytes], rows: Rows, samples: Sequence[Array]) -> None:
        """Add finished blocks; durable after `flush`."""
        self._rows, self._changed = None, True
        starts = [0] * len(keys)
        if samples:
            column = self.columns["samples"]
            starts = np.cumsum([column.end, *map(len, samples)])[:-1].tolist()
            column.append(np.concatenate(samples))
        self.columns["rows"].append(self._on_disk(keys, starts, rows))
        self._starts.extend(starts)
        self.rows.extend(keys)

    def retype(self, dtype: np.dtype[np.void], samples_width: int, drop: Iterable[bytes]) -> None:
        """Give rows another type, those that are there without the blocks to ``drop``; durable after `flush`."""
        rows = converted(self.read(), dtype)
        before = {path_of(file) for name in ("rows", "texts") for file in self.columns[name].files}
        self.rows.remove(drop)
        self.dtype, self.samples_width, self._rows, self._changed = dtype, samples_width, None, True
        dtypes, samples = self._dtypes(), self.columns["samples"].files
        self.columns = {
            name: Column(self._location, name, kind, samples if name == "samples" else [])
            for name, kind in dtypes.items()
        }
        keys = self.rows.keys_of_rows()
        self.columns["rows"].append(self._on_disk(keys, self._starts, rows))
        self._old |= before

    def put(self, kind: str, attributes: Mapping[str, Any]) -> None:
        """Replace a document; it counts after the next `flush`."""
        self._documents[kind] = dict(attributes)
        self._new_documents.add(kind)
        self._changed = True

    def is_unchanged(self) -> bool:
        """Return whether the manifest is as it was read or written last; raises OSError."""
        return self._location.get(MANIFEST) in self._contents

    def flush(self, *, again: bool = False) -> None:
        """Make everything durable, the manifest last, that too if nothing is new but ``again`` is set.

        Raises OSError, and SweepError where others have changed or removed the ledger meanwhile.
        """
        if not (self._changed or again):
            return
        if not self.is_unchanged():
            raise SweepError(CHANGED, str(self._location))
        revision, before = self.manifest.revision + 1, set(self.files)
        columns: Any = {name: column.write(revision) for name, column in self.columns.items()}
        documents: Any = {k: file for k, file in self.manifest.documents.items() if k in self._documents}
        for kind in self._new_documents:
            content = json.dumps(self._documents[kind]).encode()
            documents[kind] = File(name=f"{kind}.{revision}.0", checksum=checksum(content))
            self._location.put(path_of(documents[kind]), content)
        manifest = Manifest(
            store=self.manifest.store,
            revision=revision,
            row=json.loads(json.dumps(self.dtype.descr if self.dtype.names else [])),
            samples_width=self.samples_width,
            columns=columns,
            documents=documents,
        )
        content = manifest.sealed()
        self._contents = (*self._contents, content)  # an answer may be lost although it was written
        self._location.put(MANIFEST, content)
        self.manifest, self._contents, self._changed, self._new_documents = manifest, (content,), False, set()
        for column in self.columns.values():
            column.commit()
        self.tidy()
        self._old = before - set(self.files)  # kept until the next flush, for who reads the store meanwhile

    def tidy(self) -> None:
        """Remove the files that did not count any more at the last flush."""
        for key in self._old - set(self.files):
            self._location.delete(key)
        self._old = set()

    def mend(self, damaged: Mapping[str, str]) -> None:
        """Write a ledger that is whole, without what was in damaged files: their blocks count as missing."""
        revision, lost = self.manifest.revision + 1, np.zeros(self.rows.end, dtype=bool)
        rows = self.columns["rows"].read({})
        for name, column in self.columns.items():
            starts = column.starts
            for number, file in enumerate(column.files):
                if path_of(file) in damaged:
                    first, last = starts[number : number + 2]
                    empty = np.zeros(last - first, dtype=column.dtype)
                    column.files[number] = column.put(empty, revision, 10**6 + number)
                    lost |= self._uses(name, rows, first, last)
        for kind in list(self._documents):
            if path_of(self.manifest.documents.get(kind)) in damaged:  # type: ignore[call-overload]
                del self._documents[kind]
        rows[lost] = np.zeros((), dtype=rows.dtype)
        column = self.columns["rows"]
        starts = column.starts
        for number, (first, last) in enumerate(pairwise(starts)):
            if lost[first:last].any():
                column.files[number] = column.put(rows[first:last], revision, 2 * 10**6 + number)
        self.flush(again=True)

    def _uses(self, name: str, rows: NDArray[Any], first: int, last: int) -> NDArray[np.bool_]:
        """Return which rows are, or refer to, some records of a column."""
        if name == "rows":
            places = np.arange(len(rows))
            return (places >= first) & (places < last)
        if name == "samples":
            starts, stops = [rows["start"]], [rows["start"] + _counts(rows)]
        else:
            texts = [rows["row"][n].reshape(len(rows), -1) for n, kind in _fields(self.dtype) if kind.base.kind == "O"]
            starts, stops = [t["start"] for t in texts], [t["start"] + t["bytes"] for t in texts]
        uses = np.zeros(len(rows), dtype=bool)
        for start, stop in zip(starts, stops, strict=True):
            uses |= ((start < last) & (stop > first)).reshape(len(rows), -1).any(axis=1)
        return uses

    def _on_disk(self, keys: Sequence[bytes], starts: Sequence[int], rows: Rows) -> NDArray[Any]:
        """Return rows as records, their texts added to the column of these."""
        records = np.zeros(len(keys), dtype=self.columns["rows"].dtype)
        records["key"] = np.frombuffer(b"".join(keys), dtype=f"V{KEY_BYTES}")
        records["start"] = starts
        if not self.dtype.hasobject:
            records["row"] = rows
            return records
        for name, kind in _fields(self.dtype):
            records["row"][name] = self._with_texts(rows[name]) if kind.base.kind == "O" else rows[name]
        return records

    def _with_texts(self, texts: NDArray[Any]) -> NDArray[Any]:
        column = self.columns["texts"]
        encoded = [text.encode() if isinstance(text, str) else b"" for text in texts.reshape(-1)]  # 0 in a lost row
        places = np.zeros(len(encoded), dtype=TEXT)
        places["bytes"] = list(map(len, encoded))
        places["start"] = column.end + np.cumsum(places["bytes"], dtype=np.uint64) - places["bytes"]
        column.append(np.frombuffer(b"".join(encoded), dtype=np.uint8))
        return places.reshape(texts.shape)

    def _in_memory(self, records: NDArray[Any]) -> Rows:
        """Return records as rows, with their texts; raises ValueError where these are not there."""
        if not self.dtype.hasobject:
            return np.ascontiguousarray(records["row"], dtype=self.dtype)
        rows = np.zeros(len(records), dtype=self.dtype)
        for name, kind in _fields(self.dtype):
            stored = records["row"][name]
            rows[name] = self._texts_at(stored) if kind.base.kind == "O" else stored
        return rows

    def _texts_at(self, places: NDArray[Any]) -> NDArray[Any]:
        starts, stops = places["start"].reshape(-1), (places["start"] + places["bytes"]).reshape(-1)
        if (stops > len(self._texts)).any():
            raise ValueError("it has fewer texts than rows")
        content, known = self._texts, dict[str, str]()  # equal texts are one object
        texts = np.empty(len(starts), dtype=object)
        for number, (start, stop) in enumerate(zip(starts.tolist(), stops.tolist(), strict=True)):
            text = content[start:stop].decode()
            texts[number] = known.setdefault(text, text)
        return texts.reshape(places.shape)


def path_of(file: File | None) -> str:
    """Return the name of a file of the ledger in its store."""
    return "" if file is None else f"{FOLDER}/{file.name}"


def failures_as_json(failures: Mapping[bytes, Record]) -> dict[str, Any]:
    """Return failures as JSON holds them: digests in hexadecimal, the ends of the first `MAX_TRACEBACKS` tracebacks."""
    kept: dict[str, Record] = {}
    tracebacks = 0
    for digest, record in failures.items():
        text = record.get("traceback", "")
        tracebacks += bool(text)
        end = text.encode()[-TRACEBACK_BYTES:].decode(errors="ignore")  # the end says what was raised and where
        kept[digest.hex()] = record | {"traceback": end if tracebacks <= MAX_TRACEBACKS else ""}
    return {"failures": kept}


def _failures(document: Mapping[str, Any]) -> dict[bytes, Record]:
    """Return the failures that a document records; raises ValueError."""
    try:
        recorded = document.get("failures", {}).items()
        failures = {bytes.fromhex(key): {str(k): str(v) for k, v in record.items()} for key, record in recorded}
    except (AttributeError, ValueError) as error:
        raise ValueError(f"it is no record of failed points: {error}") from error
    if any(len(digest) != DIGEST_BYTES for digest in failures):
        raise ValueError("it is no record of failed points: a digest of another length")
    return failures


def _fields(dtype: np.dtype[np.void]) -> list[tuple[str, np.dtype[Any]]]:
    return [(name, dtype[name]) for name in dtype.names or ()]


def _dtype(row: Sequence[Any]) -> np.dtype[np.void]:
    """Return the type of rows that a manifest tells; raises ValueError for any other than linksweep writes."""
    fields: list[Any] = []
    for name, kind, *shape in row:
        if isinstance(kind, list):
            inner = _dtype(kind)
            if inner.hasobject:
                raise ValueError("its rows have another type")
            fields.append((str(name), inner))
        elif kind in TYPES and all(isinstance(n, int) and n >= 0 for sizes in shape for n in sizes):
            fields.append((str(name), kind, *map(tuple, shape)))
        else:
            raise ValueError("its rows have another type")
    return np.dtype(fields)


def _counts(records: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the realisations of blocks, from the end of their keys: catalogues, and realisations of each."""
    keys = np.ascontiguousarray(records["key"] if records.dtype.names else records)
    numbers = np.frombuffer(keys.tobytes(), dtype="<u4").reshape(len(keys), KEY_BYTES // 4)[:, -2:].astype(np.uint64)
    return np.asarray(numbers[:, 0] * numbers[:, 1])
