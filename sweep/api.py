"""The platform as functions, for scripts and notebooks."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import xarray as xr

from sweep.executing.choose import Resources
from sweep.executing.execute import GUARD, NO_LIMITS, Limits
from sweep.executing.upstream import is_reading_main
from sweep.running.run import Progress, Silent, run_study
from sweep.stores.location import Where, located
from sweep.stores.store import open_dataset
from sweep.studies.reader import load_study, study_from_dict
from sweep.studies.study import Study

log = logging.getLogger("linksweep")


def run(
    study: str | Path | Mapping[str, Any] | Study,
    store: Where | None = None,
    *,
    workers: int | None = None,
    pool: Literal["processes", "threads", "serial"] | None = None,
    scheduler: str | None = None,
    cluster: str | Path | None = None,
    limits: Limits = NO_LIMITS,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Run a study and return its results; the same call after an interruption goes on where it stopped.

    ``study`` is the name of a built-in study, a TOML file, a mapping of the same shape, or a `Study`.  The store is
    ``results/NAME.zarr`` unless given.  ``workers``, ``pool``, ``scheduler``, ``cluster`` and ``limits`` say what to
    run on, as the options of ``sweep run`` do; nothing is printed unless ``progress`` does.  Points that failed are NaN
    in the dataset, its ``status`` and its attribute ``failures`` tell why, and a warning is logged.
    Raises SweepError for bad input, before anything is written.
    """
    _leave_a_worker_that_runs_its_script()
    loaded = _study(study)
    place = located(store or Path("results") / f"{loaded.name}.zarr")
    resources = Resources(workers, pool, scheduler, cluster=None if cluster is None else Path(cluster), limits=limits)
    dataset, failures = run_study(loaded, place, resources, progress or Silent())
    if failures:
        log.warning("%d points of %s failed, the first at %s", len(failures), place, next(iter(failures.items())))
    return dataset


def open(store: Where) -> xr.Dataset:  # noqa: A001 (sweep.open, as xarray and zarr have theirs)
    """Return the results in a store, in memory, as one writing of them left them, even while a run goes on.

    ``store`` is a path or s3://BUCKET/NAME.  Raises SweepError where there are none, or damaged ones.
    """
    return open_dataset(store)


def _study(study: str | Path | Mapping[str, Any] | Study) -> Study:
    if isinstance(study, Study):
        return study
    return study_from_dict(study) if isinstance(study, Mapping) else load_study(str(study))


def _leave_a_worker_that_runs_its_script() -> None:
    """Worker processes run a script again up to its guard; without one each would start workers."""
    if is_reading_main():
        raise SystemExit(GUARD)
