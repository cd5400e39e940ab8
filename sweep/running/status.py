"""Reports what a store holds and what a plan would do, as plain mappings for people and scripts."""

import json
import math
import time
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.contract import Named, SweepError
from linksweep.sweep.executing.pools import available_cores
from linksweep.sweep.formatting import units_of
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.planning.plan import TARGET, Plan
from linksweep.sweep.planning.point_status import Status, count_status
from linksweep.sweep.running.progress import by_axis
from linksweep.sweep.running.run import plan_study
from linksweep.sweep.running.writer import MAX_FAILURES_NAMED, failures_by_place
from linksweep.sweep.stores.ledger import Ledger
from linksweep.sweep.stores.location import Where
from linksweep.sweep.stores.lock import holder
from linksweep.sweep.stores.store import BLOCKS, UNFINISHED, OpenStore, is_new
from linksweep.sweep.studies.record import recorded_study
from linksweep.sweep.studies.study import Study

PROVENANCE = ("study_digest", "study_overrides", "seed", "started", "host", "git_commit", "versions")
"""Attributes of a store that its status shows.  Not ``finished``, which is the time of the last writing."""


def status_report(store: Where) -> dict[str, Any]:
    """Return the progress and provenance of a store, as its ledger has it, which is newer than its dataset.

    Nothing that the store names is imported: what an experiment declares, the store has recorded.  Where it has not,
    the progress is that of the last writing, and a ``note`` says so.  Raises SweepError if there is no store.
    """
    opened = OpenStore(store)
    attributes = opened.attributes
    ledger = opened.ledger()
    whole = bool(attributes.get("complete")) and attributes.get(BLOCKS) == len(ledger.rows)
    dataset = None if is_new(opened.root) else opened.dataset()
    note: dict[str, str] = {} if dataset is not None else {"note": UNFINISHED}
    try:
        axes, units, status, realisations, failures = _of_ledger(opened, ledger, dataset if whole else None)
    except SweepError as error:
        if dataset is None:
            raise SweepError(f"{UNFINISHED} ({'; '.join(error.problems)})", str(opened.location)) from error
        axes, units, status, realisations = _of_dataset(dataset)
        failures = json.loads(attributes.get("failures", "{}"))
        if len(failures) >= MAX_FAILURES_NAMED:  # there may be more, which the records beside the ledger have
            failures = {record["place"]: record["message"] for record in ledger.failures.values()}
        note = {"note": f"as of the last writing: {'; '.join(error.problems)}"}
    random = "n_sim" in attributes
    wanted = int(attributes["n_sim"]) * int(attributes["n_cat"]) if random else 1
    return {
        "title": attributes["title"],
        **note,
        "complete": bool(np.all((status == Status.DONE) | (status == Status.EXCLUDED))),
        "running": str(holder(opened.location) or "no"),
        "last written": attributes.get("finished", "never"),
        "points": {code.word: n for code, n in count_status(status).items()},
        "blocks in the ledger": len(ledger.rows),
        **({"realisations done": int(realisations.sum())} if random else {}),
        "axes": by_axis(axes, status, realisations, wanted),
        "units": units,
        "failures": failures,
        "provenance": {key: attributes[key] for key in PROVENANCE if attributes.get(key) not in (None, "")},
    }


Progress = tuple[dict[str, list[dict[str, Any]]], dict[str, str], NDArray[np.int8], NDArray[np.int64]]
"""The values along each dimension, the units of the axes, and the status and the realisations of each point."""


def _of_ledger(opened: OpenStore, ledger: Ledger, same: xr.Dataset | None) -> tuple[*Progress, dict[str, str]]:
    """Return the progress by the ledger, or by a dataset that says the ``same``, which takes less time, and the points
    that failed by their place.

    Raises SweepError where the store has not recorded what that needs.
    """
    study = recorded_study(opened.attributes, str(opened.location))
    grid = Grid(study)
    axes = {
        dimension: [dict(zip(grid.dimensions[dimension], map(_plain, row), strict=True)) for row in rows]
        for dimension, rows in grid.rows.items()
    }
    units = {name: study.experiment.parameter(name).unit for name in study.axes}
    if same is not None:
        return axes, units, *_points_of(same.transpose(*grid.dimensions, ...)), {}  # it is complete
    if study.sampling.precision is not None:
        raise SweepError("only the experiment can say how many realisations reach a precision")
    try:
        accumulator = Accumulator(Plan(grid), ledger.rows, ledger.read(), ledger.failures)
    except (KeyError, TypeError, ValueError) as error:
        raise SweepError(f"the record of its experiment does not fit its points ({error})") from error
    status, realisations = grid.with_repeats(accumulator.status), grid.with_repeats(accumulator.realisations)
    failures = failures_by_place(grid, accumulator.status, ledger.failures)
    return axes, units, status.reshape(grid.shape), realisations.reshape(grid.shape), failures


def _points_of(dataset: xr.Dataset) -> tuple[NDArray[np.int8], NDArray[np.int64]]:
    status = dataset["status"].values
    return status, dataset["n_sim_done"].values if "n_sim_done" in dataset else (status == Status.DONE).astype(int)


def _plain(value: Any) -> Any:
    return value.name if isinstance(value, Named) else value


def _of_dataset(dataset: xr.Dataset) -> Progress:
    dimensions = [str(dimension) for dimension in dataset["status"].dims]
    axes = {d: [{d: value} for value in dataset[d].values.tolist()] for d in dimensions}
    units = {d: units_of(dataset[d].attrs) for d in dimensions}
    return axes, units, *_points_of(dataset)


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
