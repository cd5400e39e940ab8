"""The figure of a dataset: the kind that suits it or that is asked for, with its title."""

from collections.abc import Hashable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from linksweep.sweep.analysis.quantity import (
    claims_of,
    main_quantity,
    numeric_axes,
    require_quantity,
    varied_parameters,
)
from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.planning.point_status import Status, count_status, unfinished_in_words
from linksweep.sweep.plots import KINDS
from linksweep.sweep.plots.analyses import sensitivity_figure
from linksweep.sweep.plots.points import sampled
from linksweep.sweep.plots.style import SCALE, entitle, fit_names, value_text, with_chosen_component, with_scales
from linksweep.sweep.result import Result
from linksweep.sweep.studies.study import POINT

# A map is the default if two axes have at least this many points each, and it has at most so many panels; curves are
# the default for points of a table or design if an axis has at least so many values.
MAP_POINTS, MAP_PANELS, CURVE_POINTS = 5, 6, 8


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
    what = Result(dataset).kind
    if what == "grid":
        return _study_figure(dataset, kind, variables, over, log, linear)
    if log or linear:
        raise SweepError("only figures of the results of a study have scales to choose")
    if variables or over:
        raise SweepError(f"a figure of a {what} has no variables and no axis to choose, only its kind")
    if what == "sensitivity" and kind is None:
        return sensitivity_figure(dataset)
    kinds = KINDS.get(what, {})
    if kind is None and not kinds:
        raise SweepError(f"there is no figure of a {what}")
    # the first that is possible; if none is, the first says what is missing
    kind = kind or next(iter(all_figures(dataset)), next(iter(kinds)))
    if kind not in kinds:
        raise SweepError(f"no kind {shown(kind)} of a {what}{suggest(kind, list(kinds)) if kinds else ''}")
    return _titled(dataset, what, kind)


def all_figures(dataset: xr.Dataset, titled: bool = True) -> dict[str, Figure]:
    """Return all figures that a link or a forecast can have, by kind."""
    figures, what = {}, Result(dataset).kind
    for name in KINDS[what]:
        with suppress(SweepError):  # says what the dataset lacks
            figures[name] = _titled(dataset, what, name, titled)
    return figures


def _titled(dataset: xr.Dataset, what: str, kind: str, titled: bool = True) -> Figure:
    """Return a figure with its title: of measurements their own, of a link or a forecast its tables."""
    about = dataset.attrs
    figure: Figure = KINDS[what][kind].load()(dataset)
    figure.set_label(kind)  # for the caption
    if titled and "satellite" in about:
        title = f"{Path(about['satellite']).name} and {Path(about['reference']).name}"
        if "sign" in about:
            title += f"\n{about['sign'].replace('-', ' − ')}, epoch {about['epoch']:.2f}, clip {about['clip']}"
        entitle(figure, title)
    return figure


# Results of a study


def possible_kinds(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the kinds of figure that a quantity of the results of a study can have."""
    return [name for name, kind in KINDS["grid"].items() if kind.load().possible(dataset, variable)]


def _study_figure(
    dataset: xr.Dataset,
    kind: str | None,
    variables: Sequence[str],
    over: Sequence[str],
    log: Sequence[str],
    linear: Sequence[str],
) -> Figure:
    single = [d for d in dataset["status"].dims if dataset.sizes[d] == 1]
    one_point = len(single) == dataset["status"].ndim
    only_samples = one_point and not variables and not any(name in dataset.coords for name in over)
    if sampled(dataset) is not None and (kind == "scatter" or (kind is None and only_samples)):
        with_scales(dataset, (), log, linear)  # none can be chosen
        return _draw(dataset, dataset.squeeze(single), "scatter", list(variables), over)
    if (dataset["status"].values == Status.EXCLUDED).all():
        raise SweepError("every point is excluded by the study")
    names = list(variables) or [main_quantity(dataset)]
    _require_values(dataset, names)
    dataset = with_scales(dataset, [*names, *map(str, dataset.coords)], log, linear)
    unused: list[Hashable] = [d for d in single if d not in over]
    if len(unused) == dataset["status"].ndim:
        unused = unused[1:]  # something has to be drawn along
    part = with_chosen_component(dataset.squeeze(unused))
    possible = possible_kinds(part, names[0])
    chosen = kind or _suitable(part, names[0], over)
    if chosen not in possible:
        raise SweepError(f"no {chosen} of {names[0]} here; possible are {', '.join(possible) or 'none'}")
    return _draw(dataset, part, chosen, names, over)


def _suitable(dataset: xr.Dataset, variable: str, over: Sequence[str]) -> str:
    array, varied, numeric = dataset[variable], varied_parameters(dataset), numeric_axes(dataset, variable)
    if POINT in array.dims and varied and all(name in varied for name in over):
        return "curves" if not over and any(dataset[name].size >= CURVE_POINTS for name in numeric) else "points"
    if POINT in array.dims and varied and len(over) == 1:
        return "curves"
    if len(over) == 2:
        return "map"
    laws = {(claim.slope.variable, claim.slope.over) for claim in claims_of(dataset) if claim.slope is not None}
    linear = any(dataset[name].attrs.get(SCALE) == "linear" for name in (variable, *numeric))
    if any((variable, axis) in laws for axis in numeric) and not over and not linear and array.ndim == 1:
        return "law"
    long = {dataset[a].dims[0] for a in numeric if dataset[a].size >= MAP_POINTS}
    panels = int(np.prod([n for d, n in array.sizes.items() if d not in long], dtype=int))
    return "map" if not over and len(long) == 2 and panels <= MAP_PANELS else "lines"


def _draw(whole: xr.Dataset, part: xr.Dataset, kind: str, variables: list[str], over: Sequence[str]) -> Figure:
    """Return a figure with the title of the study, the values that all points share, and whether points are missing."""
    figure: Figure = KINDS["grid"][kind].load().draw(part, variables, over)
    axes = [str(n) for n, c in part.coords.items() if not c.dims and not str(n).endswith("_unit")]
    shared = ", ".join(value_text(part, name, part[name].item()) for name in axes)
    status = part["status"].values
    missing = int(np.sum((status != Status.DONE) & (status != Status.EXCLUDED)))
    words = f"INCOMPLETE: {missing:,} of {status.size:,} points are not done" if missing else ""
    entitle(figure, "\n".join(filter(None, (str(whole.attrs.get("title", "")), shared, words))))
    fit_names(figure)
    return figure


def _require_values(dataset: xr.Dataset, names: list[str]) -> None:
    """Raise SweepError for what is no quantity or has components of several units, which cannot share an axis, and
    where none has a value.
    """
    for name in names:
        require_quantity(dataset, name)
        for dimension in dataset[name].dims:
            units = dataset.coords.get(f"{dimension}_unit")
            several = [] if units is None else list(dict.fromkeys(units.values.tolist()))
            if len(several) > 1:
                raise SweepError(
                    f"{name} has components in {' and '.join(several)}; choose one with "
                    f"--at {dimension}={dataset[dimension].values[0]}"
                )
    if not any(np.isfinite(dataset[name].values).any() for name in names):
        unfinished = unfinished_in_words(count_status(dataset["status"].values))
        why = f": of {dataset['status'].size:,} points {unfinished}" if unfinished else ""
        raise SweepError(f"{' and '.join(names)}: there is no value to draw here{why}")
