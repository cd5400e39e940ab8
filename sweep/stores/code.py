"""Records which code made the blocks of a store: each record has the first row of the ledger that the code made."""

import json
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.code.load import SESSION, code_differences, code_of, unsteady
from linksweep.sweep.contract import SweepError
from linksweep.sweep.contract.block import ledger_key
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.stores.store import CODE, Store
from linksweep.sweep.studies.study import Study

UNKNOWN, SEVERAL = 0, -1
"""The code of a point that is not done, and of one whose blocks were made by different codes."""


class CodeRecord(NamedTuple):
    """Code that made the rows of a ledger from ``first_row`` on, up to those of the next record."""

    first_row: int
    code: Mapping[str, str]


def records_of(attributes: Mapping[str, Any]) -> list[CodeRecord]:
    """Return the records of a store in their order; none for a store that keeps none yet."""
    return [CodeRecord(**record) for record in json.loads(attributes.get(CODE, "[]"))]


def as_json(records: Sequence[CodeRecord]) -> str:
    """Return records as an attribute holds them."""
    return json.dumps([record._asdict() for record in records])


def differences_of_code(attributes: Mapping[str, Any], study: Study) -> list[str]:
    """Say how a study's code differs from that which made the last blocks of a store; nothing if it does not, or if the
    store has no record.
    """
    records = records_of(attributes)
    return _differences(records[-1].code, study) if records else []


def _differences(code: Mapping[str, str], study: Study) -> list[str]:
    reference = study.experiment_reference
    now = code_of(reference, study.experiment)
    changed = {name for name in {*code, *now} if code.get(name) != now.get(name)}
    if changed and all(name.startswith("value ") for name in changed) and not reference.startswith(f"{SESSION}:"):
        now |= {name: code[name] for name in changed & unsteady(reference) & code.keys()}
    return code_differences(code, now, "in the store", "now")


def check_code(store: Store, study: Study) -> None:
    """Raise SweepError for a store whose blocks were made by other code than a study's."""
    changes = differences_of_code(store.attributes, study)
    if changes and store.rows:
        raise SweepError(
            [
                "was made by other code, whose numbers would be mixed up with those of today's; --accept-code (in "
                "Python accept_code=True) goes on and records for each point which code made it, --fresh (fresh=True) "
                "starts anew, -o (store=NAME) names another store",
                *changes,
            ],
            str(store.location),
        )


def record_code(store: Store, study: Study, say: Callable[[str], None]) -> None:
    """Record which code makes the blocks from now on, and tell the user if it has changed."""
    records = continued(records_of(store.attributes), store.next_row, study)
    for sentence in differences_of_code(store.attributes, study) if store.next_row else ():
        say(f"other code goes on with {store.location}: {sentence}")
    if records[-1].code or CODE in store.attributes:  # linksweep's own experiments are known by their version
        store.record({CODE: as_json(records)})


def continued(records: Sequence[CodeRecord], rows: int, study: Study) -> list[CodeRecord]:
    """Return the records of a ledger of so many rows when a study's code goes on with it."""
    before = [record for record in records if record.first_row < rows]  # later ones have made no rows
    if before and not _differences(before[-1].code, study):
        return before
    return [*before, CodeRecord(rows if before else 0, code_of(study.experiment_reference, study.experiment))]


def codes_of_points(
    plan: Plan, accumulator: Accumulator, rows: Mapping[bytes, int], records: Sequence[CodeRecord]
) -> NDArray[np.int32]:
    """Return for each point the number of the record, from 1, of the code that made it."""
    codes = np.full(len(plan.grid), UNKNOWN, dtype=np.int32)
    starts = [record.first_row for record in records]
    n_cat = plan.grid.study.sampling.n_cat
    for point in plan.grid.points():
        if accumulator.status[point.index] == Status.DONE:
            cost = plan.cost(point.parameters)
            parts = range(plan.parts(cost, int(accumulator.realisations[point.index]) // n_cat))
            keys = (ledger_key(point.digest, block) for block in plan.blocks(cost, parts))
            made_by = {bisect_right(starts, rows[key]) for key in keys}
            codes[point.index] = made_by.pop() if len(made_by) == 1 else SEVERAL
    return codes
