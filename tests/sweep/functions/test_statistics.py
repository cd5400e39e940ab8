"""Statistics of realisations: right numbers, errors of right coverage, the same bits however blocks are cut."""

import numpy as np
import pytest
from scipy import stats

from sweep.functions.layout import Field
from sweep.functions.statistics import merged, moments_of, quantiles, statistic


def made(values):
    """The moments of values (n, size) from three blocks."""
    parts = np.array_split(values, [len(values) // 5, len(values) // 2])
    total, n = moments_of(parts[0]), len(parts[0])
    for part in parts[1:]:
        total = merged(total, float(n), moments_of(part), float(len(part)))
        n += len(part)
    return total


def test_merged_moments_are_those_of_all_also_far_from_zero():
    values = np.random.default_rng(1).exponential(1.0, (1000, 2)) + 1e8
    mean, m2, m3, m4, low, high = made(values)
    assert mean == pytest.approx(values.mean(axis=0), rel=1e-14)
    assert m2 / 1000 == pytest.approx(values.var(axis=0), rel=1e-6)
    assert m3 / 1000 == pytest.approx(stats.moment(values, 3), rel=1e-5)
    assert m4 / 1000 == pytest.approx(stats.moment(values, 4), rel=1e-5)
    assert low.tolist() == values.min(axis=0).tolist()
    assert high.tolist() == values.max(axis=0).tolist()


def coverage(runs, n):
    """The share of runs whose error holds the truth, by statistic, for exponential waits and a chance of 0.1."""
    rng = np.random.default_rng(7)
    truth = {"mean": 1.0, "std": 1.0, "median": np.log(2.0), "q95": -np.log(0.05), "count": 0.1 * n, "share": 0.1}
    hits = dict.fromkeys(truth, 0)
    count = np.array([float(n)])
    for _ in range(runs):
        waits, long = rng.exponential(1.0, (n, 1)), (rng.random((n, 1)) < 0.1).astype(float)
        found = {name: statistic(name, Field("w", "float"), made(waits)[None], count) for name in ("mean", "std")}
        found["count"] = statistic("count", Field("l", "bool"), made(long)[None], count)
        found["share"] = statistic("mean", Field("l", "bool"), made(long)[None], count)
        half, high = quantiles([0.5, 0.95], waits)
        found |= {"median": tuple(half), "q95": tuple(high)}
        for name, (value, error) in found.items():
            hits[name] += abs(value.item() - truth[name]) <= error.item()
    return {name: hit / runs for name, hit in hits.items()}


@pytest.mark.slow
def test_errors_hold_the_truth_as_often_as_they_should():
    """0.683 of the time: 400 runs know it to 0.023, and a skewed law is not quite a normal one."""
    for name, share in coverage(400, 600).items():
        assert 0.59 < share < 0.77, (name, share)


@pytest.mark.slow
def test_errors_hold_the_truth_over_many_seeds():
    for name, share in coverage(4000, 1000).items():
        assert 0.645 < share < 0.72, (name, share)


def test_extremes_have_no_error_and_rare_quantiles_none_that_is_known():
    values = np.random.default_rng(3).normal(size=(20, 1))
    value, error = statistic("max", Field("w", "float"), moments_of(values)[None], np.array([20.0]))
    assert (value.item(), error) == (values.max(), None)
    (found,) = quantiles([0.99], values)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()
