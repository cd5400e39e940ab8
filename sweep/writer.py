"""The one writer of a run: results into the ledger as they come, on disk every second, as labelled dataset now and
then.
"""

import json
import time
from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.grid import describe
from sweep.plan import Plan, PlanSize, Work
from sweep.provenance import now, provenance
from sweep.results import DONE, EXCLUDED, assemble, assemble_samples
from sweep.store import Store
from sweep.worker import TaskResult

FLUSH_EVERY_S = 1.0
WRITE_EVERY_S = 5.0
WRITE_SHARE = 0.05
"""The dataset is rewritten on the way so rarely that this takes at most such a share of the time."""

MAX_FAILURES_KEPT = 1000


class Writer:
    """Takes the results of tasks in whatever order they arrive; ``remaining`` counts the blocks that each point still
    needs.
    """

    def __init__(self, plan: Plan, remaining: NDArray[np.int32], store: Store) -> None:
        """Start with an open store."""
        self.plan, self.store = plan, store
        self.failures: dict[int, str] = {}
        self._remaining = remaining.copy()
        self._started = store.attributes.get("started", now())
        self._flushed = self._written = time.monotonic()
        self._write_took = 0.0

    def take(self, works: Sequence[Work], result: TaskResult) -> PlanSize:
        """Add a task's results, and return how much that was."""
        good = [i for i in range(len(works)) if i not in result.failures]
        self.store.append(
            [works[i].key for i in good], result.sums[good], [result.samples[i] for i in good if result.samples]
        )
        for i, failure in result.failures.items():
            self.failures.setdefault(works[i].point.index, failure.message)
        points = 0
        for work in works:
            self._remaining[work.point.index] -= 1
            points += self._remaining[work.point.index] == 0
        clock = time.monotonic()
        if clock - self._flushed > FLUSH_EVERY_S:
            self.store.flush()
            self._flushed = clock
        if clock - self._written > max(WRITE_EVERY_S, self._write_took / WRITE_SHARE):
            self.write()
        return PlanSize(points, len(works), sum(w.block.realisations for w in works), sum(w.cost for w in works))

    def write(self) -> xr.Dataset:
        """Write the labelled dataset of everything taken so far, and return it."""
        begun = time.monotonic()
        study = self.plan.grid.study
        dataset = assemble(self.plan, self.store.rows, self.store.sums(), self.failures)
        if study.sampling.keep_samples:
            dataset = dataset.assign(assemble_samples(self.plan, dataset["status"].values, self.store.samples))
        status = dataset["status"].values
        points, done = int(np.sum(status != EXCLUDED)), int(np.sum(status == DONE))
        dataset.attrs = provenance(study) | {
            "started": self._started,
            "finished": now(),
            "points": points,
            "points_done": done,
            "complete": int(points == done),
            "failures": json.dumps(self._failures_in_words()),
        }
        self.store.write(dataset)
        self._written = time.monotonic()
        self._write_took = self._written - begun
        return dataset

    def _failures_in_words(self) -> dict[str, str]:
        first = sorted(self.failures)[:MAX_FAILURES_KEPT]
        if not first:
            return {}
        points = {p.index: p for p in self.plan.grid.points() if p.index in self.failures}
        return {describe(self.plan.grid.study, points[i].parameters): self.failures[i] for i in first}
