"""Nothing but random numbers, on some processes: ``python -m benchmarks.normals COUNT WORKERS`` prints the seconds of
so many normals.
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from linksweep.core.setup import TILE


def fill(count):
    """Draw so many normals into a buffer that the processor's cache holds."""
    buffer, rng = np.empty(TILE), np.random.Generator(np.random.SFC64(1))
    for _ in range(round(count / TILE)):
        rng.standard_normal(out=buffer)


def main(count: int, workers: int) -> None:
    """Draw them, print the seconds."""
    with ProcessPoolExecutor(workers) as pool:
        list(pool.map(fill, [TILE] * 8 * workers))
        begun = time.perf_counter()
        list(pool.map(fill, [count / (8 * workers)] * 8 * workers))
        print(time.perf_counter() - begun)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
