"""Checks every file of a store, and sets damaged ones aside so that the next run writes them anew."""

import json
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.contract import SweepError
from sweep.stores import chunk_names, failures, snapshot
from sweep.stores.checksums import DamagedError, group_document, noting, sealed, unsealed
from sweep.stores.ledger import Ledger, rows_of
from sweep.stores.ledger_arrays import Column, columns_of
from sweep.stores.location import Location, Where, located, reading, writing
from sweep.stores.lock import holder, locked
from sweep.stores.opened import UNFINISHED
from sweep.stores.root import COPY, FORMAT, ROOT, UNBOUND, find_root, is_bound, is_new, readable_copy
from sweep.stores.texts import Texts

NOT_BOUND = (
    f"has store format {UNBOUND}, which does not record where a chunk belongs: files that were exchanged are not "
    f"found.  The next `sweep run` of the study makes it format {FORMAT}, in which they are"
)
CUT_SHORT = (
    "is unfinished: its run ended while it wrote the results; nothing is damaged, and the same `sweep run` goes on"
)


@dataclass(frozen=True)
class Report:
    """What is wrong with which file: of those that say what the store means (``identity``), of the ``ledger``, and of
    the ``results``, which can be written anew from the ledger.

    ``remarks`` are sentences about a store in which nothing is wrong: that it is unfinished, or of an older format.
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
        _check(location)  # raises for what is no store, before anything is written
    with locked(location, break_lock=break_lock), writing(location):
        report, attributes, columns = _check(location)
        done: list[str] = []
        for file in report.identity:
            _set_aside(location, file)
        if ROOT in report.identity:
            root = snapshot.root_document({**attributes, "complete": 0, "generation": 0}, {})
            location.put(ROOT, sealed(root, ROOT))
            done.append(f"{ROOT} was made anew from {COPY}; the results are not in it until `sweep run` writes them")
        if COPY in report.identity:
            location.put(COPY, sealed(group_document(attributes), COPY))
            done.append(f"{COPY} was made anew from {ROOT}")
        for file in sorted(report.ledger, key=lambda file: not file.startswith("blocks/index/")):
            done.append(_remake(location, file, columns))
        if report.results:
            files = ", ".join(report.results)
            done.append(f"{files}: the next `sweep run` writes the results anew from the ledger")
        return done


def _check(location: Location) -> tuple[Report, dict[str, Any], dict[str, Column]]:
    """Return the report, what the store means, and the columns of its ledger."""
    report = Report({}, {}, {})
    root: dict[str, Any] | None = None
    try:
        root = find_root(location)
        if root is None:
            raise SweepError("no store there", str(location))
        attributes = root["attributes"]
    except SweepError:
        copy = readable_copy(location)
        if copy is None:
            raise
        attributes = copy
        report.identity[ROOT] = "it is of another store"
        with noting(report.identity, ROOT):
            unsealed(location.get(ROOT), ROOT)
    keys = location.keys()
    columns = columns_of(location, json.loads(attributes["ledger"]), keys)
    documents = location.get_all([COPY, failures.FILE, *(column.description for column in columns.values())])
    report.ledger.update(Texts(location, keys).damaged)
    for column in columns.values():
        with noting(report.ledger, column.description):
            column.check_description(documents[column.description])
    has_begun = root is None or not is_new(root) or any(column.chunks for column in columns.values())
    if documents[COPY] is None:
        report.identity.update({COPY: "it is missing"} if has_begun else {})
    else:
        with noting(report.identity, COPY):
            unsealed(documents[COPY], COPY)
    with noting(report.ledger, failures.FILE):
        failures.read(documents[failures.FILE])
    for column in columns.values():
        with noting(report.ledger):
            column.verify()
    report.ledger.update(_missing_chunks(columns))
    if not report.ledger:  # else its rows are read in vain
        with noting(report.ledger):  # whole chunks that stand in the place of others
            Ledger(columns).verify()
    if root is not None:
        _check_results(location, root, report)
        if not report and not attributes.get("complete"):
            report.remarks.append(_unfinished(root))
        if not is_bound(root):
            report.remarks.append(NOT_BOUND)
    return report, attributes, columns


def _unfinished(root: dict[str, Any]) -> str:
    done, points = (root["attributes"].get(key) for key in ("points_done", "points"))
    if is_new(root) or points is None:
        return UNFINISHED
    return f"is incomplete: {done:,} of {points:,} points were done when the results were last written"


def _missing_chunks(columns: dict[str, Column]) -> dict[str, str]:
    """Return the missing chunks: those before the last one that is there, and those of rows that the index has."""
    needed = {name: set(range(column.end)) for name, column in columns.items()}
    with suppress(DamagedError):  # a damaged index is in the report, and must be repaired first
        index = columns["index"].read()
        for name in columns.keys() - {"index", "samples"}:
            needed[name] |= set((np.flatnonzero(index.any(axis=1)) // columns[name].chunk_rows).tolist())
        if "samples" in columns:
            needed["samples"] |= _chunks_of_samples(index, columns["samples"])
    files = (columns[name].key(number) for name in needed for number in sorted(needed[name] - columns[name].chunks))
    return dict.fromkeys(files, "it is missing")


def _chunks_of_samples(index: NDArray[np.uint8], samples: Column) -> set[int]:
    """Return the chunks with the samples of the blocks in the index, of each block by its last row."""
    keys, starts, counts = rows_of(index)
    last = {keys[row].tobytes(): int(row) for row in np.flatnonzero(index.any(axis=1))}
    spans = (samples.numbers(int(starts[row]), int(starts[row] + counts[row])) for row in last.values())
    return set().union(*spans)


def _check_results(location: Location, root: dict[str, Any], report: Report) -> None:
    """Add to a report what is wrong with the files of the results, and whether their last writing was cut short."""
    documents = snapshot.arrays_of(root)
    files = {f"{name}/zarr.json": document for name, document in documents.items()}
    cut_short = False
    for file, content in location.get_all(files).items():
        try:
            document = None if content is None else snapshot.array_document(content, file, root)
        except ValueError as error:
            report.results[file] = str(error)
            continue
        if document is None:
            report.results[file] = "it is missing"
        cut_short |= document not in (None, files[file])  # whole, but of a writing that the root does not know yet
    for name, document in documents.items():  # array by array: never all in memory
        report.results.update(snapshot.damaged_chunks(root, location.get_all(chunk_names.chunk_keys({name: document}))))
    if cut_short:
        report.remarks.append(CUT_SHORT)


def _remake(location: Location, file: str, columns: dict[str, Column]) -> str:
    """Replace a file of the ledger: a description by one that fits the chunks, a chunk by one without rows."""
    _set_aside(location, file)
    for name, column in columns.items():
        if file == column.description:
            location.put(file, column.described(column.end))
            return f"{file} was made anew"
        if (number := column.number(file)) is not None:
            if name == "samples":
                _strike_out(number, column, columns["index"])
            column.write(number, column.empty())
    return f"{file}: the next `sweep run` computes again what was in it"


def _strike_out(lost: int, samples: Column, index: Column) -> None:
    """Remove from the index the rows whose samples are, at least in part, in a lost chunk."""
    size = index.chunk_rows
    rows = index.read()
    _, starts, counts = rows_of(rows)
    begin, end = lost * samples.chunk_rows, (lost + 1) * samples.chunk_rows
    struck = rows.any(axis=1) & (starts < end) & (starts + counts > begin)
    rows[struck] = 0
    for number in sorted({int(row) // size for row in np.flatnonzero(struck)}):
        index.write(number, rows[number * size : (number + 1) * size])


def _set_aside(location: Location, file: str) -> None:
    if (content := location.get(file)) is not None:
        location.parent.put(f"{location.name}.damaged/{file}", content)
        location.delete(file)
