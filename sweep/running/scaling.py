"""Measures how a study scales with workers: the same work on more of them (strong), as much for each (weak)."""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.contract import FEWEST_SAMPLES, Array, SweepError, small_sample_factor
from linksweep.sweep.executing.pools import DEFAULT_POOL, MOST_WORKERS, PoolName, Resources, available_cores
from linksweep.sweep.formatting import described
from linksweep.sweep.planning.plan import Survey
from linksweep.sweep.running.progress import Progress
from linksweep.sweep.running.run import run_study
from linksweep.sweep.studies.record import made_by, provenance
from linksweep.sweep.studies.study import Study

KINDS = ("strong", "weak")
# Variance of a median over that of a mean, of many normal numbers (of five: 1.43).
MEDIAN_OVER_MEAN = np.pi / 2.0


@dataclass
class _Clock(Progress):
    """Records when the workers of a run have started, and when its results are on disk."""

    started: float = 0.0
    ended: float = 0.0

    def start(self, survey: Survey, where: str, workers: int | None) -> None:
        self.started = time.perf_counter()

    def written(self) -> None:
        self.ended = time.perf_counter()


def measure_scaling(
    study: Study,
    workers: Sequence[int],
    pool: PoolName = DEFAULT_POOL,
    repetitions: int = 3,
    say: Callable[[str], None] = lambda text: None,
) -> xr.Dataset:
    """Return ``seconds``, ``speedup`` and ``efficiency`` of a study, medians over repetitions, (kind, workers).

    ``seconds`` begin when the workers have started and end with the last result on disk; ``start_seconds`` are those
    before and after.  Each repetition has every run in it, ratios are taken within a repetition, and ``NAME_error`` is
    the standard error of the median, where there are at least 5 repetitions.  Weak scaling multiplies the catalogues by
    the workers where a study has several, or else the realisations; a function without random numbers has neither, and
    no weak scaling.  Runs go into stores of their own, which are removed.
    Raises SweepError for workers that are not distinct or do not begin with one, for a study with a precision, and
    where a point fails.
    """
    if list(workers) != sorted(set(workers)) or workers[0] != 1 or workers[-1] > MOST_WORKERS:
        listed = ",".join(map(str, workers))
        raise SweepError(f"workers = {listed}: must increase from 1, with which all is compared, to <= {MOST_WORKERS}")
    if study.sampling.precision is not None:
        raise SweepError("a study with a precision decides itself how much it computes; leave it out", study.source)
    grown = "n_cat" if study.sampling.n_cat > 1 else "n_sim"
    kinds = KINDS[:1] if study.experiment.deterministic else KINDS
    timed = np.empty((len(kinds), len(workers), repetitions, 2))
    _timed(_with(study, "n_sim", 1), 1, pool)  # the first run of all also reads what is not in memory yet
    for turn in range(repetitions):
        for place, count in enumerate(workers):
            for kind, name in enumerate(kinds):
                if name == "weak" and count == 1:
                    timed[kind, place, turn] = timed[0, place, turn]
                    continue
                more = study if name == "strong" else _with(study, grown, count * getattr(study.sampling, grown))
                timed[kind, place, turn] = _timed(more, count, pool)
                seconds = timed[kind, place, turn, 0]
                say(f"{turn + 1}/{repetitions}: {name} scaling, workers: {count}, {seconds:.2f} s")
    dataset = _dataset(np.array(workers), timed)
    return dataset.assign_attrs(
        provenance(study) | made_by(),
        result="scaling",
        title=f"Scaling of “{study.title}”",
        pool=pool,
        weak_scaling_grows=grown,
        repetitions=repetitions,
        cores=available_cores(),
    )


def _with(study: Study, name: str, value: int) -> Study:
    return replace(study, sampling=study.sampling.model_copy(update={name: value}))


def _timed(study: Study, workers: int, pool: PoolName) -> tuple[float, float]:
    """Return the seconds of a run once its workers have started, and those before and after."""
    clock = _Clock()
    with tempfile.TemporaryDirectory(prefix="linksweep-scaling-", ignore_cleanup_errors=True) as folder:
        begun = time.perf_counter()
        _, failures = run_study(study, Path(folder) / "s.zarr", Resources(workers=workers, pool=pool), clock)
        whole = time.perf_counter() - begun
    if failures:
        place, reason = next(iter(failures.items()))
        raise SweepError(f"{len(failures):,} points fail, e.g. {place}: {reason}", study.source)
    return clock.ended - clock.started, whole - (clock.ended - clock.started)


def _dataset(workers: NDArray[np.int64], timed: Array) -> xr.Dataset:
    kinds = KINDS[: len(timed)]
    seconds, starts = timed[..., 0], timed[..., 1]
    work = np.stack([np.ones_like(workers), workers])[: len(kinds), :, None]  # over the work of one worker
    speedup = work * seconds[:, :1] / seconds
    values = {
        "seconds": (seconds, "s", "time with the workers there"),
        "start_seconds": (starts, "s", "time to start and to end the workers"),
        "speedup": (speedup, "", "work a second, over that of one worker"),
        "efficiency": (speedup / workers[:, None], "", "speed-up for each worker"),
    }
    variables = {}
    for name, (array, unit, meaning) in values.items():
        variables[name] = (("kind", "workers"), np.median(array, axis=2), described(unit, meaning))
        if (count := array.shape[2]) >= FEWEST_SAMPLES:
            of_mean = array.var(axis=2, ddof=1) * small_sample_factor(count) / count
            error = np.sqrt(MEDIAN_OVER_MEAN * of_mean)
            variables[f"{name}_error"] = (("kind", "workers"), error, described(unit, f"error of {name}"))
    return xr.Dataset(variables, coords={"kind": np.array(kinds, dtype=object), "workers": workers})
