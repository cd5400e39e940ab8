"""The link of real tables: 1.6 million motions, vector harmonics to degree 5, on one core."""

import json
import sys

import numpy as np

from benchmarks.measured import Measured, Size, Target, watch

N_SOURCES = 1_600_000

_CODE = """
import json, resource, sys, time
import numpy as np
from core.constants import MAS
from core.tie.astrometry import Astrometry
from core.tie.normal_sums import Problem
from core.tie.sources import SourceTable
from core.unknowns import parse_unknowns
n, degree = int(sys.argv[1]), int(sys.argv[2])
rng = np.random.default_rng(1)
ra, dec, nan = rng.uniform(0.0, 2.0 * np.pi, n), np.arcsin(rng.uniform(-1.0, 1.0, n)), np.full(n, np.nan)
motion, error = rng.normal(0.0, 0.4 * MAS, (2, n)), np.full(n, 0.4 * MAS)
satellite = Astrometry(np.array([ra, dec, nan, *motion]), np.array([nan, nan, nan, error, error]), np.full(n, 2016.0))
zero = np.array([nan, nan, nan, 0.0 * ra, 0.0 * ra])
reference = Astrometry(zero, zero, nan)
table = SourceTable(Problem(satellite, reference, np.arange(n), parse_unknowns(f"vsh_motion:{degree}"), 2016.0))
before, begun, cpu = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter(), time.process_time()
table.solve(np.ones(n))
print(json.dumps({
    "seconds": time.process_time() - cpu,
    "mb": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3,
}))
"""


def measure(size: Size, repetitions: int, _peers: bool) -> list[Measured]:
    """Return CPU seconds of one pass and its memory beyond the table, by degree."""
    n = 20_000 if size == "tiny" else N_SOURCES
    found = []
    for degree in (1, 5):
        runs = [_once(n, degree) for _ in range(repetitions)]
        target = Target("<=", 3.0) if degree == 5 else None
        found.append(
            Measured(f"a pass over {n:,} motions, l = {degree}", [r["seconds"] for r in runs], "s CPU", target)
        )
        limit = Target("<=", 400.0) if degree == 5 else None
        found.append(Measured(f"memory beyond the table, l = {degree}", [r["mb"] for r in runs], "MB", limit))
    return found


def _once(n: int, degree: int) -> dict[str, float]:
    from pathlib import Path

    threads = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    run = watch([sys.executable, "-c", _CODE, str(n), str(degree)], Path.cwd(), threads)
    values = json.loads(run.output)
    assert np.isfinite(list(values.values())).all()
    return dict(values)
