"""The store of a study: a ledger of finished blocks and failures, and the labelled dataset made from it.

The ledger is the truth.  Only the client writes, under the lock of `sweep.stores.lock`.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import xarray as xr

from sweep.contract import Array, SweepError
from sweep.stores import failures, snapshot
from sweep.stores.checksums import group_document, sealed, unsealed
from sweep.stores.chunked_rows import DamagedError
from sweep.stores.identity import COPY, REPAIR, ROOT, damaged_copy, differences, find_root, identity, read_root
from sweep.stores.ledger import Ledger, columns_of, damaged_descriptions
from sweep.stores.location import Location, Where, located, reading, writing
from sweep.studies.study import Study

FAILURES = "failures/zarr.json"
RESERVED = {"blocks", "failures"}
CODE = "code"
"""The attribute that tells which code made the rows of the ledger."""

MOST_UNWRITTEN = 2**26
"""Bytes of sums and samples that may wait for the next flush."""

ATTEMPTS = 20
"""How often a reader begins anew because the dataset was replaced while it was read."""


class Store:
    """An open store of one study: what is done, appending to it, and writing the dataset."""

    def __init__(self, where: Where, study: Study) -> None:
        """Open the ledger; raises SweepError as `read_attributes`, or where files of it are damaged."""
        self.location, self.study = located(where), study
        root = read_root(self.location)
        self.attributes: dict[str, Any] = root["attributes"]
        shapes = json.loads(self.attributes["ledger"])
        expected = json.loads(identity(study)["ledger"])
        if {name: width for name, (_, width) in shapes.items()} != {n: width for n, (_, width) in expected.items()}:
            raise SweepError("the ledger's rows have other lengths; the store was made by another version", str(where))
        damaged: dict[str, str] = {}
        with reading(self.location):
            keys = self.location.keys()
            columns = columns_of(self.location, shapes, keys)
            documents = self.location.get_all([COPY, FAILURES, *(c.description for c in columns.values())])
            damaged |= damaged_descriptions(columns.values(), documents)
            damaged |= damaged_copy(documents[COPY])
            try:
                self.failures = failures.read(documents[FAILURES])
                self._ledger = Ledger(columns)
            except ValueError as error:
                damaged[FAILURES] = str(error)
            except DamagedError as error:
                damaged |= error.files
        if damaged:
            raise _damaged_ledger(self.location, damaged)
        self._copied = None if documents[COPY] is None else unsealed(documents[COPY])["attributes"]
        self.rows = self._ledger.rows
        self._failures_changed = False
        self._unwritten = 0
        try:
            self._documents = snapshot.arrays_of(root)
        except ValueError as error:
            raise SweepError(str(error), str(self.location)) from error
        self._digests: dict[str, bytes] = {}
        self._files = snapshot.leftovers(keys, self._documents)

    def sums(self) -> Array:
        """Return all rows of the ledger, (rows, width); `rows` says which is whose."""
        with reading(self.location):
            return self._ledger.sums()

    def samples(self, key: bytes) -> Array:
        """Return the kept samples of a finished block, (realisations, width); raises SweepError where they are
        damaged.
        """
        try:
            with reading(self.location):
                return self._ledger.samples(key)
        except DamagedError as error:
            raise _damaged_ledger(self.location, error.files) from error

    def verify(self) -> None:
        """Raise SweepError where files of the ledger that opening did not read are damaged."""
        try:
            with reading(self.location):
                self._ledger.verify()
        except DamagedError as error:
            raise _damaged_ledger(self.location, error.files) from error

    def append(self, keys: Sequence[bytes], sums: Array, samples: Sequence[Array] = ()) -> None:
        """Add finished blocks, with their samples if the study keeps them; they are durable after the next `flush`."""
        if not keys:
            return
        self._ledger.append(keys, sums, samples)
        self._unwritten += sums.nbytes + sum(kept.nbytes for kept in samples)
        if self._unwritten > MOST_UNWRITTEN:
            self.flush()

    def fail(self, digest: bytes, record: failures.Record) -> None:
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
                document = group_document({"failures": failures.as_json(self.failures)})
                self.location.put(FAILURES, sealed(document))
                self._failures_changed = False
            self._ledger.flush()
            self._unwritten = 0

    def write(self, dataset: xr.Dataset) -> None:
        """Replace the labelled dataset, in one step for readers; raises SweepError where it cannot be written."""
        attributes, arrays = snapshot.encode(dataset)
        attributes |= identity(self.study) | {
            "ledger": self.attributes["ledger"],
            **({CODE: self.attributes[CODE]} if CODE in self.attributes else {}),
            "generation": self.attributes.get("generation", 0) + 1,
        }
        digests = {name: array.digest() for name, array in arrays.items()}
        named = {name: self._named(name, array, digests[name]) for name, array in arrays.items()}
        documents = {name: array.document for name, array in named.items()}
        in_use = {*snapshot.chunk_keys(documents), *snapshot.chunk_keys(self._documents)}
        described, gone = (
            {f"{n}/zarr.json" for n in names} for names in (documents, set(self._documents) - set(documents))
        )
        with writing(self.location):
            self.keep_copy(attributes)
            self._delete(self._files - in_use - described - gone)
            self._write_arrays(
                {name: array for name, array in named.items() if self._digests.get(name) != digests[name]}
            )
            self.location.put(ROOT, sealed(snapshot.root_document(attributes, documents)))
            self._delete(gone)
        self._files = in_use | described
        self._documents, self._digests, self.attributes = documents, digests, attributes

    def _delete(self, keys: Iterable[str]) -> None:
        for key in keys:
            self.location.delete(key)

    def _named(self, name: str, array: snapshot.Encoded, digest: bytes) -> snapshot.Encoded:
        """Name an array's chunks: as the last generation does if nothing has changed, or else as it does not."""
        if name not in self._documents:
            return array.named(0)
        last = snapshot.encoding_of(self._documents[name])
        return array.named(last if self._digests.get(name) == digest else 1 - last)

    def _write_arrays(self, arrays: Mapping[str, snapshot.Encoded]) -> None:
        """Write values, and then the status that speaks of them, for those who read without the root document."""
        for names in (set(arrays) - {"status"}, {"status"} & set(arrays)):
            self.location.put_all({k: content for name in names for k, content in arrays[name].files(name).items()})
            self.location.put_all({f"{n}/zarr.json": json.dumps(arrays[n].document).encode() for n in names})

    @property
    def next_row(self) -> int:
        """The row of the ledger that the next block gets."""
        return self._ledger.next_row

    def record_code(self, code: str) -> None:
        """Remember, before anything of it is computed, which code makes the blocks from now on."""
        if self.attributes.get(CODE) == code:
            return
        root = read_root(self.location)
        root["attributes"][CODE] = self.attributes[CODE] = code
        with writing(self.location):
            self.location.put(ROOT, sealed({key: value for key, value in root.items() if key != "checksum"}))
            self._copied = None
            self.keep_copy(self.attributes)

    def keep_copy(self, attributes: Mapping[str, Any]) -> None:
        """Keep a copy of what the store means in the ledger, if the study has changed since the last one."""
        if self._copied is None or self._copied.get("study_digest") != attributes.get("study_digest"):
            copied = {key: value for key, value in attributes.items() if key not in ("failures", "generation")}
            self.location.put(COPY, sealed(group_document(copied)))
            self._copied = copied


def create_or_resume(where: Where, study: Study, attributes: Mapping[str, Any]) -> Store:
    """Return the store at a place, made in one step if there is none.

    Raises SweepError where something else is there, results that cannot be mixed with this study's, or damaged ones.
    """
    location = located(where)
    if check_store(location, study):
        with writing(location):
            root = snapshot.root_document({**attributes, **identity(study), "complete": 0, "generation": 0}, {})
            location.put(ROOT, sealed(root))
    store = Store(location, study)
    with writing(location):
        store.keep_copy(store.attributes)
    return store


def existing_store(where: Where, study: Study) -> Store | None:
    """Return the store at a place if there is one, without writing; raises SweepError as `create_or_resume`."""
    location = located(where)
    return None if check_store(location, study) else Store(location, study)


def check_store(where: Where, study: Study) -> bool:
    """Return whether a place is free; raises SweepError unless it is, or holds results that this study can be mixed
    with.
    """
    names = {*study.axes, *study.experiment.coordinates}
    names |= {output.name for output in (*study.experiment.outputs, *study.experiment.sample_outputs)}
    if taken := sorted(RESERVED & names):
        raise SweepError(f"no axis or result can be named {', '.join(taken)}: a store has a group of that name")
    location = located(where)
    root = find_root(location)
    if root is None and (obstacle := location.obstacle()):
        raise SweepError(obstacle, str(location))
    if root is not None and (different := differences(root["attributes"], study)):
        raise SweepError(
            ["holds results of a different study, which would be mixed up; give another store with -o", *different],
            str(location),
        )
    return root is None


def read_attributes(where: Where) -> dict[str, Any]:
    """Return the attributes of a store; raises SweepError unless a linksweep store of this format is there."""
    attributes: dict[str, Any] = read_root(located(where))["attributes"]
    return attributes


def finished_blocks(where: Where) -> int:
    """Return how many blocks the ledger of a store holds, whatever its dataset says; raises SweepError as
    `read_attributes`, and where the ledger is damaged.
    """
    location = located(where)
    shapes = json.loads(read_attributes(location)["ledger"])
    try:
        with reading(location):
            columns = columns_of(location, shapes, location.keys("blocks/"))
            return int(columns["index"].read().any(axis=1).sum())
    except DamagedError as error:
        raise _damaged_ledger(location, error.files) from error


def open_dataset(where: Where) -> xr.Dataset:
    """Return the labelled dataset of a store, in memory, as one writing of it left it, whatever a run does meanwhile.

    Raises SweepError as `read_attributes`, if there is none yet or if it is damaged.
    """
    location = located(where)
    root = read_root(location)
    for _ in range(ATTEMPTS):
        problem: ValueError | None = None
        try:
            with reading(location):
                dataset = snapshot.decode(root, location.get_all(snapshot.chunk_keys(snapshot.arrays_of(root))))
        except ValueError as error:
            problem = error
        before, root = root, read_root(location)
        if root == before:
            break
    else:
        raise SweepError("is being written faster than it can be read; try again", str(location))
    if problem is not None:
        rewrite = "`sweep run` the study again to write them anew from the ledger"
        raise SweepError(f"the results are damaged ({problem}); {rewrite}", str(location)) from problem
    if not dataset.data_vars:
        raise SweepError("has no results yet; `sweep run` the study to go on", str(location))
    return dataset


def _damaged_ledger(location: Location, files: Mapping[str, str]) -> SweepError:
    problems = [f"{file} is damaged ({problem})" for file, problem in files.items()]
    problems[-1] += f"; {REPAIR.format(location)}, and the next `sweep run` computes again what is lost"
    return SweepError(problems, str(location))
