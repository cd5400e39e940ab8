"""The figure of a dataset: the kind that suits it or that is asked for, with its title.

Figures of results of a study are here: a quantity over the axes of a grid, in small panels of lines with errors,
prediction and published values, or of maps, and a fitted law; points without an order, those of a table or a design,
over each parameter, in pairs and as curves; and the kept samples of a single point.
"""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import combinations, islice, product
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colors, patheffects, ticker, transforms
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep import formatting
from linksweep.sweep.analysis import laws, quantity
from linksweep.sweep.contract import Array, Status, SweepError, shown, suggest
from linksweep.sweep.planning.union import REFINED
from linksweep.sweep.plots import KINDS, Kind, style
from linksweep.sweep.result import Result
from linksweep.sweep.studies.study import POINT

# A map is the default if two axes have at least this many points each, and it has at most so many panels; curves are
# the default for points of a table or design if an axis has at least so many values.
MAP_POINTS, MAP_PANELS, CURVE_POINTS = 5, 6, 8

_DATE = re.compile(r"\d{4}-\d\d-\d\d([T ]\d\d(:\d\d(:\d\d(\.\d+)?)?)?)?")

MOST_PANELS = 24
MOST_ACROSS = 4  # panels side by side; more of them continue in further rows
FEW_POINTS = 300  # more points than this are drawn small and without errors
MOST_MARKERS = 40  # more points on a line than this have no markers
FEWEST_STEPS = 3  # of an axis, which then has colours of a ramp
WIDE_COLOURS = 20.0  # values that span more than this factor have logarithmic colours
LARGEST = 1e307  # beyond it, the ends of an axis or what lies between them may be no floats
MOST_PIXELS = 1500  # along each side of an image; panels have no more, and what lies between them is not read
FAR = 30.0  # series whose largest values differ by more than this factor need panels with axes of their own

OPEN: dict[str, Any] = style.marks(0, 4.5, color="0.15", fillstyle="none", markeredgewidth=0.8)
# Dashes of predictions have one of the first two widths, or together the third, in points of print.
NARROWEST_DASH, WIDEST_DASH, ALL_DASHES = 3.0, 10.0, 150.0
EDGE_PT = WIDEST_DASH / 2.0 + 2.0  # what a mark at the end of an axis needs, so that it is not cut off
# Points closer than the first share of the axis cover each other; if more than the second share do, or two series
# everywhere, they are moved aside, so many points of print from their places at most.
COVERED, COVERED_SHARE, ASIDE_PT = 0.015, 0.25, 4.5

BAND = "band"  # the attribute of a difference: how far it may be from zero by chance


def draw_figure(
    dataset: xr.Dataset,
    kind: str | None = None,
    variables: Sequence[str] = (),
    over: Sequence[str] = (),
    log: Sequence[str] = (),
    linear: Sequence[str] = (),
) -> Figure:
    """Return a figure of a dataset: the kind that suits it, or the one asked for.

    ``variables`` are quantities (several become columns of panels), the main one by default; ``over`` is the
    axis of curves, the two axes of a map, or the two components of a scatter.  ``log`` and ``linear`` are axes and
    quantities with such a scale, by default as the study says or as the spacing of their values suggests.
    A link or a forecast has its own kinds.
    Raises SweepError for a kind that the dataset cannot have, which says what it lacks.
    """
    result = Result(dataset)
    if result.kind == "grid":
        return _study_figure(style.with_scales(dataset, log, linear), kind, list(variables), over)
    if variables or over or log or linear:
        raise SweepError(f"a figure of a {result.kind} has no variables, axes and scales to choose, only its kind")
    if result.kind not in KINDS:
        raise SweepError(f"there is no figure of a {result.kind}")
    return _titled(result, kind or next(iter(KINDS[result.kind])))


def all_figures(result: Result) -> dict[str, Figure]:
    """Return all figures that a result other than that of a study can have, by kind."""
    figures = {}
    for name in KINDS[result.kind]:
        with suppress(SweepError):  # says what the dataset lacks
            figures[name] = _titled(result, name)
    return figures


def _kind(result_kind: str, name: str) -> Kind:
    if name not in (kinds := KINDS[result_kind]):
        raise SweepError(f"no kind {shown(name)} of a {result_kind}{suggest(name, list(kinds))}")
    return kinds[name]


def _titled(result: Result, kind: str) -> Figure:
    """Return a figure with its title, and with what it shows as its label, for the caption."""
    one, result = _kind(result.kind, kind), Result(style.with_literal_texts(result.dataset))
    figure: Figure = one.load()(result.dataset)
    title = "\n".join(filter(None, [result.title, result.subtitle]))
    figure.set_label(": ".join(filter(None, [one.caption, title.replace("\n", "; ")])))
    style.complete(figure, title)
    return figure


# Results of a study


def _study_figure(dataset: xr.Dataset, kind: str | None, variables: list[str], over: Sequence[str]) -> Figure:
    if not (kind or variables or over):
        dataset, kind, variables, over = _as_its_study_says(dataset)
    dataset = style.with_literal_texts(_with_dates(dataset))
    single = [d for d in dataset["status"].dims if dataset.sizes[d] == 1]
    one_point = len(single) == dataset["status"].ndim
    only_samples = one_point and not variables and not any(name in dataset.coords for name in over)
    if sampled(dataset) is not None and (kind == "scatter" or (kind is None and only_samples)):
        return _draw(dataset.squeeze(single), "scatter", variables, over)
    names = variables or [quantity.main_quantity(dataset)]
    for name in names:
        quantity.require_quantity(dataset, name)
    dataset = dataset.assign_coords({d: dataset[d] for name in names for d in dataset[name].dims})
    unseen = {n for n in quantity.quantities(dataset) if quantity.own_dimensions(dataset, n)}.difference(names)
    dataset = dataset.drop_vars(unseen)  # arrays may be large
    fine = {d: -(-dataset.sizes[d] // MOST_PIXELS) for d in quantity.own_dimensions(dataset, names[0])}
    if sum(step > 1 for step in fine.values()) > 1:  # an image
        dataset = dataset.isel({d: slice(None, None, step) for d, step in fine.items()})
    # Infinity has no place in a figure; the caption says how often it is left out.
    finite = {n: dataset[n].where(abs(dataset[n]) < np.inf) for n in names if dataset[n].dtype.kind == "f"}
    dataset = _where_known(dataset.assign(finite), names[0])
    _require_values(dataset, names)
    part = style.with_chosen_component(dataset.squeeze([d for d in single if d not in over]))
    chosen = kind or _suitable(part, names[0], over)
    if chosen in ("law", "map", "pairs") and len(names) > 1:
        raise SweepError(f"a figure of the kind {chosen} is of one variable, not of {', '.join(names)}")
    return _draw(part, chosen, names, over)


def _as_its_study_says(dataset: xr.Dataset) -> tuple[xr.Dataset, str | None, list[str], list[str]]:
    """Return what the study of a dataset says to draw, as far as the dataset has it: its part, kind, quantity, axes."""
    form = style.form_of(dataset)
    along = {n: dataset[n].values.tolist() for n in map(str, dataset.coords) if dataset[n].ndim == 1}
    part = quantity.select(dataset, {n: value for n, value in form.at.items() if value in along.get(n, ())})
    return part, form.kind, [n for n in [form.variable] if n in dataset], [n for n in form.over if n in along]


def _with_dates(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset in which texts along a dimension that are all dates or times are times."""
    for name, texts in dataset.coords.items():
        if texts.ndim == 1 and texts.size and all(_DATE.fullmatch(str(text)) for text in texts.values):
            with suppress(ValueError):  # such as the 31st of February
                dataset = dataset.assign_coords({name: texts.astype("datetime64[us]")})  # ns end in 2262
    return dataset


def _where_known(dataset: xr.Dataset, variable: str) -> xr.Dataset:
    """Return a dataset without the components at which a quantity has no value anywhere; if the others have one unit,
    that is the unit of all.
    """
    for d in [d for d in quantity.own_dimensions(dataset, variable) if f"{d}_unit" in dataset.coords]:
        known = dataset[variable].notnull().any([other for other in dataset[variable].dims if other != d])
        dataset = dataset.isel({d: known.values}) if known.any() else dataset
        units, along = set(dataset[f"{d}_unit"].values.tolist()), (v for v in dataset.data_vars.values() if d in v.dims)
        shared = {v.name: v.assign_attrs(units=min(units)) for v in along if "," in formatting.units_of(v.attrs)}
        dataset = dataset.assign(shared) if len(units) == 1 else dataset
    return dataset


def _with_effect(dataset: xr.Dataset, axes: Sequence[str]) -> xr.Dataset:
    """Return a dataset without the points at which one of some axes has no effect."""
    return dataset.isel({dataset[axis].dims[0]: dataset[axis].notnull().values for axis in axes})


def _suitable(dataset: xr.Dataset, variable: str, over: Sequence[str]) -> str:
    array, numeric = dataset[variable], quantity.numeric_axes(dataset, variable)
    if POINT in array.dims and (parameters := quantity.varied_parameters(dataset)):
        is_long = any(dataset[n].size >= CURVE_POINTS for n in quantity.numeric_axes(dataset, variable, "ifM"))
        if set(over) <= set(parameters):
            return "curves" if is_long and not over else "points"
        if len(over) == 1:
            return "curves"
    if len(over) == 2:
        return "map"
    laws = [(one.slope.variable, one.slope.over) for one in quantity.claims_of(dataset) if one.slope is not None]
    linear = any(dataset[name].attrs.get(style.SCALE) == "linear" for name in (variable, *numeric))
    is_law = any((variable, axis) in laws for axis in numeric) and not (dataset["status"] == Status.RUNNING).any()
    if is_law and not over and not linear and array.ndim == 1:
        return "law"
    long = {dataset[a].dims[0]: a for a in numeric if dataset[a].size >= MAP_POINTS}
    panels = int(np.prod([n for d, n in array.sizes.items() if d not in long], dtype=int))
    is_map = not over and len(long) == 2 and panels <= MAP_PANELS
    # two axes may have an effect nowhere together
    return "map" if is_map and _with_effect(dataset, [*long.values()])[variable].notnull().any() else "lines"


def _draw(dataset: xr.Dataset, kind: str, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure with the title of the study, the values that all points share, and whether points are missing."""
    figure: Figure = _kind("grid", kind).load()(dataset, variables, over)
    axes = [str(n) for n, c in dataset.coords.items() if not c.dims and not str(n).endswith("_unit")]
    shared = style.values_text(dataset, {name: quantity.listed(dataset, name, [])[0] for name in axes})
    words = f"INCOMPLETE: {quantity.lacking(dataset)}" if _is_unfinished(dataset) else ""
    title = str(dataset.attrs.get("title", ""))
    figure.set_label("; ".join(filter(None, (title, style.plain(shared)))))
    style.complete(figure, "\n".join(filter(None, (title, shared, words))))
    return figure


def _is_unfinished(dataset: xr.Dataset) -> bool:
    return not bool(dataset["status"].isin([Status.DONE, Status.EXCLUDED]).all())


def _require_values(dataset: xr.Dataset, names: list[str]) -> None:
    """Raise SweepError for components of several units, which cannot share an axis, for numbers of which matplotlib
    cannot make an axis, and where none has a value.
    """
    for name, d in [(n, d) for n in names for d in dataset[n].dims if f"{d}_unit" in dataset.coords]:
        if len(several := dict.fromkeys(dataset[f"{d}_unit"].values.tolist())) > 1:
            how = f"choose one with --at {d}={dataset[d].values[0]}"
            raise SweepError(f"{name} has components in {' and '.join(several)}; {how}")
    for name in [n for n in (*names, *map(str, dataset.coords)) if dataset[n].dtype.kind == "f"]:
        if (np.nan_to_num(np.abs(dataset[name].values), posinf=0.0) > LARGEST).any():
            raise SweepError(f"{name} has numbers beyond {LARGEST:g}, which cannot be drawn")
    if not any(np.isfinite(dataset[name].values).any() for name in names):
        why = f": {quantity.lacking(dataset)}" if _is_unfinished(dataset) else ""
        raise SweepError(f"{' and '.join(names)}: there is no value to draw here{why}")


# Panels

# A function that draws a variable of a dataset into a panel.
Draw = Callable[[Axes, xr.Dataset, str], None]


def panel_dimensions(dataset: xr.Dataset, variable: str, axis: str) -> tuple[list[str], str | None]:
    """Return the dimensions of a variable drawn along an axis that become panels, rows before columns, and that along
    which values differ by more than `FAR`, so that each panel needs a scale of its own.  All others become colours.

    The dimension along which values differ most becomes columns, if there are several or that is far.  Of three or more
    one becomes rows.
    """
    array, left = dataset[variable], _others(dataset, variable, [axis])
    few = [d for d in left[:1] if array.sizes[d] <= len(style.COLOURS)]
    far = next((d for d in few if _separation(array, d) > FAR), None)
    if len(left) < 3:
        return (left[:1] if far or len(left) == 2 else []), far
    return [min(left[1:], key=lambda d: (array[d].dtype.kind not in "if", array.sizes[d])), left[0]], far


def _others(dataset: xr.Dataset, variable: str, along: Sequence[str]) -> list[str]:
    """Return the dimensions of a variable, but for those of the axes it is drawn ``along``: where values differ most
    comes first.
    """
    array, used = dataset[variable], {dataset[axis].dims[0] for axis in along}
    left = [str(d) for d in array.dims if d not in used and array.sizes[d] > 1]
    return sorted(left, key=lambda d: -_separation(array, d))


def _too_many(dataset: xr.Dataset, dimensions: Sequence[str], variables: Sequence[str] = ()) -> SweepError:
    counts = {d: dataset.sizes[d] for d in dimensions} | ({"variables": len(variables)} if len(variables) > 1 else {})
    sizes = ", ".join(f"{name} ({number})" for name, number in counts.items())
    choice = ", choose some (--variable)" if len(variables) > 1 else ""
    return SweepError(f"{sizes}: too many for one picture; fix some (--at AXIS=VALUE){choice} or choose --over")


def _separation(array: xr.DataArray, dimension: str) -> float:
    """Return the ratio between the largest and the smallest of the largest values along a dimension."""
    largest = abs(array).max([d for d in array.dims if d != dimension], skipna=True).values
    largest = largest[np.isfinite(largest) & (largest > 0.0)]
    return float(largest.max() / largest.min()) if largest.size else 1.0


def draw_panels(
    dataset: xr.Dataset, variables: list[str], *draws: Draw, dimensions: Sequence[str] = (), far: str | None = None
) -> Figure:
    """Return a figure with a panel for each combination along some dimensions, each variable and each function that
    draws one; the last of these are columns.

    Panels that would be empty are left out.  Those along ``far`` have axes and units of their own.  If the figure is
    too narrow for the columns, they continue in further rows.
    """
    has_axis = len(draws) == 1 and dataset[variables[0]].size > 1  # that panels share: of one value it is its own
    counts = [*(dataset.sizes[d] for d in dimensions), *(len(some) for some in (variables, draws) if len(some) > 1)]
    every = ((panel, draw) for panel in _panels(dataset, variables, dimensions, far) for draw in draws)
    panels = list(islice(every, MOST_PANELS + 1))
    if len(panels) > MOST_PANELS:
        raise _too_many(dataset, dimensions[::-1], variables)
    wanted = counts[-1] if len(counts) > 1 else len(panels)
    down = -(-len(panels) // min(style.most_columns(wanted), MOST_ACROSS))  # rounded up
    across = -(-len(panels) // down)
    size = (6.4, 4.4) if len(panels) == 1 else (1.2 + 3.1 * across, 1.2 + 2.4 * down)
    figure, grid = style.new_figure(*size, down, across, n=len(panels))
    firsts: dict[tuple[Any, ...], Axes] = {}
    for number, (axes, ((part, name, title, shares), draw)) in enumerate(zip(grid, panels, strict=False)):
        if number and has_axis:
            axes.sharex(grid[0])
        if firsts.setdefault(shares, axes) is not axes:
            axes.sharey(firsts[shares])
        draw(axes, part, name)
        axes.set_label(name)  # for the caption
        width, height = style.panel_size(axes)
        axes.set_title(style.in_lines(title, width))
        # not label_outer: a neighbour may have a scale of its own, and that below may be missing
        has_y = number % across == 0 or panels[number - 1][0][-1] != shares
        has_x = not has_axis or number + across >= len(panels)
        axes.tick_params(which="both", labelleft=has_y, labelbottom=has_x)
        axes.set_xlabel(style.in_lines(axes.get_xlabel(), width) if has_x else "")
        axes.set_ylabel(style.in_lines(axes.get_ylabel(), height) if has_y else "")
    return figure


def _panels(
    dataset: xr.Dataset, variables: list[str], dimensions: Sequence[str], far: str | None
) -> Iterator[tuple[xr.Dataset, str, str, tuple[Any, ...]]]:
    """Yield the panels that have anything to show, row by row: the part of the dataset in readable units, the variable,
    the title, and what shares the y axis; those along ``far`` have units of their own.
    """
    wholes = dict[tuple[Any, ...], xr.Dataset]()  # of all panels that share an axis: arrays may be large
    for place, name in product(quantity.places_along(dataset, dimensions), variables):
        alone = {d: i for d, i in place.items() if d == far}
        shares = (name, *alone.items())
        if shares not in wholes:
            whole = quantity.in_readable_units(dataset.isel(alone))
            parts = quantity.parts_of(whole, name)
            beside = [parts[part] for part in ("predicted", "published") if part in parts]
            scale = "log" if style.is_logarithmic(whole[name], *beside) else "linear"
            wholes[shares] = whole.assign({name: whole[name].assign_attrs({style.SCALE: scale})})
        part = wholes[shares].isel({d: i for d, i in place.items() if d != far})
        if np.isfinite(part[name].values.astype(float)).any():
            values = {d: quantity.listed(dataset, d, [d])[i] for d, i in place.items()}
            yield part, name, style.values_text(dataset, values), shares


# Series

# What has a colour of its own: its name, colour and marker, and the part of a dataset.
Series = tuple[str, dict[str, Any], xr.Dataset]


def series_of(dataset: xr.Dataset, variable: str, *along: str, numbers: dict[str, int] | None = None) -> list[Series]:
    """Return the series of a variable: its parts that have a value, for every combination of its dimensions except
    those it is drawn ``along``; raises SweepError for more parts than colours.

    ``numbers`` holds the number of each series, by its name, for all panels of a figure: each keeps its colour even if
    another series has no values in a panel.
    """
    others = [str(d) for d in dataset[variable].dims if d not in along]
    everything = [dataset.isel(place) for place in quantity.places_along(dataset, others)]
    parts = [one for one in everything if np.isfinite(one[variable].values).any()]  # a study may exclude the others
    if len(parts) > len(style.COLOURS):
        raise _too_many(dataset, others)
    named = [d for d in others if d in dataset.coords and dataset.sizes[d] > 1]
    names = [style.values_text(dataset, {d: quantity.listed(one, d, [])[0] for d in named}) for one in parts]
    steps, numbers = _steps(dataset, variable, *along), {} if numbers is None else numbers
    for name in (*steps, *names):
        numbers.setdefault(name, len(numbers))
    return [(name, style.series(numbers[name], len(steps)), one) for name, one in zip(names, parts, strict=True)]


def _steps(dataset: xr.Dataset, variable: str, *along: str) -> list[str]:
    """Return the names of the series of a variable in their order if they are values of one further axis of numbers."""
    left = [str(d) for d in dataset[variable].dims if d not in along and dataset.sizes[d] > 1]
    if len(left) != 1 or dataset[left[0]].dtype.kind not in "if" or dataset.sizes[left[0]] < FEWEST_STEPS:
        return []
    return [style.value_text(dataset, left[0], value) for value in np.sort(dataset[left[0]].values).tolist()]


# Lines


def one_axis(dataset: xr.Dataset, variables: Sequence[str], over: Sequence[str]) -> str:
    """Return the axis to draw along, which all variables have: the one asked for, or the longest numeric one of the
    first, or its longest.
    """
    variable, *others = variables
    numeric = quantity.numeric_axes(dataset, variable, "ifM")
    grid = {*dataset["status"].dims} - {POINT}
    along = {str(n): c for n, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] in grid}
    axes = [name for name, values in along.items() if values.notnull().any()] + numeric  # it may have no effect here
    # names of components only if they are asked for or alone
    further = [d for d in quantity.own_dimensions(dataset, variable) if d in dataset.coords]
    axes += further if over or not axes else []
    if not axes or (over and (len(over) > 1 or over[0] not in axes)):
        known = ", ".join(dict.fromkeys(axes)) or "none"
        raise SweepError(f"{variable} cannot be drawn along {', '.join(over) or 'any axis'}; its axes are {known}")
    axis = over[0] if over else (numeric or sorted(axes, key=lambda n: -dataset[n].size))[0]
    return one_axis(dataset, others, [axis]) if others else axis


def lines_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of variables against an axis, or of the numbers at a single point."""
    if all(dataset[name].size == 1 for name in variables) and not over:
        figure = draw_panels(dataset.squeeze(), variables, _draw_point)
        figure.set_figheight(max(1.0 + 0.3 * figure.get_figwidth(), style.in_letters(20.0)))
        return figure
    axis = one_axis(dataset, variables, over)
    draw = partial(draw_lines, over=axis, numbers={})
    dimensions, far = panel_dimensions(dataset, variables[0], axis)
    return draw_panels(dataset, variables, draw, dimensions=dimensions, far=far)


def draw_lines(axes: Axes, dataset: xr.Dataset, variable: str, over: str, numbers: dict[str, int]) -> None:
    """Draw a variable against an axis of the grid, one colour for every combination of the other dimensions.

    ``numbers`` are those of `series_of`.

    Points have their one-sigma errors (Monte Carlo and catalogues), and thin lines join them.  Dashes are the
    closed-form prediction, which is known at the points alone, on bars of its catalogue error.  Open symbols are
    published values with half a unit of their last digit.
    """
    x = positions(axes, dataset, over, "x")
    dimension = str(dataset[over].dims[0])
    order = np.argsort(x, kind="stable")
    dataset, x = dataset.isel({dimension: order}), x[order]
    joined = dataset[over].dtype.kind in "ifM" and dimension != POINT and len(x) > 1
    joined = joined and not formatting.is_truth(dataset[variable])
    drawn = series_of(dataset, variable, dimension, numbers=numbers)
    offsets = _offsets(dataset[variable], np.array([one[variable].values[np.isfinite(x)] for *_, one in drawn]))
    moved = [_draw_series(axes, x, one, variable, offset, joined) for one, offset in zip(drawn, offsets, strict=True)]
    colour = style.COLOURS[0] if len(numbers) == 1 else "0.35"
    known = {part for *_, one in drawn for part in quantity.parts_of(one, variable)}
    if "predicted" in known:
        axes.plot([], [], color=colour, label=style.PREDICTED, markersize=WIDEST_DASH, **style.DASH)
    if "published" in known:
        axes.plot([], [], **OPEN, label=style.PUBLISHED)
    if any(moved):
        axes.plot([], [], linestyle="none", label=style.MOVED)
    if half := dataset[variable].attrs.get(BAND):
        axes.axhline(0.0, color="black", linewidth=0.6)
        axes.axhspan(-half, half, color=style.COLOURS[6], **style.BAND)
    style.fit_scale(axes, "y", dataset[variable])
    axes.set(xlabel=style.axis_label(dataset, over), ylabel=style.quantity_label(dataset, variable))
    axes.margins(x=bool(axes.get_xmargin()) * max(0.05, EDGE_PT / (72.0 * style.panel_size(axes)[0] - 2.0 * EDGE_PT)))
    if joined and len(axes.figure.axes) == 1 and _steps(dataset, variable, dimension):
        _name_ends(axes, {name: float(one[variable].values[-1]) for name, _, one in drawn})


def _name_ends(axes: Axes, ends: Mapping[str, float]) -> None:
    """Write the values that name lines at their ends, if these are apart; the legend then leaves them out."""
    axes.autoscale_view()  # which is otherwise put off
    heights = np.sort(axes.transData.transform([(1.0, end) for end in ends.values()])[:, 1])
    size = 72.0 * style.in_letters(1.0)
    if not (np.diff(heights) * 72.0 / axes.figure.dpi > 0.85 * size).all():  # some end earlier, or too close
        return
    look: dict[str, Any] = {"xycoords": axes.get_yaxis_transform(), "textcoords": "offset points", "fontsize": "small"}
    for artist in (one for one in style.labelled(axes) if one.get_label() in ends):
        axis, _, value = str(name := artist.get_label()).partition(" = ")
        artist.set_label(f"{style.AT_END}{name}")
        axes.annotate(value, (1.0, ends[name]), (4.0, 0.0), va="center", **look)
    title = style.in_lines(axis, style.in_letters(8.0))
    axes.annotate(title, (1.0, max(ends.values())), (4.0, 0.8 * size), va="bottom", **look)


def positions(axes: Axes, dataset: xr.Dataset, axis: str, which: str) -> Array:
    """Return the positions of the values of an axis or a parameter, and set the scale and ticks of ``which`` axis."""
    array = dataset[axis]
    if array.dtype.kind in "if":
        style.fit_scale(axes, which, array)
        return np.asarray(array.values.astype(float))
    if array.dtype.kind == "M":
        scale: Any = axes.xaxis if which == "x" else axes.yaxis
        with style.settings():  # in whose labels dates do not cover each other
            scale.update_units(array.values)
        return np.asarray(scale.convert_units(array.values))
    values = array.values.tolist()
    names, before = list(dict.fromkeys(values)), f"{style.symbol(axis, array.attrs)} = "
    style.name_ticks(axes, which, [style.value_text(dataset, axis, name).removeprefix(before) for name in names])
    places = np.array([names.index(value) for value in values], dtype=float)
    if array.dims == (POINT,):  # spread a little in both directions, so that points do not hide each other: R2 sequence
        places += 0.5 * (np.arange(array.size) * {"x": 0.7548776662, "y": 0.5698402910}[which] % 1.0 - 0.5)
    return places


def _offsets(array: xr.DataArray, values: Array) -> list[float]:
    """Return by how many points of print the markers of each series, of ``values`` (series, points), are moved aside: 0
    unless series cover each other in many places, or two of them everywhere.
    """
    values = np.log(values) if style.is_logarithmic(array) else values.astype(float)
    gaps = np.diff(np.sort(values, axis=0), axis=0)
    near = COVERED * (np.fmax.reduce(values, axis=None) - np.fmin.reduce(values, axis=None))
    is_aside = any((abs(one - other) <= near).all() for one, other in combinations(values, 2))
    is_aside |= bool((gaps <= near).sum() > COVERED_SHARE * np.isfinite(gaps).sum())
    outermost = is_aside * min(ASIDE_PT * (len(values) - 1) / 2.0, ASIDE_PT)
    return list(map(float, np.linspace(-outermost, outermost, len(values))))


def _draw_series(axes: Axes, x: Array, drawn: Series, variable: str, offset: float, joined: bool) -> bool:
    """Draw one series, and return whether its markers are moved aside, with their error bars; a line never is."""
    name, mark, one = drawn
    if REFINED in one.attrs and one["status"].shape == x.shape:  # other series have points in between
        there = np.flatnonzero(one["status"].values != Status.EXCLUDED)
        x, one = x[there], one.isel({one["status"].dims[0]: there})
    few, is_line = len(x) <= FEW_POINTS, joined and len(x) > MOST_MARKERS
    is_aside = offset != 0.0 and not is_line
    parts, colour = quantity.parts_of(one, variable), mark["color"]
    y = parts["value"].values.astype(float)
    sigma = parts["error"].values if "error" in parts and (few or is_line) else None
    look: dict[str, Any] = {**mark, "linestyle": "none", "markersize": 3.5 if few else 2.0, "elinewidth": 0.8}
    look |= {"zorder": 3, "alpha": 1.0 if few else 0.4}
    words = name or (style.COMPUTED if quantity.standard_error(one, variable) is None else style.SIMULATED)
    running = np.broadcast_to(one["status"].values == Status.RUNNING, y.shape)
    marked, label, moved = np.full(y.shape, True), words, list[Any]()
    if is_line:  # which shows no point that has no neighbour, and every second one may be done first
        alone = np.isfinite(y) & (np.convolve(np.isfinite(y), [1, 0, 1], "same") == 0)
        marked, label = alone | running, style.ALONE if alone.any() else style.RUNNING
    if marked.any():
        error = None if sigma is None else sigma[marked]
        moved.append(axes.errorbar(x[marked], y[marked], error, label=label, **look))
    if running.any():
        centre = {"color": "white", "markersize": 0.5 * look["markersize"], "zorder": 3.1, "label": style.RUNNING}
        moved.append(axes.errorbar(x[running], y[running], **look | centre))
    for level in y[np.isnan(x) & np.isfinite(y)]:
        axes.axhline(level, color=colour, linewidth=1.2, linestyle=":", label=style.WITHOUT)
    if joined:
        line, width, opacity, said = "solid", 0.8, 0.6, style.JOINED
        if is_line:
            line, width, opacity, said = mark["linestyle"], 1.2, 1.0, words
        axes.plot(x, y, color=colour, zorder=2, linestyle=line, linewidth=width, alpha=opacity, label=said)
        if sigma is not None and (is_line or "predicted" not in parts):
            axes.fill_between(x, y - sigma, y + sigma, color=colour, label=style.ERROR_BAND, **style.BAND)
    if "predicted" in parts:
        curve, spread = parts["predicted"].values, one.get(f"{variable}_catalogue_error")
        width = float(np.clip(ALL_DASHES / len(x), NARROWEST_DASH, WIDEST_DASH))
        axes.plot(x, curve, color=colour, zorder=2.5, markersize=width, **style.DASH)
        if spread is not None and np.isfinite(spread).any():
            half, bar = np.nan_to_num(spread.values), {**style.BAND, "linewidth": 0.6 * width}
            axes.vlines(x, curve - half, curve + half, color=colour, label=style.PREDICTION_BAND, **bar)
    if "published" in parts:
        half = parts["published_rounding"].values if "published_rounding" in parts else None
        look = {**OPEN, "marker": mark["marker"], "elinewidth": 0.6, "zorder": 4, "label": f"_{style.PUBLISHED}"}
        moved.append(axes.errorbar(x, parts["published"].values, yerr=half, **look))
    aside = transforms.ScaledTranslation(offset / 72.0, 0.0, axes.figure.dpi_scale_trans)
    for artist in (one for container in moved for one in container.get_children() if is_aside):
        artist.set_transform(artist.get_transform() + aside)
    return is_aside


def _draw_point(axes: Axes, dataset: xr.Dataset, variable: str) -> None:
    """Draw the value of a variable at the one point of a dataset with its one-sigma error, the prediction and the
    published value with half a unit of its last digit, each in a line of its own with its numbers.
    """
    parts, known = quantity.parts_of(dataset, variable), quantity.standard_error(dataset, variable)
    rows = {style.COMPUTED if known is None else style.SIMULATED: ("value", "error" if known is not None else "")}
    rows |= {style.PREDICTED: ("predicted", ""), style.PUBLISHED: ("published", "published_rounding")}
    rows = {word: row for word, row in rows.items() if row[0] in parts and bool(parts[row[0]].notnull().all())}
    for number, (word, (name, half)) in enumerate(rows.items()):
        value, error = parts[name].item(), float(parts[half].item()) if half in parts else 0.0
        value = bool(value) if formatting.is_truth(dataset[variable]) else value
        look = style.marks(number, 5.0, label=word, fillstyle="none" if word == style.PUBLISHED else "full")
        axes.errorbar(float(value), -number, xerr=error or None, elinewidth=1.2, **look)
        units = formatting.units_of(dataset[variable].attrs)
        text = formatting.with_unit(value, error if word == style.SIMULATED else 0.0, units)
        above: dict[str, Any] = {"xytext": (0, 7), "textcoords": "offset points", "ha": "center"}
        axes.annotate(formatting.with_micro_signs(text), (value, -number), **above)
    axes.set_yticks([-number for number in range(len(rows))], list(rows))
    axes.set_ylim(0.6 - len(rows), 0.7)
    axes.margins(x=0.35)
    axes.locator_params(axis="x", nbins=round(style.panel_size(axes)[0] / style.in_letters(8.0 * style.LETTER_WIDTH)))
    style.fit_scale(axes, "x", dataset[variable])
    axes.set_xlabel(style.quantity_label(dataset, variable))
    axes.tick_params(axis="y", length=0.0)


# Laws


def law_figure(dataset: xr.Dataset, variables: list[str], along: Sequence[str]) -> Figure:
    """Return a figure of a variable against an axis on logarithmic scales, with the fitted power law and its one-sigma
    band; and below that the residuals from the law in percent, where errors can be seen.

    There is one colour for every combination of the other dimensions that the study does not exclude everywhere.  The
    dashed guide has the exponent that a claim of the study states, and meets the law at its pivot.
    """
    variable = variables[0]
    axes = [*along, *quantity.numeric_axes(dataset, variable)]
    over = quantity.require_axis(dataset, variable, axes[0] if axes else None)
    if linear := [name for name in (over, variable) if dataset[name].attrs.get(style.SCALE) == "linear"]:
        raise SweepError(f"a law is drawn on logarithmic axes, and {linear[0]} is to have a linear one")
    dataset = quantity.in_readable_units(_with_effect(dataset, [over]))
    drawn = series_of(dataset, variable, str(dataset[over].dims[0]))
    lines = [line for line in laws.lines(dataset, variable, over).lines if len(line.x)]
    result = laws.fit_power_law(dataset, variable, over)
    figure, (upper, lower) = style.new_figure(6.4, 5.2, 2, sharex=True, height_ratios=(3, 1))
    for (words, mark, _), line in zip(drawn, lines, strict=True):
        x, y, fine = line.x, line.y, np.geomspace(line.x.min(), line.x.max(), 100)
        error = np.nan_to_num(line.sigmas())
        law = {str(name): array.item() for name, array in result.isel(line.index).data_vars.items()}
        curve, there = (law["amplitude"] * (at / law["pivot"]) ** law["exponent"] for at in (fine, x))
        spread = law["amplitude_error"] / law["amplitude"]
        tilt = np.log(fine / law["pivot"]) * law["exponent_error"]
        square = np.nan_to_num(spread**2 + tilt**2 + 2.0 * law["correlation"] * spread * tilt)
        half = np.sqrt(np.maximum(square, 0.0)).round(11)
        look, band = {**mark, "linestyle": "none", "markersize": 3.5}, {"color": mark["color"], **style.BAND}
        known = law["exponent_error"] if law["exponent_error"] > 1e-9 else 0.0  # less is of rounding
        fitted = _power(dataset, over, formatting.with_error(law["exponent"], known).replace(" ± ", r"\pm"))
        fitted = fitted if len(x) > 1 else "too few points"
        text = f"{words}: {fitted}" if words else style.SIMULATED if error.any() else style.COMPUTED
        upper.errorbar(x, y, yerr=error if error.any() else None, label=text, **look)
        upper.plot(fine, curve, color=mark["color"], linewidth=1.0, label="" if words else f"fit {fitted}")
        if half.any():
            upper.fill_between(fine, curve * (1.0 - half), curve * (1.0 + half), label=style.LAW_BAND, **band)
        lower.fill_between(fine, -100.0 * half, 100.0 * half, **band)
        residual = np.round(100.0 * (y / there - 1.0), 9)  # without what is of rounding
        lower.errorbar(x, residual, yerr=100.0 * error / there, **look)
        if np.isfinite(expected := law.get("expected", np.nan)):
            guide = law["amplitude"] * (fine / law["pivot"]) ** expected
            text = f"guide {_power(dataset, over, format(expected, 'g'))}"
            upper.plot(fine, guide, label=text, **style.GUIDE)  # the legend names alike ones once
            lower.plot(fine, 100.0 * (guide / curve - 1.0), **style.GUIDE)
    style.logarithmic(upper, "x", dataset[over].values)  # also of the lower axes, which share x
    style.logarithmic(upper, "y", dataset[variable].values)
    upper.set_label(variable)
    upper.set_ylabel(style.quantity_label(dataset, variable))
    lower.axhline(0.0, color="black", linewidth=0.6)
    lower.set(xlabel=style.label(dataset[over], over), ylabel="residual [%]")
    return figure


def _power(dataset: xr.Dataset, over: str, exponent: str) -> str:
    """Return the axis to a power, as mathematics."""
    name = style.symbol(over, dataset[over].attrs)
    base = name.strip("$") if name.startswith("$") else rf"\mathrm{{{name}}}".replace(" ", r"\ ")
    return f"${base}^{{{exponent}}}$"


# Maps


def map_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of a variable over two axes, and below it how well its values are known."""
    variable, numeric = variables[0], quantity.numeric_axes(dataset, variables[0])
    chosen = [quantity.require_axis(dataset, variable, axis) for axis in over or _two_axes(dataset, variable)]
    if len(chosen) != 2 or len({dataset[axis].dims[0] for axis in chosen}) != 2:
        known, got = (", ".join(names) or "none" for names in (numeric, chosen))
        raise SweepError(f"a map needs two axes of numbers that are crossed, not {got}; there are {known}")
    if len(others := _others(dataset, variable, chosen)) > 2:
        raise _too_many(dataset, others)
    dataset = _with_effect(dataset, chosen)
    _require_values(dataset, variables)
    readable = quantity.in_readable_units(dataset)
    draw = partial(draw_map, x=chosen[0], y=chosen[1], limits=colour_limits(readable[variable]))
    figure = draw_panels(readable, variables, draw, dimensions=others[::-1])
    mesh = figure.axes[0].collections[0]  # all panels share their colours
    style.add_bar(figure, mesh, readable[variable], style.quantity_label(readable, variable), ax=figure.axes)
    if words := _accuracy_in_words(dataset, variable):
        figure.supxlabel(style.in_lines(words, figure.get_figwidth(), 20), fontsize="medium")
    return figure


def _two_axes(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the two longest axes that do not share a dimension, in the order of the variable's dimensions: those of
    the grid, then its own.
    """
    axes = quantity.numeric_axes(dataset, variable)
    longest = {dataset[axis].dims[0]: axis for axis in reversed(axes)}
    two = sorted(longest, key=lambda d: axes.index(longest[d]))[:2]
    return [longest[d] for d in dataset[variable].dims if d in two]


def colour_limits(array: xr.DataArray) -> colors.Normalize:
    """Return the scale of colours for all values of a variable, logarithmic as an axis of it would be, and where they
    span a large factor that no single gap makes up.
    """
    values = array.values.astype(float)
    values = values[np.isfinite(values)]
    low, high = float(values.min()), float(values.max())
    is_wide = low > 0.0 and high > WIDE_COLOURS * low and style.unevenness(np.log(np.unique(values))) < 0.5
    is_log = style.is_logarithmic(array) or (is_wide and style.SCALE not in array.attrs)
    return (colors.LogNorm if is_log else colors.Normalize)(low, high)


def draw_map(axes: Axes, dataset: xr.Dataset, variable: str, x: str, y: str, limits: colors.Normalize) -> None:
    """Draw a variable over two axes: colours at the points of the grid, and contours, but none of truth values.

    ``limits`` are those of the colours, which all panels of a figure share.  Points without a value are left white.
    """
    array = dataset.sortby([x, y])[variable].astype(float)
    places: dict[str, Any] = {"x": x, "y": y, "ax": axes, "add_labels": False}
    low, high = float(limits.vmin or 0.0), float(limits.vmax or 0.0)
    scales: Any = {f"{w}scale": "log" for w, name in (("x", x), ("y", y)) if style.is_logarithmic(dataset[name])}
    # with borders of cells halfway between the points, on the scale of the axis
    array.plot.pcolormesh(**places, **scales, cmap="cividis", norm=limits, add_colorbar=False, rasterized=True)
    is_log = isinstance(limits, colors.LogNorm)
    levels = ticker.LogLocator(subs=(1.0, 2.0, 5.0)) if is_log else ticker.MaxNLocator(8, steps=[1, 2, 2.5, 5, 10])
    inside = [level for level in levels.tick_values(low, high) if low < level < high]
    is_smooth = inside and _is_smooth(np.log(array.values) if is_log else array.values, len(inside))
    if is_smooth and not formatting.is_truth(dataset[variable]):
        # solid, also those of negative numbers
        look: Any = {"colors": "white", "levels": inside, "linewidths": 0.8, "linestyles": "solid"}
        contours = array.plot.contour(**places, **look)
        for artist in (contours, *axes.clabel(contours, fmt=style.number_text, fontsize="small")):
            artist.set_path_effects([patheffects.withStroke(linewidth=2.2, foreground="0.15")])
    for axis, which, name in ((axes.xaxis, "x", x), (axes.yaxis, "y", y)):
        style.fit_scale(axes, which, dataset[name])
        if dataset[name].size <= 3:  # ticks at these alone
            axis.set_ticks(dataset[name].values, formatting.plain(dataset[name].values.tolist()))
            axis.set_minor_locator(ticker.NullLocator())
    axes.set(xlabel=style.explained_label(dataset[x], x), ylabel=style.explained_label(dataset[y], y))


def _is_smooth(values: Array, levels: int) -> bool:
    """Return whether contours of a map would show its shape: not those of plateaus, steps and noise, which no two
    neighbours of a point interpolate to half the distance of two levels.
    """
    middles = [(one[2:] + one[:-2]) / 2.0 - one[1:-1] for one in (values, values.T)]
    largest = max(float(np.abs(one).max(initial=0.0)) for one in middles)  # NaN where a value is missing
    return min(values.shape) > 2 and largest < 0.5 * float(np.ptp(values)) / (levels + 1)


def _accuracy_in_words(dataset: xr.Dataset, variable: str) -> str:
    """Return how well the values of a map are known and agree with their prediction; '' where they have no errors."""
    if (error := quantity.standard_error(dataset, variable)) is None:
        return ""
    value, predicted = dataset[variable], dataset.get(quantity.prediction_name(dataset, variable))
    relative = float(error.max()) / (float(abs(value).max()) or np.nan)
    apart = np.nan if predicted is None else float((abs(value - predicted) / error.where(error > 0.0)).max())
    words = f"; at most {apart:.1f}σ from the prediction" if np.isfinite(apart) else ""
    return f"errors (1σ) at most {100.0 * relative:.2g} % of the largest{words}" if np.isfinite(relative) else ""


MOST_PARAMETERS, MOST_PAIRED = 12, 8
FEW_CURVES = 12  # up to this many curves are drawn one by one

# Two quantiles over the points, the opacity of the band between them, and its name.
BANDS = ((0.05, 0.95, 0.15, "90 % of the points"), (0.25, 0.75, 0.3, "50 % of the points"))


# A table or a design


def points_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure with a row for each variable and a column for each parameter: all, or those in ``over``.  With
    one variable, many parameters take several rows.
    """
    draws = [partial(draw_lines, over=name, numbers={}) for name in _parameters(dataset, over, MOST_PARAMETERS)]
    return draw_panels(dataset, variables, *draws)


def pairs_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of parameters in pairs, coloured by a variable."""
    dataset = quantity.in_readable_units(dataset)
    variable, parameters = variables[0], _parameters(dataset, over, MOST_PAIRED)
    further = [str(d) for d in dataset[variable].dims if d != POINT and dataset.sizes[d] > 1]
    if further or len(parameters) < 2:
        raise SweepError(f"pairs need two parameters and one value a point; fix {', '.join(further)}: --at AXIS=VALUE")
    n, values = len(parameters) - 1, dataset[variable].squeeze().values.astype(float)
    figure, panels = style.new_figure(2.4 + 1.7 * n, 1.2 + 1.6 * n, n, n, least=1.0, sharex="col", sharey="row")
    known = np.isfinite(values)
    dots: dict[str, Any] = {"c": values[known], "cmap": "cividis", "norm": colour_limits(dataset[variable])}
    dots |= {"s": 10.0 if len(values) <= FEW_POINTS else 4.0, "linewidths": 0.0}
    for axes, (up, across) in zip(panels, product(parameters[1:], parameters[:-1]), strict=True):
        if parameters.index(across) >= parameters.index(up):
            axes.set_visible(False)
            continue
        x, y = positions(axes, dataset, across, "x"), positions(axes, dataset, up, "y")
        drawn = axes.scatter(x[known], y[known], **dots)
        axes.set(label=variable, xlabel=style.label(dataset[across], across), ylabel=style.label(dataset[up], up))
        axes.label_outer()
    text = style.quantity_label(dataset, variable)
    style.add_bar(figure, drawn, dataset[variable], text, ax=panels[n - 1 :: n], shrink=0.7)
    return figure


def curves_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of variables of points along a dimension of their own."""
    if POINT not in dataset[variables[0]].dims:
        raise SweepError("curves are of the points of a table or a design")
    return draw_panels(dataset, variables, partial(_draw_curves, over=one_axis(dataset, variables, over)))


def _draw_curves(axes: Axes, dataset: xr.Dataset, variable: str, over: str) -> None:
    """Draw a variable of points along a dimension of its own, one colour for every combination of the others: the
    median and bands of many points, or the curve of each of a few.
    """
    along, array, x = str(dataset[over].dims[0]), dataset[variable], positions(axes, dataset, over, "x")
    for words, mark, one in series_of(dataset, variable, POINT, along):
        y, colour = one[variable].transpose(POINT, along).values.astype(float), mark["color"]
        y = y[np.isfinite(y).any(axis=1)]
        if array.sizes[POINT] <= FEW_CURVES:
            labels = [words, *[""] * (len(y) - 1)]  # alone, the curves are what the axis says
            axes.plot(x, y.T, color=colour, linewidth=0.9, alpha=0.8, label=labels)
            continue
        for low, high, opacity, name in BANDS:
            band: dict[str, Any] = {"color": colour, "alpha": opacity, "linewidth": 0.0, "label": "" if words else name}
            axes.fill_between(x, *np.nanquantile(y, (low, high), axis=0), **band)
        middle = words or f"median of {len(y):,} points"
        axes.plot(x, np.nanmedian(y, axis=0), color=colour, linewidth=1.4, label=middle)
    style.fit_scale(axes, "y", array)
    axes.set(xlabel=style.label(dataset[over], over), ylabel=style.quantity_label(dataset, variable))


def _parameters(dataset: xr.Dataset, over: Sequence[str], most: int) -> list[str]:
    """Return the parameters asked for, or all in which the points differ; raises SweepError for more than ``most``."""
    known = quantity.varied_parameters(dataset)
    if not known:
        raise SweepError("there are no points of a table or a design that differ in a parameter")
    if unknown := [name for name in over if name not in known]:
        raise SweepError(f"the points do not differ in {shown(unknown[0])}{suggest(unknown[0], known)}")
    chosen = list(over) or known
    if len(chosen) > most:
        listed = ", ".join(chosen)
        raise SweepError(f"{len(chosen)} parameters are too many for one picture of {most}: choose --over, {listed}")
    return chosen


# Kept samples


def sampled(dataset: xr.Dataset) -> str | None:
    """Return the variable with the kept samples of several components along one dimension; None if there is none."""
    known = {"sample", *dataset["status"].dims}
    kept = {str(name): array for name, array in dataset.data_vars.items() if "sample" in array.dims}
    return next((n for n, v in kept.items() if [v.sizes[d] > 1 for d in v.dims if d not in known] == [True]), None)


def scatter_figure(dataset: xr.Dataset, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure of the samples of two components at one point: those in ``over``, or the first two in the unit of
    the main quantity, or the first two; with ellipses of 68 and 95 % of a normal distribution.

    Where the dataset has a ``bias``, the truth (mean estimate - bias) is a cross.  The standard deviations stand above
    the legend with their errors, sigma/sqrt(2 n).
    """
    if variables or (variable := sampled(dataset)) is None:
        raise SweepError("a scatter is of kept samples of several components; choose two with --over, and no variable")
    if dataset["status"].ndim:
        left = ", ".join(f"{d} ({dataset.sizes[d]})" for d in dataset["status"].dims)
        raise SweepError(f"a scatter is of one point; choose it with --at AXIS=VALUE: {left}")
    dimension = next(str(d) for d in dataset[variable].dims if d != "sample")
    known = [str(name) for name in dataset[dimension].values]  # or an index
    dataset = dataset.assign_coords({dimension: known})
    if over and (len(set(over)) != 2 or not set(over) <= set(known)):
        raise SweepError(f"a scatter needs two components of {variable}: {', '.join(known)}; not {', '.join(over)}")
    unit_of = dict(zip(known, quantity.units_along(dataset, variable, [dimension]), strict=True))
    main = dataset[quantity.main_quantity(dataset)].attrs if quantity.quantities(dataset) else {}
    alike = [name for name in known if unit_of[name] == main.get("units")]
    names = list(over or (alike if len(alike) > 1 else known)[:2])
    figure, (axes,) = style.new_figure(5.2, 4.8)
    both = dataset[variable].sel({dimension: names}).transpose(dimension, "sample").values.astype(float)
    both = both[:, np.isfinite(both).all(axis=0)]
    if (n := both.shape[1]) < 3:
        raise SweepError(f"{variable} has {n} samples here; at least 3 are needed")
    units, factor = [unit_of[name] for name in names], 1.0
    if units[0] == units[1]:
        readable, factor = formatting.prefixed(both.std(axis=1), units[0])
        units = [readable, readable]
        axes.set_aspect("equal")
    both *= factor
    mean, covariance = both.mean(axis=1), np.cov(both)
    sigma = np.sqrt(np.diag(covariance))
    style.draw_cloud(axes, both, f"{n} estimates")
    for confidence, line in ((0.683, "solid"), (0.954, "dashed")):
        look = {"linestyle": line, "label": f"{100 * confidence:.0f} % of their normal law"}
        style.draw_ellipse(axes, mean, covariance, confidence, edgecolor=style.COLOURS[1], **look)
    of_mean = sigma / np.sqrt(n)
    if "bias" in dataset and dimension in dataset["bias"].dims:
        truth = mean - factor * dataset["bias"].sel({dimension: names}).values
        axes.plot(*truth, "x", color="black", label="truth", markersize=9.0, markeredgewidth=1.4)
        if (error := quantity.standard_error(dataset, "bias")) is not None:  # estimates of one draw share its bias
            of_mean = factor * error.sel({dimension: names}).values
    axes.errorbar(*mean, *of_mean[::-1], label="mean", **style.marks(1, 3.0))
    words = []
    for which, name, spread, unit in zip("xy", names, sigma, units, strict=True):
        axes.set(**{f"{which}label": style.label(dataset[variable], name, unit)})
        form = formatting.with_error if dataset.attrs.get("n_cat", 1) == 1 else formatting.rounded
        text = form(spread, spread / np.sqrt(2 * n))  # the error holds for estimates of one draw
        words.append(rf"std({style.symbol(name)}) = {text} {formatting.written(unit)}")
    style.legend(figure, title="\n".join([*words, rf"correlation ${covariance[0, 1] / np.prod(sigma):+.2f}$"]))
    return figure


# Analyses: sensitivity indices of parameters, and how a run scales with workers

WORDS = {"first": "first order", "total": "total", "mu_star": r"mean absolute effect $\mu^*$", "sigma": r"$\sigma$"}


def sensitivity_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of indices, lines along a further dimension."""
    kinds = [name for name in WORDS if name in dataset]
    if not np.isfinite(dataset[kinds[0]]).any():
        raise SweepError(f"{dataset.attrs['output']} does not vary: there are no indices to draw")
    further = [str(d) for d in dataset[kinds[0]].dims if d != "parameter" and dataset.sizes[d] > 1]
    dataset = dataset.squeeze([d for d in dataset.dims if d not in ("parameter", *further)])
    effect = "share of the variance" if "first" in kinds else "effect over the range"
    symbols = {n: "+".join(map(style.symbol, n.split("+"))) for n in dataset["parameter"].values.tolist()}
    if further:
        words = {n: dataset[n].assign_attrs(symbol=f"{effect}, {WORDS[n]}") for n in kinds}
        return lines_of(dataset.assign(words), kinds, further[0], "parameter", symbols)
    figure, (axes,) = style.new_figure(6.4, 1.4 + 0.45 * dataset.sizes["parameter"])
    one = dataset.sortby(dataset[kinds[-1] if "total" in kinds else kinds[0]].fillna(0.0))
    parts = {WORDS[kind]: (one[kind].values, one.get(f"{kind}_error")) for kind in kinds}
    style.draw_beside(axes, "y", [symbols[name] for name in one["parameter"].values.tolist()], parts)
    if "first" in kinds:
        axes.set_xlim(right=max(1.02, axes.get_xlim()[1]))  # of the whole variance, and of the errors of all marks
    axes.set_xlabel(style.label(one[kinds[0]].assign_attrs(symbol=effect), kinds[0]))
    return figure


def scaling_figure(dataset: xr.Dataset) -> Figure:
    """Return speed-up over one worker beside efficiency (1 is ideal) against the number of workers, by kind ("strong":
    the same work, "weak": the same work per worker), with the ideal line.
    """
    words = {"speedup": "speed-up over one worker", "efficiency": "efficiency"}
    dataset = dataset.assign({name: dataset[name].assign_attrs(symbol=text) for name, text in words.items()})
    kinds = {kind: f"{kind} scaling" for kind in dataset["kind"].values.tolist()}
    figure, workers = lines_of(dataset, list(words), "workers", "kind", kinds), dataset["workers"].values.astype(float)
    for axes, ideal in zip(figure.axes, (workers, np.ones(len(workers))), strict=True):
        axes.plot(workers, ideal, label="ideal", **style.GUIDE)
        style.logarithmic(axes, "x", workers)
        axes.set_xticks(workers, [f"{w:g}" for w in workers])
        axes.set_xticks([], minor=True)
    style.logarithmic(figure.axes[0], "y", workers)
    axes.set_ylim(0.0, max(1.1, 1.05 * float(np.nanmax(dataset["efficiency"].values))))
    return figure


def lines_of(
    dataset: xr.Dataset, names: list[str], over: str, by: str, words: Mapping[str, str] | None = None
) -> Figure:
    """Return lines of what is no result of a study along an axis, with its errors NAME_error; ``words`` has what the
    values of the other dimension are called, if not as they are.
    """
    errors = {f"{n}_error": f"{n}_mc_error" for n in names if f"{n}_error" in dataset}
    status = dataset[over].dims, np.full(dataset[over].shape, Status.DONE, dtype=np.int8)
    named = dataset[by].assign_attrs(symbols=json.dumps(words or {}))
    dataset = dataset.rename(errors).assign_coords({by: named}).assign(status=status)
    return draw_panels(dataset, names, partial(draw_lines, over=over, numbers={}))
