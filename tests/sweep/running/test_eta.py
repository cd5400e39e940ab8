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


def at(share, rows):
    return next((estimate, truth) for done, estimate, truth in rows if done >= share)


def equal(random_, place):
    return 1.0, random_.uniform(0.9, 1.1)


def growing(random_, place):
    """Points grow tenfold along the grid, and their cost says how long they take to 20 %."""
    cost = 1.0 + 9.0 * place
    return cost, cost * random_.uniform(0.8, 1.2)


def shrinking(random_, place):
    return growing(random_, 1.0 - place)


def scattered(random_, place):
    cost = random_.lognormvariate(0.0, 0.7)
    return cost, cost * random_.lognormvariate(0.0, 0.3)


@pytest.mark.parametrize("known", [True, False], ids=["workers known", "workers seen"])
@pytest.mark.parametrize("workers", [1, slow(2), 7, slow(64)])
@pytest.mark.parametrize(
    ("kind", "tasks_each"),
    [(equal, 10), (growing, 10), (shrinking, 10), (scattered, 50)],
    ids=lambda v: getattr(v, "__name__", str(v)),
)
def test_after_a_fifth_of_the_work_it_is_right_within_a_factor_of_one_and_a_half(kind, tasks_each, workers, known):
    n = tasks_each * workers
    for seed in range(5):
        random_ = random.Random(seed)
        results = results_of([kind(random_, i / n) for i in range(n)], workers)
        rows = estimates(results, workers if known else None)
        for share in (0.2, 0.5):
            estimate, truth = at(share, rows)
            assert truth / 1.5 < estimate < 1.5 * truth


def test_what_is_under_way_counts_between_results():
    """Two workers at tasks of ten seconds: five seconds after a result there are five seconds less left."""
    eta = Eta(20.0, 2)
    for now in (10.0, 10.1, 20.0, 20.1):
        eta.take(now, 1.0, 10.0)
    assert eta.left(25.0) == pytest.approx(eta.left(20.1) - 4.9, abs=0.1)
    assert eta.left(20.1) == pytest.approx(80.0, rel=0.02)


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


@pytest.mark.parametrize("workers", [1, 3])
def test_first_calls_do_not_blow_up_the_estimate(workers):
    """Each process takes 8 s for its first point, all others take 10 ms."""
    eta = Eta(1000.0, workers)
    for _ in range(workers):
        eta.take(8.0, 1.0, 8.0, cold=8.0)
        assert eta.left(8.0) is None
    now = 9.5  # the results are written for the first time
    for n in range(20):
        now += 0.01 / workers
        eta.take(now, 1.0, 0.01)
        truth = (1000 - workers - n - 1) * 0.01 / workers
        assert truth / 2 <= eta.left(now) <= 4 * truth
