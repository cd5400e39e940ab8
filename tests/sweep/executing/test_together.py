"""Catalogues that an experiment evaluates together: what comes back is what one by one gives."""

from dataclasses import replace

import numpy as np
import pytest

from linksweep.sweep.code.load import keep
from linksweep.sweep.contract.block import Block
from linksweep.sweep.executing.task import PointBlock, Task
from linksweep.sweep.executing.worker import MOST_CATALOGUES, alike, run_task
from tests.sweep.coins import experiment, toss

CALLS = []


def together(points, n_sim, streams):
    """Toss for each pair of generators."""
    CALLS.append(len(streams))
    found = [toss(points, n_sim, *pair) for pair in streams]
    return {name: np.array([sums[name] for sums in found]) for name in experiment.sums}


def task_of(evaluate_catalogues, units, **options):
    CALLS.clear()
    several = replace(experiment, evaluate_catalogues=evaluate_catalogues)
    return Task(keep(several), 3, tuple(units), **options)


def unit(coins, *blocks):
    point = {"coins": coins}
    return [PointBlock((point,), bytes([coins]) * 16, block) for block in blocks]


SMALL = [Block(0, 0, 0, 16, 5), Block(1, 0, 16, 16, 5), Block(2, 0, 32, 3, 5)]
UNITS = [*unit(4, *SMALL), *unit(9, *SMALL), *unit(9, Block(0, 1, 0, 16, 7)), *unit(2, Block(0, 0, 0, 1, 5))]


def assert_same(found, expected):
    assert {r: o.row.tobytes() for r, o in found.outcomes.items()} == {
        r: o.row.tobytes() for r, o in expected.outcomes.items()
    }
    assert found.failures == expected.failures
    assert len(found.seconds) == len(expected.seconds)


def test_blocks_of_one_point_are_evaluated_in_one_call():
    expected = run_task(task_of(None, UNITS))
    assert_same(run_task(task_of(together, UNITS)), expected)
    assert CALLS == [35, 35, 16]  # the last block is of one catalogue
    assert np.all(run_task(task_of(together, UNITS)).seconds > 0.0)


def test_a_call_has_so_many_catalogues_at_most():
    blocks = [Block(k, 0, 16 * k, 16, 5) for k in range(40)]
    run_task(task_of(together, unit(4, *blocks)))
    assert sum(CALLS) == 640
    assert max(CALLS) <= MOST_CATALOGUES


@pytest.mark.parametrize("options", [{"time_limit_s": 10.0}, {"keep_samples": True}])
def test_not_where_a_block_has_a_time_limit_or_realisations_are_kept(options):
    assert_same(run_task(task_of(together, UNITS, **options)), run_task(task_of(None, UNITS)))
    assert not CALLS


def test_large_catalogues_stay_with_their_neighbours_and_are_not_evaluated_together():
    parts = unit(4, *(Block(0, part, 0, 1, 512) for part in range(3)))
    groups = [parts, UNITS[:3], UNITS[3:6], UNITS[6:7], UNITS[7:]]
    assert list(alike([*parts, *UNITS])) == [tuple(group) for group in groups]
    run_task(task_of(together, parts))
    assert not CALLS


def raising(error):
    def evaluate_catalogues(points, n_sim, streams):
        print("tried")
        raise error

    return evaluate_catalogues


def of_another_shape(points, n_sim, streams):
    return {name: values[:-1] for name, values in together(points, n_sim, streams).items()}


def not_finite(points, n_sim, streams):
    return {name: np.nan * values for name, values in together(points, n_sim, streams).items()}


@pytest.mark.parametrize(
    "evaluate_catalogues",
    [raising(ValueError("unlike")), raising(SystemExit(3)), of_another_shape, not_finite, lambda *_: None],
    ids=["raises", "exits", "shape", "NaN", "nothing"],
)
def test_where_that_fails_catalogues_are_evaluated_one_by_one(evaluate_catalogues):
    found = run_task(task_of(evaluate_catalogues, UNITS))
    assert_same(found, run_task(task_of(None, UNITS)))
    assert not found.said  # what was printed in vain is not kept
