"""What one would write first: a process pool over `numpy.linalg.lstsq`, one fit of six unknowns a realisation.

    python -m benchmarks.lstsq_pool SHARE WORKERS     prints the seconds of the work, for all of it scaled by 1/SHARE

The same work as `sweep run quasars`: 13 limiting magnitudes, 2 missions, 100 catalogues of 100 realisations each; the
positions and proper motions of N quasars with normal errors, weighted, fitted for orientation and spin; the estimates'
standard deviation.  A SHARE below 1 does only so large a part of the catalogues of each point, the same of each.
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from threadpoolctl import threadpool_limits

from linksweep.core.catalogues import CATALOGUES, V_MAX
from linksweep.core.errors import MagnitudeErrors
from linksweep.core.experiment import link

N_CAT, N_SIM = 100, 100


def design(ra, dec):
    """Return the design matrix of a small rotation and spin, (4 n, 6)."""
    east = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], axis=1)
    north = np.stack([np.sin(ra), -np.cos(ra), np.zeros_like(ra)], axis=1)
    positions = np.concatenate([east, north])
    return np.block([[positions, np.zeros_like(positions)], [np.zeros_like(positions), positions]])


def catalogue_squares(arguments):
    """Return the sum of squared estimates of the six unknowns over the realisations of one catalogue."""
    model, v_max, number = arguments
    rng = np.random.default_rng([int(10 * v_max), number])
    catalogue = CATALOGUES["quasars"].draw(link.defaults() | {"v_max": v_max}, rng)
    matrix = design(catalogue.ra, catalogue.dec)
    squares = np.zeros(6)
    with threadpool_limits(1):
        sigma = MagnitudeErrors(model).standard_errors(catalogue).T.ravel()
        weighted = matrix / sigma[:, None]
        for _ in range(N_SIM):
            noisy = rng.normal(0.0, sigma)
            squares += np.linalg.lstsq(weighted, noisy / sigma)[0] ** 2
    return squares


def main(share: float, workers: int) -> None:
    """Do the share, print the seconds of the whole."""
    n_cat = max(1, round(share * N_CAT))
    points = [(model, float(v)) for model in ("amex", "gaia") for v in V_MAX]
    tasks = [(*point, number) for number in range(n_cat) for point in points]
    with ProcessPoolExecutor(workers) as pool:
        list(pool.map(abs, range(8 * workers)))
        begun = time.perf_counter()
        squares = np.array(list(pool.map(catalogue_squares, tasks, chunksize=1))).reshape(n_cat, len(points), 6)
        seconds = time.perf_counter() - begun
    sigma = np.sqrt(squares.mean(axis=(0, 2)) / N_SIM)
    assert np.isfinite(sigma).all()
    print(seconds * N_CAT / n_cat)


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]))
