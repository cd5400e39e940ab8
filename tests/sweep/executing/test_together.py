"""Catalogues that an experiment evaluates together: what comes back is what one by one gives."""

from dataclasses import replace

import numpy as np
import pytest

import linksweep
from tests.sweep.coins import experiment, toss

MOST = 256
"""Most catalogues in one call."""

CALLS = []


def together(points, n_sim, streams):
    """Toss for each pair of generators."""
    CALLS.append(len(streams))
    found = [toss(points, n_sim, *pair) for pair in streams]
    return {name: np.array([sums[name] for sums in found]) for name in experiment.sums}


@pytest.fixture
def results(tmp_path):
    """A function that runs coins, in this process, with such a function of several catalogues."""

    def run(evaluate_catalogues, n_cat=1000, n_sim=5):
        CALLS.clear()
        several = replace(experiment, evaluate_catalogues=evaluate_catalogues)
        study = {"title": "", "experiment": several, "axes": {"coins": [4, 9]}}
        study["sampling"] = {"n_sim": n_sim, "n_cat": n_cat, "seed": 3}
        name = getattr(evaluate_catalogues, "__name__", "none")
        return linksweep.run(study, tmp_path / f"{name}.zarr", pool="serial").drop_vars("wall_time").drop_attrs()

    return run


def test_blocks_of_one_point_are_evaluated_in_one_call_of_so_many_at_most(results):
    assert results(together).identical(results(None))
    assert results(together, n_cat=3000).identical(results(None, n_cat=3000))
    results(together, n_cat=6000)
    assert 16 < max(CALLS) <= MOST


def raising(points, n_sim, streams):
    print("tried")
    raise ValueError("unlike")


def exiting(points, n_sim, streams):
    raise SystemExit(3)


def of_another_shape(points, n_sim, streams):
    return {name: values[:-1] for name, values in together(points, n_sim, streams).items()}


def not_finite(points, n_sim, streams):
    return {name: np.nan * values for name, values in together(points, n_sim, streams).items()}


def nothing(points, n_sim, streams):
    return None


@pytest.mark.parametrize("wrong", [raising, exiting, of_another_shape, not_finite, nothing])
def test_where_that_fails_catalogues_are_evaluated_one_by_one(results, wrong, caplog):
    assert results(wrong, 40).identical(results(None, 40))
    assert "tried" not in caplog.text  # what was printed in vain is not kept
