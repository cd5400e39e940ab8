"""Power laws and the law that levels off: against SciPy, NumPy, closed forms and simulated data."""

import numpy as np
import pytest
from scipy.optimize import curve_fit
from scipy.stats import chi2, kstest

from linksweep.sweep.analysis.fits import levelling, p_value, power_law

N = np.array([10.0, 20.0, 50.0, 100.0, 300.0])


@pytest.mark.parametrize("power", [-1.5, -0.5, 0.0, 1.0, 2.0])
def test_the_slope_of_an_exact_power_law(power):
    y = 3.0 * N**power
    for error in (np.zeros(5), np.full(5, np.nan), 0.01 * y, np.array([0.1, 0.01, 0.2, 0.05, 0.3]) * y):
        assert power_law(N, y, error).exponent == pytest.approx(power, abs=1e-13)


def noisy():
    rng = np.random.default_rng(20)
    relative = np.array([0.02, 0.01, 0.03, 0.01, 0.02])
    return 3.0 * N**-0.5 * (1.0 + relative * rng.standard_normal(5)), relative * 3.0 * N**-0.5


def test_the_slope_is_that_of_numpy_and_scipy():
    y, error = noisy()
    law = power_law(N, y, error)
    slope, uncertainty = law.exponent, law.exponent_error
    weights = y / error
    coefficients, covariance = np.polyfit(np.log(N), np.log(y), 1, w=weights, cov="unscaled")
    assert slope == pytest.approx(coefficients[0], rel=1e-12)
    assert uncertainty == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-10)
    options = {"p0": (0.0, 0.0), "sigma": 1.0 / weights, "absolute_sigma": True}
    fitted, covariance = curve_fit(lambda u, a, b: a * u + b, np.log(N), np.log(y), **options)
    assert slope == pytest.approx(fitted[0], rel=1e-6)
    assert uncertainty == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-6)


def test_the_error_of_a_slope_is_its_scatter():
    rng = np.random.default_rng(21)
    y, error = N**-0.5, 0.02 * N**-0.5
    slopes = [power_law(N, y + error * rng.standard_normal(5), error).exponent for _ in range(2000)]
    assert np.std(slopes) == pytest.approx(power_law(N, y, error).exponent_error, rel=0.06)  # 4/sqrt(2 x 2000)
    assert np.mean(slopes) == pytest.approx(-0.5, abs=4 * np.std(slopes) / np.sqrt(2000))


def correlated(rng, relative, correlation):
    """A covariance of relative errors and its square root: every pair of points has the same correlation."""
    covariance = np.outer(relative, relative) * (correlation + (1.0 - correlation) * np.eye(len(relative)))
    return covariance, np.linalg.cholesky(covariance)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_stated_errors_and_chi2_are_those_of_simulated_points(correlation):
    rng = np.random.default_rng(23)
    relative = np.array([0.01, 0.03, 0.01, 0.02, 0.02])
    truth = 5.0 * N**-0.5
    covariance, root = correlated(rng, relative, correlation)
    draws = truth * np.exp(rng.standard_normal((1500, 5)) @ root.T)
    laws = [power_law(N, y, covariance * np.outer(y, y)) for y in draws]
    pulls = np.array([(law.exponent + 0.5) / law.exponent_error for law in laws])
    level = np.array(
        [np.log(law.amplitude / (5.0 * law.pivot**-0.5)) / (law.amplitude_error / law.amplitude) for law in laws]
    )
    for pull in (pulls, level):
        assert pull.mean() == pytest.approx(0.0, abs=4.0 / np.sqrt(1500))
        assert pull.std() == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * 1500))
    assert kstest([law.chi2 for law in laws], chi2(3).cdf).pvalue > 1e-3


def test_neglected_correlation_would_misjudge_the_exponent():
    """Points that move together hardly tilt: taking them as independent overstates the error of the exponent."""
    error = 0.02 * N**-0.5
    covariance, _ = correlated(None, error, 0.9)
    alone, together = power_law(N, N**-0.5, error), power_law(N, N**-0.5, covariance)
    assert together.exponent_error == pytest.approx(np.sqrt(0.1) * alone.exponent_error, rel=1e-10)
    assert together.amplitude_error > alone.amplitude_error


@pytest.mark.parametrize("number", [1.0, np.nan, np.inf])
def test_a_covariance_without_an_inverse_is_refused(number):
    with pytest.raises(ValueError, match="not positive definite"):
        power_law(N, N**-0.5, np.full((5, 5), number))


def test_a_covariance_with_one_number_missing_is_refused():
    covariance = np.eye(5)
    covariance[3, 3] = np.nan
    with pytest.raises(ValueError, match="not positive definite"):
        power_law(N, N**-0.5, covariance)


def test_p_values():
    assert p_value(3.0, 3) == pytest.approx(chi2(3).sf(3.0), rel=1e-12)
    assert np.isnan(p_value(0.0, 0))


# The law that levels off

V = np.arange(14.0, 20.1, 0.5)


def level_law(v, floor, size, rate):
    return np.sqrt(floor**2 + size * np.exp(-rate * (v - 14.0)))


@pytest.mark.parametrize(("floor", "size", "rate"), [(0.55, 0.13, 0.8), (0.5, 2.0, 0.3), (1e-3, 3e-6, 1.5)])
def test_an_exact_levelling_law_is_found(floor, size, rate):
    y = level_law(V, floor, size, rate)
    law = levelling(V, y, 0.004 * y, 0.05)
    assert (law.plateau, law.rate) == pytest.approx((floor, rate), rel=1e-5)
    assert law.chi2 < (1e-6 / 0.004) ** 2  # it meets each point to 1e-6

    def fall(v):
        low, high = level_law(np.array([v - 1e-5, v + 1e-5]), floor, size, rate)
        return np.log(low / high) / 2e-5

    assert fall(law.limit) == pytest.approx(0.05, rel=1e-4)
    assert law.end_fall == pytest.approx(fall(20.0), rel=1e-4)


@pytest.mark.slow
def test_the_errors_of_the_levelling_law_cover_the_truth():
    rng = np.random.default_rng(24)
    truth = level_law(V, 0.55, 0.13, 0.8)
    exact = levelling(V, truth, 0.004 * truth, 0.05)
    names = ("plateau", "rate", "end_fall", "limit")
    pulls = []
    for _ in range(400):
        y = truth * (1.0 + 0.004 * rng.standard_normal(len(V)))
        law = levelling(V, y, 0.004 * y, 0.05)
        pulls.append([(getattr(law, n) - getattr(exact, n)) / getattr(law, f"{n}_error") for n in names])
    inside = np.mean(np.abs(pulls) < 1.0, axis=0)
    # errors are only ever scaled up: 68 % becomes 71 % on average; binomial error 2.3 %, not linear: some percent
    assert np.all(inside > 0.60)
    assert np.all(inside < 0.82)
    assert np.all(
        np.abs(np.median(pulls, axis=0)) < 0.25
    )  # 1.25/sqrt(400) = 0.06, and a little bias of a law that bends


def test_a_power_of_ten_has_no_plateau():
    y = 10.0 ** (-0.1 * (V - 14.0))
    law = levelling(V, y, 0.004 * y, 0.05)
    assert law.limit == np.inf or law.limit > 25.0
    assert law.end_fall == pytest.approx(0.1 * np.log(10.0), rel=1e-3)


def test_what_bends_downwards_falls_everywhere():
    y = np.sqrt(2.0 - ((V - 14.0) / 6.0) ** 2)
    law = levelling(V, y, 0.004 * y, 1e-6)
    assert np.isnan(law.plateau)
    assert law.limit == np.inf


def test_what_rises_falls_by_less_everywhere():
    y = np.sqrt(1.0 + 0.1 * (V - 14.0))
    assert levelling(V, y, 0.004 * y, 0.05).limit == -np.inf


def test_what_never_falls_so_steeply_falls_by_less_everywhere():
    y = level_law(V, 1.0, 0.001, 0.05)
    assert levelling(V, y, 1e-6 * y, 0.5).limit == -np.inf


def test_a_bad_fit_has_larger_errors():
    y = level_law(V, 0.55, 0.13, 0.8) * (1.0 + 0.02 * (-1.0) ** np.arange(len(V)))
    small, honest = (levelling(V, y, error * y, 0.05) for error in (0.002, 0.02))
    assert p_value(small.chi2, small.dof) < 1e-6
    assert honest.chi2 > honest.dof  # both are scaled to the scatter, which is the same
    assert small.plateau_error == pytest.approx(honest.plateau_error, rel=1e-3)


def test_unknown_errors_come_from_the_scatter():
    rng = np.random.default_rng(25)
    y = level_law(V, 0.55, 0.13, 0.8) * (1.0 + 0.004 * rng.standard_normal(len(V)))
    law, known = levelling(V, y, np.full(len(V), np.nan), 0.05), levelling(V, y, 0.004 * y, 0.05)
    assert np.isnan(law.chi2)
    assert law.plateau == pytest.approx(known.plateau, rel=1e-4)
    assert 0.3 < law.plateau_error / known.plateau_error < 2.0
