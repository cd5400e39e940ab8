"""Merges two stores of one experiment into one that holds the points of both."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.code.load import Code, SourceFunction, code_differences
from linksweep.sweep.contract import Named, Rows, SweepError, Value
from linksweep.sweep.contract.block import DIGEST_BYTES
from linksweep.sweep.contract.reducer import converted, lost_integers, same_rows
from linksweep.sweep.functions.adapter import layout_of_record
from linksweep.sweep.functions.results import Layout
from linksweep.sweep.functions.results import differences as layout_differences
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import Grid, describe
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.running.code import records_of
from linksweep.sweep.running.reproduce import study_of
from linksweep.sweep.running.writer import Writer, create_store, differences, find_store, open_store, replace_store
from linksweep.sweep.stores.ledger import Ledger, Record
from linksweep.sweep.stores.location import Location, Where, holder, is_left_over, located, locked
from linksweep.sweep.stores.store import CODE, OpenStore, Store, is_new
from linksweep.sweep.studies.reader import study_of_attributes
from linksweep.sweep.studies.record import RECORD, Recorded, provenance, recorded, recorded_study
from linksweep.sweep.studies.study import Study

# The attribute of a store made of others: JSON of where their results come from.
MERGED = "merged"

# Attributes of a store that are kept in a store made of it.
KEPT = ("study_name", "study_digest", "study_overrides", "started", "finished", "host", "versions", "git_commit")

ROWS_AT_ONCE = 10_000
# The part of a block's key that is the digest of its point.
DIGEST = slice(0, DIGEST_BYTES)


@dataclass(frozen=True)
class _Source:
    """A store that is merged."""

    location: Location
    attributes: Mapping[str, Any]
    study: Study
    ledger: Ledger
    failed: Mapping[bytes, Record]
    held: Rows

    @cached_property
    def layout(self) -> Layout | None:
        """The layout of the results of a plain function, if the store has it."""
        return layout_of_record(_record(self.attributes))


def merge(one: Where, other: Where, into: Where, *, accept_code: bool = False, trust: bool = False) -> xr.Dataset:
    """Make the store ``into`` of two stores of one experiment, and return its results; a run can go on with it.

    The points are those of both: a grid where they fill one, else a table of points.  What both have is kept once.
    Raises SweepError, with nothing written, for stores of other experiments, samplings or code (unless
    ``accept_code``), for points whose bits differ between the two, and where something is at the place already.
    """
    first, second = sources = [_source(located(place), trust) for place in (one, other)]
    _require_alike(first, second, accept_code)
    place = located(into)
    study = _study(first, second, str(place))
    told = {MERGED: json.dumps([_about(source) for source in sources])}
    found = _require_free(place, study, told)
    dtype = study.experiment.reducer.dtype
    rows = _rows(first, second, dtype)
    failed = _failures(first, second)
    plan = Plan(Grid(study))
    with locked(place):
        made = {**provenance(study), **told, RECORD: recorded(study, plan.costs())}
        if found is not None and not is_new(found.root):
            return found.dataset()
        store = open_store(replace_store(place, study, made) or create_store(place, study, made), study)
        store.keep_copy()
        _fill(store, sources, rows, dtype)
        for digest, record in failed.items():
            store.fail(digest, record)
        store.flush()
        if records := _codes(sources, rows):
            store.record({CODE: json.dumps(records)})
        accumulator = Accumulator(plan, store.rows, store.read(), store.failures, samples=store.samples)
        return Writer(accumulator, store, further=told).write(final=True)


def _require_free(place: Location, study: Study, told: Mapping[str, str]) -> OpenStore | None:
    """Return what a merge of the same stores that was killed has left; raises SweepError where anything else is."""
    found = find_store(place, study)
    if found is None:
        return None
    was_killed = is_new(found.root) or is_left_over(place)
    if not was_killed or any(found.attributes.get(key) != value for key, value in told.items()):
        raise SweepError("holds a store already; give a free place with -o", str(place))
    return found


def _source(location: Location, trust: bool) -> _Source:
    if (runs := holder(location)) is not None:
        raise SweepError(f"is being written by {runs}; merge it when that has ended", str(location))
    opened = OpenStore(location)
    plain = "function" in _record(opened.attributes)
    study = recorded_study(opened.attributes, str(location)) if plain else study_of(location, trust=trust)
    read = opened.ledger()
    return _Source(location, opened.attributes, study, read, read.failures, read.read())


def _record(attributes: Mapping[str, Any]) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(attributes.get(RECORD, "{}"))
    return record


def _require_alike(one: _Source, other: _Source, accept_code: bool) -> None:
    """Raise SweepError that says how two stores differ, if they do."""
    old, new = json.loads(one.attributes["study_meaning"]), json.loads(other.attributes["study_meaning"])
    found = differences({**one.attributes, "study_meaning": json.dumps({**old, "fixed": new["fixed"]})}, other.study)
    found = [
        text.replace(" in the store", f" in {one.location}").replace(" in the study", f" in {other.location}")
        for text in found
    ]
    numbers = ("n_sim", "n_cat", "precision", "max_n_sim")
    pairs = [(key, getattr(one.study.sampling, key), getattr(other.study.sampling, key)) for key in numbers]
    found += [f"sampling.{key}: {a} in {one.location}, {b} in {other.location}" for key, a, b in pairs if a != b]
    if not accept_code:
        codes = [records_of(source.attributes) for source in (one, other)]
        if all(codes):
            was, now = f"in {one.location}", f"in {other.location}"
            found += code_differences(codes[0][-1]["code"], codes[1][-1]["code"], was, now)
    if one.layout is not None and other.layout is not None:
        found += layout_differences(one.layout, other.layout)
        types = {} if found else lost_integers(one.held, other.held.dtype) | lost_integers(other.held, one.held.dtype)
        found += list(types.values())[:1]
    if found:
        raise SweepError([f"cannot be merged with {other.location}: these differ", *found], str(one.location))


def _study(one: _Source, other: _Source, where: str) -> Study:
    """Return the study of the points of both."""
    first, second = one.study, other.study
    if one.layout is None:
        first = replace(first, experiment=second.experiment)  # no point of it was ever computed
    else:
        first = replace(first, experiment=first.experiment.joined(second.experiment))
    document = {key: value for key, value in first.document.items() if key not in _GRID}
    crossed = [_crossed(study) for study in (first, second)]
    same = crossed[0] == crossed[1] and None not in (first.points, second.points) and not first.excluded
    axes = crossed[0] if same else {}
    settings = [study.experiment.defaults() | dict(study.fixed) for study in (first, second)]
    differing = [name for name in settings[0] if settings[0][name] != settings[1][name]]
    names = [name for name in dict.fromkeys([*first.axes, *second.axes, *differing]) if name not in axes]
    settled = (parameters for study in (first, second) for _, parameters in Grid(study).parameters())
    rows = list(dict.fromkeys(tuple(parameters[name] for name in names) for parameters in settled))
    columns = {name: list(dict.fromkeys(row[k] for row in rows)) for k, name in enumerate(names)}
    fixed = {name: raw for name, raw in document.get("fixed", {}).items() if name not in names}
    if fixed:
        document["fixed"] = fixed
    else:
        document.pop("fixed", None)
    whole = int(np.prod([len(values) for values in columns.values()], dtype=object)) == len(rows)
    if whole and not same and first.points is None and second.points is None:
        document["axes"] = {name: _written(_ordered(values)) for name, values in columns.items()}
    else:
        document["axes"] = {name: _written(values) for name, values in axes.items()}
        document["points"] = {"columns": {name: _written([row[k] for row in rows]) for k, name in enumerate(names)}}
        if first.points is not None and len(rows) == len(first.axes[first.points.names[0]]):
            document["points"]["origin"] = dict(first.points.origin)
    attributes = {"study_document": json.dumps(document), "study": "", "study_overrides": "", "study_name": first.name}
    plain = "function" in first.experiment.as_record()
    return study_of_attributes(attributes, where, (Recorded if plain else _Known)(first.experiment))


class _Known(Recorded):
    """The code of stores that may run what they name: whether they may was asked when they were opened."""

    def function(self, reference: str, folder: Path) -> SourceFunction:
        """Return a function."""
        return Code().function(reference, folder)


# Sections of a study about its grid.
_GRID = ("axes", "points", "grid", "exclude", "published", "claim")


def _crossed(study: Study) -> dict[str, tuple[Value, ...]]:
    """Return the axes of a study that share a dimension with no other axis."""
    own = () if study.points is None else study.points.names
    zipped = {name for group in study.zipped for name in group}
    return {name: values for name, values in study.axes.items() if name not in own and name not in zipped}


def _ordered(values: Sequence[Value]) -> list[Value]:
    """Return numbers in ascending order, anything else as it is."""
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    return sorted(values) if numbers else list(values)


def _written(values: Sequence[Value]) -> list[Any]:
    return [value.name if isinstance(value, Named) else value for value in values]


def _rows(one: _Source, other: _Source, dtype: np.dtype[np.void]) -> list[list[bytes]]:
    """Return the blocks to take from each in the order of their rows; raises SweepError where a block differs."""
    mine, theirs = one.ledger.rows, other.ledger.rows
    for key in mine.keys() & theirs.keys():
        same = same_rows(converted(one.held[[mine[key]]], dtype), converted(other.held[[theirs[key]]], dtype))
        if same and one.study.keeps_samples:
            same = one.ledger.samples(key).tobytes() == other.ledger.samples(key).tobytes()
        if not same:
            places = {point.digest: describe(one.study, point.parameters) for point in Grid(one.study).points()}
            words = places.get(key[DIGEST], "a point")
            raise SweepError(f"has other numbers than {other.location} at {words}", str(one.location))
    return [sorted(mine, key=mine.__getitem__), sorted(theirs.keys() - mine.keys(), key=theirs.__getitem__)]


def _failures(one: _Source, other: _Source) -> dict[bytes, Record]:
    """Return the failures of both, without those of points that the other has computed."""
    done = [{key[DIGEST] for key in source.ledger.rows} for source in (one, other)]
    mine = {digest: record for digest, record in one.failed.items() if digest not in done[1]}
    theirs = {digest: record for digest, record in other.failed.items() if digest not in done[0]}
    return mine | theirs | mine


def _fill(store: Store, sources: Sequence[_Source], rows: Sequence[Sequence[bytes]], dtype: np.dtype[np.void]) -> None:
    for source, keys in zip(sources, rows, strict=True):
        at = source.ledger.rows
        for start in range(0, len(keys), ROWS_AT_ONCE):
            part = keys[start : start + ROWS_AT_ONCE]
            samples = [source.ledger.samples(key) for key in part] if source.study.keeps_samples else []
            store.append(part, converted(source.held[[at[key] for key in part]], dtype), samples)


def _codes(sources: Sequence[_Source], rows: Sequence[Sequence[bytes]]) -> list[dict[str, Any]]:
    """Return which code made which rows of the new ledger."""
    found: list[dict[str, Any]] = []
    before = 0
    for source, keys in zip(sources, rows, strict=True):
        at = source.ledger.rows
        numbers = [at[key] for key in keys]
        for record in records_of(source.attributes):
            first = before + int(np.searchsorted(numbers, record["first_row"]))
            found = [earlier for earlier in found if earlier["first_row"] < first]
            if not found or found[-1]["code"] != record["code"]:
                found.append(record | {"first_row": first})
        before += len(keys)
    return found


def _about(source: _Source) -> dict[str, Any]:
    told = {key: source.attributes[key] for key in KEPT if source.attributes.get(key, "") != ""}
    return {"store": str(source.location), **told}
