"""The link of real tables: 1.6 million motions with vector harmonics on one core, and radio stars with every error."""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.measured import SWEEP, Measured, Size, Target, watch

N_SOURCES = 1_600_000
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

_PASS = """
import json, resource, sys, time
import numpy as np
from linksweep.core.frames import MAS
from linksweep.core.tie.astrometry import Astrometry
from linksweep.core.tie.problem import jackknife
from linksweep.core.tie.problem import group_sums
from linksweep.core.tie.problem import Problem
from linksweep.core.tie.problem import sources_of
from linksweep.core.unknowns import parse_unknowns
n, degree = int(sys.argv[1]), int(sys.argv[2])
rng = np.random.default_rng(1)
ra, dec, nan = rng.uniform(0.0, 2.0 * np.pi, n), np.arcsin(rng.uniform(-1.0, 1.0, n)), np.full(n, np.nan)
motion, error = rng.normal(0.0, 0.4 * MAS, (2, n)), np.full(n, 0.4 * MAS)
satellite = Astrometry(np.array([ra, dec, nan, *motion]), np.array([nan, nan, nan, error, error]), np.full(n, 2016.0))
zero = np.array([nan, nan, nan, 0.0 * ra, 0.0 * ra])
problem = Problem(satellite, Astrometry(zero, zero, nan), np.arange(n), parse_unknowns(f"vsh_motion:{degree}"), 2016.0)
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
def timed(work):
    begun = time.process_time()
    work()
    return time.process_time() - begun
def with_cells():
    table = sources_of(problem)
    solution = table.solve(np.ones(n))
    if not table.sums is not None:
        jackknife(table.cell_sums(np.ones(n)), solution.normal, solution.normal @ solution.estimate)
before = peak()
plain, cells = [], []
for _ in range(5):  # in turns, for one pass scatters by more than the jackknife takes
    plain.append(timed(lambda: group_sums(problem, np.zeros(n, dtype=np.int64), 1)))
    cells.append(timed(with_cells))
plain, cells = np.median(plain), np.median(cells)
extra = 100.0 * (cells / plain - 1.0)
print(json.dumps({"seconds": plain, "extra": extra, "mb": (peak() - before) / 1e3}))
"""

_TABLE = """
import sys
import numpy as np
from astropy.table import Table
n = int(sys.argv[1])
rng = np.random.default_rng(1)
columns = {"source_id": np.arange(n), "ra": rng.uniform(0.0, 360.0, n)}
columns["dec"] = np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n)))
columns["ref_epoch"] = np.full(n, 2016.0)
for name in ("pmra", "pmdec"):
    columns[name] = rng.normal(0.0, 0.4, n) + 100.0 * (rng.random(n) < 0.01)
    columns[name + "_error"] = np.full(n, 0.4)
columns["pmra_pmdec_corr"] = rng.uniform(-0.3, 0.3, n)
Table(columns).write(sys.argv[2])
"""

_PARQUET = """
import sys
import numpy as np
import pyarrow as pa
from pyarrow import parquet
n, group = int(sys.argv[1]), int(sys.argv[3])
rng = np.random.default_rng(1)
columns = {"ra": rng.uniform(0.0, 360.0, n), "dec": np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, n)))}
columns["ref_epoch"] = np.full(n, 2016.0)
for name in ("pmra", "pmdec"):
    columns[name] = rng.normal(0.0, 0.4, n) + 100.0 * (rng.random(n) < 0.01)
    columns[name + "_error"] = np.full(n, 0.4)
columns["pmra_pmdec_corr"] = rng.uniform(-0.3, 0.3, n)
parquet.write_table(pa.table(columns), sys.argv[2], row_group_size=group)
"""

_RADIO_STARS = """
import json, time
from linksweep.sweep.tie.link import tie
files = "{satellite}", "{reference}"
tie(*files, "orientation,spin", errors="formal")  # imports
begun = time.process_time()
tie(*files, "orientation,spin", errors="jackknife,bootstrap", resamples=1000)
print(json.dumps(time.process_time() - begun))
"""


def measure(size: Size, repetitions: int, _peers: bool) -> list[Measured]:
    """Return CPU seconds and memory of one pass by degree, of the whole command, and of forty radio stars."""
    n = 20_000 if size == "tiny" else N_SOURCES
    result = []
    with tempfile.TemporaryDirectory() as folder:
        for degree in (1, 5):
            runs = [_pass(n, degree, Path(folder)) for _ in range(repetitions)]
            for name, key, unit, limit in (
                (f"a pass over {n:,} motions", "seconds", "s CPU", 3.0),
                ("memory beyond the table", "mb", "MB", 400.0),
                ("jackknife of cells", "extra", "% extra", 10.0),
            ):
                target = Target("<=", limit) if degree == 5 and size != "tiny" else None
                result.append(Measured(f"{name}, l = {degree}", [run[key] for run in runs], unit, target))
        result.append(_command(n, Path(folder), repetitions))
        result += _row_groups(n, Path(folder), repetitions)
        result.append(_radio_stars(Path(folder), repetitions))
    return result


def _pass(n: int, degree: int, folder: Path) -> dict[str, float]:
    run = watch([sys.executable, "-c", _PASS, str(n), str(degree)], folder, ONE_THREAD)
    values = json.loads(run.output)
    assert np.isfinite(list(values.values())).all()
    return dict(values)


def _command(n: int, folder: Path, repetitions: int) -> Measured:
    watch([sys.executable, "-c", _TABLE, str(n), "made.fits"], folder)
    command = [*SWEEP, "tie", "made.fits", "zero-motion", "--unknowns", "spin", "--degree", "5", "--clip", "median:5"]
    runs = [watch([*command, "--errors", "cells"], folder, ONE_THREAD) for _ in range(repetitions)]
    note = f"peak {max(run.peak_bytes for run in runs) / 1e6:,.0f} MB"
    name = f"sweep tie of {n:,} sources, l = 5, with a clip"
    return Measured(name, [run.cpu_s for run in runs], "s CPU", Target("<=", 40.0), note)


def _row_groups(n: int, folder: Path, repetitions: int) -> list[Measured]:
    """Return CPU seconds and memory of the same command from Parquet, and bytes a source from a quarter of the rows."""
    command = ["--unknowns", "spin", "--degree", "5", "--clip", "median:5", "--errors", "cells"]
    peaks = {}
    for rows in (n // 4, n):
        watch([sys.executable, "-c", _PARQUET, str(rows), f"{rows}.parquet", "100000"], folder)
        runs = [
            watch([*SWEEP, "tie", f"{rows}.parquet", "zero-motion", *command], folder, ONE_THREAD)
            for _ in range(repetitions)
        ]
        peaks[rows] = [float(run.peak_bytes) for run in runs]
    slope = [(high - low) / (n - n // 4) for low, high in zip(peaks[n // 4], peaks[n], strict=True)]
    note = f"peak {max(peaks[n]) / 1e6:,.0f} MB"
    name = f"sweep tie of {n:,} sources in Parquet, row group by row group"
    result = [Measured(name, [run.cpu_s for run in runs], "s CPU", Target("<=", 40.0), note)]
    if n >= N_SOURCES:
        result.append(Measured("memory of it", slope, "bytes a source", Target("<=", 50.0)))
    return result


def _radio_stars(folder: Path, repetitions: int) -> Measured:
    for seed, name in enumerate(("satellite", "reference")):
        _write_stars(folder / f"{name}.ecsv", seed)
    code = _RADIO_STARS.format(satellite="satellite.ecsv", reference="reference.ecsv")
    seconds = [json.loads(watch([sys.executable, "-c", code], folder, ONE_THREAD).output) for _ in range(repetitions)]
    return Measured("40 radio stars, leave one out, 1000 bootstraps", seconds, "s CPU", Target("<=", 1.0))


def _write_stars(path: Path, seed: int) -> None:
    from astropy.table import Table

    sky, rng, n = np.random.default_rng(40), np.random.default_rng(seed), 40
    columns = {"name": [f"star{i}" for i in range(n)], "ra": sky.uniform(0.0, 360.0, n)}
    columns |= {"dec": sky.uniform(-70.0, 70.0, n), "ref_epoch": np.full(n, (2016.0, 2005.0)[seed])}
    columns |= {"parallax": np.full(n, 5.0), "pmra": np.zeros(n), "pmdec": np.zeros(n)}
    for name in ("ra", "dec", "parallax", "pmra", "pmdec"):
        columns[f"{name}_error"] = rng.uniform(0.1, 0.3, n)
    Table(columns).write(path)
