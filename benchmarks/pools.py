"""Threads against processes for the link: the same study on the same cores, in turns, start included.

python benchmarks/pools.py [ROUNDS]
"""

import subprocess
import sys
import tempfile
import time

STUDIES = {
    "full": ("--set", "n_cat=10", "--set", "n_sim=400"),
    "projected": ("--set", "n_cat=10", "--set", "n_sim=4000", "--set", "method=projected"),
}
POOLS = {
    "serial": ("serial",),
    "2 threads": ("threads", "--workers", "2"),
    "2 processes": ("processes", "--workers", "2"),
}


def seconds(study, pool):
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "linksweep",
            "run",
            "quasars",
            *STUDIES[study],
            "-o",
            f"{folder}/s.zarr",
            "--pool",
        ]
        begun = time.perf_counter()
        subprocess.run([*command, *POOLS[pool]], check=True, capture_output=True)
        return time.perf_counter() - begun


def main(rounds=3):
    for study in STUDIES:
        took = {pool: [] for pool in POOLS}
        for _ in range(rounds):
            for pool, times in took.items():
                times.append(seconds(study, pool))
        best = {pool: min(times) for pool, times in took.items()}
        for pool, least in best.items():
            print(f"{study:10s} {pool:12s} {least:6.1f} s  {least / best['serial']:.2f} of serial")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
