"""What a store holds and what a plan would do, as plain mappings for people and scripts."""

import json
import math
import time
from typing import Any

import numpy as np

from sweep.execute import available_cores
from sweep.location import Where
from sweep.lock import holder
from sweep.plan import TARGET
from sweep.run import plan_study
from sweep.store import finished_blocks, open_dataset
from sweep.study import Study
from sweep.tally import STATUS_WORDS


def status_report(store: Where) -> dict[str, Any]:
    """Return the progress and provenance of a store; raises SweepError if there is none."""
    dataset = open_dataset(store)
    codes = dataset["status"].values
    attributes = dataset.attrs
    return {
        "title": attributes["title"],
        "complete": bool(attributes["complete"]),
        "running": str(holder(store) or "no"),
        "points": {word: int(np.sum(codes == code)) for code, word in enumerate(STATUS_WORDS)},
        "blocks in the ledger": finished_blocks(store),
        "realisations done": int(dataset["n_sim_done"].sum()),
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


def plan_report(study: Study, store: Where) -> dict[str, Any]:
    """Return what a run would do; the time is for the cores of this machine, from a short timing of its random
    numbers.
    """
    plan, survey = plan_study(study, store)
    grid = plan.grid
    floats = len(grid) * sum(study.experiment.size_of(output) for output in study.experiment.outputs)
    samples = study.experiment.samples_width * survey.total.realisations if study.sampling.keep_samples else 0
    result_mb = 8e-6 * (floats + samples)
    ledger_mb = 8e-6 * (study.experiment.sums_width * survey.total.blocks + samples)
    return {
        "title": study.title,
        "grid": " x ".join(f"{name} {len(study.axes[name])}" for name in grid.dimensions) or "one point",
        "points": survey.total.points,
        "points_done": survey.total.points - survey.pending.points,
        "realisations": survey.total.realisations,
        "realisations_pending": survey.pending.realisations,
        "blocks_pending": survey.pending.blocks,
        "tasks_about": math.ceil(survey.pending.cost / TARGET),
        "result_mb": round(result_mb, 3),
        "ledger_mb": round(ledger_mb, 3),
        "memory_mb": round(result_mb + ledger_mb, 3),
        "seconds": round(survey.pending.cost / (_normals_per_second() * available_cores()), 1),
        "store": str(store),
    }


def _normals_per_second() -> float:
    """Time a quarter of a million normals: what a realisation costs is nearly all random numbers."""
    rng = np.random.Generator(np.random.SFC64(0))
    buffer = np.empty(65536)
    begun = time.perf_counter()
    for _ in range(4):
        rng.standard_normal(out=buffer)
    return 4 * buffer.size / (time.perf_counter() - begun)
