"""What a point's sums are, how many realisations it gets, and that a failed one gets no more."""

import json
from dataclasses import replace
from hashlib import blake2b

import numpy as np
import pytest

from linksweep.sweep.contract import Experiment, Output, Parameter
from linksweep.sweep.contract.block import Block, BlockRows, ledger_key
from linksweep.sweep.planning.accumulator import Accumulator
from linksweep.sweep.planning.grid import make_grid
from linksweep.sweep.planning.plan import Plan
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.planning.work_queue import Pending
from linksweep.sweep.studies.reader import study_from_dict
from tests.conftest import COINS


def constant(points, n_sim, rng, catalogue_rng):
    return {"n": [n_sim for _ in points]}


def summary(sums, n, n_cat):
    """Headline results whose relative errors are known exactly: sqrt(150/n) and sqrt(2000/n) per cent; one that is like
    the latter, but small by chance for the first 128; and one that is not known below 500.
    """
    results = {}
    for name, realisations in (("a", 150.0), ("b", 2000.0)):
        results |= {name: np.ones_like(n), f"{name}_mc_error": 0.01 * np.sqrt(realisations / n)}
    one, error = np.ones_like(n), results["b_mc_error"]
    results |= {"lucky": one, "lucky_mc_error": np.where(n == 128.0, 0.005, error)}
    return results | {"late": one, "late_mc_error": np.where(n < 500.0, np.nan, 0.001)}


HEADLINES = ("a", "b", "lucky", "late")
NAMES = tuple(each for name in HEADLINES for each in (name, f"{name}_mc_error"))
experiment = Experiment(
    name="exact",
    version=1,
    parameters=(Parameter("kind", "int", 0, "which"),),
    sums={"n": ()},
    outputs=tuple(Output(name, "", name, headline=name in HEADLINES, nan=True) for name in NAMES),
    evaluate=constant,
    summarise=summary,
)


def row(sums, accumulator):
    """What a block leaves of a point."""
    return np.array([tuple(sums)], dtype=accumulator.reducer.dtype)


def plan_of(headlines=("a", "b"), **sampling):
    study = study_from_dict(
        {"title": "", "experiment": f"{__file__}:experiment", "sampling": {"n_sim": 100} | sampling}
    )
    outputs = tuple(replace(output, headline=output.name in headlines) for output in experiment.outputs)
    return Plan(make_grid(replace(study, experiment=replace(study.experiment, outputs=outputs))))


def rounds(plan):
    """Return the realisations that a point has after each round, as it asks for them."""
    accumulator = Accumulator(plan)
    (point,) = plan.grid.points()
    blocks, reached = list(accumulator.missing(point)), []
    while blocks:
        more = []
        for block in blocks:
            more += accumulator.add(point, block, row([block.realisations], accumulator))
        reached.append(int(accumulator.realisations[0]))
        blocks = more
    assert accumulator.status[0] == Status.DONE
    return reached


@pytest.mark.parametrize(
    ("headlines", "expected"),
    [
        (("a",), [128, 256, 512]),  # 150 are needed: 128 are not precise enough, though within 10 %; and a quarter more
        (("b",), [128, 2048, 2560]),  # 2000, in one go from what 128 have
        (("a", "b"), [128, 2048, 2560]),  # both: the worse decides
        (("lucky",), [128, 256, 2048, 2560]),  # reached at 128, but not with a quarter more
        (("late",), [128, 256, 512, 1024]),  # twice as many while it is not known
        (("late", "b"), [128, 2048, 2560]),
    ],
)
def test_a_point_gets_what_the_worst_of_its_results_needs_at_once(headlines, expected):
    assert rounds(plan_of(headlines, precision=0.01)) == expected


def test_blocks_are_added_in_their_own_order_whatever_that_of_their_arrival():
    plan = plan_of(precision=0.001, n_cat=40)
    (point,) = plan.grid.points()
    random = np.random.default_rng(1)
    values, expected, totals = {}, np.zeros(1), set()
    for seed in range(20):
        accumulator = Accumulator(plan)
        blocks = list(accumulator.missing(point))
        while blocks:
            for block in blocks:
                if block not in values:
                    values[block] = random.normal(size=1) * 10.0 ** random.integers(-8, 8)
                    expected += values[block]
            arrived = np.random.default_rng(seed).permutation(len(blocks))
            blocks = [
                more
                for place in arrived
                for more in accumulator.add(point, blocks[place], row(values[blocks[place]], accumulator))
            ]
        totals.add(accumulator.total.tobytes())
    assert len(values) > 30
    assert totals == {expected.tobytes()}


@pytest.mark.parametrize("given_before", [0, 3])
def test_a_failed_point_is_given_out_no_more_and_never_done(given_before):
    study = study_from_dict({"title": "", "experiment": COINS, "sampling": {"n_sim": 160}, "axes": {"coins": [1, 2]}})
    costly = replace(study.experiment, cost=lambda point: 2.0**24)  # ten blocks of 16 realisations, a task each
    plan = Plan(make_grid(replace(study, experiment=costly)))
    accumulator = Accumulator(plan)
    pending = Pending(plan, accumulator)
    first, second = plan.grid.points()
    before = [work for task in pending.take(given_before) for work in task]
    assert {point.digest for work in before for point in work.points} <= {first.digest}
    accumulator.fail(first.index)
    after = [work for task in pending.take(10**6) for work in task]
    assert {point.digest for work in after for point in work.points} == {second.digest}
    for block in plan.blocks(2.0**24):  # those that were under way
        assert accumulator.add(first, block, row((1.0, 1.0), accumulator)) == []
    assert accumulator.status[first.index] == Status.FAILED


def test_the_ledger_knows_a_block_by_all_that_decides_its_sums():
    block = Block(0, 0, 0, 1, 100)
    others = [block._replace(**{name: 7}) for name in ("group", "part", "n_cat", "n_sim")]
    keys = {ledger_key(bytes(16), each) for each in (block, *others)} | {ledger_key(bytes([1] * 16), block)}
    assert len(keys) == 6
    assert {len(key) for key in keys} == {32}


def test_a_point_at_the_default_of_a_parameter_is_that_of_a_study_without_it():
    document = {"title": "", "experiment": COINS, "axes": {"coins": [1, 5]}}
    before = [point.digest for point in make_grid(study_from_dict(document)).points()]
    default = study_from_dict(document).experiment.defaults()["metal"]
    other = next(metal for metal in ("gold", "tin") if metal != default)
    document["axes"]["metal"] = [default, other]
    grid = make_grid(study_from_dict(document))
    after = {tuple(point.parameters[name] for name in ("coins", "metal")): point.digest for point in grid.points()}
    assert [after[coins, default] for coins in (1, 5)] == before
    assert not {after[coins, other] for coins in (1, 5)} & set(before)
    assert grid.digests(grid.indices()) == [point.digest for point in grid.points()]


GRIDS = {
    "plain": {"axes": {"metal": ["gold", "tin"], "coins": [1, 5, 3]}},
    "excluded": {"axes": {"metal": ["gold", "tin"], "coins": [1, 5]}, "exclude": [{"metal": "tin", "coins": 5}]},
    "zipped": {"axes": {"coins": [1, 5, 3], "chance": [0.2, 0.5, 0.4]}, "grid": {"zip": [["coins", "chance"]]}},
    "repeated rows": {"points": {"columns": {"coins": [1, 5, 1]}}, "axes": {"chance": [0.5, 0.25]}},
    "one point": {"fixed": {"coins": 4}},
}


@pytest.mark.parametrize("name", GRIDS)
def test_digests_many_at_a_time_are_those_of_the_points(name, monkeypatch):
    monkeypatch.setattr("linksweep.sweep.planning.grid.AT_ONCE", 2)
    grid = make_grid(study_from_dict({"title": "", "experiment": COINS} | GRIDS[name]))
    points = list(grid.points())
    defaults = grid.study.experiment.defaults()
    for point in points:  # as the store of a study that is years old has them
        own = {name: value for name, value in sorted(point.parameters.items()) if value != defaults[name]}
        assert point.digest == point.stream == blake2b(json.dumps(own).encode(), digest_size=16).digest()
    assert [(index, parameters) for index, parameters in grid.parameters()] == [(p.index, p.parameters) for p in points]
    assert grid.indices().tolist() == [point.index for point in points]
    assert grid.digests(grid.indices()) == [point.digest for point in points]
    assert list(grid.points(grid.indices())) == points
    assert [grid.point(point.index) for point in points] == points


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("only_failed", [False, True])
def test_a_survey_of_many_points_is_that_of_one_after_the_other(name, only_failed, monkeypatch):
    monkeypatch.setattr("linksweep.sweep.planning.accumulator.AT_ONCE", 2)
    document = {"title": "", "experiment": COINS, "sampling": {"n_sim": 10, "n_cat": 1}} | GRIDS[name]
    plan = Plan(make_grid(study_from_dict(document)))
    digests = [point.digest for point in plan.grid.points()]
    [block] = plan.blocks(1.0)
    held, failed = digests[::2], digests[1:3]
    rows = BlockRows([ledger_key(digest, block) for digest in held])
    dtype = plan.grid.study.experiment.reducer.dtype
    left = np.random.default_rng(1).normal(size=(len(held), dtype.itemsize // 8)).view(dtype).reshape(-1)
    given = (plan, rows, left, failed, frozenset(failed) if only_failed else None)
    fast = Accumulator(*given)
    monkeypatch.setattr(Accumulator, "_only_block", lambda self: None)
    slow = Accumulator(*given)
    assert fast.survey == slow.survey
    for array in ("status", "realisations", "total"):
        assert getattr(fast, array).tobytes() == getattr(slow, array).tobytes(), array
