"""Merges stores of one experiment into one: the parts of a study, or stores that hold other points each."""

import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from itertools import groupby, pairwise
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.code import code_differences
from linksweep.sweep.contract import DIGEST_BYTES, Experiment, SweepError, converted, lost_integers, same_rows
from linksweep.sweep.executing.task import DECIDING
from linksweep.sweep.executing.worker import one_thread
from linksweep.sweep.formatting import host, now
from linksweep.sweep.functions.adapter import layout_of_record
from linksweep.sweep.functions.results import Layout, joined, layout_refusals
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import Grid, describe, make_grid
from linksweep.sweep.planning.plan import Plan, lost_parts
from linksweep.sweep.planning.union import REFINED, rounds_of, united
from linksweep.sweep.running import run
from linksweep.sweep.running.progress import SENTENCES
from linksweep.sweep.running.reproduce import study_of
from linksweep.sweep.stores.integrity import LEDGER_THEN, STORE
from linksweep.sweep.stores.ledger import Ledger, Record, references
from linksweep.sweep.stores.location import Location, Where, holder, located, locked
from linksweep.sweep.stores.store import CODE, OpenStore, Store, create_store, fits, store_at
from linksweep.sweep.studies.record import RECORD, begun_by, recorded_study
from linksweep.sweep.studies.study import LOST, PART, Part, Study, in_ranges

# The attribute of a store made of others: JSON of where their results come from.
MERGED = "merged"

# Attributes of a store that are kept in a store made of it.
KEPT = ("study_name", "study_digest", "study_overrides", "started", "finished", "host", "versions", "git_commit")

ROWS_AT_ONCE = 10_000
# The part of a block's key that is the digest of its point.
DIGEST = slice(0, DIGEST_BYTES)


@dataclass(frozen=True)
class _Source:
    """A store that is merged: what its root says, the ``keys`` of its blocks, and what failed."""

    location: Location
    attributes: Mapping[str, Any]
    study: Study
    layout: Layout | None
    dtype: np.dtype[np.void]
    keys: tuple[bytes, ...]
    failed: Mapping[bytes, Record]

    def ledger(self) -> Ledger:
        """Return the ledger, read anew: those of a thousand stores do not fit into memory together."""
        return OpenStore(self.location, {"attributes": self.attributes}).ledger()


def merge(places: Sequence[Where], into: Where, *, accept_code: bool = False, trust: bool = False) -> xr.Dataset:
    """Make the store ``into`` of stores of one experiment, and return its results; a run can go on with it.

    Parts of a study make what one run of it makes, or go on with what some of them made before; parts that are lost are
    named in the attribute `LOST`.  Of other stores the points are those of all, as those of several runs in one
    store; what several have is kept once.  Raises SweepError, with nothing written, for stores of other
    experiments, samplings, parts or code (unless ``accept_code``), for points whose bits differ between them, for one
    that is being written, and where something else is at the place already.
    """
    sources = _sources(places, trust)
    _require_alike(sources, accept_code)
    place, part = located(into), sources[0].study.part
    every = [*_merged_before(place, sources[0], accept_code), *sources]
    experiment = replace(_experiment(every), parameters=sources[0].study.experiment.parameters)
    study = replace(sources[-1].study, experiment=experiment, part=None)
    digests = {key[DIGEST] for source in sources for key in source.keys}.union(*(source.failed for source in sources))
    for source in reversed(sources[:-1]) if part is None else ():
        study = united(source.study, study, digests)
    about = _about(sources)
    rounds = rounds_of(*(source.attributes for source in sources))
    origin = {MERGED: json.dumps(about)} | ({REFINED: json.dumps([*map(asdict, rounds)])} if rounds else {})
    require_free(place, study, about)
    _require_same_bits(every, experiment.reducer.dtype)
    plan = Plan(make_grid(study) if part else Grid(study))  # the warnings of one run
    with one_thread(), locked(place):
        existing = run.find_store(place, study) or create_store(place, run.attributes_of(plan) | begun_by() | origin)
        store = run.open_store(existing, study, writes=True)
        store.keep_copy()
        failed = _failures(every)
        store.clear_failures([*store.failures])
        for source in sources:
            failed |= _take(store, source, every, experiment, failed if part else {})
        store.flush()
        accumulator = run.accumulated(plan, store, wanted=frozenset())
        _fail(store, accumulator, failed)
        if part and (lost := lost_parts(plan, accumulator.status, store.rows, part.total)):
            origin[LOST] = f"{in_ranges(lost)} of {part.total}"
        return run.Writer(accumulator, store, further=origin).write(final=True).to_xarray()


def require_free(place: Location, study: Study, about: Sequence[Mapping[str, Any]]) -> None:
    """Raise SweepError for the place of a part, and unless the place is free, or has what a merge of the same stores,
    or of parts of the same study, has left.
    """
    if Part.named(place):
        raise SweepError("is the place of a part; give another one with -o", str(place))
    if (opened := run.find_store(place, study)) is None:
        return
    before = json.loads(opened.attributes.get(MERGED, "[]")) or [{}]
    alike = before == about or before[0].get("parts") == about[0].get("parts", "")
    if not alike or opened.attributes["study_digest"] != study.digest():  # a run has added points since
        raise SweepError("holds a store already; give a free place with -o", str(place))


def _with_total(place: Where) -> Where:
    """Return ``STORE.part-*-of-N`` for ``STORE.part-*`` where there are parts of one N alone; another place itself."""
    store, is_all, rest = str(place).rpartition(".part-*")
    parts = Part.among(located(store).beside(), located(store).name) if is_all and not rest else []
    totals = {part.total for part in parts}
    return f"{place}-of-{totals.pop()}" if len(totals) == 1 else place


def _sources(places: Sequence[Where], trust: bool) -> list[_Source]:
    """Return what is there of the stores, parts in their order."""
    sources: list[_Source] = []
    studies: dict[tuple[Any, ...], tuple[Study, Layout | None]] = {}
    why = "no store there; name those to merge, as in S.part-*"
    for location in (located(one) for place in places for one in Part.places(_with_total(place))):
        opened = store_at(location)
        if (runs := holder(location)) is not None:
            if not Part.named(location):  # one that has just begun has no store
                raise SweepError(f"is being written by {runs}; merge it when that has ended", str(location))
            SENTENCES.warning("%s is being written by %s; it is left out", location, runs)
            why = "nothing can be merged yet"
            continue
        if opened is None and Part.named(location):
            continue  # it is named when the others are merged
        opened = opened or OpenStore(location)
        # A thousand parts of a study have one study, which may be large.
        meant = tuple(opened.attributes.get(key) for key in ("study_document", "study_meaning", RECORD))
        if meant not in studies:
            studies[meant] = _study_in(opened, trust)
        sources.append(_source(opened, *studies[meant]))
    if not sources:
        raise SweepError(why, ", ".join(map(str, places[:3])))
    # Of stores that are no parts first one whose experiment has the parameters of all.
    return sorted(sources, key=lambda one: (one.study.part or Part(0, 0), -len(one.study.experiment.parameters)))


def _source(opened: OpenStore, study: Study, layout: Layout | None) -> _Source:
    attributes, ledger = opened.attributes, opened.ledger()
    used = (*KEPT, "study_meaning", "study_axes", CODE, REFINED, STORE, LEDGER_THEN)
    kept = {key: attributes[key] for key in used if key in attributes}
    study = replace(study, part=Part.recorded(attributes))
    return _Source(opened.location, kept, study, layout, ledger.dtype, tuple(ledger.rows), ledger.failures)


def _merged_before(place: Location, first: _Source, accept_code: bool) -> list[_Source]:
    """Return the store that was made of other parts of a study before, if there is one; raises SweepError where other
    code made it.
    """
    opened = store_at(place) if first.study.part else None
    if opened is None or opened.attributes["study_digest"] != first.attributes["study_digest"]:
        return []
    merged = _source(opened, first.study, layout_of_record(json.loads(opened.attributes.get(RECORD, "{}"))))
    if problems := _differences(merged, first, accept_code):
        raise SweepError([f"cannot take {first.location}: these differ", *problems], str(place))
    return [merged]


def _study_in(opened: OpenStore, trust: bool) -> tuple[Study, Layout | None]:
    attributes = opened.attributes
    record = json.loads(attributes.get(RECORD, "{}"))
    layout = layout_of_record(record)
    if "function" in record:
        return recorded_study(attributes, str(opened.location), whole=PART in attributes and layout is not None), layout
    return study_of(opened, trust=trust), layout


def _require_alike(sources: Sequence[_Source], accept_code: bool) -> None:
    """Raise SweepError that says how stores differ, if they do."""
    first = sources[0]
    for before, source in pairwise(sources):
        parts = first.study.part, source.study.part
        if parts[1] is not None and parts[1] == before.study.part:
            raise SweepError(f"is part {parts[1]}, and so is {before.location}", str(source.location))
        if len({part and part.total for part in parts}) > 1:
            which = [f"part {part}" if part else "no part of a study" for part in parts]
            raise SweepError(f"is {which[0]}, and {source.location} is {which[1]}", str(first.location))
        if problems := _differences(first, source, accept_code):
            raise SweepError([f"cannot be merged with {source.location}: these differ", *problems], str(first.location))


def _differences(one: _Source, other: _Source, accept_code: bool) -> list[str]:
    """Say how two stores differ in what all that are merged must have in common."""
    was, now = f"in {one.location}", f"in {other.location}"
    attributes = dict(one.attributes)
    if one.study.part is None:  # a parameter that both fix is an axis of what they make
        old, new = (json.loads(source.attributes["study_meaning"]) for source in (one, other))
        attributes["study_meaning"] = json.dumps({**old, "fixed": new["fixed"]})
    pairs = run.study_differences(attributes, other.study)
    numbers = ("n_sim", "n_cat", "precision", "max_n_sim")
    known = [{f"sampling.{key}": getattr(s.study.sampling, key) for key in numbers} for s in (one, other)]
    is_part = one.study.part is not None
    if is_part and not accept_code:
        for some, source in zip(known, (one, other), strict=True):
            some |= {name: json.loads(source.attributes["versions"]).get(name) for name in DECIDING}
    sentences = run.differing(pairs | {key: (a, known[1][key]) for key, a in known[0].items()}, was, now)
    codes = [records[-1]["code"] if (records := run.records_of(s.attributes)) else {} for s in (one, other)]
    if accept_code:  # but for defaults, without which points at them are known
        codes = [run.defaults_alone(codes[0], codes[1]), run.defaults_alone(codes[1], codes[0])]
    if all(codes):
        sentences += code_differences(codes[0], codes[1], was, now)
    if is_part and not sentences and one.attributes["study_digest"] != other.attributes["study_digest"]:
        sentences.append(f"the points are others {was} than {now}")
    if not is_part and (why := _why_other(one, other)):
        sentences.append(why)
    gone = other.study.experiment.defaults().keys() - one.study.experiment.defaults().keys()
    sentences += [f"{name} is no parameter {was}" for name in sorted(gone)]
    return sentences


def _why_other(one: _Source, other: _Source) -> str:
    """Say how the results of a function in two stores differ in kind; '' where they do not, or are not known."""
    if one.layout is other.layout or one.layout is None or other.layout is None:
        return ""
    return "; ".join(layout_refusals(one.layout, other.layout))


def _experiment(sources: Sequence[_Source]) -> Experiment:
    """Return the experiment of all stores, with what is known of its results in any of them."""
    first = _first(sources)
    layouts = {id(one.layout): one.layout for one in sources if one.layout is not None and not _why_other(first, one)}
    return first.study.experiment.with_layout(reduce(joined, layouts.values()) if layouts else None)


def _first(sources: Sequence[_Source]) -> _Source:
    """Return the store whose results say what results are like: the first in which a point was ever computed."""
    return next((source for source in sources if source.layout is not None), sources[0])


def _require_same_bits(sources: Sequence[_Source], dtype: np.dtype[np.void]) -> None:
    """Raise SweepError where a block of several stores differs between them, or stores that are no parts have integers
    that the floats of others do not hold, or other statistics.
    """
    for source in sources:
        if source.dtype != dtype and source.keys and source.study.part is None:
            unfit = {} if fits(source.dtype, dtype) else {0: "it has other statistics"}
            for why in (unfit or lost_integers(source.ledger().read(), dtype)).values():
                raise SweepError(f"cannot be merged: {why}", str(source.location))
    first: dict[bytes, int] = {}
    common: dict[int, dict[int, list[bytes]]] = defaultdict(lambda: defaultdict(list))
    for number, source in enumerate(sources):
        for key in source.keys:
            if (before := first.setdefault(key, number)) != number:
                common[before][number].append(key)
    for i, others in common.items():
        one, ledger = sources[i], sources[i].ledger()
        rows = converted(ledger.read(), dtype)
        for j, some in others.items():
            there = sources[j].ledger()
            its = converted(there.read(), dtype)
            for key in some:
                same = same_rows(rows[[ledger.rows[key]]], its[[there.rows[key]]])
                if same and one.study.keeps_samples:
                    same = ledger.samples(key).tobytes() == there.samples(key).tobytes()
                if not same:
                    places = {point.digest: describe(one.study, point.parameters) for point in Grid(one.study).points()}
                    words = places.get(key[DIGEST], "a point")
                    raise SweepError(f"has other numbers than {sources[j].location} at {words}", str(one.location))


def _failures(sources: Sequence[_Source]) -> dict[bytes, Record]:
    """Return the failures of all stores but those whose block one has by now: of a point that failed in several, that
    of the earliest block.
    """
    records = [pair for source in reversed(sources) for pair in source.failed.items()]
    digests = {digest for digest, _ in records}
    there = {(key[DIGEST], _place(key)) for source in sources for key in source.keys if key[DIGEST] in digests}
    records = [(digest, record) for digest, record in records if (digest, _block_of(record)) not in there]
    return dict(sorted(records, key=lambda pair: _block_of(pair[1]), reverse=True))


def _block_of(record: Record) -> tuple[float, ...]:
    """Return group and part of the block that failed; infinity where that was the point as a whole."""
    block = re.fullmatch(r"(\d{1,10}) (\d{1,10})", record.get(run.BLOCK, ""))
    return (float("inf"),) if block is None else (int(block[1]), int(block[2]))


def _take(
    store: Store, source: _Source, sources: Sequence[_Source], experiment: Experiment, failed: Mapping[bytes, Record]
) -> dict[bytes, Record]:
    """Add the blocks of a source that are not there yet, none that a run would not have come to after a point has
    ``failed``; return the failures of points whose results do not fit those of the other sources.
    """
    ledger, dtype = source.ledger(), experiment.reducer.dtype
    rows, values, seconds = ledger.rows, ledger.read(), ledger.seconds()
    refused: dict[bytes, Record] = {}
    other = _why_other(_first(sources), source)
    unfit = (
        dict.fromkeys(rows.values(), f"not as at the first point: {other}") if other else lost_integers(values, dtype)
    )
    keys: list[bytes] = []
    for key in sorted(rows, key=rows.__getitem__):
        if rows[key] in unfit:
            why = f"{experiment.name}: {unfit[rows[key]]}"
            refused[key[DIGEST]] = {"kind": "exception", "message": why, "traceback": "", "host": host(), "when": now()}
        elif key not in store.rows and (key[DIGEST] not in failed or _place(key) < _block_of(failed[key[DIGEST]])):
            keys.append(key)
    records = run.records_of(source.attributes)
    for number, group in groupby(keys, key=lambda key: run.number_of_code(records, rows[key])):
        if number:
            run.begin_code(store, records[number - 1]["code"])
        alike = list(group)
        for start in range(0, len(alike), ROWS_AT_ONCE):
            part = alike[start : start + ROWS_AT_ONCE]
            places = [rows[key] for key in part]
            samples = [ledger.samples(key) for key in part] if source.study.keeps_samples else []
            some = converted(values[places], dtype)
            store.adopt(source.location, references(some))
            store.append(part, some, samples, seconds[places])
    return refused


def _place(key: bytes) -> tuple[float, ...]:
    """Return group and part of a block by its key."""
    return tuple(np.frombuffer(key, "<u4", 2, DIGEST_BYTES).tolist())


def _fail(store: Store, accumulator: Accumulator, failed: Mapping[bytes, Record]) -> None:
    """Let those points fail of which not all blocks are there."""
    points = {point.digest: point for point in (accumulator.plan.grid.points() if failed else ())}
    for digest, record in failed.items():
        if (point := points.get(digest)) is None:
            store.fail(digest, record)
        elif not accumulator.is_done(point.index):
            accumulator.fail(point.index)
            store.fail(digest, record)


def _about(sources: Sequence[_Source]) -> list[dict[str, Any]]:
    """Return where the results come from: for each store, or for all parts together."""
    facts = [{key: one.attributes[key] for key in KEPT if one.attributes.get(key, "") != ""} for one in sources]
    if (part := sources[0].study.part) is None:
        return [{"store": str(one.location), **about} for one, about in zip(sources, facts, strict=True)]
    numbers = in_ranges(one.study.part.number for one in sources if one.study.part)
    values = {key: sorted({about[key] for about in facts if key in about}) for key in KEPT}
    about = {key: some[0] if len(some) == 1 else f"{some[0]} ... {some[-1]}" for key, some in values.items() if some}
    return [{"store": str(sources[0].location), "merged": numbers, "parts": part.total, **about}]
