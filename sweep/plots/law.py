"""A power law: points, fit with its band, guide of the expected exponent; and the residuals of the same."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from sweep.analysis.fits import PowerLaw, power_law
from sweep.analysis.laws import fit_power_law
from sweep.analysis.lines import lines
from sweep.formatting import with_error
from sweep.plots.style import (
    BAND,
    COLOURS,
    MARKERS,
    finish,
    label,
    legend,
    logarithmic,
    quantity_label,
    symbol,
    value_text,
)


def draw_law(axes: Axes, dataset: xr.Dataset, variable: str, over: str, expected: float | None = None) -> Axes:
    """Draw a variable against an axis on logarithmic scales, with the fitted power law and its one-sigma band.

    There is one colour for every combination of the other dimensions.  The dashed guide has the ``expected`` exponent,
    or the one that a claim of the study states, and meets the law at its pivot.
    """
    guides: set[str] = set()
    for number, (words, line, law) in enumerate(_laws(dataset, variable, over, expected)):
        colour, x = COLOURS[number % len(COLOURS)], line["x"]
        fine = np.geomspace(x.min(), x.max(), 100)
        curve, spread = law(fine), law(fine) * law.relative_error(fine)
        exponent = with_error(law.exponent, law.exponent_error).replace(" ± ", r" \pm ")
        fitted = _exponent(dataset, over, exponent)
        marker = MARKERS[number % len(MARKERS)]
        name = f"{words}: {fitted}" if words else "simulated"
        axes.errorbar(
            x, line["y"], yerr=line["error"], color=colour, marker=marker, markersize=3.5, linestyle="none", label=name
        )
        axes.plot(fine, curve, color=colour, linewidth=1.0, label="" if words else f"fit {fitted}")
        axes.fill_between(fine, curve - spread, curve + spread, color=colour, **BAND)
        if np.isfinite(line["expected"]):
            guide = law.amplitude * (fine / law.pivot) ** line["expected"]
            text = f"guide {_exponent(dataset, over, format(line['expected'], 'g'))}"
            axes.plot(
                fine, guide, color="black", linewidth=0.8, linestyle=(0, (4, 3)), label="" if text in guides else text
            )
            guides.add(text)
    logarithmic(axes, "x", dataset[over].values)
    logarithmic(axes, "y", dataset[variable].values)
    axes.set_xlabel(label(dataset[over], over))
    axes.set_ylabel(quantity_label(dataset, variable))
    finish(axes)
    legend(axes)
    return axes


def draw_law_residuals(
    axes: Axes, dataset: xr.Dataset, variable: str, over: str, expected: float | None = None
) -> Axes:
    """Draw what `draw_law` does as percent above the fitted law, where errors can be seen."""
    for number, (_, line, law) in enumerate(_laws(dataset, variable, over, expected)):
        colour, x = COLOURS[number % len(COLOURS)], line["x"]
        fine = np.geomspace(x.min(), x.max(), 100)
        band = 100.0 * law.relative_error(fine)
        axes.fill_between(fine, -band, band, color=colour, **BAND)
        axes.errorbar(
            x,
            100.0 * (line["y"] / law(x) - 1.0),
            yerr=100.0 * line["error"] / law(x),
            color=colour,
            marker=MARKERS[number % len(MARKERS)],
            markersize=3.5,
            linestyle="none",
        )
        if np.isfinite(line["expected"]):
            guide = 100.0 * ((fine / law.pivot) ** (line["expected"] - law.exponent) - 1.0)
            axes.plot(fine, guide, color="black", linewidth=0.8, linestyle=(0, (4, 3)))
    axes.axhline(0.0, color="black", linewidth=0.6)
    logarithmic(axes, "x", dataset[over].values)
    axes.set_xlabel(label(dataset[over], over))
    axes.set_ylabel("residual [%]")
    finish(axes)
    return axes


def _laws(
    dataset: xr.Dataset, variable: str, over: str, expected: float | None
) -> list[tuple[str, dict[str, Any], PowerLaw]]:
    """Return the name, the points and the law of every line that the study does not exclude."""
    found = lines(dataset, variable, over)
    result = fit_power_law(dataset, variable, over, expected)
    wanted = result["expected"].values.reshape(-1) if "expected" in result else np.full(len(found), np.nan)
    laws = []
    for i, used in enumerate(found.used):
        if not used.any():
            continue
        x, y, errors, place = found.x[used], found.value[i, used], found.errors_of(i), found.place(i)
        words = ", ".join(value_text(dataset, d, place[d]) for d in found.dims if found.grid.sizes[d] > 1)
        error = np.nan_to_num(errors if errors.ndim == 1 else np.sqrt(np.diag(errors)))
        point = {"x": x, "y": y, "error": error, "expected": float(wanted[i])}
        laws.append((words, point, power_law(x, y, errors, found.samples)))
    return laws


def _exponent(dataset: xr.Dataset, over: str, text: str) -> str:
    """Return the axis to a power, as mathematics."""
    name = symbol(over, dataset[over].attrs)
    base = name.strip("$") if name.startswith("$") else rf"\mathrm{{{name}}}"
    return f"${base}^{{{text}}}$"
