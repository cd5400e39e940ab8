"""What a mean over components hides: each component, the largest correlation, and the condition number."""

import textwrap
from collections.abc import Iterator

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.long_table import own_dimensions
from linksweep.sweep.analysis.quantity import ERROR_SUFFIXES
from linksweep.sweep.contract import Array
from linksweep.sweep.formatting import WIDTH, counted, in_three_digits
from linksweep.sweep.planning.point_status import Status

COVARIANCE, CORRELATION, CONDITION = "covariance", "correlation", "condition_number"

BAD_CONDITION = 100.0
"""Above this, unknowns can hardly be told apart; two with a correlation of 0.98 have this condition number."""

FEWEST = 30
"""The fewest realisations for a correlation, which is then known to 0.2."""

MOST_POINTS = 3

PER_LINE = 3


def component_lines(dataset: xr.Dataset) -> list[str]:
    """Return lines, of 80 characters where names are short, about the points with the worst condition.

    They show the first quantity that has errors and one dimension of components.  A dataset without such a quantity,
    or with neither a covariance nor a condition number, gives no lines.
    """
    name = _quantity(dataset)
    if name is None:
        return []
    points = sorted(_done(dataset), key=_condition, reverse=True)
    lines = [line for point in points[:MOST_POINTS] for line in _lines(point, name, _place(dataset, point))]
    if (left := len(points) - MOST_POINTS) > 0:
        lines.append(f"... and {counted(left, 'point')} with a better condition")
    return lines


def condition_warning(dataset: xr.Dataset) -> str:
    """Return a sentence about points at which some unknowns can hardly be told apart; '' where there are none."""
    bad = [condition for point in _done(dataset) if (condition := _condition(point)) > BAD_CONDITION]
    if not bad:
        return ""
    where = counted(len(bad), "point")
    return (
        f"at {where} the condition number is up to {max(bad):.3g}: some unknowns can hardly be told apart, and a mean "
        "over components hides how badly (see the components)"
    )


def _done(dataset: xr.Dataset) -> Iterator[xr.Dataset]:
    kept = [n for n in (_quantity(dataset), COVARIANCE, CORRELATION, CONDITION, "n_sim_done", "status") if n in dataset]
    if not {COVARIANCE, CONDITION}.intersection(kept):
        return
    part, status = dataset[kept], dataset["status"]
    for index in np.argwhere(status.values == Status.DONE):
        yield part.isel(dict(zip(status.dims, map(int, index), strict=True)))


def _quantity(dataset: xr.Dataset) -> str | None:
    """Return the first variable with errors and one dimension beside the axes."""
    for name in map(str, dataset.data_vars):
        errors = [f"{name}_{suffix}" for suffix in ERROR_SUFFIXES]
        if len(own_dimensions(dataset, name)) == 1 and any(error in dataset for error in errors):
            return name
    return None


def _correlation(point: xr.Dataset) -> Array | None:
    """Return the correlations (K, K); from the covariance in stores that do not have them."""
    if CORRELATION in point:
        return np.asarray(point[CORRELATION].values)
    if COVARIANCE not in point:
        return None
    covariance = point[COVARIANCE].values
    sigma = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(covariance / np.outer(sigma, sigma))


def _condition(point: xr.Dataset) -> float:
    """Return the condition number; in stores without it, that of the estimates' correlations, which is similar."""
    if CONDITION in point:
        return float(point[CONDITION])
    correlation = _correlation(point)
    if correlation is None or not np.isfinite(correlation).all() or int(point["n_sim_done"]) < FEWEST:
        return 0.0
    eigenvalues = np.linalg.eigvalsh(correlation)
    return float(eigenvalues[-1] / eigenvalues[0]) if eigenvalues[0] > 0.0 else np.inf


def _lines(point: xr.Dataset, name: str, place: str) -> Iterator[str]:
    (dimension,) = map(str, point[name].dims)
    labels = list(map(str, point[dimension].values))
    units = point[f"{dimension}_unit"].values.tolist() if f"{dimension}_unit" in point.coords else [""] * len(labels)
    cells = [
        f"{label} {in_three_digits(float(value), str(unit))}"
        for label, value, unit in zip(labels, point[name].values, units, strict=True)
    ]
    width = max(map(len, cells)) + 2
    yield from textwrap.wrap(f"{name}{place}", WIDTH)
    for first in range(0, len(cells), PER_LINE):
        yield "  " + "".join(f"{cell:{width}}" for cell in cells[first : first + PER_LINE]).rstrip()
    facts = []
    correlation = _correlation(point)
    if correlation is not None and int(point["n_sim_done"]) >= FEWEST and np.isfinite(correlation).any():
        beside = np.where(np.eye(len(labels), dtype=bool), 0.0, np.nan_to_num(correlation))
        i, j = sorted(np.unravel_index(np.argmax(np.abs(beside)), beside.shape))
        facts.append(f"largest correlation {beside[i, j]:.3f} ({labels[i]}, {labels[j]})")
    if (condition := _condition(point)) > 0.0:
        facts.append(f"condition number {condition:.3g}")
    if facts:
        yield "  " + ", ".join(facts)


def _place(dataset: xr.Dataset, point: xr.Dataset) -> str:
    axes = [str(d) for d in dataset["status"].dims if str(d) in point.coords]
    values = [(axis, point[axis].item()) for axis in axes]
    return ", " * bool(values) + ", ".join(f"{a} = {v:g}" if isinstance(v, float) else f"{a} = {v}" for a, v in values)
