"""Every stated error covers: over independent copies, (value - truth) / error scatters by one (see docs/errors.md)."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from scipy.stats import binom, chi2, t

import linksweep
from linksweep.sweep.analysis.laws import fit_levelling, fit_power_law
from linksweep.sweep.running.scaling import _dataset
from tests.sweep import spread

pytestmark = pytest.mark.slow
FALSE_ALARM = 1e-4  # a check; an error that is wrong by a factor 1.3 is found
COPIES = 400
X = [1.0, 2.0, 3.0, 5.0, 8.0]


def assert_covers(pulls, dof=np.inf):
    """Assert that pulls (copies, ...) scatter by one, as Student's t of these degrees of freedom of variance one."""
    pulls, n, tail = np.asarray(pulls), len(pulls), FALSE_ALARM / 2.0
    assert np.all(np.isfinite(pulls))
    if dof > 15:
        low, high = np.sqrt(chi2.ppf([tail, 1.0 - tail], n) / n)
        assert low < np.sqrt(np.mean(pulls**2)) < high, f"pull {np.sqrt(np.mean(pulls**2)):.3f}"
    for sigmas in (1.0, 2.0):
        inside = sigmas if np.isinf(dof) else sigmas * np.sqrt(dof / (dof - 2.0))
        share = 1.0 - 2.0 * t.sf(inside, min(dof, 1e9))
        low, high = binom.ppf([tail, 1.0 - tail], n, share) / n
        covered = np.mean(np.abs(pulls) < sigmas)
        assert low <= covered <= high, f"{covered:.3f} within {sigmas:g} errors, {share:.3f} expected"


def copies_of(law, n_cat, n_sim):
    study = {"title": "Copies", "experiment": f"{spread.__file__}:experiment", "fixed": {"law": law}}
    study |= {"axes": {"x": X, "copy": list(range(COPIES))}}
    study |= {"sampling": {"n_sim": n_sim, "n_cat": n_cat, "seed": 17, "common_random_numbers": True}}
    with TemporaryDirectory() as folder:
        return linksweep.run(study, Path(folder) / "s.zarr", pool="serial").load()


@pytest.fixture(scope="module", params=[(24, 600), (7, 100), (1, 20 * 512 + 100)], ids=["24x600", "7x100", "1x10340"])
def shared(request):
    """Points that share random numbers, and the degrees of freedom of their errors."""
    n_cat, n_sim = request.param
    dataset = copies_of("power", n_cat, n_sim)
    return dataset, (n_cat if n_cat > 1 else 20) - 1


def true_width(dataset, x):
    """Return the width over all catalogues, or that of the one catalogue of each copy, as far as it is known."""
    if dataset.attrs["n_cat"] > 1:
        return np.sqrt(spread.MEAN_SQUARE * spread.variance("power", x))
    return None


def test_the_law_through_points_that_share_random_numbers(shared):
    dataset, dof = shared
    fits = fit_power_law(dataset, "width", "x", -0.5)
    assert_covers(fits["deviation"], dof)
    assert_covers((fits["exponent"] + 0.5) / fits["exponent_error"], dof)
    truth = true_width(dataset, fits["pivot"].values)
    if truth is not None:
        assert_covers((np.log(fits["amplitude"]) - np.log(truth)) / (fits["amplitude_error"] / fits["amplitude"]), dof)
    else:  # of one catalogue enough is left to judge the law by: chi2 is Hotelling's T^2, and its p-value is uniform
        for share in (0.05, 0.5):
            low, high = binom.ppf([FALSE_ALARM / 2.0, 1.0 - FALSE_ALARM / 2.0], COPIES, share)
            assert low <= np.sum(fits["p_value"].values < share) <= high


def test_levelling_of_points_that_share_random_numbers():
    dataset = copies_of("levelling", 40, 600).isel(copy=slice(200))
    result = fit_levelling(dataset, "width", "x", fall=0.05)
    for name, value in (("rate", 0.6), ("plateau", np.sqrt(spread.MEAN_SQUARE))):
        good = np.isfinite(result[name].values) & (result[f"{name}_error"].values < 0.5 * value)
        assert good.mean() > 0.95
        assert_covers(((result[name] - value) / result[f"{name}_error"]).values[good], dof=39)


@pytest.mark.parametrize("repetitions", [9, 20])
def test_the_medians_of_repeated_timings(repetitions):
    rng = np.random.default_rng(8)
    seconds = 10.0 + rng.standard_normal((500, 2, 1, repetitions, 2))
    result = [_dataset(np.array([1]), timed).sel(kind="strong") for timed in seconds]
    pulls = [((each["seconds"] - 10.0) / each["seconds_error"]).item() for each in result]
    assert_covers(pulls, repetitions - 1)
    of_mean = seconds[0, 0, 0, :, 0].var(ddof=1) / repetitions * (repetitions - 1) / (repetitions - 3)
    assert result[0]["seconds_error"].item() == pytest.approx(np.sqrt(np.pi / 2.0 * of_mean))
