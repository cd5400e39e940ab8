"""Checks every file of a store, and sets damaged ones aside so that the next run writes them anew."""

import json
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.contract import SweepError
from sweep.stores import failures, snapshot
from sweep.stores.checksums import group_document, sealed, unsealed
from sweep.stores.chunked_rows import Column, DamagedError
from sweep.stores.identity import COPY, ROOT, damaged_copy, find_root, readable_copy
from sweep.stores.ledger import columns_of, damaged_descriptions, rows_of
from sweep.stores.location import Location, Where, located, reading, writing
from sweep.stores.lock import holder, locked
from sweep.stores.store import FAILURES


@dataclass(frozen=True)
class Report:
    """What is wrong with which file: of what says what the store means, of the ledger, of the results, which can be
    written anew from the ledger.
    """

    identity: dict[str, str]
    ledger: dict[str, str]
    results: dict[str, str]

    def __bool__(self) -> bool:
        return bool(self.identity or self.ledger or self.results)


def check(where: Where) -> Report:
    """Read every file of a store and compare it with its checksum.

    Raises SweepError where there is no store, or one that nothing tells the meaning of, and while a run writes to it.
    """
    location = located(where)
    if (runs := holder(location)) is not None:
        raise SweepError(f"is being written by {runs}; check it when that has ended", str(location))
    with reading(location):
        return _check(location)[0]


def repair(where: Where, *, break_lock: bool = False) -> list[str]:
    """Set right what can be, and return what was done in sentences; damaged files of the ledger are moved to
    ``STORE.damaged``.

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
            location.put(ROOT, sealed(root))
            done.append(f"{ROOT} was made anew from {COPY}; the results are not in it until `sweep run` writes them")
        if COPY in report.identity:
            location.put(COPY, sealed(group_document(attributes)))
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
        report.identity[ROOT] = _problem(location.get(ROOT))
    keys = location.keys()
    columns = columns_of(location, json.loads(attributes["ledger"]), keys)
    documents = location.get_all([COPY, FAILURES, *(column.description for column in columns.values())])
    report.ledger.update(damaged_descriptions(columns.values(), documents))
    report.identity.update({COPY: "it is missing"} if documents[COPY] is None else damaged_copy(documents[COPY]))
    try:
        failures.read(documents[FAILURES])
    except ValueError as error:
        report.ledger[FAILURES] = str(error)
    for column in columns.values():
        try:
            column.verify()
        except DamagedError as error:
            report.ledger.update(error.files)
    report.ledger.update(_missing_chunks(columns))
    if root is not None:
        report.results.update(_check_results(location, root))
    return report, attributes, columns


def _problem(content: bytes | None) -> str:
    try:
        unsealed(content)
    except ValueError as error:
        return str(error)
    return "it is of another store"


def _missing_chunks(columns: dict[str, Column]) -> dict[str, str]:
    """Return the chunks that are missing: below those that are there, or with what a row of the index speaks of."""
    needed = {name: set(range(len(column) // column.layout.rows)) for name, column in columns.items()}
    with suppress(DamagedError):  # a damaged index is in the report, and must be repaired first
        index = columns["index"].read()
        needed["sums"] |= set((np.flatnonzero(index.any(axis=1)) // columns["sums"].layout.rows).tolist())
        if "samples" in columns:
            needed["samples"] |= _chunks_of_samples(index, columns["samples"].layout.rows)
    files = (columns[name].key(number) for name in needed for number in sorted(needed[name] - columns[name].chunks))
    return dict.fromkeys(files, "it is missing")


def _chunks_of_samples(index: NDArray[np.uint8], size: int) -> set[int]:
    """Return the chunks of samples that rows of the index speak of, the last row of each block."""
    keys, starts, counts = rows_of(index)
    last = {keys[row].tobytes(): int(row) for row in np.flatnonzero(index.any(axis=1))}
    spans = ((int(starts[row]), int(starts[row] + counts[row])) for row in last.values())
    return {number for start, stop in spans for number in range(start // size, -(-stop // size))}


def _check_results(location: Location, root: dict[str, Any]) -> dict[str, str]:
    documents = snapshot.arrays_of(root)
    files = {f"{name}/zarr.json": document for name, document in documents.items()}
    damaged: dict[str, str] = {}
    for file, content in location.get_all(files).items():
        try:
            if content is None or json.loads(content) != files[file]:
                damaged[file] = "it is missing" if content is None else "it is not as the root document has it"
        except ValueError as error:
            damaged[file] = str(error)
    for name, document in documents.items():  # array by array: never all in memory
        one = {name: document}
        damaged |= snapshot.damaged_chunks(one, location.get_all(snapshot.chunk_keys(one)))
    return damaged


def _remake(location: Location, file: str, columns: dict[str, Column]) -> str:
    """Replace a file of the ledger: a description by what its chunks tell, a chunk by one without rows."""
    _set_aside(location, file)
    for name, column in columns.items():
        if file == column.description:
            location.put(file, column.described(len(column) // column.layout.rows))
            return f"{file} was made anew"
        if (number := column.number(file)) is not None:
            if name == "samples":
                _strike_out(number, column, columns["index"])
            column.write(number, column.none)
    return f"{file}: the next `sweep run` computes again what was in it"


def _strike_out(lost: int, samples: Column, index: Column) -> None:
    """Remove the rows from the index whose samples are, if only in part, in a chunk that is lost."""
    size = index.layout.rows
    rows = index.read()
    _, starts, counts = rows_of(rows)
    begin, end = lost * samples.layout.rows, (lost + 1) * samples.layout.rows
    struck = rows.any(axis=1) & (starts < end) & (starts + counts > begin)
    rows[struck] = 0
    for number in sorted({int(row) // size for row in np.flatnonzero(struck)}):
        index.write(number, rows[number * size : (number + 1) * size])


def _set_aside(location: Location, file: str) -> None:
    if (content := location.get(file)) is not None:
        location.parent.put(f"{location.name}.damaged/{file}", content)
        location.delete(file)
