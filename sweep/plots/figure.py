"""The figure of a dataset: the kind that suits it or that is asked for, with its title, its caption, and a description
for those who cannot see it.
"""

import re
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import xarray as xr
from matplotlib import container, lines
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from linksweep.sweep import formatting
from linksweep.sweep.analysis import answer, quantity
from linksweep.sweep.contract import Status, SweepError, shown, suggest
from linksweep.sweep.plots import KINDS, grid, style
from linksweep.sweep.result import Result
from linksweep.sweep.studies.study import POINT

# A map is the default if two axes have at least this many points each, and it has at most so many panels; curves are
# the default for points of a table or design if an axis has at least so many values.
MAP_POINTS, MAP_PANELS, CURVE_POINTS = 5, 6, 8

_DATE = re.compile(r"\d{4}-\d\d-\d\d([T ]\d\d(:\d\d(:\d\d(\.\d+)?)?)?)?")

MOST_PANELS = 6  # that a description names
MOST_RANGES = 3  # quantities or components whose ranges a caption gives

# What no label of a figure explains.
UNLABELLED = {
    grid.ERROR_BAND: "Bands join the errors of the points.",
    grid.PREDICTION_BAND: "Vertical bars behind dashes are the one-sigma errors of the predictions.",
    grid.LAW_BAND: "Bands are the one-sigma errors of the fitted laws.",
    grid.JOINED: "Thin lines join the points.",
    grid.ALONE: "Markers are points without a neighbour on their line.",
    grid.RUNNING: "Markers with a white centre are values so far, of points that are not done.",
    grid.WITHOUT: "Dotted lines are points on which the parameter along the axis has no effect.",
    style.MOVED: "Markers that cover each other are drawn a little to the left or right of them; lines are not.",
}


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
    Raises SweepError for a kind that the dataset cannot have, naming those that it can.
    """
    result = Result(dataset)
    if result.kind == "grid":
        return _study_figure(style.with_scales(dataset, log, linear), kind, list(variables), over)
    if variables or over or log or linear:
        raise SweepError(f"a figure of a {result.kind} has no variables, axes and scales to choose, only its kind")
    if not (kinds := KINDS.get(result.kind, {})):
        raise SweepError(f"there is no figure of a {result.kind}")
    if kind is not None and kind not in kinds:
        raise SweepError(f"no kind {shown(kind)} of a {result.kind}{suggest(kind, list(kinds))}")
    problems = []
    for name in [kind] if kind else kinds:  # the first that is possible; if none is, the first says what is missing
        try:
            return _titled(result, name)
        except SweepError as problem:
            problems.append(problem)
    raise problems[0]


def all_figures(result: Result) -> dict[str, Figure]:
    """Return all figures that a result other than that of a study can have, by kind."""
    figures = {}
    for name in KINDS[result.kind]:
        with suppress(SweepError):  # says what the dataset lacks
            figures[name] = _titled(result, name)
    return figures


def _titled(result: Result, kind: str) -> Figure:
    """Return a figure with its title, and with what it shows as its label, for the caption."""
    one = KINDS[result.kind][kind]
    figure: Figure = one.load()(result.dataset)
    title = "\n".join(filter(None, [result.title, result.subtitle]))
    figure.set_label(": ".join(filter(None, [one.caption, title.replace("\n", "; ")])))
    style.complete(figure, title)
    return figure


# Results of a study


def _study_figure(dataset: xr.Dataset, kind: str | None, variables: list[str], over: Sequence[str]) -> Figure:
    if not (kind or variables or over):
        dataset, kind, variables, over = _as_its_study_says(dataset)
    dataset = _with_dates(dataset)
    single = [d for d in dataset["status"].dims if dataset.sizes[d] == 1]
    one_point = len(single) == dataset["status"].ndim
    only_samples = one_point and not variables and not any(name in dataset.coords for name in over)
    if grid.sampled(dataset) is not None and (kind == "scatter" or (kind is None and only_samples)):
        return _draw(dataset, dataset.squeeze(single), "scatter", variables, over)
    if (dataset["status"].values == Status.EXCLUDED).all():
        raise SweepError("every point is excluded by the study")
    names = variables or [quantity.main_quantity(dataset)]
    for name in names:
        quantity.require_quantity(dataset, name)
    dataset = dataset.assign_coords({d: dataset[d] for name in names for d in dataset[name].dims})
    dataset = _where_known(dataset, names[0])
    _require_values(dataset, names)
    unused = [d for d in single if d not in over]
    # something has to be drawn along
    part = style.with_chosen_component(dataset.squeeze(unused[len(unused) == dataset["status"].ndim :]))
    possible = [name for name, one in KINDS["grid"].items() if one.load().possible(part, names[0])]
    chosen = kind or _suitable(part, names[0], over)
    if chosen not in possible:
        raise SweepError(f"no {chosen} of {names[0]} here; possible are {', '.join(possible) or 'none'}")
    if chosen in ("law", "map", "pairs") and len(names) > 1:
        raise SweepError(f"a figure of the kind {chosen} is of one variable, not of {', '.join(names)}")
    return _draw(dataset, part, chosen, names, over)


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


def _suitable(dataset: xr.Dataset, variable: str, over: Sequence[str]) -> str:
    array, numeric = dataset[variable], quantity.numeric_axes(dataset, variable)
    varied = quantity.varied_parameters(dataset)
    if POINT in array.dims and varied and all(name in varied for name in over):
        is_long = any(dataset[n].size >= CURVE_POINTS for n in quantity.numeric_axes(dataset, variable, "ifM"))
        return "curves" if not over and is_long else "points"
    if POINT in array.dims and varied and len(over) == 1:
        return "curves"
    if len(over) == 2:
        return "map"
    slopes = [claim.slope for claim in quantity.claims_of(dataset) if claim.slope is not None]
    laws = [(slope.variable, slope.over) for slope in slopes]
    linear = any(dataset[name].attrs.get(style.SCALE) == "linear" for name in (variable, *numeric))
    is_law = any((variable, axis) in laws for axis in numeric) and not (dataset["status"] == Status.RUNNING).any()
    if is_law and not over and not linear and array.ndim == 1:
        return "law"
    long = {dataset[a].dims[0] for a in numeric if dataset[a].size >= MAP_POINTS}
    panels = int(np.prod([n for d, n in array.sizes.items() if d not in long], dtype=int))
    return "map" if not over and len(long) == 2 and panels <= MAP_PANELS else "lines"


def _draw(whole: xr.Dataset, part: xr.Dataset, kind: str, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure with the title of the study, the values that all points share, and whether points are missing."""
    figure: Figure = KINDS["grid"][kind].load().draw(part, variables, over)
    axes = [str(n) for n, c in part.coords.items() if not c.dims and not str(n).endswith("_unit")]
    shared = style.values_text(part, {name: quantity.listed(part, name, [])[0] for name in axes})
    words = f"INCOMPLETE: {quantity.lacking(part)}" if _is_unfinished(part) else ""
    figure.set_label(title := str(whole.attrs.get("title", "")))
    style.complete(figure, "\n".join(filter(None, (title, shared, words))))
    return figure


def _is_unfinished(dataset: xr.Dataset) -> bool:
    return not bool(dataset["status"].isin([Status.DONE, Status.EXCLUDED]).all())


def _require_values(dataset: xr.Dataset, names: list[str]) -> None:
    """Raise SweepError for components of several units, which cannot share an axis, and where none has a value."""
    for name in names:
        for dimension in dataset[name].dims:
            units = dataset.coords.get(f"{dimension}_unit", xr.DataArray([""]))
            if len(several := dict.fromkeys(units.values.tolist())) > 1:
                how = f"choose one with --at {dimension}={dataset[dimension].values[0]}"
                raise SweepError(f"{name} has components in {' and '.join(several)}; {how}")
    if not any(np.isfinite(dataset[name].values).any() for name in names):
        why = f": {quantity.lacking(dataset)}" if _is_unfinished(dataset) else ""
        raise SweepError(f"{' and '.join(names)}: there is no value to draw here{why}")


# Captions


def caption_and_description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return the text of a file beside a picture: its caption, and a description under a heading of its own."""
    return f"{caption(figure, dataset, with_answer=True)}\n\nAlternative text: {description(figure, dataset)}\n"


def caption(figure: Figure, dataset: xr.Dataset, with_answer: bool = False) -> str:
    """Return the caption: the title, what the signs mean, and on request the answer of the study, or else the ranges
    of what is drawn.
    """
    title = str(figure.get_label())
    parts = [f"{title}." if title and not title.endswith((".", "?", "!")) else title, *_signs(figure, dataset)]
    if with_answer and "status" in dataset:
        sentences = answer.conclusion_in_words(dataset) or _ranges(figure, dataset)
        parts += map(formatting.with_micro_signs, [*answer.completeness(dataset), *sentences])
    return " ".join(filter(None, parts))


def description(figure: Figure, dataset: xr.Dataset) -> str:
    """Return what is seen: the panels, what each draws against what, and the range of values."""
    panels, signs = style.panels_of(figure), list(style.legend_entries(figure))
    labels = (str(artist.get_label()) for axes in panels for artist in style.labelled(axes))
    signs += [label.removeprefix(style.AT_END) for label in labels if label.startswith(style.AT_END)]
    bars = [axes.get_ylabel() for axes in figure.axes if axes not in panels and axes.get_ylabel()]
    drawn = (" against ".join(filter(None, [_label(axes, "y"), _label(axes, "x")])) or "a picture" for axes in panels)
    titles = formatting.first_of([title for axes in panels if (title := axes.get_title())], MOST_PANELS, "; ")
    parts = [
        f"Drawn: {formatting.first_of(list(dict.fromkeys(drawn)), MOST_PANELS, '; ')}",
        ": ".join(filter(None, [f"{len(panels)} panels", titles])) if len(panels) > 1 else "",
        f"Colours: {' and '.join(bars)}" if bars else "",
        f"Legend: {', '.join(signs)}" if len(signs) > 1 else "",
    ]
    sentences = [f"{text}." for text in map(style.plain, filter(None, parts))]
    return " ".join([*sentences, *map(formatting.with_micro_signs, _ranges(figure, dataset))])


def _signs(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return a sentence for each kind of sign in a figure that its labels do not explain."""
    entries = style.legend_entries(figure)
    labels = {artist.get_label() for axes in figure.axes for artist in axes.get_children()}
    drawn = dict.fromkeys(str(axes.get_label()) for axes in figure.axes if _has_error_bars(axes))
    names = [name for name in drawn if name in dataset]
    sentences = []
    if any(quantity.standard_error(dataset, name) is not None for name in names):
        sentences.append("Points are simulated, with one-sigma errors.")
    declared = dict.fromkeys(bars[0] for name in names if (bars := quantity.errors_beside(dataset, name)))
    sentences += [f"Error bars are {name}." for name in declared]
    if style.PREDICTED in entries:
        dashes = isinstance(entries[style.PREDICTED], lines.Line2D)
        sentences.append(f"{'Dashes are predicted' if dashes else 'The prediction is'} in closed form.")
    if style.PUBLISHED in entries:
        sources = sorted({str(v.attrs["source"]) for v in dataset.data_vars.values() if "source" in v.attrs})
        sentences.append(": ".join(filter(None, ["Open symbols are published", "; ".join(sources)])) + ".")
    return sentences + [words for label, words in UNLABELLED.items() if label in labels]


def _has_error_bars(axes: Axes) -> bool:
    known = [one for one in axes.containers if isinstance(one, container.ErrorbarContainer)]
    bars = [one for one in known if one.has_xerr or one.has_yerr]
    return any(str(one.get_label()).lstrip("_") != style.PUBLISHED for one in bars)


def _ranges(figure: Figure, dataset: xr.Dataset) -> list[str]:
    """Return a sentence about the values of each quantity that a figure draws: the labels of its axes."""
    if "status" not in dataset:
        return []
    sentences, variables = [], style.with_chosen_component(dataset).data_vars.items()
    for drawn in dict.fromkeys(str(axes.get_label()) for axes in figure.axes if axes.get_label() in dataset):
        alone = dataset.assign({name: array.assign_attrs(headline=name == drawn) for name, array in variables})
        for one in answer.answers(alone):
            meaning = f" ({one.meaning})" if one.meaning else ""
            sentences += [f"{one.name}{meaning}: {sentence}" for sentence in one.sentences[:1]]
    return sentences[:MOST_RANGES]


def _label(axes: Axes, which: str) -> str:
    """Return the label of an axis, or that of the axes that share it and have one."""
    siblings = getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = (getattr(one, f"get_{which}label")() for one in (axes, *siblings))
    return next(filter(None, labels), "")
