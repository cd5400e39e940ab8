"""How near the link comes to the speed of the random numbers it is made of.

    python -m benchmarks core-speed

The unit is the bare generator: the same buffers of unit normals, filled by the same generator in the same process and
nothing else done.  A ratio of 0.9 says that drawing took 90 % of the time.  For points that share a draw the ratio is
that of points times normals, as if each had drawn its own, so it may be far above 1.  Everything a block costs is in
it, catalogue and set-up too.  Medians over repetitions in which all cases take turns, in CPU time, BLAS on one thread,
in a process with the environment that `sweep run` gives its workers, whose allocator keeps what is freed.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.measured import Measured, Size, Target, watch
from linksweep.core.catalogues import V_MAX
from linksweep.core.experiment import cost, evaluate, link
from linksweep.core.setup import ROWS, TILE
from linksweep.sweep.executing.clusters import ENVIRONMENT

N_OBJ = (28, 300, 1156, 15_533)
TARGETS = {"fixed design": 0.80, "equal weights": 0.80, "errors of both": 0.35}
"""Of the bare generator, for at least so many objects:"""
TARGETS_FROM = 1000
PROJECTED_OBJECTS = 500_000
PROJECTED_S = 2.0
LIMITS = [float(v) for v in V_MAX]
Case = tuple[list[dict[str, Any]], int]


def cases() -> dict[str, Case]:
    """Return by name the points of a block and its realisations."""
    base = link.defaults() | {"catalogue": "quasars", "v_max": 20.0}
    both = {"reference_errors": "normal"}
    result: dict[str, Case] = {}
    for n_obj in N_OBJ:
        one = link.defaults() | {"n_obj": n_obj}
        few = ROWS if n_obj < N_OBJ[-1] else ROWS // 4
        result[f"fixed design, N = {n_obj}"] = [one], ROWS
        result[f"equal weights, N = {n_obj}"] = [one | {"weighting": "equal"}], ROWS
        result[f"errors of both, N = {n_obj}"] = [one | both], few
        scales = [one | {"error_scale": 1.0 + 0.1 * k} for k in range(13)]
        result[f"13 error scales, N = {n_obj}"] = scales, ROWS
    result["13 limits of Table 1"] = [base | {"v_max": v} for v in LIMITS], ROWS
    result["13 limits of Table 1, errors of both"] = [base | both | {"v_max": v} for v in LIMITS], ROWS // 4
    return result


def normals(case: Case) -> float:
    """Return the normals that the points of a case would draw, each on its own."""
    points, n_sim = case
    return float(sum(cost(point) for point in points) * n_sim)


def generator(seed: int) -> np.random.Generator:
    """Return a generator of the kind that the platform uses."""
    return np.random.Generator(np.random.SFC64(seed))


def bare(count: float) -> Callable[[], None]:
    """Return what fills the same buffers with about as many normals."""
    buffer, rng = np.empty(TILE), generator(1)

    def fill() -> None:
        for _ in range(max(1, round(count / TILE))):
            rng.standard_normal(out=buffer)

    return fill


def seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of one call."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def block(case: Case) -> Callable[[], object]:
    """Return what evaluates a case."""
    points, n_sim = case
    return lambda: evaluate(points, n_sim, generator(1), generator(2))


def repeated(work: Callable[[], object], times: int) -> Callable[[], None]:
    """Return what does the work several times."""

    def several() -> None:
        for _ in range(times):
            work()

    return several


def ratios(repetitions: int) -> dict[str, list[float]]:
    """Return for each case the throughput of normals as a fraction of the bare generator's."""
    chosen, fill_count = cases(), 2**22
    fill = bare(fill_count)
    result: dict[str, list[float]] = {name: [] for name in chosen}
    for turn in range(repetitions + 1):
        for name, case in chosen.items():
            # short blocks are repeated until a clock can tell them from nothing
            times = max(1, round(2**21 / normals(case)))
            per_normal = seconds(fill) / fill_count
            taken = seconds(repeated(block(case), times))
            if turn:  # the first turn is to warm up
                result[name].append(times * normals(case) * per_normal / taken)
    return result


def projected(n_sim: int) -> dict[str, float]:
    """Return the seconds that one realisation, that is the set-up, and ``n_sim`` of them take."""
    point = link.defaults() | {"n_obj": PROJECTED_OBJECTS, "method": "projected"}
    one, many = (median(seconds(block(([point], n))) for _ in range(3)) for n in (1, n_sim))
    return {"n_sim": float(n_sim), "set_up_s": one, "after_set_up_s": max(0.0, many - one)}


def target(name: str) -> Target | None:
    """Return the target of a case."""
    kind, _, n_obj = name.partition(", N = ")
    return Target(">=", TARGETS[kind]) if kind in TARGETS and int(n_obj) >= TARGETS_FROM else None


def measure(size: Size, repetitions: int, peers: bool) -> list[Measured]:
    """Return the rate of the bare generator, the ratio of every case and the seconds of the projected method."""
    command = [sys.executable, "-m", "benchmarks.core_speed", size, str(repetitions)]
    with tempfile.TemporaryDirectory() as folder:
        result = json.loads(watch(command, Path(folder), ENVIRONMENT).output)
    once, whole = result["projected"], size != "tiny"
    return [
        Measured("bare generator", [result["rate"] / 1e6], "M/s", note="unit normals a second and core"),
        *(Measured(n, values, "of bare", target(n) if whole else None) for n, values in result["ratios"].items()),
        Measured(f"projected, {PROJECTED_OBJECTS:,} objects: set-up", [once["set_up_s"]], "s CPU"),
        Measured(
            f"projected: {once['n_sim']:,.0f} realisations",
            [once["after_set_up_s"]],
            "s CPU",
            Target("<=", PROJECTED_S) if whole else None,
        ),
    ]


def main(size: str, repetitions: str) -> None:
    """Print what is measured in this process, as JSON."""
    with threadpool_limits(1):
        fill = bare(2**24)
        rate = 2**24 / min(seconds(fill) for _ in range(3))
        result = ratios(1 if size == "tiny" else int(repetitions))
        once = projected(10_000 if size == "tiny" else 1_000_000)
    json.dump({"rate": rate, "ratios": result, "projected": once}, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:])
