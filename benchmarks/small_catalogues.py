"""Studies of many small catalogues, as whole processes, beside their random numbers alone."""

import sys
import tempfile
from pathlib import Path

from benchmarks.measured import SWEEP, Measured, Size, Target, watch
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.studies.reader import load_study

STUDIES = ("radio-stars", "sqrt-n", "galaxies", "mission-length")
TARGETS = {name: Target("<=", 0.8 if name == "radio-stars" else 1.0) for name in STUDIES}
WORKERS = 2
START_UP_S = 3.0


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return seconds of each study and its normals, and their ratio, turn by turn."""
    few = ["--set", "n_cat=2", "--set", "n_sim=2"] if size == "tiny" else []
    result = []
    for name in STUDIES[:1] if size == "tiny" else STUDIES:
        count = 1_000_000 if size == "tiny" else normals_of(name)
        ours, cpu, normals = [], [], []
        for _ in range(1 if size == "tiny" else repetitions):
            with tempfile.TemporaryDirectory() as folder:
                command = [*SWEEP, "run", name, "--workers", str(WORKERS), "-o", "s.zarr", *few]
                run = watch(command, Path(folder))
                ours.append(run.seconds)
                cpu.append(run.cpu_s)
                alone = [sys.executable, "-m", "benchmarks.normals", str(count), str(WORKERS)]
                normals.append(float(watch(alone, Path(folder)).output))
        allowed = [a / (2.0 * n + START_UP_S) for a, n in zip(ours, normals, strict=True)]
        result += [
            Measured(f"sweep run {name}, whole process", ours, "s"),
            Measured("its CPU time, all processes", cpu, "s CPU"),
            Measured("its normals alone", normals, "s", note=f"{count:,}"),
            Measured("part of 2 x normals + 3 s", allowed, "", TARGETS[name] if size != "tiny" else None),
        ]
    return result


def normals_of(name: str) -> int:
    """Return the normals that a study draws."""
    study = load_study(name)
    plan = Plan(make_grid(study))
    costs = sum(plan.cost(point.parameters) for point in plan.grid.points())
    return round(costs) * study.sampling.n_cat * study.sampling.n_sim
