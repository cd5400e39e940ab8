"""Reports what a store holds and what a plan would do, as plain mappings for people and scripts."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep import table_writer
from linksweep.sweep.contract import Named, SweepError
from linksweep.sweep.executing.pools import available_cores
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.planning.plan import TARGET, Plan
from linksweep.sweep.planning.point_status import Status, count_status
from linksweep.sweep.planning.refined import rounds_of
from linksweep.sweep.running.run import plan_study
from linksweep.sweep.running.writer import failures_by_place
from linksweep.sweep.stores.location import Location, Where, holder, located, reading
from linksweep.sweep.stores.store import BLOCKS, UNFINISHED, OpenStore, is_new
from linksweep.sweep.studies.part import LOST, Part, in_ranges
from linksweep.sweep.studies.record import recorded_study
from linksweep.sweep.studies.study import Study

# What points of a finished part may be: others finish those that are missing.
FINISHED = (Status.DONE, Status.EXCLUDED, Status.MISSING)

# Most lines for one axis in a text.
MOST_LINES = 15

# Attributes of a store that its status shows. Not ``finished``, which is the time of the last writing.
PROVENANCE = ("study_digest", "study_overrides", "seed", "started", "host", "git_commit")


def status_report(store: Where) -> dict[str, Any]:
    """Return the progress and provenance of a store, as its ledger has it, which is newer than its dataset.

    Nothing that the store names is imported: what an experiment declares, the store has recorded.  With a precision
    only the experiment can say what is left: the progress is that of the last writing, and a ``note`` says so.  Where
    there are only parts of a store, it says which of them are lost.  Raises SweepError if there is neither.
    """
    location = located(store)
    with reading(location):
        parts = _parts_beside(location) if location.is_free() else []
    if parts:
        return _of_parts(location, parts)
    opened = OpenStore(location)
    attributes, ledger = opened.attributes, opened.ledger()
    study = recorded_study(attributes, str(opened.location))
    grid = Grid(study)
    dataset = None if is_new(opened.root) else opened.dataset().transpose(*grid.dimensions, ...)
    whole = bool(attributes.get("complete")) and attributes.get(BLOCKS) == len(ledger.rows)
    note: dict[str, str] = {} if dataset is not None else {"note": UNFINISHED}
    if dataset is not None and (whole or study.sampling.precision is not None):  # which takes less time
        status = dataset["status"].values
        realisations = dataset["n_sim_done"].values if "n_sim_done" in dataset else (status == Status.DONE).astype(int)
        failures = {record["place"]: record["message"] for record in ledger.failures.values()}
        if not whole:
            note = {"note": "as of the last writing: only the experiment can say how many realisations are needed"}
    elif study.sampling.precision is not None:
        raise SweepError(UNFINISHED, str(opened.location))
    else:
        try:
            accumulator = Accumulator(Plan(grid), ledger.rows, ledger.read(), ledger.failures, only=())
        except (KeyError, TypeError, ValueError) as error:
            reason = f"the record of its experiment does not fit its points ({error})"
            raise SweepError(reason, str(opened.location)) from error
        whole = study.part is not None and not accumulator.survey.pending.blocks
        status = grid.with_repeats(accumulator.status).reshape(grid.shape)
        realisations = grid.with_repeats(accumulator.realisations).reshape(grid.shape)
        failures = failures_by_place(grid, accumulator.status, ledger.failures)
    axes = {
        dimension: [dict(zip(grid.dimensions[dimension], map(_plain, row), strict=True)) for row in rows]
        for dimension, rows in grid.rows.items()
    }
    random = "n_sim" in attributes
    wanted = int(attributes["n_sim"]) * int(attributes["n_cat"]) if random else 1
    return {
        "title": attributes["title"],
        "part": None if study.part is None else str(study.part),
        **note,
        "complete": bool(np.isin(status, FINISHED if whole else FINISHED[:2]).all()),
        "running": None if (runs := holder(opened.location)) is None else str(runs),
        "last_written": attributes.get("finished"),
        "points": {code.word: n for code, n in count_status(status).items()},
        "blocks": len(ledger.rows),
        **({"realisations_done": int(realisations.sum())} if random else {}),
        "axes": by_axis(axes, status, realisations, wanted),
        "units": {name: study.experiment.parameter(name).unit for name in study.axes},
        **({"lost_parts": attributes[LOST]} if LOST in attributes else {}),
        "rounds": [str(one) for one in rounds_of(attributes)],
        "failures": failures,
        "command": attributes.get("command"),
        "provenance": {key: attributes[key] for key in PROVENANCE if attributes.get(key) not in (None, "")}
        | {"versions": json.loads(attributes.get("versions", "{}"))},
    }


def _parts_beside(store: Location) -> list[Part]:
    """Return the parts of a store that are beside its place."""
    named = {Part.named(name): name for name in store.beside()}
    return sorted(part for part, name in named.items() if part and name == part.place(store.name))


def _of_parts(store: Location, parts: Sequence[Part]) -> dict[str, Any]:
    """Return how far the parts of a store are, by how many there are, and which are lost: not there, or neither
    finished nor running.
    """
    report: dict[str, Any] = {"title": f"{store} is not merged yet; its parts:", "parts": {}}
    for total, some in groupby(parts, key=lambda part: part.total):
        states: dict[str, list[int]] = {"complete": [], "failed": [], "running": []}
        for part in some:
            attributes = OpenStore(part.place(store)).attributes
            ended = "complete" if attributes.get("failures", "{}") == "{}" else "failed"
            if (runs := holder(part.place(store))) or attributes["complete"]:
                states["running" if runs else ended].append(part.number)
        states["lost"] = sorted({*range(1, total + 1)}.difference(*states.values()))
        report["parts"][total] = {state: in_ranges(numbers) for state, numbers in states.items() if numbers}
    return report


def _plain(value: Any) -> Any:
    return value.name if isinstance(value, Named) else value


def plan_report(study: Study, store: Where, workers: int | None = None, accept_code: bool = False) -> dict[str, Any]:
    """Return what a run would do; the time is the least that computing takes with so many ``workers`` (one per core by
    default), from a short timing of random numbers on this machine.
    """
    plan, survey = plan_study(study, store, accept_code)
    grid = plan.grid
    floats = len(grid) * sum(study.experiment.size_of(output) for output in study.experiment.outputs)
    samples = study.experiment.samples_width * survey.total.realisations if study.keeps_samples else 0
    result_mb = 8e-6 * (floats + samples)
    ledger_mb = 1e-6 * study.experiment.reducer.dtype.itemsize * survey.total.blocks + 8e-6 * samples
    tasks = math.ceil(survey.pending.cost / TARGET) if study.experiment.cost_unit else None  # else time is not known
    most = survey.pending.blocks if tasks is None else tasks
    cores = max(1, min(workers or available_cores(), available_cores(), most))
    realisations = {"realisations": survey.total.realisations, "realisations_pending": survey.pending.realisations}
    seconds = {}
    if study.experiment.cost_unit:
        seconds["seconds"] = round(survey.pending.cost / (_normals_per_second() * cores), 1)
    return {
        "title": study.title,
        "grid": " x ".join(f"{name} {n}" for name, n in zip(grid.dimensions, grid.shape, strict=True)) or "one point",
        "points": survey.total.points,
        "points_done": survey.total.points - survey.pending.points - survey.failed,
        "points_failed": survey.failed,
        **({} if study.experiment.deterministic else realisations),
        "blocks_pending": survey.pending.blocks,
        "tasks_about": tasks,
        "result_mb": round(result_mb, 3),
        "ledger_mb": round(ledger_mb, 3),
        "memory_mb": round(result_mb + ledger_mb, 3),
        **seconds,
        "cores": cores,
        "store": str(store),
        "warnings": list(grid.warnings),
    }


def _normals_per_second() -> float:
    """Time a quarter of a million normals: what a realisation costs is nearly all random numbers."""
    rng = np.random.Generator(np.random.SFC64(0))
    buffer = np.empty(65536)
    begun = time.perf_counter()
    for _ in range(4):
        rng.standard_normal(out=buffer)
    return 4 * buffer.size / (time.perf_counter() - begun)


# How far a study is at each value along a dimension: ``at`` has the values by axis, the others are counts.
AxisRows = list[dict[str, Any]]


def by_axis(
    axes: Mapping[str, Sequence[Mapping[str, Any]]],
    status: NDArray[np.int8],
    realisations: NDArray[np.int64],
    wanted: int,
) -> dict[str, AxisRows]:
    """Return how far a study is at each value along each dimension: points done, failed and excluded, realisations.

    ``axes`` has the values along each dimension, by axis; ``status`` and ``realisations`` done are shaped as the grid,
    and ``wanted`` are the realisations of a point that is not done.
    """
    excluded, done = status == Status.EXCLUDED, status == Status.DONE
    of_point = np.where(done, realisations, np.maximum(realisations, wanted))
    counts = {
        "points": ~excluded,
        "done": done,
        "failed": status == Status.FAILED,
        "excluded": excluded,
        "realisations_done": np.where(excluded, 0, realisations),
        "realisations": np.where(excluded, 0, of_point),
    }
    rows = {}
    for number, (dimension, places) in enumerate(axes.items()):
        others = tuple(d for d in range(status.ndim) if d != number)
        sums = {name: count.sum(axis=others).tolist() for name, count in counts.items()}
        rows[dimension] = [{"at": at} | {name: sums[name][i] for name in counts} for i, at in enumerate(places)]
    return rows


def folded(rows: AxisRows, most: int = MOST_LINES) -> list[AxisRows]:
    """Join neighbours that are all finished, all begun or all untouched if these are at most ``most`` groups, or else
    groups of the same length.
    """
    if len(rows) <= most:
        return [[row] for row in rows]
    states = groupby(rows, key=lambda r: (r["done"] == r["points"], not (r["realisations_done"] or r["failed"])))
    groups = [list(alike) for _, alike in states]
    return groups if len(groups) <= most else [part.tolist() for part in np.array_split(np.array(rows), most)]


def axis_table(dimension: AxisRows, units: Mapping[str, str]) -> table_writer.Table:
    """Return how far a study is along a dimension as a table; columns that would be empty are left out."""
    name = ", ".join(f"{axis} [{unit}]" if (unit := units.get(axis, "")) else axis for axis in dimension[0]["at"])
    columns: dict[str, list[str]] = {name: [], "points done": [], "realisations": [], "failed": []}
    for group in folded(dimension):
        total = {key: sum(row[key] for row in group) for key in group[0] if key != "at"}
        first, last = (", ".join(map(str, row["at"].values())) for row in (group[0], group[-1]))
        percent = 100 * total["realisations_done"] // total["realisations"] if total["realisations"] else 100
        cells = (
            first if len(group) == 1 else f"{first} ... {last} ({len(group):,} values)",
            f"{total['done']:,}/{total['points']:,}",
            f"{percent} %" if any(row["realisations"] != row["points"] for row in dimension) else "",
            f"{total['failed']:,}" if total["failed"] else "",
        )
        for column, cell in zip(columns.values(), cells, strict=True):
            column.append(cell)
    return table_writer.Table(
        [table_writer.Column(heading, cells, left=heading == name) for heading, cells in columns.items() if any(cells)]
    )
