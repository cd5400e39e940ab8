"""The time left is right within a factor, never negative, and steady: on a simulated clock."""

import heapq
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linksweep.sweep.running.progress import Eta
from tests.tiers import examples, slow

START_S = 7.0
"""Workers take this long to be there: not work, and not extrapolated."""


def results_of(tasks, workers, travel=0.0, seed=0):
    """Give tasks (cost, seconds) to workers in order, and return results (time, cost, seconds) as they arrive."""
    random_ = random.Random(seed)
    free = [START_S] * workers
    results = []
    for cost, seconds in tasks:
        end = heapq.heappop(free) + seconds
        results.append((end + random_.uniform(0.0, travel), cost, seconds))
        heapq.heappush(free, end + 0.002)
    return sorted(results)


def estimates(results, workers):
    """Return (share of the work done, estimated, true time left) after each result."""
    eta = Eta(sum(cost for _, cost, _ in results), workers)
    total, done, rows = sum(cost for _, cost, _ in results), 0.0, []
    for now, cost, seconds in results:
        eta.take(now, cost, seconds)
        done += cost
        rows.append((done / total, eta.left(now), results[-1][0] - now))
    return rows


KINDS = {  # from a random generator and the place in the grid: cost and seconds of a task
    "equal": lambda chance, place: (1.0, chance.uniform(0.9, 1.1)),
    "growing": lambda chance, place: (1.0 + 9.0 * place, (1.0 + 9.0 * place) * chance.uniform(0.8, 1.2)),
    "shrinking": lambda chance, place: KINDS["growing"](chance, 1.0 - place),
    "scattered": lambda chance, place: (
        cost := chance.lognormvariate(0.0, 0.7),
        cost * chance.lognormvariate(0.0, 0.3),
    ),
}


@pytest.mark.parametrize("known", [True, False], ids=["workers known", "workers seen"])
@pytest.mark.parametrize("workers", [1, slow(2), 7, slow(64)])
@pytest.mark.parametrize("kind", KINDS)
def test_after_a_fifth_of_the_work_it_is_right_within_a_factor_of_one_and_a_half(kind, workers, known):
    n = (50 if kind == "scattered" else 10) * workers
    for seed in range(5):
        random_ = random.Random(seed)
        results = results_of([KINDS[kind](random_, i / n) for i in range(n)], workers)
        rows = estimates(results, workers if known else None)
        for share in (0.2, 0.5):
            estimate, truth = next(row[1:] for row in rows if row[0] >= share)
            assert truth / 1.5 < estimate < 1.5 * truth


@settings(max_examples=examples(200), derandomize=True)
@given(
    st.lists(st.tuples(st.floats(0, 1e6), st.floats(0, 1e12), st.floats(0, 1e6), st.floats(0, 1e12)), max_size=30),
    st.floats(0, 1e15),
    st.one_of(st.none(), st.integers(0, 100)),
)
def test_never_negative_nor_nan(steps, cost, workers):
    eta = Eta(cost, workers)
    now = 0.0
    assert eta.left(now) is None
    for passed, done, seconds, more in steps:
        now += passed
        eta.take(now, done, seconds)
        eta.extend(more)
        for later in (0.0, 1.0, 1e9):
            left = eta.left(now + later)
            assert math.isfinite(left)
            assert left >= 0.0
