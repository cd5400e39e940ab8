"""How long a run takes to end after Ctrl-C, SIGTERM and SIGHUP: seconds from the signal to the end of the process.

python benchmarks/interrupt.py [repetitions]
"""

import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

EXPERIMENT = """
import time
from linksweep.sweep.contract import Experiment, Output, Parameter

def evaluate(points, n_sim, rng, catalogue_rng):
    time.sleep(10)
    return {"total": rng.standard_normal(n_sim).sum()}

experiment = Experiment("sleep", 1, (Parameter("k", "int", 1, "which"),), {"total": ()}, (Output("mean", "", "mean"),),
                        evaluate, lambda sums, n, n_cat: {"mean": sums["total"] / n}, cost=lambda point: 2.0**24)
"""

STUDY = """
title = "Blocks of ten seconds"
experiment = "sleep.py:experiment"
axes.k = { start = 1, stop = 50, step = 1 }
"""

POOLS = {
    "2 processes": ["--workers", "2"],
    "2 threads": ["--pool", "threads", "--workers", "2"],
    "serial": ["--pool", "serial"],
}


def seconds_to_end(folder: Path, options: list[str], number: int, moment: float | None) -> tuple[int, float]:
    """Return exit code and seconds; ``moment`` is when the signal comes after the start, None once blocks are under
    way.
    """
    store = tempfile.mkdtemp(dir=folder, suffix=".zarr")
    command = [sys.executable, "-m", "linksweep", "run", "study.toml", "-o", store, *options]
    process = subprocess.Popen(
        command, cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True
    )
    if moment is None:
        process.stderr.readline()  # what there is to do: said when the workers are there
        moment = 1.0
    time.sleep(moment)
    begun = time.perf_counter()
    os.killpg(process.pid, number)
    process.communicate()
    return process.returncode, time.perf_counter() - begun


def main(repetitions: int) -> None:
    """Print a line for each pool, signal and moment."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "sleep.py").write_text(EXPERIMENT)
        (folder / "study.toml").write_text(STUDY)
        cases = [(pool, number, None) for pool in POOLS for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
        cases += [("2 processes", signal.SIGINT, moment) for moment in (0.5, 0.8, 1.1, 1.4, 1.7, 2.0)]
        for pool, number, moment in cases:
            ends = [seconds_to_end(folder, POOLS[pool], number, moment) for _ in range(repetitions)]
            when = "in blocks of 10 s" if moment is None else f"{moment} s after the start"
            times = [seconds for _, seconds in ends]
            codes = ", ".join(str(code) for code in sorted({code for code, _ in ends}))
            print(f"{pool:12} {number.name:8} {when:20} median {statistics.median(times):5.2f} s  "
                  f"largest {max(times):5.2f} s  exit code {codes}")  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
