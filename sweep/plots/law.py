"""A power law: points, fit with its band, a guide with the expected exponent; and below these their residuals."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from linksweep.sweep.analysis.fits import power_law
from linksweep.sweep.analysis.laws import fit_power_law
from linksweep.sweep.analysis.lines import lines
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import with_error
from linksweep.sweep.plots.labels import label, quantity_label, symbol, value_text
from linksweep.sweep.plots.legends import legend
from linksweep.sweep.plots.scales import SCALE, logarithmic
from linksweep.sweep.plots.signs import COMPUTED, LAW_BAND, SIMULATED
from linksweep.sweep.plots.style import BAND, finish, series

GUIDE: dict[str, Any] = {"color": "black", "linewidth": 0.8, "linestyle": (0, (4, 3))}


def draw_law(upper: Axes, lower: Axes, dataset: xr.Dataset, variable: str, over: str) -> None:
    """Draw a variable against an axis on logarithmic scales, with the fitted power law and its one-sigma band; and
    below that the residuals from the law in percent, where errors can be seen.

    There is one colour for every combination of the other dimensions that the study does not exclude everywhere.  The
    dashed guide has the exponent that a claim of the study states, and meets the law at its pivot.
    """
    if chosen := [name for name in (over, variable) if dataset[name].attrs.get(SCALE) == "linear"]:
        raise SweepError(f"a law is drawn on logarithmic axes, and {chosen[0]} is to have a linear one")
    found = lines(dataset, variable, over)
    result = fit_power_law(dataset, variable, over)
    wanted = result["expected"].values.reshape(-1) if "expected" in result else np.full(len(found), np.nan)
    guides: set[str] = set()
    drawn: list[tuple[Any, ...]] = []
    for number, i in enumerate(np.flatnonzero(found.used.any(axis=1)).tolist()):
        used, style = found.used[i], {**series(number), "markersize": 3.5, "linestyle": "none"}
        x, y, errors, place = found.x[used], found.value[i, used], found.errors_of(i), found.place(i)
        words = ", ".join(value_text(dataset, d, place[d]) for d in found.dims if found.grid.sizes[d] > 1)
        error = np.nan_to_num(errors if errors.ndim == 1 else np.sqrt(np.diag(errors)))
        law, fine, expected = power_law(x, y, errors, found.samples), np.geomspace(x.min(), x.max(), 100), wanted[i]
        colour, curve, relative = style["color"], law(fine), law.relative_error(fine)
        fitted = _power(dataset, over, with_error(law.exponent, law.exponent_error).replace(" ± ", r" \pm "))
        has_errors = bool(error.any())
        text = f"{words}: {fitted}" if words else SIMULATED if has_errors else COMPUTED
        upper.errorbar(x, y, yerr=error if has_errors else None, label=text, **style)
        upper.plot(fine, curve, color=colour, linewidth=1.0, label="" if words else f"fit {fitted}")
        half = curve * relative
        upper.fill_between(fine, curve - half, curve + half, color=colour, label=LAW_BAND, **BAND)
        drawn.append((style, x, y, error, fine, relative, expected, law))
        if np.isfinite(expected):
            text = f"guide {_power(dataset, over, format(expected, 'g'))}"
            guide = law.amplitude * (fine / law.pivot) ** expected
            upper.plot(fine, guide, label="" if text in guides else text, **GUIDE)
            guides.add(text)
    logarithmic(upper, "x", dataset[over].values)  # also of the lower axes, which share x
    logarithmic(upper, "y", dataset[variable].values)
    upper.set_label(variable)
    upper.set_ylabel(quantity_label(dataset, variable))
    finish(upper)
    legend(upper)
    for style, x, y, error, fine, relative, expected, law in drawn:
        lower.fill_between(fine, -100.0 * relative, 100.0 * relative, color=style["color"], **BAND)
        lower.errorbar(x, 100.0 * (y / law(x) - 1.0), yerr=100.0 * error / law(x), **style)
        if np.isfinite(expected):
            lower.plot(fine, 100.0 * ((fine / law.pivot) ** (expected - law.exponent) - 1.0), **GUIDE)
    lower.axhline(0.0, color="black", linewidth=0.6)
    lower.set_xlabel(label(dataset[over], over))
    lower.set_ylabel("residual [%]")
    finish(lower)


def _power(dataset: xr.Dataset, over: str, exponent: str) -> str:
    """Return the axis to a power, as mathematics."""
    name = symbol(over, dataset[over].attrs)
    base = name.strip("$") if name.startswith("$") else rf"\mathrm{{{name}}}"
    return f"${base}^{{{exponent}}}$"
