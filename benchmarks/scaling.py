"""Strong and weak scaling of a study: the same work on more workers, and as much for each of them.

python -m benchmarks.scaling quasars --set n_cat=4 --workers 1,2,4 --pool threads
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import linksweep
from benchmarks.measured import Measured, Size, Target
from linksweep.sweep.executing.pools import Resources
from linksweep.sweep.running.run import Silent, run_study
from linksweep.sweep.studies.study import Study

SETTINGS = {"tiny": ["n_cat=2", "n_sim=10"], "normal": ["n_sim=300"], "full": ["n_cat=1000"]}


class Clock(Silent):
    """Records when the workers of a run have started, and when its results are on disk."""

    def start(self, survey: Any, where: str, workers: int | None) -> None:
        self.started = time.perf_counter()

    def written(self) -> None:
        self.ended = time.perf_counter()


def seconds_of(study: Study, workers: int, pool: Any) -> tuple[float, float]:
    """Return the seconds of a run once its workers have started, and those before and after."""
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        _, failures = run_study(study, Path(folder) / "s.zarr", Resources(workers=workers, pool=pool), clock)
        whole = time.perf_counter() - begun
    if failures:
        raise SystemExit(f"points fail: {failures}")
    return clock.ended - clock.started, whole - (clock.ended - clock.started)


def scaling_of(study: Study, workers: Sequence[int], pool: Any, repetitions: int) -> list[dict[str, Any]]:
    """Return the medians over repetitions, each of which has every run in it; ratios are taken within a repetition.

    Weak scaling multiplies the catalogues by the workers where a study has several, or else the realisations.
    """
    grown = "n_cat" if study.sampling.n_cat > 1 else "n_sim"

    def larger(factor: int) -> Study:
        more = {grown: factor * getattr(study.sampling, grown)}
        return replace(study, sampling=study.sampling.model_copy(update=more))

    kinds = ["strong"] if study.experiment.deterministic else ["strong", "weak"]
    runs = [(kind, n) for n in workers for kind in kinds if kind == "strong" or n > 1]
    timed = np.array(
        [
            [seconds_of(study if kind == "strong" else larger(n), n, pool) for kind, n in runs]
            for _ in range(repetitions)
        ]
    )
    rows = []
    for (kind, n), (seconds, starts) in zip(runs, np.moveaxis(timed, 0, -1), strict=True):
        speedup = (n if kind == "weak" else 1) * timed[:, 0, 0] / seconds
        found = {"seconds": seconds, "start_seconds": starts, "speedup": speedup, "efficiency": speedup / n}
        rows.append({"kind": kind, "workers": n} | {name: float(np.median(some)) for name, some in found.items()})
    return rows


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return the efficiency of two workers, and the seconds to start and end them."""
    report = []
    axes = ["v_max=14"] if size == "tiny" else []
    study = linksweep.load_study("quasars", settings=SETTINGS[size], axes=axes)
    for pool in ("processes", "threads"):
        target = Target(">=", 0.9) if pool == "processes" and size != "tiny" else None
        for row in scaling_of(study, (1, 2), pool, 1 if size == "tiny" else repetitions):
            words = f"{row['kind']} scaling, {row['workers']} {pool}"
            if row["workers"] == 1:
                report.append(Measured(f"1 worker, {pool}", [row["seconds"]], "s"))
            else:
                report.append(Measured(f"{words}: efficiency", [row["efficiency"]], "", target))
                report.append(Measured("  seconds", [row["seconds"]], "s"))
                report.append(Measured("  to start and end the workers", [row["start_seconds"]], "s"))
    return report


def main() -> None:
    """Measure a study and print a line for each kind and number of workers."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=__doc__)
    parser.add_argument("study", help="the name or file of a study, or FILE.py:FUNCTION")
    parser.add_argument("--workers", default="1,2", help="numbers of workers, from 1 up")
    parser.add_argument("--pool", default="processes", choices=["processes", "threads"])
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--axis", action="append", default=[], metavar="NAME=VALUES")
    asked = parser.parse_args()
    study = linksweep.load_study(asked.study, settings=asked.set, axes=asked.axis)
    for row in scaling_of(study, [int(n) for n in asked.workers.split(",")], asked.pool, asked.repetitions):
        print(
            ", ".join(f"{name} {value:.3g}" if isinstance(value, float) else str(value) for name, value in row.items())
        )


if __name__ == "__main__":
    main()
