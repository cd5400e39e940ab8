"""The store of a study: a ledger of finished blocks and failures, and the labelled dataset made from it.

The ledger is the truth.  Only the client writes, under the lock of `sweep.stores.lock`.  Nothing here imports what a
store names.
"""

import getpass
import itertools
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from linksweep.sweep.contract import Array, Rows, SweepError
from linksweep.sweep.contract.reducer import lost_integers
from linksweep.sweep.formatting import host
from linksweep.sweep.stores import snapshot
from linksweep.sweep.stores.integrity import (
    CHUNKS,
    FORMAT,
    LEDGER_THEN,
    MANIFEST,
    REVISION,
    ROOT,
    SEAL,
    STORE,
    DamagedError,
    Manifest,
    check_attributes,
    check_root,
    group_document,
    problem_of,
    read_manifest,
    sealed,
    unsealed,
)
from linksweep.sweep.stores.ledger import FOLDER, Ledger, Record, failures_as_json, path_of
from linksweep.sweep.stores.location import Folder, Location, Where, located, reading, writing

if TYPE_CHECKING:
    import xarray as xr

FORMAT_OF = "linksweep_format"
"""The attribute with the format of a store."""

BLOCKS = "blocks"
"""The attribute that tells how many blocks the ledger had when the dataset was written."""

CODE = "code"
"""The attribute that tells which code made the rows of the ledger."""

ORIGIN = "written_by"
"""The attribute of a store that tells who wrote it, as JSON."""

RESCUED = "rescued_of"
"""The attribute of a store of results alone: of which store they are that was lost while a run wrote to it."""

MOST_UNWRITTEN = 2**26
"""Bytes of rows and samples that may wait for the next flush."""

ATTEMPTS = 20
"""How often a reader begins anew because what it reads was replaced meanwhile."""

REPAIR = "`sweep check {} --repair` repairs what can be repaired"
MARKS = (b"linksweep_format", b"study_meaning", b"study_digest")
"""Words by which a document of a store can be recognised even if it is damaged."""

UNFINISHED = (
    "is unfinished: its run has just begun, or ended before it wrote results; nothing is damaged, "
    "and the same `sweep run` goes on"
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

    def dataset(self) -> "xr.Dataset":
        """Return the labelled dataset, in memory, as it was written at one time, whatever a run does meanwhile.

        Raises SweepError if there is none yet or if it is damaged.
        """
        for _ in range(ATTEMPTS):
            problem: ValueError | None = None
            dataset = None
            try:
                with reading(self.location):
                    chunks = self.location.get_all(snapshot.chunk_keys(snapshot.arrays_of(self.root)))
                    dataset = snapshot.decode(self.root, chunks)
            except ValueError as error:
                problem = error
            if problem is None:
                break  # these are the very chunks that the root document means
            before, self.root = self.root, read_root(self.location)
            if self.root == before:
                break
        else:
            raise SweepError("is being written faster than it can be read; try again", str(self.location))
        if problem is not None:
            rewrite = "`sweep run` the study again to write them anew from the ledger"
            raise SweepError(f"the results are damaged ({problem}); {rewrite}", str(self.location)) from problem
        if dataset is None or not dataset.data_vars:
            words = UNFINISHED if is_new(self.root) else "has no results; `sweep run` the study to go on"
            raise SweepError(words, str(self.location))
        return dataset

    def ledger(self) -> Ledger:
        """Return the ledger; raises SweepError that names the damaged files of it."""
        with reading_ledger(self.location):
            for attempt in range(ATTEMPTS):
                ledger = Ledger(self.location, manifest_of(self.root))
                if not ledger.damaged:
                    return ledger
                if ledger.is_unchanged() or attempt == ATTEMPTS - 1:
                    break  # else a run has replaced files that were not read yet
            raise DamagedError(ledger.damaged)


class Store(OpenStore):
    """The open store of one study: what is done, appending to it, and writing the dataset."""

    def __init__(self, opened: OpenStore, meaning: Mapping[str, Any]) -> None:
        """Open the ledger; raises SweepError where files of it are damaged.

        ``meaning`` are the attributes that say what the numbers of the study mean.
        """
        super().__init__(opened.location, opened.root)
        self._meaning = dict(meaning)
        self._ledger = self.ledger()
        self.failures, self.rows = self._ledger.failures, self._ledger.rows
        self._failures_changed = False
        self._unwritten = 0
        try:
            self._documents = snapshot.arrays_of(self.root)
        except ValueError as error:
            raise SweepError(str(error), str(self.location)) from error
        self._digests: dict[str, bytes] = {}
        self._files = snapshot.leftovers(self._ledger.keys, self._documents)

    def hold(self, dtype: np.dtype[np.void], samples_width: int) -> None:
        """Let rows be of this type, and a kept realisation have so many floats.

        Integers of rows that are there may become floats; rows with one that no float can hold count as missing.
        Raises SweepError for rows of another version of the experiment.
        """
        if (dtype, samples_width) == (self._ledger.dtype, self._ledger.samples_width):
            return
        if self.rows and not (_fits(self._ledger.dtype, dtype) and samples_width == self._ledger.samples_width):
            raise SweepError(
                "another version of linksweep made this store, with other sums in its ledger: its results can be read, "
                "but to compute more run the study into a new store with -o",
                str(self.location),
            )
        with reading_ledger(self.location):
            lost, keys = lost_integers(self._ledger.read(), dtype), self.rows.keys_of_rows()
            self._ledger.retype(dtype, samples_width, [keys[row] for row in lost if keys[row] in self.rows])

    def read(self) -> Rows:
        """Return all rows of the ledger; `rows` has the place of each block in them."""
        with reading_ledger(self.location):
            return self._ledger.read()

    def samples(self, key: bytes) -> Array:
        """Return the kept samples of a finished block, (realisations, width); raises SweepError where they are
        damaged.
        """
        with reading_ledger(self.location):
            return self._ledger.samples(key)

    def verify(self) -> None:
        """Raise SweepError where files of the ledger that opening did not read are damaged."""
        with reading_ledger(self.location):
            self._ledger.verify()
            if self._ledger.damaged:
                raise DamagedError(self._ledger.damaged)

    def append(self, keys: Sequence[bytes], rows: Rows, samples: Sequence[Array] = ()) -> None:
        """Add finished blocks, with their samples if the study keeps them; they are durable after the next `flush`."""
        if not keys:
            return
        self._ledger.append(keys, rows, samples)
        self._unwritten += rows.nbytes + sum(kept.nbytes for kept in samples)
        if self._unwritten > MOST_UNWRITTEN:
            self.flush()

    def fail(self, digest: bytes, record: Record) -> None:
        """Remember that a point failed; durable after the next `flush`."""
        self.failures[digest] = record
        self._failures_changed = True

    def clear_failures(self, digests: Iterable[bytes]) -> None:
        """Forget failures of points, if there are any, so that they are computed again; durable after `flush`."""
        for digest in digests:
            self._failures_changed |= self.failures.pop(digest, None) is not None

    def flush(self) -> None:
        """Make everything appended so far durable; raises SweepError where that is not possible."""
        with writing(self.location):
            if self._failures_changed:
                self._ledger.put("failures", failures_as_json(self.failures))
                self._failures_changed = False
            self._ledger.flush()
            self._unwritten = 0

    def write(self, dataset: "xr.Dataset") -> None:
        """Replace the labelled dataset, in one step for readers; raises SweepError where it cannot be written."""
        attributes, arrays = snapshot.encode(dataset)
        digests = {name: array.digest() for name, array in arrays.items()}
        named = {name: self._named(name, array, digests[name]) for name, array in arrays.items()}
        attributes |= self._meaning | {
            FORMAT_OF: FORMAT,
            ORIGIN: origin(self.location),
            **({CODE: self.attributes[CODE]} if CODE in self.attributes else {}),
            "generation": self.attributes["generation"] + 1,
            STORE: self.attributes[STORE],
            BLOCKS: len(self.rows),
            CHUNKS: json.dumps({name: array.checksums() for name, array in named.items()}),
        }
        documents = {name: array.document for name, array in named.items()}
        in_use = {*snapshot.chunk_keys(documents), *snapshot.chunk_keys(self._documents)}
        described, gone = (
            {f"{n}/zarr.json" for n in names} for names in (documents, set(self._documents) - set(documents))
        )
        with writing(self.location):
            self.keep_copy(attributes)
            self.flush()
            self._delete(self._files - in_use - described - gone)
            changed = {name: named[name] for name in named if self._digests.get(name) != digests[name]}
            self._write_arrays(changed, attributes)
            attributes[LEDGER_THEN] = self._ledger.manifest.model_dump_json()
            root = group_document(attributes, documents)
            self.location.put(ROOT, sealed(root, ROOT))
            self._delete(gone)
        self._files = in_use | described
        self._documents, self._digests, self.root = documents, digests, root

    def tidy(self) -> None:
        """Remove the files of the ledger that do not count any more, at the end of a run."""
        with writing(self.location):
            self._ledger.tidy()

    def lost(self) -> list[str]:
        """Return those of the files that were written which are not there any more, as after the folder was moved;
        raises SweepError where that cannot be told.
        """
        documents = {f"{name}/zarr.json" for name in self._documents}
        needed = {ROOT, *self._ledger.files, *documents, *snapshot.chunk_keys(self._documents)}
        with reading(self.location):
            content = self.location.get(ROOT)
            gone = needed - set(self.location.keys())
            gone |= set() if self._ledger.is_unchanged() else {MANIFEST}
        return sorted(gone if content == sealed(self.root, ROOT) else gone | {ROOT})

    def _delete(self, keys: Iterable[str]) -> None:
        for key in keys:
            self.location.delete(key)

    def _named(self, name: str, array: snapshot.Encoded, digest: bytes) -> snapshot.Encoded:
        """Name an array's chunks: as in the last generation if nothing has changed, else by the other set of names."""
        if name not in self._documents:
            return array.named(0)
        last = snapshot.encoding_of(self._documents[name])
        return array.named(last if self._digests.get(name) == digest else 1 - last)

    def _write_arrays(self, arrays: Mapping[str, snapshot.Encoded], attributes: Mapping[str, Any]) -> None:
        """Write the values first and the status last, for those who read without the root document."""
        for names in (set(arrays) - {"status"}, {"status"} & set(arrays)):
            self.location.put_all({k: content for name in names for k, content in arrays[name].files(name).items()})
            files = {f"{name}/zarr.json": arrays[name].document for name in names}
            self.location.put_all({file: snapshot.described(told, file, attributes) for file, told in files.items()})

    @property
    def next_row(self) -> int:
        """The row of the ledger that the next block gets."""
        return self.rows.end

    def record(self, attributes: Mapping[str, Any]) -> None:
        """Record more of the study, such as which code makes the blocks from now on, before there are any."""
        if all(self.attributes.get(name) == value for name, value in attributes.items()):
            return
        self.root = {**self.root, "attributes": {**self.attributes, **attributes}}
        with writing(self.location):
            self.location.put(ROOT, sealed(self.root, ROOT))
            self._ledger.put("study", copied(self.attributes))

    def keep_copy(self, attributes: Mapping[str, Any] | None = None) -> None:
        """Write a copy of what the store means, the new ``attributes`` or its own, into the ledger if the study has
        changed.
        """
        attributes = self.attributes if attributes is None else attributes
        copy = self._ledger.copy
        if copy is None or any(copy.get(key) != attributes.get(key) for key in ("study_digest", FORMAT_OF)):
            self._ledger.put("study", copied(attributes))


def _fits(before: np.dtype[np.void], dtype: np.dtype[np.void]) -> bool:
    """Return whether rows can be of another type: the same but for the order, and integers that become floats."""
    if set(before.names or ()) != set(dtype.names or ()):
        return False
    pairs = [(before[name], dtype[name]) for name in before.names or ()]
    return all(a == b or (a.shape == b.shape and (a.base.kind, b.base.kind) == ("i", "f")) for a, b in pairs)


def find_store(where: Where) -> OpenStore | None:
    """Return the store at a place, None where the place is free; raises SweepError where something else is there."""
    location = located(where)
    root = find_root(location)
    if root is None:
        if obstacle := location.obstacle():
            raise SweepError(obstacle, str(location))
        return None
    if RESCUED in root["attributes"]:
        raise SweepError(
            "holds results of a store that was lost, and no ledger; give another one with -o", str(location)
        )
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
        arrays = snapshot.leftovers(keys, snapshot.arrays_of(root))
        ours = {*arrays, *(key for key in keys if key.partition("/")[0] == FOLDER)} - {MANIFEST}
        # If the process is killed after any of these, the old store has merely lost its results, then its blocks.
        put_root(location, emptied)
        for key in (MANIFEST, *sorted(ours)):
            location.delete(key)
        return create_store(location, attributes)


def put_root(location: Location, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Write the root document of a store without results."""
    root = group_document({**attributes, FORMAT_OF: FORMAT, "complete": 0, "generation": 0}, {})
    location.put(ROOT, sealed(root, ROOT))
    return root


def free_beside(location: Location) -> Location:
    """Return a free place beside a store, for what was computed for it."""
    for number in itertools.count(1):
        place = located(f"{location}.rescued{number if number > 1 else ''}")
        with suppress(SweepError):
            if find_root(place) is None:
                return place
    raise AssertionError


def open_dataset(where: Where) -> "xr.Dataset":
    """Return the labelled dataset of a store, in memory, as it was written at one time, whatever a run does meanwhile.

    Raises SweepError unless a linksweep store of this format is there, if there is no dataset yet or it is damaged.
    """
    return OpenStore(where).dataset()


def read_root(location: Location) -> dict[str, Any]:
    """Return the root document; raises SweepError unless a whole linksweep store of a known format is there."""
    root = find_root(location)
    if root is None:
        raise SweepError("no store there", str(location))
    return root


def find_root(location: Location) -> dict[str, Any] | None:
    """Return the root document, None where nothing is; raises SweepError as `read_root`."""
    where = str(location)
    with reading(location):
        location.require_plain()
        content = location.get(ROOT)
        if content is None:
            if location.is_free():
                return None
            if obstacle := location.obstacle():
                raise SweepError(obstacle, where)
        try:
            root = unsealed(content, ROOT)
            _check_format(root["attributes"], where)
            check_root(root)
            return root
        except (ValueError, KeyError) as error:
            if readable_copy(location) is not None:
                problem = "it is another document" if isinstance(error, KeyError) else error
                raise SweepError(f"{ROOT} is damaged ({problem}); {REPAIR.format(where)}", where) from error
            with suppress(ValueError, KeyError, TypeError, RecursionError):  # the checksum of another format
                _check_format(json.loads(content or b"")["attributes"], where)
            raise SweepError(_without_meaning(location, content or b""), where) from error


def _without_meaning(location: Location, content: bytes) -> str:
    """Say what a place is that has neither a whole root document nor a copy of one."""
    lost = "so that nothing tells what the numbers mean; bring one back from a backup, or run the study into a new"
    if location.get(MANIFEST) is not None:
        return f"{ROOT} and its copy in {FOLDER} are both damaged, {lost} store with -o"
    if any(mark in content for mark in MARKS):
        return f"{ROOT} is damaged and has no copy yet, {lost} store with -o; no results were in it"
    return "is not a store of linksweep (foreign or half-made); nothing was changed"


def _check_format(attributes: Mapping[str, Any], where: str) -> None:
    """Raise SweepError for a store of a format that this version does not read; KeyError for what is no store."""
    version = attributes[FORMAT_OF]
    if version != FORMAT and isinstance(version, int):
        age = "newer: upgrade with `pip install -U linksweep`" if version > FORMAT else ""
        age = age or "older, from before the first release: run the study into a new store with -o"
        raise SweepError(
            f"has store format {version}; this version of linksweep reads format {FORMAT}. It is {age}",
            where,
        )
    if version != FORMAT:
        raise KeyError(FORMAT_OF)


def manifest_of(root: Mapping[str, Any]) -> Manifest:
    """Return what the ledger held when a root document was written."""
    attributes = root["attributes"]
    if LEDGER_THEN not in attributes:
        return Manifest(store=attributes[STORE])
    return Manifest.model_validate_json(attributes[LEDGER_THEN])


def is_new(root: Mapping[str, Any]) -> bool:
    """Return whether no results were written to a store yet: a run has just begun, or ended in its first moment."""
    return not root["attributes"].get("generation")


def readable_copy(location: Location) -> dict[str, Any] | None:
    """Return the ledger's copy of a store's attributes; None where it is missing, damaged or of another format."""
    try:
        manifest = read_manifest(location.get(MANIFEST))
        file = manifest.documents["study"]
        content = location.get(path_of(file))
        if problem_of(content, file.checksum):
            return None
        attributes: dict[str, Any] = json.loads(content or b"")
        check_attributes(attributes)
    except (ValueError, LookupError, RecursionError):
        return None
    return attributes if (attributes.get(FORMAT_OF), attributes[STORE]) == (FORMAT, manifest.store) else None


def copied(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes that the ledger's copy has: all but those about one writing."""
    left_out = ("failures", "generation", BLOCKS, CHUNKS, LEDGER_THEN, SEAL, REVISION)
    return {key: value for key, value in attributes.items() if key not in left_out}


def origin(location: Location) -> str:
    """Return the host, the user and the place of a store that this process writes."""
    place = str(location.path.resolve()) if isinstance(location, Folder) else str(location)
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in a container
        user = str(os.getuid())
    return json.dumps({"host": host(), "user": user, "path": place})


def was_written_here(location: Location, attributes: Mapping[str, Any]) -> bool:
    """Return whether the last run that wrote to a store was of this user, on this host, with the store at this place.

    The store itself says so: this guards against code in a copied store, not against someone who forges these three.
    """
    return bool(attributes.get(ORIGIN) == origin(location))


def damaged_ledger(location: Location, files: Mapping[str, str]) -> SweepError:
    """Return the error that names damaged files of a ledger, and what to do."""
    problems = [f"{file} is damaged ({problem})" for file, problem in files.items()]
    problems[-1] += f"; {REPAIR.format(location)}, and the next `sweep run` computes again what is lost"
    return SweepError(problems, str(location))


@contextmanager
def reading_ledger(location: Location) -> Iterator[None]:
    """Turn an OSError, or the DamagedError of a ledger, into a SweepError."""
    try:
        with reading(location):
            yield
    except DamagedError as error:
        raise damaged_ledger(location, error.files) from error
