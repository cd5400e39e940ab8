"""Laws fitted to simulated points: their stated errors are right, and laws that do not fit are told."""

import numpy as np
import pytest
from scipy.stats import chi2, kstest

import linksweep
from linksweep import SweepError
from tests.sweep.analysis.made import grid

N = np.array([10.0, 20.0, 50.0, 100.0, 300.0])
V = np.arange(14.0, 20.1, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_stated_errors_and_chi2_of_a_power_law_are_those_of_simulated_points(correlation):
    relative = np.array([0.01, 0.03, 0.01, 0.02, 0.02])
    spread = np.outer(relative, relative) * (correlation + (1.0 - correlation) * np.eye(5))
    normal = np.random.default_rng(23).standard_normal((1500, 5))
    y = 5.0 * N**-0.5 * np.exp(normal @ np.linalg.cholesky(spread).T)
    covariance = ("model", "n", "n_other"), spread * y[:, :, None] * y[:, None, :]
    laws = linksweep.fit_power_law(grid(y, width_mc_covariance_n=covariance), "width", "n")
    level = np.log(laws.amplitude / (5.0 * laws.pivot**-0.5)) / (laws.amplitude_error / laws.amplitude)
    for pull in ((laws.exponent + 0.5) / laws.exponent_error, level):
        assert float(pull.mean()) == pytest.approx(0.0, abs=4.0 / np.sqrt(1500))
        assert float(pull.std()) == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * 1500))
    assert kstest(laws.chi2, chi2(3).cdf).pvalue > 1e-3


@pytest.mark.parametrize("number", [1.0, np.nan, np.inf])
def test_a_covariance_without_an_inverse_is_refused(number):
    covariance = np.broadcast_to(np.eye(5), (2, 5, 5)).copy()
    covariance[1] = number
    with pytest.raises(SweepError, match="not positive definite: width over n at model=new"):
        linksweep.fit_power_law(
            grid(N**-0.5, width_mc_covariance_n=(("model", "n", "n_other"), covariance)), "width", "n"
        )


def level_off(y, errors, fall=0.05):
    return linksweep.fit_levelling(grid(y, errors, x=V, name="v", unit="mag"), "width", "v", fall=fall)


def law(v, floor=0.55, size=0.13, rate=0.8):
    return np.sqrt(floor**2 + size * np.exp(-rate * (v - 14.0)))


@pytest.mark.slow
def test_the_errors_of_the_levelling_law_cover_the_truth():
    y = law(V) * (1.0 + 0.004 * np.random.default_rng(24).standard_normal((400, len(V))))
    exact, laws = level_off(law(V), 0.004 * law(V)).isel(model=0), level_off(y, 0.004 * y)
    for name in ("plateau", "rate", "end_fall", "limit"):
        pulls = ((laws[name] - exact[name]) / laws[f"{name}_error"]).values
        # errors are only ever scaled up: 68 % becomes 71 % on average; binomial error 2.3 %, not linear: some percent
        assert 0.60 < np.mean(np.abs(pulls) < 1.0) < 0.82, name
        assert abs(np.median(pulls)) < 0.25, name  # 1.25/sqrt(400) = 0.06, and a little bias of a law that bends


@pytest.mark.parametrize(
    ("y", "fall", "says"),
    [
        (np.sqrt(2.0 - ((V - 14.0) / 6.0) ** 2), 1e-6, "no plateau: falls by more everywhere"),
        (np.sqrt(1.0 + 0.1 * (V - 14.0)), 0.05, "falls by less everywhere"),
        (law(V, 1.0, 0.001, 0.05), 0.5, "falls by less everywhere"),
    ],
)
def test_what_does_not_level_off_says_so(y, fall, says):
    found = level_off(y, 1e-6 * y, fall).isel(model=0)
    assert found["conclusion"].item() == says
    assert abs(found["limit"].item()) == np.inf


def test_unknown_errors_come_from_the_scatter():
    y = law(V) * (1.0 + 0.004 * np.random.default_rng(25).standard_normal(len(V)))
    unknown, known = level_off(y, None).isel(model=0), level_off(y, 0.004 * y).isel(model=0)
    assert np.isnan(unknown.chi2)
    assert float(unknown.plateau) == pytest.approx(float(known.plateau), rel=1e-4)
    assert 0.3 < float(unknown.plateau_error / known.plateau_error) < 2.0
