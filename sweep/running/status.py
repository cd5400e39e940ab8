"""What a store holds and what a plan would do, as plain mappings for people and scripts."""

import json
import math
import time
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.contract import SweepError
from sweep.executing.execute import available_cores
from sweep.planning.accumulator import DONE, EXCLUDED, STATUS_WORDS, Accumulator
from sweep.planning.grid import Grid
from sweep.planning.plan import TARGET, Plan
from sweep.running.axis_progress import by_axis
from sweep.running.reproduce import study_of
from sweep.running.run import plan_study
from sweep.stores.location import Where
from sweep.stores.lock import holder
from sweep.stores.store import existing_store, finished_blocks, open_dataset
from sweep.studies.study import Study


def status_report(store: Where) -> dict[str, Any]:
    """Return the progress and provenance of a store, as its ledger has it, which is newer than its dataset.

    Raises SweepError if there is no store.
    """
    dataset = open_dataset(store)
    attributes = dataset.attrs
    axes, status, realisations = _progress(store, dataset)
    wanted = int(attributes["n_sim"]) * int(attributes["n_cat"])
    completion = by_axis(axes, status, realisations, wanted)
    return {
        "title": attributes["title"],
        "complete": bool(np.all((status == DONE) | (status == EXCLUDED))),
        "running": str(holder(store) or "no"),
        "last written": attributes["finished"],
        "points": {word: int(np.sum(status == code)) for code, word in enumerate(STATUS_WORDS)},
        "blocks in the ledger": finished_blocks(store),
        "realisations done": int(realisations.sum()),
        "axes": completion,
        "units": {axis: dataset[axis].attrs.get("units", "") for values in axes.values() for axis in values[0]},
        "failures": json.loads(attributes["failures"]),
        "provenance": {
            key: attributes[key]
            for key in (
                "study_digest",
                "study_overrides",
                "seed",
                "started",
                "finished",
                "host",
                "git_commit",
                "versions",
            )
            if attributes.get(key) not in (None, "")
        },
    }


def _progress(
    store: Where, dataset: xr.Dataset
) -> tuple[dict[str, list[dict[str, Any]]], NDArray[np.int8], NDArray[np.int64]]:
    """Return the values along each dimension, and the status and the realisations of each point."""
    try:
        study = study_of(store)
        opened = existing_store(store, study)
    except SweepError:  # the experiment is not here or another version: the dataset has what it had when last written
        opened = None
    if opened is None:
        dimensions = [str(dimension) for dimension in dataset["status"].dims]
        axes = {d: [{d: value} for value in dataset[d].values.tolist()] for d in dimensions}
        return axes, dataset["status"].values, dataset["n_sim_done"].values
    grid = Grid(study)
    accumulator = Accumulator(Plan(grid), opened.rows, opened.sums(), opened.failures)
    axes = {
        dimension: [
            dict(zip(names, values, strict=True)) for values in zip(*(study.axes[n] for n in names), strict=True)
        ]
        for dimension, names in grid.dimensions.items()
    }
    return axes, accumulator.status.reshape(grid.shape), accumulator.realisations.reshape(grid.shape)


def plan_report(study: Study, store: Where, workers: int | None = None) -> dict[str, Any]:
    """Return what a run would do; the time is what the random numbers alone would take, from a short timing of this
    machine, with so many ``workers`` (one a core by default).
    """
    plan, survey = plan_study(study, store)
    grid = plan.grid
    floats = len(grid) * sum(study.experiment.size_of(output) for output in study.experiment.outputs)
    samples = study.experiment.samples_width * survey.total.realisations if study.sampling.keep_samples else 0
    result_mb = 8e-6 * (floats + samples)
    ledger_mb = 8e-6 * (study.experiment.sums_width * survey.total.blocks + samples)
    tasks = math.ceil(survey.pending.cost / TARGET)
    cores = max(1, min(workers or available_cores(), available_cores(), tasks))
    return {
        "title": study.title,
        "grid": " x ".join(f"{name} {len(study.axes[name])}" for name in grid.dimensions) or "one point",
        "points": survey.total.points,
        "points_done": survey.total.points - survey.pending.points,
        "realisations": survey.total.realisations,
        "realisations_pending": survey.pending.realisations,
        "blocks_pending": survey.pending.blocks,
        "tasks_about": tasks,
        "result_mb": round(result_mb, 3),
        "ledger_mb": round(ledger_mb, 3),
        "memory_mb": round(result_mb + ledger_mb, 3),
        "seconds": round(survey.pending.cost / (_normals_per_second() * cores), 1),
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
