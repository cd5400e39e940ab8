"""Opens a store for reading by its root document: the dataset that this refers to, and the ledger.

Nothing here writes, and nothing imports what a store names.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sweep.contract import SweepError
from sweep.stores import chunk_names, failures, snapshot
from sweep.stores.checksums import DamagedError, noting, unsealed
from sweep.stores.ledger import Ledger
from sweep.stores.ledger_arrays import columns_of
from sweep.stores.location import Location, Where, located, reading
from sweep.stores.root import COPY, REPAIR, is_bound, is_new, read_root

if TYPE_CHECKING:
    import xarray as xr

ATTEMPTS = 20
"""How often a reader begins anew because the dataset was replaced while it was read."""

UNFINISHED = (
    "is unfinished: its run has just begun, or ended before it wrote results; nothing is damaged, "
    "and the same `sweep run` goes on"
)


@dataclass(frozen=True)
class OpenLedger:
    """The ledger with the failures beside it, the copy of the root's attributes in it, and all files of the store."""

    ledger: Ledger
    failures: dict[bytes, failures.Record]
    copy: dict[str, Any] | None
    keys: list[str]


class OpenStore:
    """A store of which the root document was read."""

    def __init__(self, where: Where, root: Mapping[str, Any] | None = None) -> None:
        """Read the root document unless it is given; raises SweepError unless a store of a known format is there."""
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
                    chunks = self.location.get_all(chunk_names.chunk_keys(snapshot.arrays_of(self.root)))
                    dataset = snapshot.decode(self.root, chunks)
            except ValueError as error:
                problem = error
            if problem is None and is_bound(self.root):
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

    def ledger(self, compared: bool = True) -> OpenLedger:
        """Return the ledger, its rows ``compared`` with their digests.

        Raises SweepError that names the damaged files of the ledger.
        """
        damaged: dict[str, str] = {}
        copy: dict[str, Any] | None = None
        with reading(self.location):
            keys = self.location.keys()
            columns = columns_of(self.location, json.loads(self.attributes["ledger"]), keys)
            files = [COPY, failures.FILE, *(column.description for column in columns.values())]
            documents = self.location.get_all(files)
            for column in columns.values():
                with noting(damaged, column.description):
                    column.check_description(documents[column.description])
            with noting(damaged, COPY):
                if documents[COPY] is not None:
                    copy = unsealed(documents[COPY], COPY)["attributes"]
            with noting(damaged, failures.FILE):
                found = failures.read(documents[failures.FILE])
            with noting(damaged):
                ledger = Ledger(columns, compared)
        if damaged:
            raise damaged_ledger(self.location, damaged)
        return OpenLedger(ledger, found, copy, keys)


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
