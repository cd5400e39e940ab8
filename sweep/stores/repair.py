"""Checks every file of a store, and sets damaged ones aside so that the next run writes them anew."""

from dataclasses import dataclass, field
from typing import Any

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores import snapshot
from linksweep.sweep.stores.integrity import LEDGER_THEN, ROOT, STORE, Manifest, noting, unsealed
from linksweep.sweep.stores.ledger import Ledger, path_of
from linksweep.sweep.stores.location import Location, Where, located, reading, writing
from linksweep.sweep.stores.lock import holder, locked
from linksweep.sweep.stores.store import (
    UNFINISHED,
    copied,
    is_new,
    manifest_of,
    put_root,
    read_root,
    readable_copy,
    reading_ledger,
)

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
        damaged = dict(report.ledger)
        for file in report.identity.keys() - {ROOT}:
            ledger.put("study", copied(attributes))
            done.append(f"{file}, the copy of {ROOT}, was made anew")
        if report.identity or damaged:
            done += [f"{file}: the next `sweep run` computes again what was in it" for file in damaged]
            ledger.mend(damaged)
            ledger.tidy()
        if ROOT in report.identity:
            put_root(location, {**attributes, LEDGER_THEN: ledger.manifest.model_dump_json()})
            done.append(f"{ROOT} was made anew from its copy; the results are not in it until `sweep run` writes them")
        if report.results:
            files = ", ".join(report.results)
            done.append(f"{files}: the next `sweep run` writes the results anew from the ledger")
        return done


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
        with noting(report.identity, ROOT):
            unsealed(location.get(ROOT), ROOT)
    of_root = Manifest(store=attributes[STORE]) if root is None else manifest_of(root)
    with reading_ledger(location):
        ledger = Ledger(location, of_root)
        ledger.verify()
    report.ledger.update(ledger.damaged)
    if (copy_file := path_of(ledger.manifest.documents.get("study"))) in report.ledger:
        report.identity[copy_file] = report.ledger.pop(copy_file)
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
        report.results.update(snapshot.damaged_chunks(root, location.get_all(snapshot.chunk_keys({name: document}))))
    return cut_short
