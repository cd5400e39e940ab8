"""Checks every file of a store, and sets damaged ones aside so that the next run writes them anew."""

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores import chunk_names, snapshot
from linksweep.sweep.stores.checksums import noting, unsealed
from linksweep.sweep.stores.create import put_root
from linksweep.sweep.stores.ledger import Ledger, rows_of
from linksweep.sweep.stores.location import Location, Where, located, reading, writing
from linksweep.sweep.stores.lock import holder, locked
from linksweep.sweep.stores.manifest import MANIFEST, STORE, Manifest
from linksweep.sweep.stores.opened import UNFINISHED
from linksweep.sweep.stores.root import COPY, LEDGER_THEN, ROOT, copied, find_root, is_new, manifest_of, readable_copy
from linksweep.sweep.stores.texts import Texts

CUT_SHORT = "is unfinished: its results are older than its ledger; nothing is damaged, and the same `sweep run` goes on"


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
        _check(location)  # raises for what is no store, before anything is written
    with locked(location, break_lock=break_lock), writing(location):
        report, attributes, ledger = _check(location)
        done: list[str] = []
        for file in (*report.identity, *report.ledger):
            if (content := location.get(file)) is not None:
                location.parent.put(f"{location.name}.damaged/{file}", content)
        if COPY in report.identity:
            ledger.put(COPY, copied(attributes))
            done.append(f"{COPY} was made anew from {ROOT}")
        if report.identity or report.ledger:
            done += _mend(location, ledger, report.ledger)
        if ROOT in report.identity:
            put_root(location, {**attributes, LEDGER_THEN: ledger.manifest.model_dump_json()})
            done.append(f"{ROOT} was made anew from {COPY}; the results are not in it until `sweep run` writes them")
        if report.results:
            files = ", ".join(report.results)
            done.append(f"{files}: the next `sweep run` writes the results anew from the ledger")
        return done


def _check(location: Location) -> tuple[Report, dict[str, Any], Ledger]:
    """Return the report, what the store means, and its ledger."""
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
    of_root = Manifest(store=attributes[STORE]) if root is None else manifest_of(root)
    ledger = Ledger(location, json.loads(attributes["ledger"]), of_root)
    ledger.verify()
    report.ledger.update(ledger.damaged | Texts(location, ledger).damaged)
    if COPY in report.ledger:
        report.identity[COPY] = report.ledger.pop(COPY)
    if root is not None:
        is_older = _check_results(location, root, report) or ledger.is_ahead or ledger.manifest != of_root
        if not report and not attributes.get("complete"):
            report.remarks.append(_unfinished(root))
        elif not report and is_older:
            report.remarks.append(CUT_SHORT)
    return report, attributes, ledger


def _unfinished(root: dict[str, Any]) -> str:
    done, points = (root["attributes"].get(key) for key in ("points_done", "points"))
    if is_new(root) or points is None:
        return UNFINISHED
    return f"is incomplete: {done:,} of {points:,} points were done when the results were last written"


def _check_results(location: Location, root: dict[str, Any], report: Report) -> bool:
    """Add to a report what is wrong with the files of the results; return whether a later writing was cut short."""
    documents = snapshot.arrays_of(root)
    files = {f"{name}/zarr.json": document for name, document in documents.items()}
    cut_short = False
    for file, content in location.get_all(files).items():
        with noting(report.results, file):
            cut_short |= snapshot.array_document(content, file, root) != files[file]
    for name, document in documents.items():  # array by array: never all in memory
        report.results.update(snapshot.damaged_chunks(root, location.get_all(chunk_names.chunk_keys({name: document}))))
    return cut_short


def _mend(location: Location, ledger: Ledger, damaged: dict[str, str]) -> list[str]:
    """Make a ledger whole without what was in damaged files, and return what was done."""
    done = [f"{file}: the next `sweep run` computes again what was in it" for file in damaged]
    index = ledger.columns["index"]
    rows = index.read({})
    _, starts, counts = rows_of(rows)
    lost = np.zeros(len(rows), dtype=bool)
    for name, column in ledger.columns.items():
        if column.description in damaged:
            location.put(column.description, column.described(len(column.checksums)))
            done.remove(f"{column.description}: the next `sweep run` computes again what was in it")
            done.append(f"{column.description} was made anew")
        for number in (number for number, key in enumerate(column.keys) if key in damaged):
            first, last = column.place(number)
            column.write(number, column.empty(last - first))
            lost |= (starts < last) & (starts + counts > first) if name == "samples" else False
            lost[first:last] |= name != "samples"
    rows[lost] = 0
    for number in range(len(index.checksums)):
        first, last = index.place(number)
        if lost[first:last].any():
            index.write(number, rows[first:last])
    for file in damaged.keys() & ledger.documents.known.keys():
        del ledger.documents.known[file]
    for file in damaged.keys() - {
        MANIFEST,
        *(key for c in ledger.columns.values() for key in (c.description, *c.keys)),
    }:
        location.delete(file)
    ledger.flush(again=True)
    return done
