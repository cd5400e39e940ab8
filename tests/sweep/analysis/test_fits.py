"""Power laws and the law that levels off: against SciPy, NumPy, closed forms and simulated data."""

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from linksweep.sweep.analysis.fits import levelling, power_law

N = np.array([10.0, 20.0, 50.0, 100.0, 300.0])


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


@pytest.mark.parametrize("number", [1.0, np.nan, np.inf])
def test_a_covariance_without_an_inverse_is_refused(number):
    with pytest.raises(ValueError, match="not positive definite"):
        power_law(N, N**-0.5, np.full((5, 5), number))


def test_a_covariance_with_one_number_missing_is_refused():
    covariance = np.eye(5)
    covariance[3, 3] = np.nan
    with pytest.raises(ValueError, match="not positive definite"):
        power_law(N, N**-0.5, covariance)


# The law that levels off

V = np.arange(14.0, 20.1, 0.5)


def level_law(v, floor, size, rate):
    return np.sqrt(floor**2 + size * np.exp(-rate * (v - 14.0)))


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


def test_unknown_errors_come_from_the_scatter():
    rng = np.random.default_rng(25)
    y = level_law(V, 0.55, 0.13, 0.8) * (1.0 + 0.004 * rng.standard_normal(len(V)))
    law, known = levelling(V, y, np.full(len(V), np.nan), 0.05), levelling(V, y, 0.004 * y, 0.05)
    assert np.isnan(law.chi2)
    assert law.plateau == pytest.approx(known.plateau, rel=1e-4)
    assert 0.3 < law.plateau_error / known.plateau_error < 2.0
