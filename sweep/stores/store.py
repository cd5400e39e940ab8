"""The store of a study: a ledger of finished blocks and failures, and the labelled dataset made from it.

The ledger is the truth.  Only the client writes, under the lock of `linksweep.sweep.stores.location`.  Nothing here
imports what a store names.  Zarr is imported where arrays are written or read: a run that is done needs neither.

Readers see each writing of the dataset, a generation, whole or not at all.  An array's chunks can have two sets of
names, by two encodings of Zarr's specification, and each generation uses the set that the last one does not.  So the
files of the last generation stay as they are until the root document, replaced in one step, names those of the new one;
a reader who opened the last one can read on until the generation after next begins.
"""

import base64
import getpass
import itertools
import json
import os
import platform
import re
import sys
import warnings
from collections.abc import Callable, Collection, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Outcome, SweepError, suggest
from linksweep.sweep.contract.rows import DIGEST_BYTES, EXACT_INT, LENGTH, MISSING_INT, absent, is_large, lost_integers
from linksweep.sweep.stores import integrity, ledger as ledgers
from linksweep.sweep.stores.integrity import CHUNKS, FORMAT, LEDGER_THEN, MANIFEST, REVISION, ROOT, SEAL, STORE
from linksweep.sweep.stores.ledger import Ledger
from linksweep.sweep.stores.location import RESULTS, Folder, Location, Where, holder, located, locked, reading, writing

if TYPE_CHECKING:
    import xarray as xr

# The attribute with the format of a store.
FORMAT_OF = "linksweep_format"

# The attribute that tells how many blocks the ledger had when the dataset was written.
BLOCKS = "blocks"

# The attribute that tells which code made the rows of the ledger.
CODE = "code"

# The attribute of a store that tells who wrote it, as JSON.
ORIGIN = "written_by"

# The attribute of a store of results alone: of which store they are that was lost while a run wrote to it.
RESCUED = "rescued_of"

# How often a reader begins anew because what it reads was replaced meanwhile.
ATTEMPTS = 20

# The attribute of an array that says what is in place of a missing integer or time.
FILL = "_FillValue"

# How the name of an array ends that has the values so far of a result, at points that are begun and not done; no name
# of a result has brackets.
RUNNING = "(running)"

# What a file says of times, which it has as integers.
TIMES = {"units": "nanoseconds since 1970-01-01", "calendar": "proleptic_gregorian", FILL: MISSING_INT}

# What a file says that it has in place of a missing float, NaN, as xarray writes it for Zarr 3.
MISSING_FLOAT = base64.b64encode(np.float64("nan").tobytes()).decode()

UNFINISHED = (
    "is unfinished: its run has just begun, or ended before it wrote results; nothing is damaged, "
    "and the same `sweep run` goes on"
)
CUT_SHORT = (
    "is unfinished: its results are older than its ledger; nothing is damaged, and the same `sweep run` writes them"
)


class OpenStore:
    """A store of which the root document was read, for reading: the dataset that this refers to, and the ledger."""

    def __init__(self, where: Where, root: Mapping[str, Any] | None = None) -> None:
        """Read the root document unless it is given; raises SweepError unless a store of this format is there."""
        self.location = located(where)
        self.root: Mapping[str, Any] = read_root(self.location) if root is None else root

    @property
    def attributes(self) -> dict[str, Any]:
        """What the root document says."""
        attributes: dict[str, Any] = self.root["attributes"]
        return attributes

    def dataset(self, running: bool = False) -> "xr.Dataset":
        """Return the labelled dataset as it was written at one time, whatever a run does meanwhile; with ``running`` it
        has the arrays `RUNNING`.  Large arrays of floats are read as they are used, all else is in memory.

        Raises SweepError if there is none yet or if it is damaged.
        """
        for _ in range(ATTEMPTS):
            try:
                with reading(self.location):
                    dataset = decode(self.root, self.location)
                # These are the very chunks that the root document means.
                break
            except ValueError as problem:
                # A run may have replaced these chunks meanwhile; then the root is another, and that is read instead.
                before, self.root = self.root, read_root(self.location)
                if self.root == before:
                    rewrite = "`sweep run` the study again to write them anew from the ledger"
                    raise SweepError(f"the results are damaged ({problem}); {rewrite}", str(self.location)) from problem
        else:
            raise SweepError("is being written faster than it can be read; try again", str(self.location))
        if not dataset.data_vars:
            words = UNFINISHED if is_new(self.root) else "has no results; `sweep run` the study to go on"
            raise SweepError(words, str(self.location))
        return dataset if running else finished(dataset)

    def ledger(self, writes: bool = False) -> Ledger:
        """Return the ledger; raises SweepError that names the damaged files of it."""
        for _ in range(ATTEMPTS):
            ledger = Ledger(self.location, manifest_of(self.root), writes)
            if not ledger.damaged:
                return ledger
            with reading(self.location):
                if ledger.is_unchanged():
                    # Else a run has replaced files that were not read yet.
                    break
        raise ledgers.damage(self.location, ledger.damaged)


class Store(OpenStore):
    """The open store of one study: what is done, appending to it, and writing the dataset."""

    def __init__(self, opened: OpenStore, writes: bool = False) -> None:
        """Open the ledger, as `Ledger`; raises SweepError where files of it are damaged."""
        super().__init__(opened.location, opened.root)
        self._ledger = self.ledger(writes)
        self._writing = self._ledger.writing
        self.failures, self.rows = self._ledger.failures, self._ledger.rows
        self.read, self.samples, self.append = self._ledger.read, self._ledger.samples, self._ledger.append
        self.fail, self.clear_failures = self._ledger.fail, self._ledger.clear_failures
        self.flush, self.tidy, self.seconds = self._ledger.flush, self._ledger.tidy, self._ledger.seconds
        self._files = _of_arrays(self._ledger.keys, arrays_of(self.root))

    def hold(self, dtype: np.dtype[np.void], samples_width: int) -> None:
        """Let rows be of this type, and a kept realisation have so many floats.

        Integers of rows that are there may become floats; rows with one that no float can hold count as missing.
        Raises SweepError for rows with other statistics.
        """
        if (dtype, samples_width) == (self._ledger.dtype, self._ledger.samples_width):
            return
        if self.rows and not (fits(self._ledger.dtype, dtype) and samples_width == self._ledger.samples_width):
            raise SweepError("has other statistics; --redo old computes its points again", str(self.location))
        lost, keys = lost_integers(self._ledger.read(), dtype), self.rows.keys_of_rows()
        self._ledger.retype(dtype, samples_width, [keys[row] for row in lost])

    def again(self, records: Mapping[bytes, ledgers.Record | None]) -> None:
        """Forget what is done of points, by their digests, and let them have failed for the reasons in ``records``, if
        any, until they are computed again; durable after `flush`, in one step.
        """
        keys = [key for key in self.rows if key[:DIGEST_BYTES] in records]
        if keys:
            self._ledger.retype(self._ledger.dtype, self._ledger.samples_width, keys)
        for digest, record in records.items():
            if record is not None:
                self.fail(digest, record)

    @property
    def keep(self) -> Callable[[dict[int, Outcome]], dict[int, Outcome]]:
        """What writes large arrays into this store from other processes, and leaves them where it cannot."""
        place = str(getattr(self.location, "path", self.location))
        return partial(ledgers.written_if_seen, place, self.attributes[STORE])

    def kept(self, outcomes: Mapping[int, Outcome]) -> dict[int, Outcome]:
        """Return outcomes whose large arrays are in the store; raises SweepError where they cannot be."""
        with self._writing():
            return ledgers.written(outcomes, self.location)

    def adopt(self, source: Location, chunks: Set[bytes]) -> None:
        """Copy chunks of another store, by their references; raises SweepError as `read_chunk`."""
        for chunk in chunks - self._ledger.chunks:
            with self._writing():
                self.location.put(ledgers.file_of(chunk), ledgers.read_chunk(source, chunk))

    def verify(self) -> None:
        """Raise SweepError where files of the ledger that opening did not read are damaged."""
        self._ledger.verify()
        if self._ledger.damaged:
            raise ledgers.damage(self.location, self._ledger.damaged)

    def write(self, dataset: Any) -> None:
        """Replace the labelled dataset, in one step for readers; raises SweepError where it cannot be written."""
        generation = self.attributes["generation"] + 1
        attributes, documents, chunks, linked = encode(dataset, ledgers.CHUNK_NAMES[generation % 2])
        checksums = {key: integrity.checksum(content) for key, content in chunks.items()}
        checksums |= {key: chunk.hex() for key, chunk in linked.items()}
        attributes |= {
            FORMAT_OF: FORMAT,
            ORIGIN: origin(self.location),
            **({CODE: self.attributes[CODE]} if CODE in self.attributes else {}),
            "generation": generation,
            STORE: self.attributes[STORE],
            BLOCKS: len(self.rows),
            CHUNKS: json.dumps(checksums),
        }
        about = {STORE: attributes[STORE], REVISION: generation}
        described = dict[str, bytes]()
        for name, array in documents.items():
            file = f"{name}/zarr.json"
            described[file] = integrity.sealed({**array, "attributes": {**array["attributes"], **about}}, file)
        gone = {f"{name}/zarr.json" for name in arrays_of(self.root)} - described.keys()
        in_use = {*described, *checksums, *chunk_checksums(self.root)}
        with self._writing():
            # The order is what makes a kill harmless: rows, then results, then the root that refers to both.
            self.keep_copy(attributes)
            self.flush()
            self.location.delete(*(self._files - in_use - gone))
            self.location.copy_all({key: ledgers.file_of(chunk) for key, chunk in linked.items()})
            # Values first and the status last, for those who read without the root document.
            for is_status in (False, True):
                for files in (chunks, described):
                    self.location.put_all({k: c for k, c in files.items() if k.startswith("status/") == is_status})
            attributes[LEDGER_THEN] = self._ledger.manifest.model_dump_json()
            self._put_root(integrity.group_document(attributes, documents))
            # Who reads the last writing may miss values so far, and nothing else: NaN, as if there were none yet.
            gone |= {f for f in in_use if f"{f.partition('/')[0]}/zarr.json" in gone and f"{RUNNING}/" in f}
            self.location.delete(*gone)
        self._files = in_use - gone

    def has(self, dataset: Any) -> bool:
        """Return whether this dataset is what was written last of these rows, and every file of it is whole."""
        then = self._ledger.manifest.model_dump_json()
        wanted = {**dataset.attrs, ORIGIN: origin(self.location), LEDGER_THEN: then}
        same = all(self.attributes.get(name) == value for name, value in wanted.items())
        return same and arrays_of(self.root).keys() == dataset.variables.keys() and self.is_whole()

    def is_whole(self) -> bool:
        """Return whether every file of the dataset is as it was written last."""
        report = Report({}, {}, {})
        with reading(self.location):
            return not _check_results(self.location, self.root, report) and not report

    def lost(self) -> list[str]:
        """Return those of the files that were written which are not there any more, as after the folder was moved;
        raises SweepError where that cannot be told.
        """
        documents = {f"{name}/zarr.json" for name in arrays_of(self.root)}
        needed = {ROOT, *self._ledger.files, *documents, *chunk_checksums(self.root)}
        needed |= {*map(ledgers.file_of, self._ledger.chunks)}
        with reading(self.location):
            content = self.location.get(ROOT)
            gone = needed - set(self.location.keys())
            gone |= set() if self._ledger.is_unchanged() else {MANIFEST}
        return sorted(gone if content == integrity.sealed(self.root, ROOT) else gone | {ROOT})

    def rescue(self, dataset: Any, lost: Collection[str]) -> Location:
        """Write a labelled dataset beside this store, of which files are ``lost``, and return where; large arrays that
        have a chunk among these are left out.
        """
        store = getattr(self.location, "path", self.location)  # whose folder may be the present one, and be gone
        names = (f"{store}.rescued{number if number > 1 else ''}" for number in itertools.count(1))
        place = next(place for place in map(located, names) if place.is_free())
        beside = Store(create_store(place, {**dataset.attrs, RESCUED: str(self.location)}), writes=True)
        chunks = {n: one.data.used() for n, one in dataset.variables.items() if isinstance(one.data, ledgers.Stored)}
        gone = [name for name, some in chunks.items() if not {*map(ledgers.file_of, some)}.isdisjoint(lost)]
        beside.adopt(self.location, {chunk for name, some in chunks.items() if name not in gone for chunk in some})
        beside.write(replace(dataset.drop_vars(gone), attrs={**dataset.attrs, RESCUED: str(self.location)}))
        return place

    def _put_root(self, root: Mapping[str, Any]) -> None:
        """Replace the root document; after an error the one that is there counts."""
        before, self.root = self.root, root
        try:
            self.location.put(ROOT, integrity.sealed(root, ROOT))
        except BaseException:
            # It may be written although the answer is lost.
            if self.location.get(ROOT) == integrity.sealed(before, ROOT):
                self.root = before
            raise

    def record(self, attributes: Mapping[str, Any]) -> None:
        """Record more of the study, such as which code makes the blocks from now on, before there are any."""
        if all(self.attributes.get(name) == value for name, value in attributes.items()):
            return
        with self._writing():
            self._put_root({**self.root, "attributes": {**self.attributes, **attributes}})
            self._ledger.put("study", copied(self.attributes))

    def keep_copy(self, attributes: Mapping[str, Any] | None = None) -> None:
        """Write a copy of what the store means, the new ``attributes`` or its own, into the ledger if the study has
        changed.
        """
        attributes = self.attributes if attributes is None else attributes
        copy = self._ledger.copy
        if copy is None or any(copy.get(key) != attributes.get(key) for key in ("study_digest", FORMAT_OF)):
            self._ledger.put("study", copied(attributes))


def fits(before: np.dtype[np.void], dtype: np.dtype[np.void]) -> bool:
    """Return whether rows can be of another type: the same but for the order, integers that become floats, and arrays
    with a length beside them that become longer.
    """
    names = set(before.names or ())
    if names != set(dtype.names or ()):
        return False
    pairs = [(before[name], dtype[name], name + LENGTH in names) for name in names]
    return all(
        (a.base == b.base or (a.base.kind, b.base.kind) == ("i", "f"))
        and (a.shape == b.shape or (grows and all(m <= n for m, n in zip(a.shape, b.shape, strict=True))))
        for a, b, grows in pairs
    )


def store_at(where: Where) -> OpenStore | None:
    """Return the store at a place, None where the place is free; raises SweepError where something else is there."""
    location = located(where)
    root = find_root(location)
    if root is None:
        return None
    if RESCUED in root["attributes"]:
        raise SweepError("holds results of a store that was lost; give another one with -o", str(location))
    return OpenStore(location, root)


def create_store(where: Where, attributes: Mapping[str, Any]) -> OpenStore:
    """Make a store at a free place, in one step, in which nothing is done yet."""
    location = located(where)
    with writing(location):
        root = put_root(location, {**attributes, ORIGIN: origin(location), STORE: uuid4().hex})
    return OpenStore(location, root)


def replace_store(where: Where, attributes: Mapping[str, Any]) -> OpenStore | None:
    """Begin a store anew: remove the ledger and the results of the one that is there; None where there is none.

    Files that linksweep did not write are left alone.  Raises SweepError where something other than a store is.
    """
    location = located(where)
    root = find_root(location)
    if root is None:
        return None
    emptied = {key: value for key, value in root["attributes"].items() if key not in (LEDGER_THEN, CHUNKS)}
    with writing(location):
        keys = location.keys()
        arrays = _of_arrays(keys, arrays_of(root))
        ours = {*arrays, *(key for key in keys if key.partition("/")[0] == ledgers.FOLDER)} - {MANIFEST}
        # If the process is killed after any of these, the old store has merely lost its results, then its blocks.
        put_root(location, emptied)
        location.delete(MANIFEST, *sorted(ours))
        return create_store(location, attributes)


def put_root(location: Location, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Write the root document of a store without results."""
    root = integrity.group_document({**attributes, FORMAT_OF: FORMAT, "complete": 0, "generation": 0}, {})
    location.put(ROOT, integrity.sealed(root, ROOT))
    return root


def finished(dataset: Any) -> Any:
    """Return a dataset without what points that are not done have so far."""
    return dataset.drop_vars([name for name in dataset.data_vars if str(name).endswith(RUNNING)])


def read_root(location: Location) -> dict[str, Any]:
    """Return the root document; raises SweepError unless a whole linksweep store of a known format is there."""
    root = find_root(location)
    if root is None:
        hint, path = "", location.path if isinstance(location, Folder) else None
        if path is not None and path.is_dir():
            hint = ": the folder is empty; no run has begun in it, or its files are gone"
        elif path is not None:
            beside = {one.name for one in path.parent.glob("*.zarr")}
            hint = suggest(path.name, sorted(beside | {*map(str, RESULTS.glob("*.zarr"))}))
        raise SweepError(f"no store there{hint}", str(location))
    return root


def find_root(location: Location) -> dict[str, Any] | None:
    """Return the root document, None where nothing is; raises SweepError as `read_root`."""
    where = str(location)
    with reading(location):
        content = location.get(ROOT)
        if content is None:
            if location.is_free():
                return None
            content = location.get(ROOT)  # a run has perhaps just put it there
        try:
            root = integrity.unsealed(content, ROOT)
            location.require_plain()  # what is not ours is not gone through
            _check_format(root["attributes"], where)
            integrity.checked(integrity.Root, root)
            return root
        except (ValueError, KeyError) as error:
            if readable_copy(location) is not None:
                problem = "it is another document" if isinstance(error, KeyError) else error
                raise SweepError(f"{ROOT} is damaged ({problem}); {ledgers.REPAIR}", where) from error
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                # The checksum of another format.
                attributes = json.loads(content or b"")["attributes"]
                if FORMAT_OF not in attributes:
                    kind = {"tie": "link"}.get(attributes["result"], attributes["result"])
                    said = f"is a stored {kind}, without points and a ledger: see `sweep show`"
                    raise SweepError(said, where) from error
                _check_format(attributes, where)
            ways = "bring one of these back from a backup, or give another store"
            whole = f"is not a store of linksweep, or its {ROOT} and the copy in {ledgers.FOLDER} are damaged: {ways}"
            raise SweepError(whole, where) from error


def _check_format(attributes: Mapping[str, Any], where: str) -> None:
    """Raise SweepError for a store of a format that this version does not read; KeyError for what is no store."""
    version = attributes[FORMAT_OF]
    if not isinstance(version, int):
        raise KeyError(FORMAT_OF)
    if version != FORMAT:
        old, new = "older: run the study into a new store with -o", "newer: upgrade with `pip install -U linksweep`"
        age = new if version > FORMAT else old
        raise SweepError(f"has store format {version}; this version reads format {FORMAT}. It is {age}", where)


def manifest_of(root: Mapping[str, Any]) -> integrity.Manifest:
    """Return what the ledger held when a root document was written."""
    attributes = root["attributes"]
    if LEDGER_THEN not in attributes:
        return integrity.Manifest(store=attributes[STORE])
    return integrity.Manifest.model_validate_json(attributes[LEDGER_THEN])


def is_new(root: Mapping[str, Any]) -> bool:
    """Return whether no results were written to a store yet: a run has just begun, or ended in its first moment."""
    return not root["attributes"].get("generation")


def readable_copy(location: Location) -> dict[str, Any] | None:
    """Return the ledger's copy of a store's attributes; None where it is missing, damaged or of another format."""
    try:
        manifest = integrity.read_manifest(location.get(MANIFEST))
        file = manifest.documents["study"]
        attributes: dict[str, Any] = json.loads(integrity.whole(location.get(ledgers.path_of(file)), file.checksum))
        integrity.checked(integrity.Attributes, {**attributes, "generation": 0})
    except (ValueError, LookupError, RecursionError):
        # Who asks has a damaged root already, and says so.
        return None
    return attributes if (attributes.get(FORMAT_OF), attributes[STORE]) == (FORMAT, manifest.store) else None


def seen(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes that results have: all but those by which a store knows its files."""
    return {key: value for key, value in attributes.items() if key not in (CHUNKS, LEDGER_THEN, STORE, SEAL)}


def copied(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes that the ledger's copy has: all but those about one writing."""
    left_out = ("failures", "generation", BLOCKS, CHUNKS, LEDGER_THEN, SEAL, REVISION)
    return {key: value for key, value in attributes.items() if key not in left_out}


def origin(location: Location) -> str:
    """Return the host, the user and the place of a store that this process writes."""
    place = str(location.path.resolve()) if isinstance(location, Folder) else str(location)
    user = str(os.getuid())
    with suppress(KeyError, OSError):
        # Of a user without a name, as in a container.
        user = getpass.getuser()
    return json.dumps({"host": platform.node(), "user": user, "path": place})


def was_written_here(location: Location, attributes: Mapping[str, Any]) -> bool:
    """Return whether the last run that wrote to a store was of this user, on this host, with the store at this place.

    The store itself says so: this guards against code in a copied store, not against someone who forges these three.
    """
    return bool(attributes.get(ORIGIN) == origin(location))


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
    # A version without it does this in another way.
    known: Any = getattr(pycompat, "_cached_duck_array_modules", {})
    known.setdefault("dask", _DaskArrays())


def encode(
    dataset: Any, chunk_names: Mapping[str, str]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]], dict[str, bytes], dict[str, bytes]]:
    """Return the attributes of a dataset, the documents of its arrays, the contents of their chunks by file, and the
    references to those that the ledger has.

    Every chunk has a checksum, and none is left out for being empty, so that a missing one must have been lost.
    """
    files: dict[str, Any] = {}
    linked: dict[str, bytes] = {}
    labels = sorted(name for name in dataset.coords if name not in dataset.sizes)
    for name, variable in dataset.variables.items():
        values, attributes, how = variable.data, dict(variable.attrs), dict[str, Any]()
        along = [label for label in labels if set(dataset[label].dims) <= set(variable.dims)]
        if along and name not in dataset.coords:
            attributes["coordinates"] = " ".join(along)
        if values.dtype.kind == "M":
            attributes |= TIMES
            values = values.astype("M8[ns]").view(np.int64)
        elif values.dtype.kind in "OU":
            values = values.astype(np.dtypes.StringDType())
        elif values.dtype.kind == "f":
            attributes[FILL], how["fill_value"] = MISSING_FLOAT, np.nan
        elif FILL in variable.encoding:
            attributes[FILL] = variable.encoding[FILL]
        how |= {"chunk_key_encoding": chunk_names, "dimension_names": variable.dims, "attributes": attributes}
        array = ledgers.new_array(files, name, values, **how)
        if not isinstance(values, ledgers.Stored):
            continue
        # The first point is written as a missing one: all others that are missing have the same chunks.
        array[(0,) * (values.chunks.ndim - 1)] = absent(values.dtype)
        empty = dict(files)
        for file, first, chunk in values.files(name, chunk_names):
            files[file] = empty[first]
            linked |= {file: chunk} if any(chunk) else {}
    contents = {key: bytes(buffer.to_bytes()) for key, buffer in files.items() if key not in linked}
    contents.pop(ROOT)  # of arrays alone
    documents = {str(name): json.loads(contents.pop(f"{name}/zarr.json")) for name in dataset.variables}
    return dict(dataset.attrs), documents, contents, linked


def decode(root: Mapping[str, Any], location: Location) -> "xr.Dataset":
    """Return the dataset of a root document, in memory but for large arrays of floats.

    Raises ValueError that names a file which is missing or not what the root document means.
    """
    import xarray as xr
    from zarr.storage import MemoryStore

    dask_arrays_only_where_imported()
    later = _large_chunks(root, location)
    lazy = {key.partition("/")[0] for key in later}
    expected = {key: checksum for key, checksum in chunk_checksums(root).items() if key not in later}
    contents = location.get_all(expected)
    there, damaged = dict[str, bytes](), dict[str, str]()
    for key, checksum in expected.items():
        with integrity.noting(damaged, key):
            is_text = arrays_of(root)[key.partition("/")[0]].get("data_type") == "string"
            there[key] = integrity.whole_chunk(contents[key], checksum, is_text)
    if damaged:
        raise ValueError("; ".join(f"{key}: {problem}" for key, problem in damaged.items()))
    files = ledgers.Files(location, later, {**there, ROOT: json.dumps(root).encode()})
    try:
        with warnings.catch_warnings():
            # Zarr-python#3709: consolidated metadata is not in the v3 specification yet.
            warnings.filterwarnings("ignore", message="Consolidated metadata")
            # Without durations: older xarray makes some of numbers in "days", "hours" and the like.
            whole = MemoryStore(files, read_only=True)
            opened = xr.open_zarr(whole, chunks=None, consolidated=True, decode_timedelta=False, mask_and_scale=False)
            dataset: xr.Dataset = opened.drop_vars(lazy).load().assign({name: opened[name] for name in lazy})
            for name in [name for name, variable in dataset.variables.items() if FILL in variable.attrs]:
                variable = dataset[name].variable
                variable.encoding[FILL] = fill = variable.attrs.pop(FILL)
                if variable.dtype.kind == "i":  # xarray would round large ones beside those that are missing
                    dataset[name] = variable.copy(data=with_gaps(variable.values, fill))
    except Exception as error:
        # Of forged documents: each codec of Zarr raises its own.
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error
    dataset.attrs = seen(root["attributes"])
    return dataset


def with_gaps(whole: NDArray[np.int64], fill: int) -> NDArray[Any]:
    """Return integers with NaN in place of missing ones, which are ``fill``: floats, or objects where a float would
    round one.
    """
    missing = whole == fill
    floats = np.where(missing, np.nan, whole)
    return np.where(missing, np.nan, whole.astype(object)) if (np.abs(floats) >= EXACT_INT).any() else floats


def _large_chunks(root: Mapping[str, Any], location: Location) -> dict[str, bytes]:
    """Return the references of chunks of large arrays by their files.  Integers are not among them: xarray rounds
    some.
    """
    documents = arrays_of(root)
    axes = len(documents.get("status", {}).get("shape", ()))
    names = {n for n, d in documents.items() if d.get("data_type") == "float64" and is_large(d["shape"][axes:])}
    there = set(location.keys(f"{ledgers.FOLDER}/")) if names else set()
    chunks = {k: bytes.fromhex(c) for k, c in chunk_checksums(root).items() if k.partition("/")[0] in names}
    return {key: chunk for key, chunk in chunks.items() if ledgers.file_of(chunk) in there}


def chunk_checksums(root: Mapping[str, Any]) -> dict[str, str]:
    """Return the checksum of each chunk of the dataset by the name of its file."""
    checksums: dict[str, str] = json.loads(root["attributes"].get(CHUNKS, "{}"))
    return checksums


def arrays_of(root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the documents of the dataset's arrays by name."""
    return dict(root.get("consolidated_metadata", {}).get("metadata", {}))


def _of_arrays(keys: Collection[str], names: Collection[str]) -> set[str]:
    """Return the files of the arrays of these names, and chunks of others that are left over, among all files."""
    described = {key.removesuffix("/zarr.json") for key in keys if key.endswith("/zarr.json")}
    chunk = re.compile(r"[^/]+/(c|c\.|\d)[\d.]*")
    return {
        key
        for key in keys
        if (folder := key.partition("/")[0]) in names or (folder not in described and chunk.fullmatch(key))
    }


@dataclass(frozen=True)
class Report:
    """What is wrong with which file: of those that say what the store means (``identity``), of the ``ledger``, and of
    the ``results``, which can be written anew from the ledger.

    ``remarks`` are sentences about a store in which nothing is wrong: that it is unfinished.
    """

    identity: dict[str, str]
    ledger: dict[str, str]
    results: dict[str, str]
    remarks: list[str] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.identity or self.ledger or self.results)


def check(where: Where) -> Report:
    """Read every file of a store and compare it with its checksum.

    Raises SweepError where there is no store, where nothing says what its numbers mean, and while a run writes to it.
    """
    location = located(where)
    if (runs := holder(location)) is not None:
        raise SweepError(f"is being written by {runs}; check it when that has ended", str(location))
    with reading(location):
        return _check(location)[0]


def repair(where: Where, *, break_lock: bool = False) -> list[str]:
    """Repair what can be repaired, and return what was done in sentences; damaged files, except those of the results,
    are moved to ``STORE.damaged``.

    Raises SweepError as `check`, and as `locked`.
    """
    location = located(where)
    with reading(location):
        # Raises for what is no store, before anything is written.
        _check(location)
    with locked(location, break_lock=break_lock), writing(location):
        report, attributes, ledger = _check(location)
        ledger.writes = True
        for file in (*report.identity, *report.ledger):
            if (content := location.get(file)) is not None:
                location.parent.put(f"{location.name}.damaged/{file}", content)
        if report.ledger:
            attributes = {**attributes, "repaired": 1}
            if ROOT not in report.identity:  # before the ledger forgets that something was there
                location.put(ROOT, integrity.sealed({**read_root(location), "attributes": attributes}, ROOT))
        if report.identity or report.ledger:
            ledger.put("study", copied(attributes))
            ledger.mend(report.ledger)
            ledger.tidy()
        done = dict.fromkeys(report.identity, f"the copy of {ROOT} was made anew")
        if ROOT in report.identity:
            put_root(location, {**attributes, LEDGER_THEN: ledger.manifest.model_dump_json()})
            done[ROOT] = "it was made anew from its copy; the results are not in it until `sweep run` writes them"
        done |= dict.fromkeys(report.ledger, "the next `sweep run` computes again what was in it")
        done |= dict.fromkeys(report.results, "the next `sweep run` writes it anew from the ledger")
        return [f"{file}: {what}" for file, what in done.items()]


def _check(location: Location) -> tuple[Report, dict[str, Any], Ledger]:
    """Return the report, what the store means, and its ledger."""
    report = Report({}, {}, {})
    root: dict[str, Any] | None = None
    try:
        root = read_root(location)
        attributes = root["attributes"]
    except SweepError:
        copy = readable_copy(location)
        if copy is None:
            raise
        attributes = copy
        report.identity[ROOT] = "it is of another store"
        with integrity.noting(report.identity, ROOT):
            integrity.unsealed(location.get(ROOT), ROOT)
    of_root = integrity.Manifest(store=attributes[STORE]) if root is None else manifest_of(root)
    ledger = Ledger(location, of_root)
    # The samples, which opening leaves unread.
    ledger.verify()
    report.ledger.update(ledger.damaged)
    if (copy_file := ledgers.path_of(ledger.manifest.documents.get("study"))) in report.ledger:
        report.identity[copy_file] = report.ledger.pop(copy_file)
    if root is not None:
        is_older = _check_results(location, root, report) or ledger.is_ahead or ledger.manifest != of_root
        if not report and not attributes.get("complete"):
            done, points = (attributes.get(key) for key in ("points_done", "points"))
            is_begun = is_new(root) or points is None
            incomplete = f"is incomplete: {done} of {points} points were done when the results were last written"
            report.remarks.append(UNFINISHED if is_begun else incomplete)
        elif not report and is_older:
            report.remarks.append(CUT_SHORT)
    return report, attributes, ledger


def _check_results(location: Location, root: Mapping[str, Any], report: Report) -> bool:
    """Add to a report what is wrong with the files of the results; return whether a later writing was cut short."""
    cut_short = False
    attributes = root["attributes"]
    files = {f"{name}/zarr.json": document for name, document in arrays_of(root).items()}
    for file, content in location.get_all(files).items():
        with integrity.noting(report.results, file):
            document = integrity.unsealed(content, file)
            about = {key: document["attributes"].pop(key, None) for key in (SEAL, STORE, REVISION)}
            # These documents are for who reads without the root, so they may be of a writing that the root does not
            # know yet: that of a run which was killed.
            is_later = type(about[REVISION]) is int and about[REVISION] > attributes["generation"]
            if about[STORE] != attributes[STORE] or not (document == files[file] or is_later):
                raise ValueError(integrity.ANOTHER)
            cut_short |= document != files[file]
    for file, checksum in chunk_checksums(root).items():
        # One by one: never all in memory.
        with integrity.noting(report.results, file):
            integrity.whole(location.get(file), checksum)
    return cut_short
