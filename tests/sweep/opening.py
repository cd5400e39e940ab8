"""Stores as a run and its tests open them: what tests need from inside is imported here."""

# ruff: noqa: F401 (tests import from here what they need from inside)
import json
from contextlib import nullcontext, suppress
from pathlib import Path
from unittest.mock import patch

import numpy as np
import xarray as xr

import linksweep
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.formatting import harmless
from linksweep.sweep.interrupt import RunInterruptedError
from linksweep.sweep.planning.accumulator import TUNED
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.planning.plan import generators
from linksweep.sweep.running import run as running
from linksweep.sweep.running.merge import MERGED, merge
from linksweep.sweep.running.progress import Progress
from linksweep.sweep.running.run import find_store, identity, open_store, plan_study
from linksweep.sweep.running.status import status_report
from linksweep.sweep.stores import ledger, location
from linksweep.sweep.stores.integrity import MANIFEST, checksum, sealed, unsealed
from linksweep.sweep.stores.ledger import file_of, path_of
from linksweep.sweep.stores.location import Folder, Holder, holder, located, locked, short_name, store_named
from linksweep.sweep.stores.store import OpenStore, Store, check, chunk_checksums, create_store, repair
from linksweep.sweep.studies.reader import live_study, load_study
from linksweep.sweep.studies.record import begun_by, provenance
from linksweep.sweep.studies.study import POINT, POINT_TABLE
from linksweep.sweep.table_writer import Column, Table

SERIAL = Resources(pool="serial")
OFTEN = {"flush_every_s": -1.0, "most_blocks": 1}  # a run that writes its ledger after every block
IN_TEXT = None  # a step from a text into the document that it holds


def run_study(*study, **how):
    dataset, failures = running.run_study(*study, **how)
    return dataset.to_xarray(), failures


def run(document, store, tuning=None, **options):
    """Return the results of a study, which is run in this process; ``tuning`` says how often it writes."""
    if tuning is None and not options:
        return linksweep.run(document, store, pool="serial")
    with patch.multiple(TUNED, **(tuning or {})) if tuning else nullcontext():
        return run_study(live_study(document), store, SERIAL, **options)[0]


def bare(results):
    dataset = results if isinstance(results, xr.Dataset) else xr.open_zarr(results).load()
    return dataset.drop_vars("wall_time").drop_attrs(deep=False)


def same(one, other):
    """Refuse results that differ in a bit, or in what they say of a variable."""
    xr.testing.assert_identical(bare(one), bare(other))


class Sentences(Progress):
    def __init__(self):
        self.said, self.blocks, self.printed = [], [], []

    def say(self, text):
        self.said.append(text)

    def advance(self, works, result, taken):
        self.blocks.append(len(works))
        self.printed.extend(result.said.values())


class Stopping(Progress):
    def __init__(self, tasks, error=KeyboardInterrupt):
        self.left, self.error = tasks, error

    def advance(self, works, result, taken):
        self.left -= 1
        if self.left <= 0:
            raise self.error


class Killed(BaseException):
    pass


def dying(monkeypatch, kind=Folder):
    """Let a process die, without a lock, before a change of a file of a store, after ``left[0]`` others."""
    left = [10**9]

    def counted(operation):
        def counting(place, key, *arguments):
            if not key.endswith(".lock"):
                left[0] -= 1
                if left[0] < 0:
                    raise Killed
            return operation(place, key, *arguments)

        return counting

    for name in ("put", "create", "swap"):
        monkeypatch.setattr(kind, name, counted(getattr(kind, name)))
    delete = counted(kind.delete)
    monkeypatch.setattr(kind, "delete", lambda place, *keys: [delete(place, key) for key in keys])
    monkeypatch.setattr(kind, "put_all", lambda place, files: [place.put(*file) for file in files.items()])
    copy_all = kind.copy_all
    copy = counted(lambda place, new, old: copy_all(place, {new: old}))
    monkeypatch.setattr(kind, "copy_all", lambda place, names: [copy(place, *name) for name in names.items()])
    return left


def until_done(left, steps, call, between=lambda: None):
    """Call until the end, killed after ``steps`` changes, then half as many; return the result and number of kills."""
    for killed, most in enumerate((steps, steps // 2)):
        left[0] = most
        try:
            with suppress(Killed):
                return call(), killed
        finally:
            left[0] = 10**9
        between()
    return call(), 2


def existing_store(where, study):
    study = live_study(study) if isinstance(study, dict) else study
    actual = find_store(where, study)
    return None if actual is None else open_store(actual, study)


def create_or_resume(where, document):
    study = live_study(document)
    opened = find_store(where, study) or create_store(where, provenance(study) | begun_by() | identity(study))
    store = open_store(opened, study, writes=True)
    store.keep_copy()
    return store


def write(store, dataset):
    store.write(dataset.assign_attrs({name: store.attributes[name] for name in ("study_meaning", "study_axes")}))


def parts_of(store, column="rows"):
    return [path_of(getattr(part, column)) for part in OpenStore(store).ledger().parts]


def rows_on_disk(store):
    with suppress(FileNotFoundError):
        manifest = json.loads((Path(store) / "blocks" / "zarr.json").read_text())["attributes"]["manifest"]
        return sum(part["records"] for part in manifest["parts"])
    return 0


def files_of(store):
    return located(store).get_all(located(store).keys())


def in_use(store):
    opened = OpenStore(store)
    described = {f"{name}/zarr.json" for name in opened.root["consolidated_metadata"]["metadata"]}
    kept = opened.ledger()
    return {"zarr.json", *described, *chunk_checksums(opened.root), *kept.files, *map(file_of, kept.chunks)}


def forge(store, change, file="zarr.json"):
    document = json.loads((Path(store) / file).read_text())
    change(document["attributes"])
    (Path(store) / file).write_bytes(sealed(document, file))


def places_in(document, at=()):
    """Yield the way to every field of a document, also of documents in its texts; of lists to the first two items."""
    if at and at != ("attributes", "checksum"):
        yield at
    if isinstance(document, str) and document[:1] in ("{", "["):
        with suppress(ValueError, RecursionError):
            yield from places_in(json.loads(document), (*at, IN_TEXT))
    items = document.items() if isinstance(document, dict) else ()
    items = enumerate(document[:2]) if isinstance(document, list) else items
    for step, value in items:
        yield from places_in(value, (*at, step))


def replaced(document, at, value):
    if not at:
        return value
    step, *rest = at
    if step is IN_TEXT:
        return json.dumps(replaced(json.loads(document), rest, value))
    changed = document.copy()
    changed[step] = replaced(document[step] if rest else None, rest, value)
    return changed
