"""A vectorised function gives each point what it gives it alone, or its points fail."""

import numpy as np
import pytest

import linksweep
from linksweep import experiment
from sweep.executing.together import dependence
from sweep.functions.adapter import experiment_of
from sweep.planning.point_status import Status

POINTS = [{"x": x} for x in (3.0, 1.0, -2.0, 0.5)]


def told(of_all):
    """What is said of a function of an array ``x``."""

    def function(x: float):
        return of_all(x)

    made = experiment_of(experiment(vectorised=True)(function))
    return dependence(made, POINTS, made.many(POINTS))


@pytest.mark.parametrize(
    ("of_all", "words"),
    [
        (np.sort, "is -2.0 in a call for 4 points, but 3.0 for the same point alone"),
        (np.cumsum, "is 2.5 in a call for 4 points, but 0.5 for"),
        (lambda x: x - x.mean(), "is 2.375 in a call for 4 points, but 0.0 for"),
        (lambda x: np.arange(len(x)), "is 3 in a call for 4 points, but 0 for"),
        (lambda x: x == x.max(), "is False in a call for 4 points, but True for"),
        (lambda x: np.where(x < x.max(), "less", "most"), "is another text in a call"),
        (lambda x: np.stack([x, x / np.abs(x).max()], axis=1), "is 0.16"),
        (lambda x: np.broadcast_to(x, (len(x), len(x))).copy(), "is of the shape (4,) in a call"),
        (lambda x: np.full((len(x), 2), len(x)), "is 4 in a call for 4 points, but 1 for"),
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
        lambda x: x * (1.0 + 1e-3 / len(x)),  # as a solver of all together
        lambda x: np.where(x == 3.0, 1e-16 * len(x), x),  # zero but for rounding
        lambda x: np.datetime64("2020-01-01", "ns") + (1e9 * x).astype("m8[ns]"),
    ],
)
def test_what_does_not_is_not(of_all):
    assert told(of_all) == ""


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("fewest", "differs"), [(1, False), (2, True)])
def test_numbers_that_are_not_finite_are_the_same_as_themselves_only(value, fewest, differs):
    @experiment(vectorised=True, outputs=[linksweep.Output("y", nan=True)])
    def function(x: float):
        return np.where((x == 3.0) & (len(x) >= fewest), value, x)

    made = experiment_of(function)
    assert bool(dependence(made, POINTS, made.many(POINTS))) == differs


@experiment(vectorised=True)
def ranks(x: float):
    return np.argsort(np.argsort(x))


def test_no_point_that_depends_on_others_is_stored(tmp_path):
    dataset = linksweep.run(ranks, tmp_path / "ranks.zarr", axes={"x": np.linspace(5.0, 1.0, 300)}, pool="serial")
    status = dataset["status"].values
    assert set(status) <= {Status.DONE, Status.FAILED}
    assert (status == Status.FAILED).sum() >= 290  # the first ones are computed alone, to measure them
    assert set(dataset["ranks"].values[status == Status.DONE]) == {0}
