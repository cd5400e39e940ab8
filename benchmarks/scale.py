"""Large grids: a million points planned, a hundred thousand run; memory over the points, and files in the store."""

import tempfile
from pathlib import Path

from benchmarks.measured import SWEEP, Measured, Size, Target, watch
from benchmarks.trivial import toml

PLANNED = {"tiny": 10_000, "normal": 1_000_000, "full": 1_000_000}
RUN = {"tiny": (100, 900), "normal": (10_000, 100_000), "full": (10_000, 100_000)}

MOST_GROWN = 1.35
"""Of ten times as many points: each has a key in memory, 0.2 kB, and its results while they are written at the end."""


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return seconds and memory of a plan, and of runs of few and many points (once: they are long)."""
    report: list[Measured] = []
    whole = size != "tiny"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plan.toml").write_text(toml(PLANNED[size]))
        plans = [watch([*SWEEP, "plan", "plan.toml"], folder) for _ in range(repetitions if whole else 1)]
        what = f"plan of {PLANNED[size]:,} points"
        report.append(Measured(what, [p.seconds for p in plans], "s", Target("<=", 10.0) if whole else None))
        peak = [p.peak_bytes / 1e6 for p in plans]
        report.append(Measured(f"{what}: peak memory", peak, "MB", Target("<=", 1000.0) if whole else None))
        peaks = []
        for points in RUN[size]:
            (folder / "run.toml").write_text(toml(points))
            run = watch([*SWEEP, "run", "run.toml", "--workers", "2", "--quiet", "-o", f"{points}.zarr"], folder)
            files = [path for path in (folder / f"{points}.zarr").rglob("*") if path.is_file()]
            _, middle = min(run.own_bytes, key=lambda sample: abs(sample[0] / run.seconds - 0.5))
            peaks.append(max(memory for _, memory in run.own_bytes))
            report += [
                Measured(f"run of {points:,} points, whole process", [run.seconds], "s"),
                Measured("  client and scheduler, half-way", [middle / 1e6], "MB"),
                Measured("  client and scheduler, peak", [peaks[-1] / 1e6], "MB"),
                Measured("  largest process, peak", [run.peak_bytes / 1e6], "MB"),
                Measured("  files in the store", [len(files)]),
                Measured("  size of the store", [sum(path.stat().st_size for path in files) / 1e6], "MB"),
            ]
        grown = f"client and scheduler, peak of {RUN[size][1]:,} over that of {RUN[size][0]:,}"
        report.append(Measured(grown, [peaks[1] / peaks[0]], "", Target("<=", MOST_GROWN) if whole else None))
    return report
