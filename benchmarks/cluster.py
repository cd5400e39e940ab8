"""A run on 64 worker processes of four threads on this machine, whose tasks sleep, so that cores do not matter; also
while workers are killed and others start.  The same tasks by Dask alone show what of the rest is Dask's.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.measured import ROOT, SWEEP, Measured, Size, Target, watch

WORKERS, THREADS = 64, 4
TASK_S = 1.0
ROUNDS = 30
"""Tasks for each thread: a run of half a minute."""

LIFETIME_S = 5.0
"""A worker is killed every so many seconds where they come and go."""

STUDY = """
title = "Tasks that sleep"
experiment = "benchmarks.sleepers:experiment"
[axes]
sheep = { start = 1, stop = %d, step = 1 }
[fixed]
seconds = %s
[sampling]
n_sim = 1
seed = 1
"""

BARE = """
import sys, time
from distributed import Client
tasks, seconds = int(sys.argv[2]), float(sys.argv[3])
client = Client(sys.argv[1])
begun = time.monotonic()
client.gather(client.map(time.sleep, [seconds] * tasks, pure=False))
print(time.monotonic() - begun)
"""


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return efficiencies: the ideal seconds over those beyond what a run of one task takes."""
    workers, rounds = (2, 2) if size == "tiny" else (WORKERS, ROUNDS)
    tasks = workers * THREADS * rounds
    result = []
    for words, lifetime_s in (("all stay", 0.0), (f"one is replaced every {LIFETIME_S:g} s", LIFETIME_S)):
        command = [sys.executable, "-m", "benchmarks.many_workers", *map(str, (workers, THREADS, lifetime_s))]
        with (
            tempfile.TemporaryDirectory() as name,
            subprocess.Popen(
                command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            ) as cluster,
        ):
            assert cluster.stdout is not None
            address, folder = cluster.stdout.readline().strip(), Path(name)
            runs = []
            for number, seconds in ((1, 0.0), (tasks, TASK_S)):
                (folder / "s.toml").write_text(STUDY % (number, seconds))
                run = [*SWEEP, "run", "s.toml", "--scheduler", address, "-o", f"{number}.zarr"]
                runs.append(watch(run, folder))
            bare = float(watch([sys.executable, "-c", BARE, address, str(tasks), str(TASK_S)], folder).output)
            cluster.communicate()  # closes its input, which ends it
        one, many = runs
        spent = many.seconds - one.seconds
        target = Target(">=", 0.9) if size != "tiny" else None
        result += [
            Measured(f"{workers} workers, {words}: efficiency", [TASK_S * rounds / spent], "", target),
            Measured("  by Dask alone", [TASK_S * rounds / bare], ""),
            Measured("  seconds", [many.seconds], "s"),
            Measured("  run of one task", [one.seconds], "s"),
            Measured("  cores that the client keeps busy", [many.cpu_s / many.seconds], "", Target("<=", 1.0)),
        ]
    return result
