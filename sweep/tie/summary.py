"""Every result of a study of a link from its sums over draws."""

from collections.abc import Mapping

import numpy as np

from linksweep.core.arrays import Array
from linksweep.sweep.tie.components import ORIENTATION, SPIN

FACTS = ("n_sources", "n_kept", "chi2_ratio", "largest_share", "n_drawn")
"""Numbers of the tables that no draw changes."""


def summarise(sums: Mapping[str, Array], n: Array, n_cat: Array) -> dict[str, Array]:
    """Return every output from the sums over n draws."""
    each = n[:, None]
    bias = sums["error"] / each
    sigma = np.sqrt(sums["error_squares"] / each)
    facts = dict(zip(FACTS, (sums["facts"] / each).T, strict=True))
    results: dict[str, Array] = dict(facts) | {
        name: sums[name] / each for name in ("estimate", "error_formal", "error_scaled", "error_jackknife")
    }
    for name in ("n_sources", "n_kept", "n_drawn"):
        results[name] = np.round(results[name])  # a whole number times n, over n
    results |= {
        "sigma": sigma,
        "sigma_mc_error": sigma / np.sqrt(2.0 * each),
        "sigma_predicted": np.sqrt(sums["predicted_variance"] / each),
        "bias": bias,
        "bias_mc_error": _error_of_mean(sums["error"], sums["error_squares"], each),
        "n_kept_drawn": sums["kept"] / n,
        "chi2_ratio_drawn": sums["ratio"] / n,
        "chi2_ratio_drawn_mc_error": _error_of_mean(sums["ratio"], sums["ratio_squares"], n),
    }
    for name, key in (("coverage", "within"), ("coverage_scaled", "within_scaled")):
        results[name] = sums[key] / each
        between = (sums[key] + 1.0) / (each + 2.0)  # never 0 or 1, where the error would be 0
        results[f"{name}_mc_error"] = np.sqrt(between * (1.0 - between) / each)
    variance = _error_of_mean(sums["mean_square"], sums["mean_square_squares"], each)
    for which, (name, part) in enumerate((("sigma_orientation", ORIENTATION), ("sigma_spin", SPIN))):
        rms = np.sqrt(sums["mean_square"][:, which] / n)
        results[name] = rms
        with np.errstate(invalid="ignore", divide="ignore"):
            results[f"{name}_mc_error"] = np.where(rms > 0.0, variance[:, which] / (2.0 * rms), rms)
        results[f"{name}_predicted"] = np.sqrt((sums["predicted_variance"] / each)[:, part].mean(axis=1))
    return results | _of_fields_and_bins(sums, n[:, None, None])


def _of_fields_and_bins(sums: Mapping[str, Array], n: Array) -> dict[str, Array]:
    power, in_bins = np.moveaxis(sums["power"], 1, 0) / n, np.moveaxis(sums["bins"], 1, 0) / n
    sigma = np.sqrt(sums["bins_squares"] / n)
    return {
        **dict(zip(("power", "power_noise", "power_probability"), power, strict=True)),
        "power_drawn": sums["power_drawn"] / n,
        "power_drawn_mc_error": _error_of_mean(sums["power_drawn"], sums["power_drawn_squares"], n),
        "power_drawn_predicted": sums["power_predicted"] / n,
        **dict(zip(("spin_by_bin", "spin_by_bin_error"), in_bins, strict=True)),
        "sigma_by_bin": sigma,
        "sigma_by_bin_mc_error": sigma / np.sqrt(2.0 * n),
        "sigma_by_bin_predicted": np.sqrt(sums["bins_variance"] / n),
    }


def _error_of_mean(total: Array, squares: Array, n: Array) -> Array:
    """Return the standard error of total/n from the scatter of the n numbers; NaN for one."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(np.maximum(squares / n - (total / n) ** 2, 0.0) / np.where(n > 1, n - 1.0, np.nan))
