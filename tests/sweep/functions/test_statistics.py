"""Statistics of realisations: right numbers, errors of right coverage, the same bits however blocks are cut."""

import numpy as np
import pytest
from scipy import stats

from linksweep.sweep.functions.results import Field
from linksweep.sweep.functions.statistics import (
    fewest_for,
    merged,
    moments_of,
    quantile_of,
    quantiles,
    statistic,
    unknown,
)


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


LAWS = {
    "normal": stats.norm(3.0, 1.0),
    "exponential": stats.expon(),
    "lognormal": stats.lognorm(1.0),
    "uniform": stats.uniform(),
    "gamma": stats.gamma(3.0),
    "gumbel": stats.gumbel_r(),
    "weak lognormal": stats.lognorm(0.5),
    "Laplace": stats.laplace(),
    "Poisson": stats.poisson(100.0),
}
CLOSE = (0.935, 0.965)
"""The band of 95 +- 1.5 %, within two errors."""


def drawn(law, n, copies, seed=7):
    """Realisations (n, copies) of a law of SciPy, by its quantile function: the same whatever SciPy draws."""
    return law.ppf(np.random.default_rng([seed, n]).random((n, copies))).astype(float)


def found(name, values, kind="float"):
    """A statistic of many copies (n, copies) and its error, each (copies,)."""
    if (level := quantile_of(name)) is not None:
        return quantiles([level], values)[0]
    moments = made(values) if len(values) > 9 else moments_of(values)
    value, error = statistic(name, Field("w", kind), moments[None], np.array([float(len(values))]))
    return value[0], error[0]


def truth(law, name):
    return law.mean() if name == "mean" else law.std() if name == "std" else law.ppf(quantile_of(name))


def covered(name, law, values):
    """The share of copies whose error is known, and of these the share with the truth within two errors."""
    value, error = found(name, values)
    known = np.isfinite(error)
    inside = np.abs(value - truth(law, name)) <= 2.0 * error
    return known.mean(), inside.sum() / max(1, known.sum())


def slack(copies):
    """What chance adds to either side of the band."""
    return 3.0 * np.sqrt(0.05 * 0.95 / copies)


@pytest.mark.parametrize("law", ["normal", "exponential", "lognormal"])
@pytest.mark.parametrize("name", ["mean", "std", "median", "q90"])
def test_errors_of_fifty_realisations_hold_the_truth_95_times_of_100(law, name):
    known, share = covered(name, LAWS[law], drawn(LAWS[law], 50, 2000))
    assert known > 0.95
    assert CLOSE[0] - slack(2000) < share < CLOSE[1] + slack(2000)


@pytest.mark.slow
@pytest.mark.parametrize("n", [50, 100, 400, 2000])
@pytest.mark.parametrize("law", LAWS)
def test_errors_hold_the_truth_95_times_of_100(law, n):
    copies = 6000 if n < 2000 else 2000
    values = drawn(LAWS[law], n, copies)
    for name in ("mean", "std", "q5", "q25", "median", "q90", "q95", "q99"):
        known, share = covered(name, LAWS[law], values)
        level = quantile_of(name)
        if level is not None and n < fewest_for(level):
            assert known == 0.0
        elif level is None or law != "Poisson" or n == 50:  # many of them have few different values at a quantile
            assert known > 0.95
            assert CLOSE[0] - slack(copies) < share < CLOSE[1] + slack(copies), name


@pytest.mark.slow
@pytest.mark.parametrize("n", [50, 100, 400, 2000])
def test_pulls_scatter_by_one(n):
    """Of a skewed law less: an error on one side of the truth must reach it too."""
    for name, law, least, most in (
        *[(name, "normal", 0.9, 1.1) for name in ("mean", "std", "median", "q90")],
        *[(name, law, 0.7, 1.4) for name in ("mean", "std", "median", "q90") for law in ("exponential", "lognormal")],
    ):
        value, error = found(name, drawn(LAWS[law], n, 2000))
        pulls = ((value - truth(LAWS[law], name)) / error)[np.isfinite(error)]
        assert least < np.sqrt(np.mean(pulls**2)) < most, (name, law)


def moments_of_two(low, high, n):
    """The moments of every number of the higher of two values among n, (1, MOMENTS, n + 1), with these numbers."""
    highs = np.arange(n + 1)
    values = np.where(np.arange(n)[:, None] < highs, high, low).astype(float)
    return moments_of(values)[None], highs


@pytest.mark.parametrize("kind", ["bool", "float"])
@pytest.mark.parametrize("n", [50, 100, 400, 2000])
@pytest.mark.parametrize("chance", [0.5, 0.4, 0.3, 0.25, 0.2])
def test_errors_of_a_law_of_two_values_hold_the_truth_exactly_as_often(kind, n, chance):
    """No simulation: each number of the higher value has its binomial probability."""
    low, high = (0.0, 1.0) if kind == "bool" else (-3.0, 5.0)
    moments, highs = moments_of_two(low, high, n)
    likely = stats.binom.pmf(highs, n, chance)
    for name, is_ in (("mean", low + (high - low) * chance), ("std", (high - low) * np.sqrt(chance * (1.0 - chance)))):
        value, error = (part[0] for part in statistic(name, Field("w", kind), moments, np.array([float(n)])))
        inside = np.abs(value - is_) <= 2.0 * error
        share = likely[inside].sum() / likely[np.isfinite(error)].sum()
        least, most = CLOSE[0] - 0.001, CLOSE[1] + 0.004  # steps of one realisation are up to 3 % of the copies
        assert least < share < (most if name == "mean" or chance <= 0.3 else 1.01), name
        if kind == "bool":
            count, of_count = (p[0] for p in statistic("count", Field("w", kind), moments, np.array([float(n)])))
            assert count.tolist() == highs.tolist()
            if name == "mean":
                np.testing.assert_allclose(of_count, n * error, rtol=1e-12)


@pytest.mark.parametrize("highs", [1, 20, 45, 50, 55, 99])
def test_the_error_of_the_spread_of_two_values_is_made_of_the_interval_of_their_share(highs):
    n = 100
    moments, _ = moments_of_two(0.0, 1.0, n)
    value, error = (part[0, highs] for part in statistic("std", Field("w", "bool"), moments, np.array([float(n)])))
    share, likely = highs / n, (highs + 2) / (n + 4)
    of_share = np.sqrt(likely * (1.0 - likely) / n)
    between = np.linspace(max(0.0, share - 2.0 * of_share), min(1.0, share + 2.0 * of_share), 100_001)
    spreads = np.sqrt(between * (1.0 - between))
    expected = np.sqrt(((spreads.max() - value) ** 2 + (value - spreads.min()) ** 2) / 8.0)
    assert value == pytest.approx(np.sqrt(share * (1.0 - share) * n / (n - 1)), rel=1e-12)
    assert error == pytest.approx(expected, rel=1e-6)


def test_rare_truth_values_have_an_error_and_alike_numbers_have_none_that_is_known():
    """None of 50 happened, and the chance is 5 %: an error of 0 would be wrong 1 of 13 times."""
    moments, _ = moments_of_two(0.0, 1.0, 50)
    value, error = statistic("mean", Field("w", "bool"), moments, np.array([50.0]))
    assert value[0, 0] == 0.0
    assert value[0, 0] + 2.0 * error[0, 0] > 0.05
    for name in ("mean", "std"):
        for constant in (0.0, 0.1, 1e8, -7.0):
            alike, error = found(name, np.full((50, 1), constant))
            assert alike[0] == pytest.approx(constant if name == "mean" else 0.0, abs=1e-7)
            assert np.isnan(error[0])
        values = np.full((50, 1), 0.25)
        values[17] = 9.0  # one that is different says how large others may be, but not how many there are
        assert np.isnan(found(name, values)[1][0])
        values[3:5] = 9.0
        assert found(name, values)[1][0] > 0.0


@pytest.mark.parametrize(("name", "fewest"), [("mean", 5), ("std", 50), ("median", 6), ("q95", 74), ("q99.9", 3782)])
def test_the_fewest_realisations_that_have_an_error(name, fewest):
    values = drawn(LAWS["normal"], fewest, 2)
    assert np.isfinite(found(name, values)[1]).all()
    assert np.isnan(found(name, values[1:])[1]).all()
    assert np.isfinite(found(name, values[1:])[0]).all()
    assert str(fewest) in unknown(name, Field("w", "float"))


@pytest.mark.parametrize("name", ["median", "q75", "q90", "q95"])
def test_a_quantile_between_few_values_has_no_error(name):
    """The differences from the truth are whole numbers then: no error has them inside 95 times of 100."""
    for law in (stats.bernoulli(0.3), stats.randint(1, 7), stats.poisson(1.0)):
        _, error = found(name, drawn(law, 400, 500))
        assert np.isnan(error).mean() > 0.99
    _, error = found(name, drawn(LAWS["normal"], 400, 500).round(2))
    assert np.isfinite(error).all()


def test_a_quantiles_error_is_made_of_the_order_statistics_at_two_sigma():
    """Against SciPy's binomial: the limits are between the two that leave less and more than the tail outside."""
    n, level, tail = 400, 0.9, stats.norm.sf(2.0)
    values = np.sort(drawn(LAWS["exponential"], n, 1), axis=0)
    value, error = found("q90", values)
    last = int(stats.binom.isf(tail, n, level))
    first = int(stats.binom.ppf(tail, n, level)) - 1  # 0 is the least of them
    inner = np.array([values[first + 1, 0], values[last - 1, 0]])
    outer = np.array([values[first, 0], values[last, 0]])
    least, most = (np.sqrt(np.mean((ends - value[0]) ** 2)) / 2.0 for ends in (inner, outer))
    assert least <= error[0] <= most
    other_way = found("q10", -values)
    assert other_way[1][0] == pytest.approx(error[0], rel=1e-12)
    scaled = found("q90", 5.0 * values + 2.0)
    assert scaled[1][0] == pytest.approx(5.0 * error[0], rel=1e-12)


@pytest.mark.parametrize("name", ["mean", "std"])
def test_errors_do_not_depend_on_unit_origin_or_blocks(name):
    values = drawn(LAWS["gamma"], 300, 5)
    _, error = found(name, values)
    assert found(name, 1e-6 * values)[1] == pytest.approx(1e-6 * error, rel=1e-9)
    assert found(name, values - 40.0)[1] == pytest.approx(error, rel=1e-9)
    once = statistic(name, Field("w", "float"), moments_of(values)[None], np.array([300.0]))[1][0]
    assert once == pytest.approx(error, rel=1e-9)


@pytest.mark.parametrize("n", [5, 6, 8, 12])
def test_means_of_few_normal_realisations_have_errors_as_of_students_t(n):
    """The scatter of (mean - truth)/error is that of t with n - 1 degrees of freedom, scaled to variance one."""
    value, error = found("mean", drawn(LAWS["normal"], n, 20_000))
    dof = n - 1.0
    expected = 1.0 - 2.0 * stats.t.sf(2.0 * np.sqrt(dof / (dof - 2.0)), dof)
    known = np.isfinite(error)
    assert known.mean() > 0.99
    assert np.mean(np.abs(value - 3.0)[known] <= 2.0 * error[known]) == pytest.approx(expected, abs=0.02)
    values = np.concatenate([np.arange(n) - 7.0, 7.0 - np.arange(n)])[:, None]  # without a skew
    expected = np.std(values, ddof=1) / np.sqrt(2 * n) * np.sqrt((2 * n - 1) / (2 * n - 3))
    assert found("mean", values)[1][0] == pytest.approx(expected, rel=1e-12)


def test_a_standard_deviation_is_that_of_numpy_and_of_one_realisation_there_is_none():
    values = drawn(LAWS["gamma"], 37, 4)
    assert found("std", values)[0] == pytest.approx(np.std(values, axis=0, ddof=1), rel=1e-12)
    assert np.isnan(found("std", values[:1])[0]).all()


def test_the_error_of_a_standard_deviation_is_made_of_the_unbiased_kurtosis():
    """Against SciPy's, for a sample without a skew and for so many realisations that nothing is enlarged."""
    values = np.sort(drawn(LAWS["normal"], 60, 1), axis=0)
    values = (values - values[::-1]) / 2.0
    kurtosis = stats.kurtosis(values[:, 0], bias=False)
    plain = (kurtosis + 2.0 + 2.0 / 59.0) / 240.0
    enlarged = plain * np.exp(np.clip((8.0 * kurtosis + 3.3 * kurtosis**2) / 60.0, -0.5, 3.0))
    value, error = found("std", values)
    assert error[0] == pytest.approx(value[0] * np.sqrt(enlarged), rel=1e-9)
    for law in (LAWS["uniform"], LAWS["normal"], LAWS["Laplace"]):
        values = drawn(law, 50_000, 1)
        value, error = found("std", values)
        expected = value[0] * np.sqrt((stats.kurtosis(values[:, 0], bias=False) + 2.0) / 200_000.0)
        assert error[0] == pytest.approx(expected, rel=5e-3)


def test_errors_of_many_realisations_are_those_of_the_central_limit():
    n = 400_000
    values = drawn(LAWS["normal"], n, 1)
    expected = {"mean": 1.0, "std": np.sqrt(0.5), "median": np.sqrt(np.pi / 2.0)}
    for name, scale in expected.items():
        assert found(name, values)[1][0] == pytest.approx(scale / np.sqrt(n), rel=0.06)


def test_extremes_have_no_error_and_rare_quantiles_none_that_is_known():
    values = np.random.default_rng(3).normal(size=(20, 1))
    value, error = statistic("max", Field("w", "float"), moments_of(values)[None], np.array([20.0]))
    assert (value.item(), error) == (values.max(), None)
    (found,) = quantiles([0.99], values)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()
