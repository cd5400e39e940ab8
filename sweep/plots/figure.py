"""Whole figures: which picture suits a dataset, its panels, title and legend."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from sweep.analysis.measured_claims import claims_of
from sweep.analysis.quantity import main_quantity, numeric_axes, quantities, require_axis, require_quantity
from sweep.contract import SweepError, shown, suggest
from sweep.planning.point_status import Status
from sweep.plots.law import draw_law, draw_law_residuals
from sweep.plots.layout import arrange
from sweep.plots.lines import draw_lines
from sweep.plots.maps import accuracy_in_words, draw_map
from sweep.plots.panels import draw_panels
from sweep.plots.scaling import draw_efficiency, draw_speed_up, is_scaling
from sweep.plots.scatter import component_dimension, draw_scatter, sampled
from sweep.plots.style import value_text
from sweep.plots.tie.figure import draw_link, is_link

KINDS = ("lines", "law", "map", "scatter", "scaling")

MAP_POINTS = 5
"""A map is drawn unasked where two axes have at least so many points each."""
MAP_PANELS = 6


def draw_figure(
    dataset: xr.Dataset, kind: str | None = None, variables: Sequence[str] = (), over: Sequence[str] = ()
) -> Figure:
    """Return a figure of a dataset: the kind that suits it, or the one of `KINDS` that is asked for.

    ``variables`` are quantities (several become columns of panels), the main one if there is none; ``over`` the axis
    along which curves go, the two of a map, or the two components of a scatter.
    A link or a forecast has its own kinds.
    Raises SweepError for a kind that the dataset cannot have, naming those that it can.
    """
    if is_link(dataset):
        if variables or over:
            raise SweepError("a figure of a link has no variables and no axis to choose, only its kind")
        return draw_link(dataset, kind)
    if kind is not None and kind not in KINDS:
        raise SweepError(f"no kind {shown(kind)}{suggest(kind, KINDS)}")
    if is_scaling(dataset):
        return _scaling(dataset, kind)
    if sampled(dataset) is not None and (
        kind == "scatter" or (kind is None and _suits_scatter(dataset, variables, over))
    ):
        if variables:
            raise SweepError("a scatter is of kept samples, not of a variable; choose its two components with --over")
        return _scatter(dataset, over)
    names = list(variables) or [main_quantity(dataset)]
    for name in names:
        require_quantity(dataset, name)
        _require_one_unit(dataset, name)
    whole = dataset
    dataset = _without_single(dataset, over)
    possible = possible_kinds(dataset, names[0])
    chosen = kind or _suitable(dataset, names[0], over, possible)
    if chosen not in possible:
        raise SweepError(f"no {chosen} of {names[0]} here; possible are {', '.join(possible) or 'none'}")
    draw = {"lines": _lines, "law": _law, "map": _map}[chosen]
    figure = draw(dataset, names, over)
    _title(figure, whole, dataset)
    return figure


def possible_kinds(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the kinds of picture that a quantity of a dataset can have."""
    if is_scaling(dataset):
        return ["scaling"]
    numeric = numeric_axes(dataset, variable)
    kinds = ["lines"] if dataset["status"].ndim else []
    kinds += ["law"] if numeric else []
    kinds += ["map"] if len({dataset[axis].dims[0] for axis in numeric}) > 1 else []
    return kinds + (["scatter"] if sampled(dataset) is not None else [])


def _suits_scatter(dataset: xr.Dataset, variables: Sequence[str], over: Sequence[str]) -> bool:
    """Return whether kept samples are all that there is to draw: one point, and no axis or variable asked for."""
    return dataset["status"].size == 1 and not variables and not any(name in dataset.coords for name in over)


def _suitable(dataset: xr.Dataset, variable: str, over: Sequence[str], possible: Sequence[str]) -> str:
    if len(over) == 2:
        return "map"
    laws = {(claim.slope.variable, claim.slope.over) for claim in claims_of(dataset) if claim.slope is not None}
    stated = any((variable, axis) in laws for axis in numeric_axes(dataset, variable))
    if stated and not over and len(dataset[variable].dims) == 1:
        return "law"
    long = {dataset[a].dims[0] for a in numeric_axes(dataset, variable) if dataset[a].size >= MAP_POINTS}
    panels = int(np.prod([n for d, n in dataset[variable].sizes.items() if d not in long], dtype=int))
    return "map" if not over and len(long) == 2 and panels <= MAP_PANELS else "lines"


def _lines(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    axis = _one_axis(dataset, variables[0], over)
    layout = arrange(dataset, variables[0], (str(dataset[axis].dims[0]),))
    return draw_panels(dataset, variables, layout, lambda axes, part, name: draw_lines(axes, part, name, axis))


def _law(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if len(variables) > 1:
        raise SweepError(f"a law is drawn for one variable, not for {', '.join(variables)}")
    axis = require_axis(dataset, variables[0], (list(over) or numeric_axes(dataset, variables[0]))[0])
    layout = arrange(dataset, variables[0], (str(dataset[axis].dims[0]),))
    if layout.rows or (layout.columns and not layout.far):
        raise SweepError("a law is drawn for one further dimension at most; fix others with --at AXIS=VALUE")
    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    draw_law(upper, dataset, variables[0], axis)
    upper.set_xlabel("")
    draw_law_residuals(lower, dataset, variables[0], axis)
    return figure


def _map(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    if len(variables) > 1:
        raise SweepError(f"a map is drawn for one variable, not for {', '.join(variables)}")
    numeric = numeric_axes(dataset, variables[0])
    chosen = list(over) or _two_axes(dataset, numeric)
    for axis in chosen:
        require_axis(dataset, variables[0], axis)
    if len(chosen) != 2 or len({dataset[axis].dims[0] for axis in chosen}) != 2:
        raise SweepError(
            f"a map needs two axes that are crossed, of {', '.join(numeric)}; not {', '.join(chosen) or 'none'}"
        )
    layout = arrange(dataset, variables[0], tuple(str(dataset[axis].dims[0]) for axis in chosen), series=False)
    x, y = chosen
    figure = draw_panels(dataset, variables, layout, lambda axes, part, name: draw_map(axes, part, name, x, y))
    if words := accuracy_in_words(dataset, variables[0]):
        figure.supxlabel(words, fontsize=8)
    return figure


def _scatter(dataset: xr.Dataset, over: Sequence[str]) -> Figure:
    variable = sampled(dataset)
    assert variable is not None, "asked for before"
    whole, dataset = dataset, dataset.squeeze([d for d in dataset["status"].dims if dataset.sizes[d] == 1])
    if dataset["status"].ndim:
        left = ", ".join(f"{d} ({dataset.sizes[d]})" for d in dataset["status"].dims)
        raise SweepError(f"a scatter is of one point; choose it with --at AXIS=VALUE: {left}")
    dimension = component_dimension(dataset, variable)
    known = dataset[dimension].values.tolist()
    if unknown := [name for name in over if name not in known]:
        raise SweepError(f"{shown(unknown[0])} is no component of {variable}{suggest(unknown[0], known)}")
    if over and len(set(over)) != 2:
        raise SweepError(f"a scatter needs two components, of {', '.join(known)}; not {', '.join(over)}")
    one, other = over or _two_components(dataset, dimension)
    figure = Figure(figsize=(7.4, 4.4), layout="constrained")
    draw_scatter(figure.add_subplot(), dataset, variable, (one, other))
    _title(figure, whole, dataset)
    return figure


def _scaling(dataset: xr.Dataset, kind: str | None) -> Figure:
    if kind not in (None, "scaling"):
        raise SweepError(f"no {kind} of this; possible is scaling")
    figure = Figure(figsize=(8.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_speed_up(left, dataset)
    draw_efficiency(right, dataset)
    figure.suptitle(str(dataset.attrs.get("title", "")), fontsize="medium")
    return figure


def _title(figure: Figure, whole: xr.Dataset, drawn: xr.Dataset) -> None:
    """Write the title of the study, the values that all points share, and whether points are missing."""
    axes = [str(n) for n, c in drawn.coords.items() if not c.dims and not str(n).endswith("_unit")]
    shared = ", ".join(value_text(drawn, name, drawn[name].item()) for name in axes)
    status = drawn["status"].values
    missing = int(np.sum((status != Status.DONE) & (status != Status.EXCLUDED)))
    words = f"INCOMPLETE: {missing} of {status.size} points are not done" if missing else ""
    figure.suptitle("\n".join(filter(None, (str(whole.attrs.get("title", "")), shared, words))), fontsize="medium")


def _without_single(dataset: xr.Dataset, over: Sequence[str]) -> xr.Dataset:
    """Return the dataset without dimensions of one value, but one to draw along."""
    single = [d for d in dataset["status"].dims if dataset.sizes[d] == 1 and d not in over]
    if len(single) == dataset["status"].ndim and single:
        single = single[1:]
    return dataset.squeeze(single)


def _require_one_unit(dataset: xr.Dataset, variable: str) -> None:
    """Raise SweepError for components of different units, which have no axis in common."""
    for dimension in dataset[variable].dims:
        units = dataset.coords.get(f"{dimension}_unit")
        if units is not None and len(set(units.values.tolist())) > 1:
            raise SweepError(
                f"{variable} has components in {' and '.join(dict.fromkeys(units.values.tolist()))}; choose one with "
                f"--at {dimension}={dataset[dimension].values[0]}"
            )


def _one_axis(dataset: xr.Dataset, variable: str, over: Sequence[str]) -> str:
    """Return the axis to draw along: as asked for, or the longest of numbers, or the longest."""
    axes = [str(n) for n, c in dataset.coords.items() if c.dims and c.dims[0] in dataset["status"].dims and c.ndim == 1]
    if over:
        if len(over) > 1 or over[0] not in axes:
            raise SweepError(f"{', '.join(over)} is not one axis to draw along; there are {', '.join(axes)}")
        return over[0]
    return (numeric_axes(dataset, variable) or sorted(axes, key=lambda n: -dataset[n].size))[0]


def _two_axes(dataset: xr.Dataset, numeric: Sequence[str]) -> list[str]:
    """Return the two longest axes that do not share a dimension, in the order of the grid."""
    found: dict[str, str] = {}
    for axis in numeric:
        found.setdefault(str(dataset[axis].dims[0]), axis)
    order = [str(d) for d in dataset["status"].dims]
    return sorted(list(found.values())[:2], key=lambda axis: order.index(str(dataset[axis].dims[0])))


def _two_components(dataset: xr.Dataset, dimension: str) -> tuple[str, str]:
    """Return the first two components in the unit of the main quantity, or the first two."""
    known = dataset[dimension].values.tolist()
    units = f"{dimension}_unit"
    if units in dataset.coords and quantities(dataset):
        wanted = dataset[main_quantity(dataset)].attrs.get("units")
        same = [name for name, unit in zip(known, dataset[units].values.tolist(), strict=True) if unit == wanted]
        known = same if len(same) > 1 else known
    return str(known[0]), str(known[1])
