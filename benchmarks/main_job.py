"""The main job, `sweep run quasars`, as a whole process, beside a straightforward process pool and the bare normals."""

import sys
import tempfile
from pathlib import Path

from benchmarks.measured import SWEEP, Measured, Size, Target, watch
from benchmarks.start_up import ONE_POINT
from linksweep.core.catalogues import V_MAX, quasar_count

WORKERS = 2
UNIQUE = 4 * quasar_count(float(V_MAX[-1]), completed=False) * 10_000
"""Normals, four a quasar and realisation: each limit sees the brightest of the same quasars, both missions the same
errors.
"""

START_UP_S = 3.0
SHARES = {"tiny": (0.01, 0.01), "normal": (0.02, 0.25), "full": (1.0, 1.0)}
"""The parts of the pool's work and of the normals that are timed; the rest is scaled."""


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return seconds and their ratios, turn by turn."""
    pool_share, normals_share = SHARES[size]
    few = ["--set", "n_cat=2", "--set", "n_sim=10"] if size == "tiny" else []
    ours, cpu, pool, normals, one = [], [], [], [], []
    for _ in range(1 if size == "tiny" else repetitions):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            run = watch([*SWEEP, "run", "quasars", "--workers", str(WORKERS), "-o", "q.zarr", *few], folder)
            ours.append(run.seconds)
            cpu.append(run.cpu_s)
            (folder / "one.toml").write_text(ONE_POINT)
            one.append(watch([*SWEEP, "run", "one.toml", "-o", "one.zarr"], folder).seconds)
            command = [sys.executable, "-m", "benchmarks.lstsq_pool", str(pool_share), str(WORKERS)]
            pool.append(float(watch(command, folder).output))
            command = [sys.executable, "-m", "benchmarks.normals", str(round(normals_share * UNIQUE)), str(WORKERS)]
            normals.append(float(watch(command, folder).output) / normals_share)
    scaled = "" if pool_share == 1.0 else f"{pool_share:.0%} of the catalogues timed and scaled"
    faster = [b / a for a, b in zip(ours, pool, strict=True)]
    beyond = [a / (n + b) for a, n, b in zip(ours, normals, one, strict=True)]
    allowed = [a / (2.0 * n + START_UP_S) for a, n in zip(ours, normals, strict=True)]
    whole = size != "tiny"
    return [
        Measured("sweep run quasars, whole process", ours, "s"),
        Measured("its CPU time, all processes", cpu, "s CPU"),
        Measured("pool over numpy.linalg.lstsq", pool, "s", note=scaled),
        Measured("the unique normals alone", normals, "s", note="" if normals_share == 1.0 else "scaled"),
        Measured("a run of one point", one, "s"),
        Measured("over the normals and a run of one point", beyond, "", Target("<=", 1.35) if whole else None),
        Measured("times faster than the pool", faster, "", Target(">=", 15.0) if whole else None),
        Measured("part of 2 x normals + 3 s", allowed, "", Target("<=", 1.0) if whole else None),
    ]
