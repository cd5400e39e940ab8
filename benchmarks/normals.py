"""Nothing but the unique random numbers of `sweep run quasars`, on some processes: ``python -m benchmarks.normals
SHARE WORKERS`` prints the seconds, for all of them scaled by 1/SHARE.
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from core.noise import TILE
from core.quasars import V_MAX, quasar_count

UNIQUE = 4 * quasar_count(float(V_MAX[-1]), completed=False) * 10_000
"""Four a quasar and realisation: each limit sees the brightest of the same quasars, both missions the same errors."""


def fill(count):
    """Draw so many normals into a buffer that the processor's cache holds."""
    buffer, rng = np.empty(TILE), np.random.Generator(np.random.SFC64(1))
    for _ in range(round(count / TILE)):
        rng.standard_normal(out=buffer)


def main(share: float, workers: int) -> None:
    """Do the share, print the seconds of the whole."""
    with ProcessPoolExecutor(workers) as pool:
        list(pool.map(fill, [TILE] * 8 * workers))
        begun = time.perf_counter()
        list(pool.map(fill, [share * UNIQUE / (8 * workers)] * 8 * workers))
        print((time.perf_counter() - begun) / share)


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]))
