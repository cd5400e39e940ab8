"""The store of a study: a ledger of finished blocks and failures, and the labelled dataset made from it.

The ledger is the truth.  Only the client writes, under the lock of `sweep.stores.lock`.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from linksweep.sweep.contract import Array, SweepError
from linksweep.sweep.functions.values import TEXT_BYTES
from linksweep.sweep.stores import chunk_names, failures, snapshot
from linksweep.sweep.stores.checksums import DamagedError, sealed
from linksweep.sweep.stores.identity import identity
from linksweep.sweep.stores.location import Where, reading, writing
from linksweep.sweep.stores.manifest import MANIFEST, STORE
from linksweep.sweep.stores.opened import OpenStore, reading_ledger
from linksweep.sweep.stores.origin import ORIGIN, origin
from linksweep.sweep.stores.root import COPY, LEDGER_THEN, ROOT, copied
from linksweep.sweep.studies.study import Study

if TYPE_CHECKING:
    import xarray as xr

BLOCKS = "blocks"
"""The attribute that tells how many blocks the ledger had when the dataset was written."""

CODE = "code"
"""The attribute that tells which code made the rows of the ledger."""

MOST_UNWRITTEN = 2**26
"""Bytes of sums and samples that may wait for the next flush."""


class Store(OpenStore):
    """The open store of one study: what is done, appending to it, and writing the dataset."""

    def __init__(self, opened: OpenStore, study: Study) -> None:
        """Open the ledger; raises SweepError where files of it are damaged, or it has the layout of another version."""
        super().__init__(opened.location, opened.root)
        self.study = study
        widths, expected = (
            {name: width for name, (_, width) in json.loads(told["ledger"]).items()}
            for told in (self.attributes, identity(study))
        )
        if widths != expected:
            raise SweepError(
                "another version of linksweep made this store, with other sums in its ledger: its results can be read, "
                "but to compute more run the study into a new store with -o",
                str(self.location),
            )
        self._ledger = self.ledger()
        self.failures, self._copied, self.rows = self._ledger.failures, self._ledger.copy, self._ledger.rows
        self.texts = self.texts_of(self._ledger)
        self._leave_out_rows_without_texts()
        self._failures_changed = False
        self._unwritten = 0
        try:
            self._documents = snapshot.arrays_of(self.root)
        except ValueError as error:
            raise SweepError(str(error), str(self.location)) from error
        self._digests: dict[str, bytes] = {}
        self._files = chunk_names.leftovers(self._ledger.keys, self._documents)

    def _leave_out_rows_without_texts(self) -> None:
        """Count rows as missing if their texts are missing, so that these points are computed again."""
        if not (places := self.study.experiment.text_places()):
            return
        sums = self._ledger.sums()
        without = []
        for key, row in self.rows.items():
            content = sums[row].tobytes()
            if any(content[start : start + TEXT_BYTES] not in self.texts for start in places):
                without.append(key)
        self.rows.remove(without)

    def sums(self) -> Array:
        """Return the sums of all rows of the ledger, (rows, width); `rows` has the row of each block."""
        with reading_ledger(self.location):
            return self._ledger.sums()

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

    def append(self, keys: Sequence[bytes], sums: Array, samples: Sequence[Array], texts: Mapping[bytes, str]) -> None:
        """Add finished blocks, with their samples if the study keeps them, and the texts in them by their digests; they
        are durable after the next `flush`.
        """
        if not keys:
            return
        self.texts.add(texts)
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
                self._ledger.put(failures.FILE, {"failures": failures.as_json(self.failures)})
                self._failures_changed = False
            self.texts.flush()  # before the rows that refer to them
            self._ledger.flush()
            self._unwritten = 0

    def write(self, dataset: "xr.Dataset") -> None:
        """Replace the labelled dataset, in one step for readers; raises SweepError where it cannot be written."""
        attributes, arrays = snapshot.encode(dataset)
        digests = {name: array.digest() for name, array in arrays.items()}
        named = {name: self._named(name, array, digests[name]) for name, array in arrays.items()}
        attributes |= identity(self.study) | {
            ORIGIN: origin(self.location),
            "ledger": self.attributes["ledger"],
            **({CODE: self.attributes[CODE]} if CODE in self.attributes else {}),
            "generation": self.attributes["generation"] + 1,
            STORE: self.attributes[STORE],
            BLOCKS: len(self.rows),
            snapshot.CHECKSUMS: json.dumps({name: array.checksums() for name, array in named.items()}),
        }
        documents = {name: array.document for name, array in named.items()}
        in_use = {*chunk_names.chunk_keys(documents), *chunk_names.chunk_keys(self._documents)}
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
            root = snapshot.root_document(attributes, documents)
            self.location.put(ROOT, sealed(root, ROOT))
            self._delete(gone)
        self._files = in_use | described
        self._documents, self._digests, self.root = documents, digests, root

    def lost(self) -> list[str]:
        """Return those of the files that were written which are not there any more, as after the folder was moved;
        raises SweepError where that cannot be told.
        """
        documents = {f"{name}/zarr.json" for name in self._documents}
        needed = {ROOT, *self._ledger.files, *documents, *chunk_names.chunk_keys(self._documents)}
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
        last = chunk_names.encoding_of(self._documents[name])
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
        return self._ledger.next_row

    def record_code(self, code: str) -> None:
        """Record which code makes the blocks from now on, before it makes any."""
        if self.attributes.get(CODE) == code:
            return
        self.root = {**self.root, "attributes": {**self.attributes, CODE: code}}
        with writing(self.location):
            self.location.put(ROOT, sealed(self.root, ROOT))
        self._copied = None
        self.keep_copy()

    def keep_copy(self, attributes: Mapping[str, Any] | None = None) -> None:
        """Write a copy of what the store means, the new ``attributes`` or its own, into the ledger if the study has
        changed; raises SweepError where it cannot be written.
        """
        attributes = self.attributes if attributes is None else attributes
        decisive = ("study_digest", "linksweep_format", "ledger")
        if self._copied is None or any(self._copied.get(key) != attributes.get(key) for key in decisive):
            self._copied = copied(attributes)
            with writing(self.location):
                self._ledger.put(COPY, self._copied)


def open_dataset(where: Where) -> "xr.Dataset":
    """Return the labelled dataset of a store, in memory, as it was written at one time, whatever a run does meanwhile.

    Raises SweepError unless a linksweep store of this format is there, if there is no dataset yet or it is damaged.
    """
    return OpenStore(where).dataset()
