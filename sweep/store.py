"""The Zarr store of a study: an append-only ledger of finished blocks, and the labelled dataset made from it.

The ledger is the truth: group ``blocks`` with two arrays of equal rows, ``index`` (who a row is, 32 bytes as
`sweep.plan.ledger_key` says) and ``sums`` (the block's sums), and ``samples`` where a study keeps them, the
realisations of one row after those of another.  Chunks are whole files that replace their predecessors in one step,
samples and sums before the index that names them, so that a process killed at any instant leaves a ledger that is
merely shorter.  Only the client writes.
"""

import json
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec

from sweep.contract import SweepError
from sweep.failures import Record, as_json, from_json
from sweep.study import Study
from sweep.tablefile import content_digest

FORMAT = 1
KEY_BYTES = 32
CHUNK_BYTES = 2**20

REWRITE = "`sweep run` the study again to write them anew from the ledger"


class Store:
    """An open store of one study: what is done, appending to it, and writing the dataset."""

    def __init__(self, path: Path, study: Study) -> None:
        """Open the ledger of the store at ``path`` for a study's blocks, making it where it is missing."""
        self.path, self.study = path, study
        self.attributes = read_attributes(path)
        width = study.experiment.sums_width
        self._rows_per_chunk = max(64, 2 ** int(np.log2(CHUNK_BYTES / (8 * max(width, 1)))))
        self._index = self._array("index", KEY_BYTES, "uint8", 0)
        self._sums = self._array("sums", width, "float64", np.nan)
        self._samples: zarr.Array[Any] | None = None
        if study.sampling.keep_samples:
            self._samples = self._array("samples", study.experiment.samples_width, "float64", np.nan)
        self.rows = self._read_index()
        self._next = 1 + max(self.rows.values(), default=-1)
        self._sample_ends = _ends_of_samples(np.asarray(self._index[: self._next]))
        self._unwritten_samples: list[NDArray[np.float64]] = []
        self._tail_index = np.zeros((self._rows_per_chunk, KEY_BYTES), dtype=np.uint8)
        self._tail_sums = np.full((self._rows_per_chunk, width), np.nan)
        self._unwritten = 0
        self.failures = self._read_failures()
        self._failures_changed = False
        in_tail = self._next % self._rows_per_chunk
        if in_tail:
            start = self._next - in_tail
            self._tail_index[:in_tail] = self._index[start : self._next]
            self._tail_sums[:in_tail] = self._sums[start : self._next]

    def sums(self) -> NDArray[np.float64]:
        """Return all rows of the ledger, (rows, width); `rows` says which is whose."""
        self.flush()
        return cast(NDArray[np.float64], self._sums[: self._next])

    def samples(self, key: bytes) -> NDArray[np.float64]:
        """Return the kept samples of a finished block, (realisations, width)."""
        assert self._samples is not None, "only a study that keeps samples asks for them"
        row = self.rows[key]
        return np.asarray(self._samples[self._sample_ends[row] : self._sample_ends[row + 1]])

    def append(
        self, keys: Sequence[bytes], sums: NDArray[np.float64], samples: Sequence[NDArray[np.float64]] = ()
    ) -> None:
        """Add finished blocks, with their samples if the study keeps them; they are durable after the next `flush`."""
        for number, (key, row) in enumerate(zip(keys, sums, strict=True)):
            if self._samples is not None:
                self._unwritten_samples.append(samples[number])
                self._sample_ends.append(self._sample_ends[-1] + len(samples[number]))
            at = self._next % self._rows_per_chunk
            self._tail_index[at] = np.frombuffer(key, dtype=np.uint8)
            self._tail_sums[at] = row
            self.rows[key] = self._next
            self._next += 1
            self._unwritten += 1
            if at == self._rows_per_chunk - 1:
                self.flush()

    def fail(self, digest: bytes, record: Record) -> None:
        """Remember that a point failed; durable after the next `flush`."""
        self.failures[digest] = record
        self._failures_changed = True

    def forgive(self, digests: Iterable[bytes]) -> None:
        """Forget failures of points, if there are any, so that they are computed again; durable after `flush`."""
        for digest in digests:
            self._failures_changed |= self.failures.pop(digest, None) is not None

    def flush(self) -> None:
        """Make everything appended so far durable; raises SweepError where that is not possible."""
        with _writing(self.path):
            self._flush()

    def _flush(self) -> None:
        if self._failures_changed:
            root = zarr.open_group(self.path, mode="r+", use_consolidated=False)
            root.require_group("failures").attrs.put({"failures": as_json(self.failures)})
            self._failures_changed = False
        if not self._unwritten:
            return
        self._flush_samples()
        start = (self._next - 1) // self._rows_per_chunk * self._rows_per_chunk
        stop = start + self._rows_per_chunk
        for array, tail, empty in ((self._sums, self._tail_sums, np.nan), (self._index, self._tail_index, 0)):
            if array.shape[0] < stop:
                array.resize((stop, *array.shape[1:]))
            array[start:stop] = tail
            if self._next == stop:
                tail[:] = empty
        self._unwritten = 0

    def _flush_samples(self) -> None:
        if self._samples is not None:
            stop = self._sample_ends[-1]
            new = np.concatenate(self._unwritten_samples)
            if self._samples.shape[0] < stop:
                self._samples.resize((stop, self._samples.shape[1]))
            self._samples[stop - len(new) : stop] = new
            self._unwritten_samples = []

    def write(self, dataset: xr.Dataset) -> None:
        """Replace the labelled dataset; until its last step the store says that it is incomplete.

        Raises SweepError where it cannot be written.
        """
        with _writing(self.path):
            self._write(dataset)

    def _write(self, dataset: xr.Dataset) -> None:
        group = zarr.open_group(self.path, mode="r+", use_consolidated=False)
        encoding: dict[str, Any] = {}
        for name, variable in dataset.variables.items():
            old = group.get(str(name))
            if isinstance(old, zarr.Array) and not _holds(old, variable):
                del group[str(name)]
                old = None
            if old is None:
                encoding[str(name)] = {"compressors": [ZstdCodec(level=1), Crc32cCodec()]}
        stale = set(group.array_keys()) - {str(name) for name in dataset.variables}
        for name in stale:
            del group[name]
        attributes = {**dataset.attrs, **_identity(self.study)}
        partial = dataset.assign_attrs({**attributes, "complete": 0})
        partial.to_zarr(self.path, mode="a", consolidated=False, zarr_format=3, encoding=encoding)
        group = zarr.open_group(self.path, mode="r+", use_consolidated=False)
        group.attrs.put(attributes)
        with warnings.catch_warnings():  # zarr-python#3709: consolidated metadata is not in the v3 specification yet
            warnings.filterwarnings("ignore", message="Consolidated metadata")
            zarr.consolidate_metadata(self.path)

    def _array(self, name: str, width: int, dtype: str, fill: float) -> zarr.Array[Any]:
        try:
            root = zarr.open_group(self.path, mode="r+", use_consolidated=False)
            blocks = root.require_group("blocks")
            if name not in blocks:
                blocks.create_array(
                    name,
                    shape=(0, width),
                    chunks=(self._rows_per_chunk, width),
                    dtype=dtype,
                    fill_value=fill,
                    compressors=[ZstdCodec(level=1), Crc32cCodec()],
                )
            array = blocks[name]
        except (OSError, ValueError, TypeError) as error:
            raise SweepError(f"blocks/{name} is damaged: {error}", str(self.path)) from error
        if not isinstance(array, zarr.Array) or array.shape[1:] != (width,):
            raise SweepError(
                f"the ledger's {name!r} does not have rows of {width} numbers; the store was made by another version",
                str(self.path),
            )
        return array

    def _read_failures(self) -> dict[bytes, Record]:
        if not (self.path / "failures").exists():
            return {}
        try:
            attributes = dict(zarr.open_group(self.path, path="failures", mode="r").attrs)
        except (OSError, ValueError, TypeError) as error:
            raise SweepError(f"the record of failed points is damaged: {error}", str(self.path)) from error
        return from_json(cast(dict[str, Any], attributes.get("failures", {})), str(self.path))

    def _read_index(self) -> dict[bytes, int]:
        """Return the row of every finished block; a row whose sums never reached the disk does not count."""
        rows = min(self._index.shape[0], self._sums.shape[0])
        index, sums = (_read(array, rows, self.path) for array in (self._index, self._sums))
        written = index.any(axis=1) & ~np.isnan(sums).all(axis=1)
        return {index[row].tobytes(): int(row) for row in np.flatnonzero(written)}


def _read(array: "zarr.Array[Any]", rows: int, path: Path) -> NDArray[Any]:
    """Return the first rows of an array; raises SweepError where a chunk fails its checksum or cannot be decoded."""
    try:
        return np.asarray(array[:rows])
    except (ValueError, RuntimeError) as error:
        raise SweepError(f"{array.name.strip('/')} is damaged: {error}", str(path)) from error


def _ends_of_samples(index: NDArray[np.uint8]) -> list[int]:
    """Return where the samples of each row of the index end, and 0 before the first: rows follow one another."""
    numbers = np.frombuffer(index.tobytes(), dtype="<u4").reshape(-1, KEY_BYTES // 4)
    realisations = numbers[:, -2].astype(np.int64) * numbers[:, -1]
    return cast(list[int], np.concatenate([[0], np.cumsum(realisations)]).tolist())


def create_or_resume(path: Path, study: Study, attributes: Mapping[str, Any]) -> Store:
    """Return the store at ``path``, made in one atomic step if there is none.

    Raises SweepError where something else is there, or results that cannot be mixed with this study's.
    """
    check_store(path, study)
    if not (path / "zarr.json").exists():
        with _writing(path):
            zarr.create_group(path, zarr_format=3, attributes={**attributes, **_identity(study), "complete": 0})
    return Store(path, study)


def finished_blocks(path: Path) -> int:
    """Return how many blocks the ledger of a store holds, whatever its dataset says."""
    try:
        index = zarr.open_array(path, path="blocks/index", mode="r")
        return int(np.asarray(index[:]).any(axis=1).sum())
    except (OSError, ValueError, RuntimeError):
        return 0


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise SweepError(f"cannot be written: {reason}; what was finished before is kept", str(path)) from error


def existing_store(path: Path, study: Study) -> Store | None:
    """Return the store at ``path`` if there is one, without writing; raises SweepError as `create_or_resume`."""
    check_store(path, study)
    return Store(path, study) if (path / "blocks" / "sums" / "zarr.json").exists() else None


def check_store(path: Path, study: Study) -> None:
    """Raise SweepError unless ``path`` is free or holds results that this study can be mixed with."""
    if _is_free(path):
        parent = next(p for p in path.absolute().parents if p.exists())
        if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            raise SweepError(f"cannot make a store there: {parent} is not a directory that can be written", str(path))
        return
    differences = _differences(read_attributes(path), study)
    if differences:
        raise SweepError(
            ["holds results of a different study, which would be mixed up; give another store with -o", *differences],
            str(path),
        )


def _differences(attributes: Mapping[str, Any], study: Study) -> list[str]:
    """Say in what the meaning of stored results differs from a study's; values of what is an axis in either do not."""
    old, new = json.loads(attributes["study_meaning"]), json.loads(_identity(study)["study_meaning"])
    axes = {*json.loads(attributes["study_axes"]), *study.axes}
    defaults = json.loads(json.dumps(study.experiment.defaults(), default=content_digest))
    pairs = [(key, old.get(key, "absent"), new.get(key, "absent")) for key in sorted({*old, *new} - {"fixed"})]
    pairs += [
        (f"fixed.{name}", old["fixed"].get(name, defaults.get(name)), new["fixed"].get(name, defaults.get(name)))
        for name in sorted({*old["fixed"], *new["fixed"]} - axes)
    ]
    return [f"{key}: {was!r} in the store, {now!r} in the study" for key, was, now in pairs if was != now]


def read_attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of a store; raises SweepError unless a linksweep store of this format is there."""
    where = str(path)
    if _is_free(path):
        raise SweepError("no store there", where)
    if not path.is_dir():
        raise SweepError("is a file, not a Zarr store", where)
    try:
        attributes: dict[str, Any] = json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        version = attributes["linksweep_format"]
        if version == FORMAT:
            json.loads(attributes["study_meaning"])["fixed"], json.loads(attributes["study_axes"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SweepError("is not a store of linksweep (foreign or half-made); nothing was changed", where) from error
    if version != FORMAT:
        raise SweepError(f"has store format {version}; this version of linksweep reads format {FORMAT}", where)
    return attributes


def open_dataset(path: Path) -> xr.Dataset:
    """Return the labelled dataset of a store, in memory; raises SweepError as `read_attributes`, if there is none yet
    or if it is damaged.
    """
    read_attributes(path)
    try:
        with warnings.catch_warnings():  # no consolidated metadata while a run has not written any results
            warnings.filterwarnings("ignore", message="Failed to open Zarr store with consolidated metadata")
            dataset: xr.Dataset = xr.open_zarr(path).load()
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        raise SweepError(f"the results are damaged ({error}); {REWRITE}", str(path)) from error
    if not dataset.data_vars:
        raise SweepError("has no results yet; `sweep run` the study to go on", str(path))
    if "status" not in dataset:
        raise SweepError(f"the results are damaged (no status); {REWRITE}", str(path))
    return dataset


def _identity(study: Study) -> dict[str, Any]:
    return {
        "linksweep_format": FORMAT,
        "study_meaning": json.dumps(study.meaning(), default=content_digest),
        "study_axes": json.dumps(list(study.axes)),
    }


def _holds(array: "zarr.Array[Any]", variable: xr.Variable) -> bool:
    """Return whether only the values of a stored array need to be written: xarray leaves the rest of it as it is."""
    attributes = {key: value for key, value in array.attrs.items() if key not in ("_FillValue", "coordinates")}
    same_kind = array.shape == variable.shape and _kind(array) == variable.dtype.kind
    return same_kind and attributes == variable.attrs


def _kind(array: "zarr.Array[Any]") -> str:
    return np.dtype(array.dtype).kind if array.dtype.kind != "T" else "O"


def _is_free(path: Path) -> bool:
    """Nothing is there, or a directory in which a killed process left at most a temporary file of its first write."""
    try:
        if not path.exists():
            return not path.is_symlink()
        return path.is_dir() and all(p.name.startswith("zarr.json.") and p.is_file() for p in path.iterdir())
    except OSError as error:  # a name that is too long, a directory closed to us
        raise SweepError(f"cannot be a store: {error.strerror}", str(path)) from error
