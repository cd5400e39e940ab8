"""Designs: which points of the unit cube stand for many parameters at once."""

import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from sweep.contract import Array, SweepError

MORRIS_LEVELS = 4
"""Values of each parameter in a Morris design; an even number."""

SENSITIVITY = "needs SALib, which is not installed: pip install 'linksweep[sensitivity]'"


class Design(NamedTuple):
    """How a design is made of ``n``, the number of parameters and a seed, as (points, parameters) in the unit cube;
    whether a larger n begins with the same points; and what n counts.
    """

    make: Callable[[int, int, int], Array]
    grows: bool
    counts: str = "points"


def _sobol(n: int, dimensions: int, seed: int) -> Array:
    from scipy.stats import qmc

    with warnings.catch_warnings():  # `remarks` says it in our words
        warnings.filterwarnings("ignore", message="The balance properties", category=UserWarning)
        return np.asarray(qmc.Sobol(dimensions, seed=np.random.default_rng(seed)).random(n))


def _halton(n: int, dimensions: int, seed: int) -> Array:
    from scipy.stats import qmc

    return np.asarray(qmc.Halton(dimensions, seed=np.random.default_rng(seed)).random(n))


def _latin_hypercube(n: int, dimensions: int, seed: int) -> Array:
    from scipy.stats import qmc

    return np.asarray(qmc.LatinHypercube(dimensions, seed=np.random.default_rng(seed)).random(n))


def _random(n: int, dimensions: int, seed: int) -> Array:
    return np.random.default_rng(seed).random((n, dimensions))


def _saltelli(n: int, dimensions: int, seed: int) -> Array:
    salib()
    from SALib.sample import sobol

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The balance properties", category=UserWarning)
        generator = np.random.default_rng(seed)
        return np.asarray(sobol.sample(_unit_cube(dimensions), n, calc_second_order=False, seed=generator))


def _morris(n: int, dimensions: int, seed: int) -> Array:
    salib()
    from SALib.sample import morris

    generator = np.random.default_rng(seed)
    return np.asarray(morris.sample(_unit_cube(dimensions), n, num_levels=MORRIS_LEVELS, seed=generator))


DESIGNS: Mapping[str, Design] = {
    "sobol": Design(_sobol, grows=True),
    "latin-hypercube": Design(_latin_hypercube, grows=False),
    "halton": Design(_halton, grows=True),
    "random": Design(_random, grows=True),
    "saltelli": Design(_saltelli, grows=True, counts="base points, of (parameters + 2) points each"),
    "morris": Design(_morris, grows=True, counts="trajectories, of (parameters + 1) points each"),
}


def salib() -> None:
    """Raise SweepError unless SALib can be imported."""
    try:
        import SALib  # noqa: F401
    except ImportError as error:
        raise SweepError(SENSITIVITY) from error


def size_of(design: str, n: int, dimensions: int) -> int:
    """Return how many points a design has."""
    return n * {"saltelli": dimensions + 2, "morris": dimensions + 1}.get(design, 1)


def remarks(origin: Mapping[str, Any]) -> list[str]:
    """Return what a run warns of a design with."""
    n = origin.get("n", 1)
    if origin.get("design") not in ("sobol", "saltelli") or n & (n - 1) == 0:
        return []
    below = 1 << (n.bit_length() - 1)
    return [
        f"points.n = {n:,} is not a power of two, for which Sobol points are spread most evenly; take {below:,} or "
        f"{2 * below:,}"
    ]


def _unit_cube(dimensions: int) -> dict[str, Any]:
    names = [f"x{k}" for k in range(dimensions)]
    return {"num_vars": dimensions, "names": names, "bounds": [[0.0, 1.0]] * dimensions}
