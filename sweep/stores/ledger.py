"""The ledger of finished blocks: ``index`` says which block a row is (32 bytes as `ledger_key`) and at which row of
``samples`` its realisations begin (8 bytes), ``sums`` are the block's sums, ``samples`` the realisations themselves,
where a study keeps them.  The failed points, the texts and a copy of the root's attributes are documents beside these.

Only what the manifest, written last, says is there counts.
"""

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Array, SweepError
from linksweep.sweep.planning.block_rows import KEY_BYTES, BlockRows
from linksweep.sweep.stores import failures
from linksweep.sweep.stores.checksums import DamagedError, noting
from linksweep.sweep.stores.ledger_arrays import KINDS, START_BYTES, Column
from linksweep.sweep.stores.location import Location
from linksweep.sweep.stores.manifest import MANIFEST, Documents, Manifest, Part, newest
from linksweep.sweep.stores.root import COPY

ROW = np.dtype([("key", f"V{KEY_BYTES - 8}"), ("n_cat", "<u4"), ("n_sim", "<u4"), ("start", "<u8")])
"""A row of the index: the key ends with the number of catalogues and the number of realisations of each."""


CHANGED = "its ledger was removed, or changed by others, during this run"


class Ledger:
    """Knows the row of every finished block, and appends others."""

    def __init__(self, location: Location, shapes: Mapping[str, Sequence[int]], of_root: Manifest) -> None:
        """Read all but samples and texts; ``damaged`` has what is wrong with which file.  Raises OSError.

        ``shapes`` are the rows and the width of a chunk of each array, ``of_root`` is what the root document knows.
        """
        self._location = location
        self.damaged: dict[str, str] = {}
        self.keys = frozenset(location.keys())
        content = location.get(MANIFEST)
        self.manifest = of_root
        self._contents: tuple[bytes | None, ...] = (content,)
        with noting(self.damaged, MANIFEST):
            self.manifest = newest(content, of_root, shapes)
        self.columns = {
            name: Column(location, f"blocks/{name}", shapes[name], dtype, self.manifest.columns.get(name, Part()))
            for name, dtype in KINDS.items()
            if name in shapes
        }
        self.documents = Documents(location, self.manifest)
        self.damaged |= {key: "it is missing" for key in self.files if key not in self.keys | {MANIFEST}}
        found = location.get_all([COPY, failures.FILE, *(column.description for column in self.columns.values())])
        for column in self.columns.values():
            with noting(self.damaged, column.description):
                column.check_description(found[column.description])
        self.copy: dict[str, Any] | None = None
        self.failures: dict[bytes, failures.Record] = {}
        with noting(self.damaged, COPY):
            self.copy = self.documents.read(COPY, found[COPY])
        with noting(self.damaged, failures.FILE):
            self.failures = failures.read(self.documents.read(failures.FILE, found[failures.FILE]))
        index, sums = (self.columns[name].read(self.damaged) for name in ("index", "sums"))
        keys, starts, counts = rows_of(index)
        if "samples" in self.columns and (starts + counts > self.columns["samples"].rows).any():
            self.damaged[MANIFEST] = "it has fewer samples than blocks/index"
        self._sums: Array | None = sums
        self._changed = False
        self._starts = array("q", starts.tobytes())
        self.rows = BlockRows(keys, np.asarray(index.any(axis=1)))

    @property
    def next_row(self) -> int:
        """The row that the next block gets."""
        return len(self._starts)

    @property
    def files(self) -> list[str]:
        """The names of the files that count."""
        chunks = [key for column in self.columns.values() for key in column.keys]
        return [*([MANIFEST] if self.manifest.revision else []), *self.manifest.documents, *chunks]

    @property
    def is_ahead(self) -> bool:
        """Whether there are chunks that the manifest does not know: a run ended while it wrote them."""
        known = {key for column in self.columns.values() for key in column.keys}
        chunks = {key for key in self.keys if key.startswith("blocks/") and "/c/" in key}
        return self.documents.known != self.manifest.documents or bool(chunks - known)

    def sums(self) -> Array:
        """Return the sums of all rows, (rows, width); `rows` has that of each block.  Raises DamagedError, OSError."""
        self.flush()
        if self._sums is None:
            damaged: dict[str, str] = {}
            self._sums = self.columns["sums"].read(damaged)
            if damaged:
                raise DamagedError(damaged)
        return self._sums

    def samples(self, key: bytes) -> Array:
        """Return the kept samples of a finished block that was flushed, (realisations, width); raises DamagedError,
        OSError.
        """
        start = self._starts[self.rows[key]]
        count = int(rows_of(_index_rows([key], [start]))[2][0])
        return np.asarray(self.columns["samples"].rows_between(start, start + count))

    def verify(self) -> None:
        """Add to ``damaged`` the samples that are not what was written; opening has checked the rest but the texts."""
        if "samples" in self.columns:
            self.columns["samples"].verify(self.damaged)

    def append(self, keys: Sequence[bytes], sums: Array, samples: Sequence[Array]) -> None:
        """Add finished blocks; durable after `flush`."""
        self._sums, self._changed = None, True
        starts = [0] * len(keys)
        if samples:
            column = self.columns["samples"]
            starts = np.cumsum([column.end, *map(len, samples)])[:-1].tolist()
            column.append(np.concatenate(samples))
        index = _index_rows(keys, starts)
        self.columns["sums"].append(sums)
        self.columns["index"].append(index)
        self._starts.extend(starts)
        self.rows.extend(keys)

    def put(self, file: str, attributes: Mapping[str, Any]) -> None:
        """Replace a document; it counts after the next `flush`."""
        self._changed = True
        self.documents.put(file, attributes)

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
        for column in self.columns.values():
            column.flush()
        parts = {name: column.part for name, column in self.columns.items()}
        revision = self.manifest.revision + 1
        known = dict(self.documents.known)
        manifest = Manifest(store=self.manifest.store, revision=revision, columns=parts, documents=known)
        content = manifest.sealed()
        self._contents = (*self._contents, content)  # an answer may be lost although it was written
        self._location.put(MANIFEST, content)
        self.manifest, self._contents, self._changed = manifest, (content,), False


def rows_of(index: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """Return the keys of rows of the index, where their samples begin and how many there are."""
    rows = index.view(ROW)[:, 0]
    return index[:, :KEY_BYTES], rows["start"].astype(np.int64), rows["n_cat"].astype(np.int64) * rows["n_sim"]


def _index_rows(keys: Sequence[bytes], starts: Sequence[int]) -> NDArray[np.uint8]:
    index = b"".join(k + start.to_bytes(START_BYTES, "little") for k, start in zip(keys, starts, strict=True))
    return np.frombuffer(index, dtype=np.uint8).reshape(len(keys), KEY_BYTES + START_BYTES)
