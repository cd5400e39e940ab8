"""The points of a store beside those of a study: shown together, and computed again where the user asks for it."""

import json
from collections import defaultdict
from collections.abc import Set
from dataclasses import dataclass, replace

from linksweep.sweep.contract import Named, SweepError
from linksweep.sweep.contract.rows import DIGEST_BYTES
from linksweep.sweep.formatting import host, now
from linksweep.sweep.planning.grid import Grid, describe
from linksweep.sweep.planning.union import united
from linksweep.sweep.running.code import rows_of_other_code
from linksweep.sweep.stores.ledger import Record
from linksweep.sweep.stores.store import BLOCKS, Store
from linksweep.sweep.studies.record import recorded_study
from linksweep.sweep.studies.study import Study
from linksweep.sweep.tables.reader import from_frame
from linksweep.sweep.tables.where import rows_where

OLD = "old"
"""What a condition calls points that were made by other code than today's."""

AGAIN = "is to be computed again where "
"""With which the reason begins why a point is not done that a run was to compute again."""


@dataclass(frozen=True)
class Beside:
    """What becomes of the points of a store beside those that are asked for: ``only`` the latter stay in its dataset;
    with ``keep`` constants that differ become axes; those that meet the condition ``redo`` are computed again.
    """

    only: bool = False
    keep: bool = False
    redo: str = ""


ALL = Beside()


def with_stored(store: Store, study: Study) -> tuple[Study, Set[bytes] | None]:
    """Return the study of the points of a store and a study together, and the digests of those to be computed.

    The study itself, and None, where it has all of them.  Raises SweepError as `united`.
    """
    attributes, where = store.attributes, str(store.location)
    if attributes.get("study_digest") == study.digest():
        return study, None
    document = json.loads(attributes["study_document"])
    # The same files, as the caller has found; that which the store names may have moved.
    files = {one.name for one in study.experiment.parameters if one.kind == "file"} & document.get("fixed", {}).keys()
    document["fixed"] = document.get("fixed", {}) | {
        name: raw for name, raw in study.document.get("fixed", {}).items() if name in files
    }
    stored = recorded_study({**attributes, "study_document": json.dumps(document)}, where)
    stored = replace(stored, document={**stored.document, "define": document.get("define", {})})
    digests = {key[:DIGEST_BYTES] for key in store.rows} | store.failures.keys()
    is_whole = attributes.get("complete") and attributes.get(BLOCKS) == len(store.rows)
    try:
        whole = united(stored, study, None if is_whole else digests)
    except SweepError as error:
        raise SweepError(error.problems, where) from error
    if whole is study:
        return study, None
    grid = Grid(study)
    wanted = set(grid.digests(grid.indices()))
    # More realisations are for all points, which are not shown without them.
    return whole, wanted if whole.sampling is stored.sampling else wanted | digests


def again_where(store: Store, study: Study, condition: str) -> dict[bytes, Record | None]:
    """Return the points of a study to be computed again where a condition is true, by their digests, with why.

    Where a run with the same condition was killed, they are those that it has left.  What other code made of points
    that are not in the study any more is to be forgotten: None.  Raises SweepError for a condition that is none.
    """
    import pandas as pd  # takes a quarter of a second

    message = AGAIN + condition
    left = {digest for digest, record in store.failures.items() if record["message"] == message}
    rows = defaultdict[bytes, list[int]](list)
    for key, row in store.rows.items():
        rows[key[:DIGEST_BYTES]].append(row)
    other = rows_of_other_code(store, study)
    points = [point for point in Grid(study).points() if point.digest in rows or point.digest in store.failures]
    made_by_other = [any(row in some for row in rows[point.digest] for some in other) for point in points]
    table = [
        {OLD: is_old}
        | {name: str(value) if isinstance(value, Named) else value for name, value in p.parameters.items()}
        for p, is_old in zip(points, made_by_other, strict=True)
    ]
    columns = pd.DataFrame(table, index=range(len(points))).convert_dtypes()
    met = rows_where(from_frame(columns), condition, "--redo", may_be_none=True) if points else ()
    record = {"kind": "again", "message": message, "traceback": "", "host": host(), "when": now()}
    known = {point.digest for point in points}
    again: dict[bytes, Record | None] = {
        digest: None for digest in rows.keys() - known if any(row in some for row in rows[digest] for some in other)
    }
    for point, is_met, is_old in zip(points, met, made_by_other, strict=True):
        if point.digest in left or (is_met and (is_old or not left)):
            again[point.digest] = {"place": describe(study, point.parameters), **record}
    return again
