"""A vectorised function gives each point what it gives it alone, or its points fail."""

import json
import re

import numpy as np
import pytest

import linksweep
from linksweep import SweepError, experiment

X = np.linspace(5.0, 1.0, 300)


def run(of_all, store, **declared):
    def function(x: float):
        return of_all(x)

    return linksweep.run(experiment(vectorised=True, **declared)(function), store, axes={"x": X}, pool="serial")


def failed(dataset):
    """How many points failed, and why the first did; the first ones of a run are computed alone, to measure them."""
    return int((dataset.status == 2).sum()), next(iter(json.loads(dataset.attrs["failures"]).values()), "")


@pytest.mark.parametrize(
    "of_all",
    [
        np.sort,
        np.cumsum,
        lambda x: x - x.mean(),
        lambda x: np.argsort(np.argsort(x)),
        lambda x: x == x.max(),
        lambda x: np.where(x < x.max(), "less", "most"),
        lambda x: np.stack([x, x / np.abs(x).max()], axis=1),
        lambda x: np.full((len(x), 2), len(x)),
        lambda x: np.where((x == x.min()) | (x == x.max()), x, x + (len(x) > 1)),  # right at both ends
    ],
)
def test_what_depends_on_the_others_fails_with_both_values(of_all, tmp_path):
    number, message = failed(run(of_all, tmp_path / "s.zarr"))
    assert number >= 290
    there, alone = re.search(r"is (.+) in a call for [\d,]+ points, but (.+) for the same point \(x=", message).groups()
    assert there != alone


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
def test_what_does_not_is_kept(of_all, tmp_path):
    assert failed(run(of_all, tmp_path / "s.zarr")) == (0, "")


@pytest.mark.parametrize(("apart", "tolerance"), [(1e-3, 0.01), (1e-9, 1e-8), (1e-11, 1e-10)])
def test_how_far_results_may_differ_is_declared(apart, tolerance, tmp_path):
    def solver(x):
        return x * (1.0 + apart / len(x))

    assert failed(run(solver, tmp_path / "s.zarr"))[0] >= 290
    assert failed(run(solver, tmp_path / "t.zarr", tolerance=tolerance))[0] == 0
    assert failed(run(np.cumsum, tmp_path / "u.zarr", tolerance=tolerance))[0] >= 290


def test_a_tolerance_is_for_vectorised_functions():
    with pytest.raises(SweepError, match="tolerance = 1e-06: is for vectorised functions"):
        experiment(tolerance=1e-6)(lambda x=1.0: x)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("fewest", "differs"), [(1, False), (2, True)])
def test_numbers_that_are_not_finite_are_the_same_as_themselves_only(value, fewest, differs, tmp_path):
    ds = run(
        lambda x: np.where(len(x) >= fewest, value, x),
        tmp_path / "s.zarr",
        outputs=[linksweep.Output("y", nan=True)],
    )
    assert ("in a call for" in failed(ds)[1]) == differs
