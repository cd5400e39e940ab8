"""Designs: points in the unit cube that sample many parameters at once."""

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from linksweep.sweep.contract import Array, SweepError

MORRIS_LEVELS = 4
"""Values of each parameter in a Morris design; an even number."""

SENSITIVITY = "needs SALib, which is not installed: pip install 'linksweep[sensitivity]'"


class Design(NamedTuple):
    """How to ``draw`` a design from n and the number of parameters; whether it ``grows``: a larger n begins with the
    same points; what n ``counts``; how many points each of these has ``beside`` one for each parameter, None if it
    is a single point; and whether it is ``of_sobol``, a sequence that is even for powers of two.
    """

    draw: Callable[[int, int, np.random.Generator], Any]
    grows: bool
    counts: str = "points"
    beside: int | None = None
    of_sobol: bool = False

    def size(self, n: int, dimensions: int) -> int:
        """Return how many points it has."""
        return n if self.beside is None else n * (dimensions + self.beside)

    def make(self, n: int, dimensions: int, seed: int) -> Array:
        """Return its points, (points, parameters), in the unit cube."""
        with warnings.catch_warnings():  # `remarks` says it in our words
            warnings.filterwarnings("ignore", message="The balance properties", category=UserWarning)
            return np.asarray(self.draw(n, dimensions, np.random.default_rng(seed)))


def _of_scipy(name: str, n: int, dimensions: int, rng: np.random.Generator) -> Any:
    from scipy.stats import qmc

    return getattr(qmc, name)(dimensions, seed=rng).random(n)


def _random(n: int, dimensions: int, rng: np.random.Generator) -> Any:
    return rng.random((n, dimensions))


def _saltelli(n: int, dimensions: int, rng: np.random.Generator) -> Any:
    salib()
    from SALib.sample import sobol

    return sobol.sample(unit_cube(dimensions), n, calc_second_order=False, seed=rng)


def _morris(n: int, dimensions: int, rng: np.random.Generator) -> Any:
    salib()
    from SALib.sample import morris

    return morris.sample(unit_cube(dimensions), n, num_levels=MORRIS_LEVELS, seed=rng)


DESIGNS: Mapping[str, Design] = {
    "sobol": Design(partial(_of_scipy, "Sobol"), grows=True, of_sobol=True),
    "latin-hypercube": Design(partial(_of_scipy, "LatinHypercube"), grows=False),
    "halton": Design(partial(_of_scipy, "Halton"), grows=True),
    "random": Design(_random, grows=True),
    "saltelli": Design(_saltelli, True, "base points, of (parameters + 2) points each", beside=2, of_sobol=True),
    "morris": Design(_morris, True, "trajectories, of (parameters + 1) points each", beside=1),
}


def salib() -> None:
    """Raise SweepError unless SALib can be imported."""
    try:
        import SALib  # noqa: F401
    except ImportError as error:
        raise SweepError(SENSITIVITY) from error


def remarks(origin: Mapping[str, Any]) -> list[str]:
    """Return the warnings of a run about a design."""
    n, design = origin.get("n", 1), DESIGNS.get(origin.get("design", ""))
    if design is None or not design.of_sobol or n & (n - 1) == 0:
        return []
    below = 1 << (n.bit_length() - 1)
    return [
        f"points.n = {n:,} is not a power of two, for which Sobol points are spread most evenly; take {below:,} or "
        f"{2 * below:,}"
    ]


def unit_cube(dimensions: int) -> dict[str, Any]:
    """Return SALib's definition of a problem with this many parameters between 0 and 1."""
    names = [f"x{k}" for k in range(dimensions)]
    return {"num_vars": dimensions, "names": names, "bounds": [[0.0, 1.0]] * dimensions}
