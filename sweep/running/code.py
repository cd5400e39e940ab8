"""Which code made the numbers of a store: its attribute ``code`` is a list of records, each with the ``first_row`` of
the ledger that its ``code`` made.
"""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any

from linksweep.sweep.code import as_recorded_where_unsteady, code_differences, code_of
from linksweep.sweep.contract import DIGEST_BYTES, SweepError
from linksweep.sweep.stores.store import CODE, Store
from linksweep.sweep.studies.study import Study


def records_of(attributes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the records of a store in their order; none for a store that keeps none yet."""
    records: list[dict[str, Any]] = json.loads(attributes.get(CODE, "[]"))
    return records


def differences_of_code(records: Sequence[Mapping[str, Any]], study: Study) -> list[str]:
    """Say how a study's code differs from that of the last of some records; nothing where there is none."""
    if not records:
        return []
    reference, old = study.experiment_reference, records[-1]["code"]
    now = as_recorded_where_unsteady(code_of(reference, study.experiment), old, reference)
    return code_differences(old, now, "in the store", "now")


def rows_of_other_code(store: Store, study: Study) -> list[range]:
    """Return the rows of a ledger that were made by other code than a study's."""
    records = records_of(store.attributes)
    starts = [*(record["first_row"] for record in records), store.next_row]
    return [
        range(first, end)
        for record, (first, end) in zip(records, pairwise(starts), strict=True)
        if differences_of_code([record], study)
    ]


def check_code(store: Store, study: Study, gone: Collection[bytes] = ()) -> None:
    """Raise SweepError for a store whose last blocks other code than a study's has made, but for points that are to
    be computed again, by their digests.
    """
    records = records_of(store.attributes)
    if gone:
        last = max((row for key, row in store.rows.items() if key[:DIGEST_BYTES] not in gone), default=-1)
        records = [record for record in records if record["first_row"] <= last]
    if store.rows and (changes := differences_of_code(records, study)):
        meaning = (
            "was made by other code, whose numbers would be mixed up with those of today's; --redo old (in Python "
            'redo="old") computes its points again, --accept-code (accept_code=True) goes on and records for each '
            "point which code made it, --fresh (fresh=True) starts anew, -o (store=NAME) names another store"
        )
        raise SweepError([meaning, *changes], str(store.location))


def record_code(store: Store, study: Study, say: Callable[[str], None]) -> None:
    """Record which code makes the blocks from now on, and tell the user if it has changed."""
    rows = store.next_row
    records = [record for record in records_of(store.attributes) if record["first_row"] < rows]  # others made no rows
    changes = differences_of_code(records, study)
    for sentence in changes:
        say(f"other code goes on with {store.location}: {sentence}")
    if changes or not records:
        code = code_of(study.experiment_reference, study.experiment)
        records.append({"first_row": rows if records else 0, "code": code})
    if records[-1]["code"] or CODE in store.attributes:  # linksweep's own experiments are known by their version
        store.record({CODE: json.dumps(records)})
