"""A vectorised function gives each point what it gives it alone, or its points fail."""

import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import linksweep
from linksweep import SweepError, experiment
from linksweep.sweep.executing.worker import dependence
from linksweep.sweep.functions.adapter import experiment_of
from linksweep.sweep.planning.point_status import Status
from tests.tiers import examples

POINTS = [{"x": x} for x in (3.0, 1.0, -2.0, 0.5)]
DIGESTS = [b"a", b"b", b"c", b"d"]


def told(of_all, **declared):
    """What is said of a function of an array ``x``."""

    def function(x: float):
        return of_all(x)

    made = experiment_of(experiment(vectorised=True, **declared)(function))
    return dependence(made, POINTS, made.compute(POINTS, 1, ()), DIGESTS)


@pytest.mark.parametrize(
    ("of_all", "words"),
    [
        (np.sort, "is -2.0 in a call for 4 points, but 3.0 for the same point (x=3.0) alone"),
        (np.cumsum, "is 4.0 in a call for 4 points, but 1.0 for the same point (x=1.0)"),
        (lambda x: x - x.mean(), "is 2.375 in a call for 4 points, but 0.0 for"),
        (lambda x: np.arange(len(x)), "is 1 in a call for 4 points, but 0 for"),
        (lambda x: x == x.max(), "is False in a call for 4 points, but True for"),
        (lambda x: np.where(x < x.max(), "less", "most"), "is 'less' in a call for 4 points, but 'most' for"),
        (
            lambda x: np.stack([x, x / np.abs(x).max()], axis=1),
            "is [1.0, 0.3333333333333333] in a call for 4 points, but [1.0, 1.0] for",
        ),
        (
            lambda x: np.broadcast_to(x, (len(x), len(x))).copy(),
            "is [3.0, 1.0, -2.0, 0.5] in a call for 4 points, but [3.0] for",
        ),
        (lambda x: np.full((len(x), 2), len(x)), "is [4, 4] in a call for 4 points, but [1, 1] for"),
    ],
)
def test_what_depends_on_the_others_is_told_with_both_values(of_all, words):
    assert words in told(of_all)
    assert "returns for a point must not depend on the others" in told(of_all)


@pytest.mark.parametrize(
    "of_all",
    [
        np.sin,
        lambda x: x > 0.0,
        lambda x: (10 * x).astype(int),
        lambda x: np.where(x > 0.0, "up", "down"),
        lambda x: np.stack([x, x**2, np.full_like(x, np.pi)], axis=1),
        lambda x: x * (1.0 + 1e-15 * len(x)),
        lambda x: np.where(x == 3.0, 1e-16 * len(x), x),  # zero but for rounding
        lambda x: np.datetime64("2020-01-01", "ns") + (1e9 * x).astype("m8[ns]"),
    ],
)
def test_what_does_not_is_not(of_all):
    assert told(of_all) == ""


@pytest.mark.parametrize(("apart", "tolerance"), [(1e-3, 0.01), (1e-9, 1e-8), (1e-11, 1e-10)])
def test_how_far_results_may_differ_is_declared(apart, tolerance):
    def solver(x):
        return x * (1.0 + apart / len(x))

    assert "must not depend on the others by more than its tolerance (1e-12 if it declares none)" in told(solver)
    assert told(solver, tolerance=tolerance) == ""
    assert told(solver, tolerance=apart / 10.0) != ""
    assert told(np.cumsum, tolerance=tolerance) != ""


def test_a_tolerance_is_for_vectorised_functions():
    with pytest.raises(SweepError, match="tolerance = 1e-06: is for vectorised functions"):
        experiment(tolerance=1e-6)(lambda x=1.0: x)


@settings(max_examples=examples(100), derandomize=True)
@given(st.integers(4, 40), st.randoms(use_true_random=False))
def test_the_same_points_are_compared_in_any_order_and_one_is_in_the_interior(n, chance):
    asked = []

    def function(x: float):
        asked.append(x.tolist())
        return x

    made = experiment_of(experiment(vectorised=True)(function))
    whole = [({"x": float(k)}, bytes([k * 37 % 256])) for k in range(n)]
    compared = set()
    for _ in range(3):
        chance.shuffle(whole)
        points, digests = zip(*whole, strict=True)
        values = made.compute(points, 1, ())
        asked.clear()
        assert dependence(made, points, values, digests) == ""
        assert len(asked) == 3
        alone = [x for (x,) in asked]
        assert set(alone) - {points[0]["x"], points[-1]["x"]}
        compared.add(frozenset(alone))
    assert len(compared) == 1


@experiment(vectorised=True)
def edges(x: float):
    """Right for one point, and at both ends of many."""
    place = np.arange(len(x))
    return np.where((place == 0) | (place == len(x) - 1), x, x + 1.0)


def test_a_function_that_is_wrong_between_the_ends_is_refused_by_name_and_value(tmp_path):
    dataset = linksweep.run(edges, tmp_path / "e", axes={"x": np.arange(200.0)}, pool="serial")
    status = dataset["status"].values
    assert (status == Status.FAILED).sum() >= 190
    done = status == Status.DONE
    assert np.array_equal(dataset["edges"].values[done], dataset["x"].values[done])
    for message in json.loads(dataset.attrs["failures"]).values():
        value, alone = re.match(r"edges: 'edges' is (\S+) in a call for \d+ points, but (\S+) for", message).groups()
        assert float(value) == float(alone) + 1.0
        assert f"(x={alone})" in message


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("fewest", "differs"), [(1, False), (2, True)])
def test_numbers_that_are_not_finite_are_the_same_as_themselves_only(value, fewest, differs):
    @experiment(vectorised=True, outputs=[linksweep.Output("y", nan=True)])
    def function(x: float):
        return np.where((x == 3.0) & (len(x) >= fewest), value, x)

    made = experiment_of(function)
    assert bool(dependence(made, POINTS, made.compute(POINTS, 1, ()), DIGESTS)) == differs


@experiment(vectorised=True)
def ranks(x: float):
    return np.argsort(np.argsort(x))


def test_no_point_that_depends_on_others_is_stored(tmp_path):
    dataset = linksweep.run(ranks, tmp_path / "ranks.zarr", axes={"x": np.linspace(5.0, 1.0, 300)}, pool="serial")
    status = dataset["status"].values
    assert set(status) <= {Status.DONE, Status.FAILED}
    assert (status == Status.FAILED).sum() >= 290  # the first ones are computed alone, to measure them
    assert set(dataset["ranks"].values[status == Status.DONE]) == {0}
