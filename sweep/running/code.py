"""The code of a store: which made its numbers, and which a command that is given the store may run.

A store's attribute ``code`` is a list of records, each with the first row of the ledger that its code made.  Looking at
a store loads nothing that it names: see `sweep.studies.record.Recorded`.  Computing from it does.  Where that code lies
inside the store, or the store was not written here, the user must allow it with ``--trust``.
"""

import json
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.code import load
from linksweep.sweep.contract import SweepError, shown
from linksweep.sweep.contract.block import ledger_key
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.stores.integrity import ROOT
from linksweep.sweep.stores.location import Folder, Location
from linksweep.sweep.stores.store import CODE, Store, was_written_here
from linksweep.sweep.studies.study import DEFAULT_EXPERIMENT, Study

# The code of a point that is not done, and of one whose blocks were made by different codes.
UNKNOWN, SEVERAL = 0, -1


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


def differences_of_code(records: Sequence[CodeRecord], study: Study) -> list[str]:
    """Say how a study's code differs from that which made the last blocks of a store; nothing if it does not, or if the
    store has no record.
    """
    if not records:
        return []
    code, reference = records[-1].code, study.experiment_reference
    now = load.code_of(reference, study.experiment)
    changed = {name for name in {*code, *now} if code.get(name) != now.get(name)}
    if all(name.startswith("value ") for name in changed) and not reference.startswith(f"{load.SESSION}:") and changed:
        now |= {name: code[name] for name in changed & load.unsteady(reference) & code.keys()}
    return load.code_differences(code, now, "in the store", "now")


def check_code(store: Store, study: Study) -> None:
    """Raise SweepError for a store whose blocks were made by other code than a study's."""
    changes = differences_of_code(records_of(store.attributes), study) if store.rows else []
    if changes:
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
    rows = store.next_row
    records = [record for record in records_of(store.attributes) if record.first_row < rows]  # later ones made no rows
    changes = differences_of_code(records, study)
    for sentence in changes:
        say(f"other code goes on with {store.location}: {sentence}")
    if changes or not records:
        code = load.code_of(study.experiment_reference, study.experiment)
        records.append(CodeRecord(rows if records else 0, code))
    if records[-1].code or CODE in store.attributes:  # linksweep's own experiments are known by their version
        store.record({CODE: as_json(records)})


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


def asking(location: Location, attributes: Mapping[str, Any], trust: bool = False) -> load.Code:
    """Return what loads the code that a store names, where the user has allowed it (``trust``), or need not be asked;
    elsewhere it raises SweepError that names the code.
    """

    def check(reference: str) -> None:
        if trust or reference == DEFAULT_EXPERIMENT:
            return
        file = load.file_of(reference)
        inside = isinstance(location, Folder) and Path(file).resolve().is_relative_to(location.path.resolve())
        if inside or not was_written_here(location, attributes):
            here = "and the store was not written here: by this user, on this host, at this place"
            reason = "which lies inside the store" if inside else here
            raise SweepError(f"would run {file}, {reason}; inspect it, and give --trust if it may run", str(location))

    return load.Code(check)


def ours_alone() -> load.Code:
    """Return what loads the link, for a store of it that is looked at, and raises SweepError for anything else."""

    def check(reference: str) -> None:
        if reference != DEFAULT_EXPERIMENT:
            raise SweepError(f"only stores of the link alone can be drawn so; this one names {shown(reference)}")

    return load.Code(check)


def require_trust_of_study(path: Path, trust: bool) -> None:
    """Raise SweepError for a study file that lies inside a store: what it names came with the store."""
    store = next((folder for folder in path.resolve().parents if (folder / ROOT).is_file()), None)
    if store is not None and not trust:
        reason = f"lies inside the store {store}, and would run what it names"
        raise SweepError(f"{reason}; inspect it, and give --trust if it may run", str(path))
