"""Statistics of realisations: right numbers, errors of right coverage, the same bits however blocks are cut."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from linksweep import Output, experiment, run
from tests.tiers import few, slow

LAWS = {"normal": stats.norm(3.0, 1.0), "exponential": stats.expon(), "lognormal": stats.lognorm(1.0)}
LAWS |= {"uniform": stats.uniform(), "gamma": stats.gamma(3.0), "gumbel": stats.gumbel_r(), "Laplace": stats.laplace()}
LAWS |= {"weak lognormal": stats.lognorm(0.5), "Poisson": stats.poisson(100.0)}
CLOSE = (0.935, 0.965)  # the band of 95 +- 1.5 %, within two errors
FEWEST = {"q5": 74, "q25": 14, "median": 6, "q75": 14, "q90": 35, "q95": 74, "q99": 388}  # realisations for an error
QUICK = [(law, 50, 1500) for law in ("normal", "exponential", "lognormal")]
LONG = [slow(law, n, 6000 if n < 2000 else 2000) for law in LAWS for n in (50, 100, 400, 2000)]


class TwoModes:
    def __init__(self, share):
        self.share = share

    def cdf(self, x):
        return (1.0 - self.share) * stats.norm.cdf(x, 0.0, 0.5) + self.share * stats.norm.cdf(x, 5.0, 0.5)

    def ppf(self, p):
        return np.interp(p, self.cdf(x := np.linspace(-4.0, 9.0, 20_001)), x)


def drawn(law, n, copies, seed=7):
    """Realisations (n, copies) of a law of SciPy, by its quantile function: the same whatever SciPy draws."""
    return law.ppf(np.random.default_rng([seed, n]).random((n, copies))).astype(float)


def measured(values, *names):
    """Statistics of realisations (n, copies) and their errors, pairs of (copies,), and the last error's description."""
    done = [0]

    @experiment(outputs=[Output("w", dims="copy", statistics=names)])
    def f(rng, n_sim):
        done[0] += n_sim
        return values[done[0] - n_sim : done[0]]

    with tempfile.TemporaryDirectory() as folder:
        ds = run(f, Path(folder) / "s.zarr", sampling={"n_sim": len(values)}, pool="serial")
    errors = [ds.get(f"w_{name}_mc_error") for name in names]
    pairs = [(ds[f"w_{n}"].values, None if e is None else e.values) for n, e in zip(names, errors, strict=True)]
    return *pairs, "" if errors[-1] is None else errors[-1].attrs.get("description", "")


def one(name, values):
    return measured(values, name)[0]


def truth(law, name):
    if name in ("mean", "std"):
        return getattr(law, name)()
    return law.ppf(0.5 if name == "median" else float(name[1:]) / 100.0)


@pytest.mark.parametrize(("law", "n", "copies"), [*QUICK, *LONG])
def test_errors_hold_the_truth_95_times_of_100(law, n, copies):
    names = ["mean", "std", *FEWEST]
    *result, _ = measured(drawn(LAWS[law], n, copies), *names)
    slack = 3.0 * np.sqrt(0.05 * 0.95 / copies)  # what chance adds to either side of the band
    for name, (value, error) in zip(names, result, strict=True):
        known = np.isfinite(error)
        if n < FEWEST.get(name, 50):
            assert not known.any()
        elif name in ("mean", "std") or law != "Poisson" or n == 50:  # many have few different values at a quantile
            inside = np.abs(value - truth(LAWS[law], name)) <= 2.0 * error
            assert known.mean() > 0.95
            most = CLOSE[1] + (0.01 if n < 2 * FEWEST.get(name, 0) else 0.0)  # hardly enough for this quantile
            assert CLOSE[0] - slack < inside.sum() / known.sum() < most + slack, name


@pytest.mark.parametrize("n", [50, *map(slow, (200, 400))])
@pytest.mark.parametrize(("share", "name"), [(0.12, "q90"), (0.88, "q10"), (0.45, "median"), (0.55, "median")])
def test_errors_of_quantiles_hold_the_truth_across_a_gap(share, name, n):
    """Where one limit is in the other mode and one is near, their root mean square would not reach the far one."""
    law, copies = TwoModes(share), 2000
    value, error = one(name, drawn(law, n, copies))
    known, inside = np.isfinite(error), np.abs(value - truth(law, name)) <= 2.0 * error
    assert known.mean() > 0.95
    slack = 3.0 * np.sqrt(0.05 * 0.95 / copies)
    assert CLOSE[0] - slack < inside.sum() / known.sum() < CLOSE[1] + slack


def two_values(low, high, n):
    return np.where(np.arange(n)[:, None] < np.arange(n + 1), high, low)


@pytest.mark.parametrize("kind", ["bool", "float"])
@pytest.mark.parametrize("n", [50, 100, slow(400)])
def test_errors_of_a_law_of_two_values_hold_the_truth_exactly_as_often(kind, n):
    """No simulation: each number of the higher value has its binomial probability."""
    low, high = (False, True) if kind == "bool" else (-3.0, 5.0)
    names = ("mean", "std", "count") if kind == "bool" else ("mean", "std")
    (mean, of_mean), (std, of_std), *counts, _ = measured(two_values(low, high, n), *names)
    for chance in (0.5, 0.4, 0.3, 0.25, 0.2):
        likely = stats.binom.pmf(np.arange(n + 1), n, chance)
        spread = (high - low) * np.sqrt(chance * (1.0 - chance))
        for value, error, is_, most in (
            (mean, of_mean, low + (high - low) * chance, CLOSE[1] + 0.004),
            (std, of_std, spread, CLOSE[1] + 0.004 if chance <= 0.3 else 1.01),
        ):  # steps of one realisation are up to 3 % of the copies
            inside = np.abs(value - is_) <= 2.0 * error
            assert CLOSE[0] - 0.001 < likely[inside].sum() / likely[np.isfinite(error)].sum() < most
    between = np.linspace(*np.clip([mean - 2.0 * of_mean, mean + 2.0 * of_mean], low, high), 2001)  # likely means
    spreads = np.sqrt((between - low) * (high - between))
    expected = np.hypot(spreads.max(axis=0) - std, std - spreads.min(axis=0)) / np.sqrt(8.0)
    np.testing.assert_allclose(of_std, np.where(np.isnan(of_std), np.nan, expected), rtol=1e-3)
    for count, of_count in counts:
        assert count.tolist() == list(range(n + 1))
        np.testing.assert_allclose(of_count, n * of_mean, rtol=1e-12)


def test_rare_truth_values_have_an_error_and_alike_numbers_have_none_that_is_known():
    """None of 50 happened, and the chance is 5 %: an error of 0 would be wrong 1 of 13 times."""
    value, error = one("mean", two_values(False, True, 50))
    assert (value[0], 2.0 * error[0] > 0.05) == (0.0, True)
    constants = [0.0, 0.1, 1e8, -7.0]
    values = np.full((50, 6), [*constants, 0.25, 0.25])
    values[17, 4] = 9.0  # one that is different says how large others may be, but not how many there are
    values[3:6, 5] = 9.0
    (mean, of_mean), (std, of_std), _ = measured(values, "mean", "std")
    assert mean[:4] == pytest.approx(constants, abs=1e-7)
    assert std[:4] == pytest.approx(0.0, abs=1e-7)
    for error in (of_mean, of_std):
        assert (np.isfinite(error).tolist(), error[5] > 0.0) == ([False] * 5 + [True], True)


@pytest.mark.parametrize(("name", "fewest"), [("mean", 5), ("std", 50), ("q95", 74), slow("q99.9", 3782)])
def test_the_fewest_realisations_that_have_an_error(name, fewest):
    values = drawn(LAWS["normal"], fewest, 2)
    (_, error), said = measured(values, name)
    assert (np.isfinite(error).all(), str(fewest) in said) == (True, True)
    value, error = one(name, values[1:])
    assert (np.isnan(error).all(), np.isfinite(value).all()) == (True, True)


def test_a_quantiles_error_is_made_of_order_statistics_and_numbers_of_several_blocks_are_those_of_numpy():
    """Against SciPy's binomial: the limits are between the two that leave less and more than the tail outside."""
    n, level, tail = 400, 0.9, stats.norm.sf(2.0)
    values = np.sort(drawn(LAWS["exponential"], n, 1), axis=0)
    value, error = one("q90", values)
    last = int(stats.binom.isf(tail, n, level))
    first = int(stats.binom.ppf(tail, n, level)) - 1  # 0 is the least of them
    ends = (values[first + 1, 0], values[last - 1, 0]), (values[first, 0], values[last, 0])
    least, most = (np.sqrt(np.mean((np.array(pair) - value[0]) ** 2)) / 2.0 for pair in ends)
    assert least <= error[0] <= most
    assert one("q10", -values)[1][0] == pytest.approx(error[0], rel=1e-12)
    assert one("q90", 5.0 * values + 2.0)[1][0] == pytest.approx(5.0 * error[0], rel=1e-12)
    repeated = np.array([[0, 0], [1, 1], [1, 1], [1, 1], [1, 2], [2, 3.0]])  # 3 and 4 values, with both limits
    assert np.isfinite(one("median", repeated)[1]).tolist() == [False, True]
    values = np.random.default_rng(1).exponential(1.0, (1300, 2)) + 1e8
    (mean, _), (std, of_std), (low, _), (high, none), _ = measured(values, "mean", "std", "min", "max")
    assert mean == pytest.approx(values.mean(axis=0), rel=1e-14)
    assert std == pytest.approx(values.std(axis=0, ddof=1), rel=1e-6)
    in_blocks, at_once = (one("std", part)[1] for part in (values - 1e8, values[:500] - 1e8))
    assert of_std == pytest.approx(in_blocks, rel=1e-5)  # from the third and fourth moments
    assert in_blocks == pytest.approx(error_of_std(values - 1e8), rel=1e-9)
    assert at_once == pytest.approx(error_of_std(values[:500] - 1e8), rel=1e-9)
    assert (low.tolist(), high.tolist(), none) == (values.min(axis=0).tolist(), values.max(axis=0).tolist(), None)
    assert np.isnan(one("std", values[:1])[0]).all()


@pytest.mark.parametrize("scale", few(3, [1e-200, 1e-56, 1e72, 1e-72, 1e44, 1e52]))
def test_errors_are_in_proportion_to_the_numbers_or_not_known(scale):
    values, names = drawn(LAWS["exponential"], 400, 3), ("mean", "std", "median")
    *plain, _ = measured(values, *names)
    *scaled, _ = measured(scale * values, *names)
    for name, (_, expected), (_, error) in zip(names, plain, scaled, strict=True):
        unknown = scale < 1e-76 and name != "median"  # its fourth power is 0
        np.testing.assert_allclose(error / scale, np.where(unknown, np.nan, expected), rtol=1e-9)


@pytest.mark.parametrize("n", few(2, [5, 12, 6, 8]))
def test_means_of_few_normal_realisations_have_errors_as_of_students_t(n):
    """The scatter of (mean - truth)/error is that of t with n - 1 degrees of freedom, scaled to variance one."""
    value, error = one("mean", drawn(LAWS["normal"], n, 20_000))
    dof = n - 1.0
    expected = 1.0 - 2.0 * stats.t.sf(2.0 * np.sqrt(dof / (dof - 2.0)), dof)
    known = np.isfinite(error)
    assert known.mean() > 0.99
    assert np.mean(np.abs(value - 3.0)[known] <= 2.0 * error[known]) == pytest.approx(expected, abs=0.02)
    values = np.concatenate([np.arange(n) - 7.0, 7.0 - np.arange(n)])[:, None]  # without a skew
    expected = np.std(values, ddof=1) / np.sqrt(2 * n) * np.sqrt((2 * n - 1) / (2 * n - 3))
    assert one("mean", values)[1][0] == pytest.approx(expected, rel=1e-12)


def error_of_std(values):
    """The error of the standard deviation of realisations (n, copies), from SciPy's unbiased kurtosis and skewness."""
    n, kurtosis, skewness = len(values), stats.kurtosis(values, bias=False), np.abs(stats.skew(values, bias=False))
    plain = (kurtosis + 2.0 + 2.0 / (n - 1.0)) / (4.0 * n)
    enlarged = np.exp(np.clip((8.0 * kurtosis + 62.0 * skewness + 3.3 * kurtosis**2) / n, -0.5, 3.0))
    return values.std(axis=0, ddof=1) * np.sqrt(plain * enlarged)
