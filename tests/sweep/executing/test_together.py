"""Catalogues and points that are evaluated together: what comes back is what one by one gives, or points fail."""

import json
import re
import sys
import tempfile
from dataclasses import replace

import numpy as np
import pytest

import linksweep
from tests.sweep.coins import experiment, toss
from tests.sweep.opening import same
from tests.tiers import few

MOST = 256  # most catalogues in one call
CALLS = []
X = np.linspace(5.0, 1.0, 300)
ANY = [linksweep.Output("y", nan=True)]
OTHERS = [np.sort, np.cumsum, lambda x: x - x.mean(), lambda x: np.argsort(np.argsort(x)), lambda x: x == x.max()]
OTHERS += [lambda x: np.where(x < x.max(), "less", "most"), lambda x: np.stack([1e15 * x, x / np.abs(x).max()], axis=1)]
OTHERS += [lambda x, y=y: np.where(len(x) >= 2, y, x) for y in (np.nan, np.inf)]
OTHERS += [lambda x: np.full((len(x), 2), len(x)), lambda x: x + (np.arange(len(x)) > 2)]  # right at the first ones
OTHERS += [lambda x: np.where(x > 3.0, x, 1e-12 * (len(x) > 1))]  # more than rounding, where others are 5
OTHERS += [lambda x: np.where((x == x.min()) | (x == x.max()), x, x + (len(x) > 1))]  # right at both ends
OWN = [np.sin, lambda x: x > 0.0, lambda x: (10 * x).astype(int), lambda x: np.where(x > 0.0, "up", "down")]
OWN += [lambda x: np.stack([x, x**2, np.full_like(x, np.pi)], axis=1), lambda x: np.where(x > 3.0, np.nan, -np.inf)]
OWN += [lambda x: np.datetime64("2020-01-01", "ns") + (1e9 * x).astype("m8[ns]")]
OWN += [lambda x: x * (1.0 + 1e-15 * len(x)), lambda x: np.where(x == 3.0, 1e-16 * len(x), x)]  # but for rounding


def together(points, n_sim, streams):
    CALLS.append(len(streams))
    result = [toss(points, n_sim, *pair) for pair in streams]
    return {name: np.array([sums[name] for sums in result]) for name in experiment.sums}


def results(evaluate_catalogues, n_cat=500, n_sim=5):
    CALLS.clear()
    several = replace(experiment, evaluate_catalogues=evaluate_catalogues)
    study = {"title": "", "experiment": several, "axes": {"coins": [4, 9]}}
    with tempfile.TemporaryDirectory() as folder:
        sampling = {"n_sim": n_sim, "n_cat": n_cat, "seed": 3}
        return linksweep.run(study | {"sampling": sampling}, f"{folder}/s.zarr", pool="serial").load()


def test_blocks_of_one_point_are_evaluated_in_one_call_of_so_many_at_most():
    same(results(together), results(None))
    same(results(together, 70, 600), results(None, 70, 600))  # of 512 realisations and of the rest
    results(together, n_cat=3000)
    assert 16 < max(CALLS) <= MOST


def raising(points, n_sim, streams):
    print("tried")
    raise ValueError("unlike")


def other(change):
    return lambda *arguments: {name: change(values) for name, values in together(*arguments).items()}


WRONG = [raising, lambda *_: sys.exit(3), lambda *_: None]
WRONG += [other(lambda values: values[:-1]), other(lambda values: np.nan * values)]


@pytest.mark.parametrize("wrong", few(2, WRONG[1:] + WRONG[:1]))
def test_where_that_fails_catalogues_are_evaluated_one_by_one(wrong, caplog):
    same(results(wrong, 40), results(None, 40))
    assert "tried" not in caplog.text  # what was printed in vain is not kept


def failed(of_all, store, max_failures=None, x=X, **declared):
    """How many points failed, and why the first did; the first ones of a run are computed alone, to measure them."""

    @linksweep.experiment(vectorised=True, **declared)
    def function(x: float):
        return of_all(x)

    dataset = linksweep.run(function, store, axes={"x": x}, pool="serial", max_failures=max_failures)
    return int((dataset.status == 2).sum()), next(iter(json.loads(dataset.attrs["failures"]).values()), "")


@pytest.mark.parametrize("of_all", few(5, OTHERS[::-1]))
def test_what_depends_on_the_others_fails_with_both_values(of_all, tmp_path):
    number, message = failed(of_all, tmp_path / "s.zarr", outputs=ANY)
    assert number >= 290
    there, alone = re.search(r"is (.+) in a call for [\d,]+ points, but (.+) for the same point \(x=", message).groups()
    assert there != alone


def test_a_call_for_few_points_does_not_vouch_for_others(tmp_path):
    late = [failed(lambda x: x + (len(x) > 4), tmp_path / f"{len(x)}.zarr", x=x)[0] for x in (X[:3], X)]
    assert (late[0], late[1] >= 290) == (0, True)


@pytest.mark.parametrize("of_all", few(5, OWN[::-1]))
def test_what_does_not_is_kept(of_all, tmp_path):
    assert failed(of_all, tmp_path / "s.zarr", outputs=ANY) == (0, "")
    CALLS.clear()
    number, _ = failed(lambda x: CALLS.append(x) or np.where(x % 2 < 0.7, np.nan, x), tmp_path / "t.zarr", 999)
    assert number == (X % 2 < 0.7).sum() > 2 * len(CALLS), "those that are NaN take no others with them"


@pytest.mark.parametrize(("apart", "tolerance"), few(1, [(1e-3, 0.01), (1e-9, 1e-8), (1e-11, 1e-10)]))
def test_how_far_results_may_differ_is_declared(apart, tolerance, tmp_path):
    def solver(x):
        return x * (1.0 + apart / len(x))

    assert failed(solver, tmp_path / "s.zarr")[0] >= 290
    assert failed(solver, tmp_path / "t.zarr", tolerance=tolerance)[0] == 0
    assert failed(np.cumsum, tmp_path / "u.zarr", tolerance=tolerance)[0] >= 290
