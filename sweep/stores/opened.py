"""Opens a store for reading by its root document: the dataset that this refers to, and the ledger.

Nothing here writes, and nothing imports what a store names.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores import chunk_names, snapshot
from linksweep.sweep.stores.checksums import DamagedError
from linksweep.sweep.stores.ledger import Ledger
from linksweep.sweep.stores.location import Location, Where, located, reading
from linksweep.sweep.stores.root import REPAIR, is_new, manifest_of, read_root
from linksweep.sweep.stores.texts import Texts

if TYPE_CHECKING:
    import xarray as xr

ATTEMPTS = 20
"""How often a reader begins anew because the dataset was replaced while it was read."""

UNFINISHED = (
    "is unfinished: its run has just begun, or ended before it wrote results; nothing is damaged, "
    "and the same `sweep run` goes on"
)


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
            ledger = Ledger(self.location, json.loads(self.attributes["ledger"]), manifest_of(self.root))
            if ledger.damaged:
                raise DamagedError(ledger.damaged)
            return ledger

    def texts_of(self, ledger: Ledger) -> Texts:
        """Return the texts in a ledger; raises SweepError that names damaged files."""
        with reading_ledger(self.location):
            texts = Texts(self.location, ledger)
            if texts.damaged:
                raise DamagedError(texts.damaged)
            return texts


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
