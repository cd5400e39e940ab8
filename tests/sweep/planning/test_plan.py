"""Blocks tile the realisations exactly once, and nothing but the point itself decides its numbers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from linksweep.sweep.contract import SweepError
from linksweep.sweep.contract.block import BlockRows, ledger_key
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.planning.plan import LARGEST_BLOCK, MAX_CATALOGUES, MAX_SIMS, Plan
from linksweep.sweep.planning.work_queue import TASK_S, TUNED, Pending
from linksweep.sweep.studies.reader import load_study, study_from_dict
from tests.conftest import COINS
from tests.sweep.running import test_precision
from tests.tiers import examples, slow

PRECISE = f"{test_precision.__file__}:experiment"


def plan_of(document, **sampling):
    return Plan(make_grid(study_from_dict(document | {"sampling": document["sampling"] | sampling})))


def work_of(plan):
    """All work of a plan, in order."""
    nothing = Accumulator(plan)
    return [work for task in Pending(plan, nothing).take(10**6) for work in task]


def keys_of(document):
    return [key for work in work_of(plan_of(document)) for key in ledger_keys(work)]


def ledger_keys(work):
    return [ledger_key(point.digest, work.block) for point in work.points]


def test_a_grid_of_too_many_points_is_refused_with_its_size():
    axes = {"coins": list(range(1, 5002)), "chance": [0.2 + 0.0001 * k for k in range(2000)]}
    with pytest.raises(SweepError, match=r"the grid has 10,002,000 points \(coins 5,001 x chance 2,000\); at most 10,"):
        make_grid(study_from_dict({"title": "", "experiment": COINS, "axes": axes}))


def one_point(n_sim, n_cat):
    return plan_of({"title": "", "experiment": COINS, "sampling": {"n_sim": n_sim, "n_cat": n_cat}})


@pytest.mark.slow
@settings(max_examples=100, derandomize=True)
@given(st.integers(1, 3000), st.integers(1, 60), st.floats(1.0, 1e9))
def test_the_blocks_of_a_point_tile_its_realisations_exactly_once(n_sim, n_cat, cost):
    plan = one_point(n_sim, n_cat)
    covered = np.zeros((n_cat, n_sim), dtype=int)
    sims = max(b.n_sim for b in plan.blocks(cost))
    for block in plan.blocks(cost):
        start = block.part * sims
        covered[block.first_catalogue : block.first_catalogue + block.n_cat, start : start + block.n_sim] += 1
    assert np.all(covered == 1)


@settings(max_examples=examples(60), derandomize=True)
@given(st.integers(1, 2000), st.integers(1, 40), st.integers(0, 2000), st.integers(0, 40), st.floats(1.0, 1e8))
def test_more_realisations_leave_whole_blocks_as_they_were(n_sim, n_cat, more_sim, more_cat, cost):
    before = list(one_point(n_sim, n_cat).blocks(cost))
    after = list(one_point(n_sim + more_sim, n_cat + more_cat).blocks(cost))
    largest = max(after, key=lambda b: (b.n_sim, b.n_cat))
    whole = {b for b in before if b.n_sim == largest.n_sim and b.n_cat == largest.n_cat}
    assert whole <= set(after)


def test_a_point_has_the_same_key_and_blocks_in_any_grid(coins):
    alone = {**coins, "axes": {"metal": ["tin"]}, "fixed": {"coins": 5, "chance": 0.4}}
    keys = [
        ledger_keys(work)
        for work in work_of(plan_of(coins))
        if work.points[0].parameters["metal"] == "tin" and work.points[0].parameters["coins"] == 5
    ]
    assert [key for several in keys for key in several] == keys_of(alone)


def test_a_default_that_is_written_out_is_the_same_point(coins):
    implicit = {**coins, "axes": {"coins": [1]}}
    explicit = {**implicit, "fixed": coins["fixed"] | {"metal": "gold"}}
    assert keys_of(implicit) == keys_of(explicit)


def test_an_integer_and_the_equal_float_are_the_same_point(coins):
    whole = {**coins, "fixed": {"coins": 1, "chance": 0.5}, "axes": {}}
    assert keys_of(whole | {"fixed": {"coins": 1.0}}) == keys_of(whole)


def given_out(pending, seconds_of, workers=1):
    """Return all tasks, each measured when as many as keep so many workers busy have been given out after it."""
    tasks, out = [], []
    while True:
        while len(out) < 4 * workers and (more := pending.take(1)):
            tasks += more
            out += more
        if not out:
            return tasks
        works = out.pop(0)
        seconds = [seconds_of(point) for work in works for point in work.points]
        assert pending.settle(works, np.array(seconds)) == works


def test_tasks_hold_all_work_in_order(coins):
    plan = plan_of(coins, n_sim=300_000)
    batches = given_out(Pending(plan, Accumulator(plan)), lambda point: 1e-4)
    expected = [
        ledger_key(point.digest, block)
        for point in plan.grid.points()
        for block in plan.blocks(plan.cost(point.parameters))
    ]
    assert [key for batch in batches for work in batch for key in ledger_keys(work)] == expected
    assert len(batches) < sum(map(len, batches)) / 50  # blocks of coins are small: many go into one task


def points_of(coins, count):
    axes = {"coins": {"start": 1, "stop": count, "step": 1}}
    return plan_of({**coins, "axes": axes}, n_sim=1, n_cat=1)


@pytest.mark.parametrize("workers", [slow(1), 4, slow(16)])
@pytest.mark.parametrize("seconds", [1e-5, 1e-3, 0.02, 0.5, 30.0])
def test_tasks_are_of_about_a_second_and_enough_for_all(coins, seconds, workers):
    """Whatever the experiment declares as its cost: here one random number for each realisation."""
    plan = points_of(coins, 5000)
    tasks = given_out(Pending(plan, Accumulator(plan)), lambda point: seconds, workers)
    assert sum(map(len, tasks)) == 5000
    assert all(len(task) == 1 or len(task) * seconds <= 1.01 * TASK_S for task in tasks)
    most = TUNED.most_blocks
    assert all(len(task) <= most for task in tasks)
    assert len(tasks) >= 4 * workers
    assert len(tasks) <= 4 * workers + 2 * 4 * workers * math.log(5000) + 2 * 5000 * seconds / TASK_S + 5000 / most
    assert all(len(task) == 1 for task in tasks[: 4 * workers])  # nothing was measured before


def test_what_a_worker_did_not_come_to_is_pending_again(coins):
    plan = points_of(coins, 200)
    pending = Pending(plan, Accumulator(plan))
    [first] = pending.take(1)
    pending.settle(first, np.array([1e-6]))
    [task] = pending.take(1)
    assert len(task) > 10
    assert pending.settle(task, np.full(7, 1.0)) == task[:7]
    left = [work for works in given_out(pending, lambda point: 1.0) for work in works]
    assert [work.points[0].index for work in left] == list(range(8, 200))


def test_work_that_is_put_back_is_shared_among_all_like_other_work(coins):
    """Tasks after it are as large as without it: it counts as left, and comes in its own order."""
    sizes = []
    for put_back in (0, 60):
        plan = points_of(coins, 2000)
        pending = Pending(plan, Accumulator(plan))
        [first] = pending.take(1)
        pending.settle(first, np.array([0.02]))
        for number in range(put_back):  # again and again: nothing of it is lost
            [task] = pending.take(1)
            assert [work.points[0].index for work in task] == list(range(1 + number, 1 + number + len(task)))
            assert pending.settle(task, np.full(1, 0.02)) == task[:1]
        sizes.append(len(pending.take(1)[0]))
    assert sizes[0] == pytest.approx(50, abs=1)
    assert sizes[1] == pytest.approx(50, abs=1)


def test_work_of_points_that_share_a_draw_is_put_back_whole():
    """A worker that stops inside of it has not done it: there is a second for each point."""
    study = load_study("quasars", ["n_cat=3", "n_sim=64", "common_random_numbers=true"])
    plan = Plan(make_grid(study))
    pending = Pending(plan, Accumulator(plan))
    tasks = pending.take(3)
    assert [len(task) for task in tasks] == [1, 1, 1]
    several = tasks[0] + tasks[1] + tasks[2]
    points = len(several[0].points)
    assert points > 1
    assert pending.settle(several, np.full(2 * points - 1, 1e-3)) == several[:1]
    assert [work for task in pending.take(2) for work in task][:2] == several[1:]


@pytest.mark.parametrize(
    ("most", "parts"), [(64, 1), (65, 2), (128, 2), (129, 3), (512, 4), (513, 5), (1024, 5), (1025, 6)]
)
def test_the_parts_of_a_precision_double_until_blocks_are_whole(coins, most, parts):
    plan = plan_of({"title": "", "experiment": PRECISE, "sampling": {"n_sim": most, "precision": 0.1}})
    assert plan.parts(1.0) == parts
    reached = [plan.realisations(1.0, k) for k in range(9)]
    assert reached == [0, 64, 128, 256, 512, 1024, 1536, 2048, 2560]
    blocks = plan.blocks(1.0, range(8))
    assert [block.n_sim for block in blocks] == np.diff(reached).tolist()
    assert plan.parts(1.0, 20_000) == next(k for k in range(100) if plan.realisations(1.0, k) >= 20_000)


def test_a_block_is_bounded(coins):
    blocks = list(one_point(10**6, 100).blocks(cost=1.0))
    assert max(b.n_sim for b in blocks) == MAX_SIMS
    assert max(b.n_cat for b in blocks) == MAX_CATALOGUES
    large = list(one_point(10**4, 10).blocks(cost=1e6))
    assert all(b.n_cat == 1 and b.realisations * 1e6 <= LARGEST_BLOCK for b in large)
    assert all(b.n_sim == b.n_cat == 1 for b in one_point(10, 10).blocks(cost=1e9))


@pytest.mark.parametrize("common", [False, True])
@pytest.mark.parametrize("held", [0, 3])
def test_the_cost_of_what_is_pending_is_that_of_the_work_given_out(common, held):
    """By which the time left is estimated: points that share a draw cost less than each alone."""
    study = load_study("quasars", ["n_cat=5", "n_sim=777", f"common_random_numbers={str(common).lower()}"])
    plan = Plan(make_grid(study))
    blocks = [(point, block) for point in plan.grid.points() for block in plan.blocks(plan.cost(point.parameters))]
    keys = [ledger_key(point.digest, block) for point, block in blocks if block.group < held]
    left = np.ones(len(keys), study.experiment.reducer.dtype)
    accumulator = Accumulator(plan, BlockRows(keys), left)
    pending, given = Pending(plan, accumulator), 0.0
    while tasks := pending.take(1):
        given += sum(work.cost for work in tasks[0])
    assert given > 0
    assert accumulator.survey.pending.cost == pytest.approx(given)
