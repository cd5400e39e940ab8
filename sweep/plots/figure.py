"""Whole figures: which picture suits a dataset, its panels, title and legend."""

from collections.abc import Hashable, Sequence

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from linksweep.sweep.analysis.gaps import with_nan
from linksweep.sweep.analysis.measured_claims import claims_of
from linksweep.sweep.analysis.quantity import main_quantity, numeric_axes, require_quantity, varied_parameters
from linksweep.sweep.analysis.sensitivity import is_sensitivity
from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.planning.point_status import Status, count_status, unfinished_in_words
from linksweep.sweep.plots.kinds import GRID, SCALING
from linksweep.sweep.plots.labels import value_text, with_chosen_component
from linksweep.sweep.plots.named_ticks import fit_names
from linksweep.sweep.plots.scales import SCALE, with_scales
from linksweep.sweep.plots.scatter import sampled
from linksweep.sweep.plots.sensitivity import sensitivity_figure
from linksweep.sweep.plots.standalone import is_scaling
from linksweep.sweep.plots.style import wrapped
from linksweep.sweep.plots.tie.figure import draw_link, is_link
from linksweep.sweep.studies.study import POINT

MAP_POINTS = 5
"""A map is the default if two axes have at least this many points each."""
MAP_PANELS = 6

CURVE_POINTS = 8
"""Curves are the default for points of a table or design if an axis has at least this many values."""


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
    if (log or linear) and "status" not in dataset:
        raise SweepError("only figures of the results of a study have scales to choose")
    if is_link(dataset):
        if variables or over:
            raise SweepError("a figure of a link has no variables and no axis to choose, only its kind")
        return draw_link(dataset, kind)
    if kind is not None and kind not in (known := [*GRID, *SCALING]):
        raise SweepError(f"no kind {shown(kind)}{suggest(kind, known)}")
    if is_sensitivity(dataset):
        if kind is not None or variables or over:
            raise SweepError("a figure of sensitivity indices has nothing to choose")
        return sensitivity_figure(dataset)
    if is_scaling(dataset):
        if kind not in (None, *SCALING):
            raise SweepError(f"no {kind} of this; possible is {' or '.join(SCALING)}")
        figure: Figure = SCALING[kind or next(iter(SCALING))].load()(dataset)
        return figure
    dataset = with_nan(dataset)
    only_samples = dataset["status"].size == 1 and not variables and not any(name in dataset.coords for name in over)
    if sampled(dataset) is not None and (kind == "scatter" or (kind is None and only_samples)):
        with_scales(dataset, (), log, linear)
        return _drawn(dataset, dataset.squeeze(_single(dataset)), "scatter", list(variables), over)
    if (dataset["status"].values == Status.EXCLUDED).all():
        raise SweepError("every point is excluded by the study")
    names = list(variables) or [main_quantity(dataset)]
    _require_values(dataset, names)
    dataset = with_scales(dataset, [*names, *map(str, dataset.coords)], log, linear)
    part = with_chosen_component(_without_single(dataset, over))
    possible = possible_kinds(part, names[0])
    chosen = kind or _suitable(part, names[0], over)
    if chosen not in possible:
        raise SweepError(f"no {chosen} of {names[0]} here; possible are {', '.join(possible) or 'none'}")
    return _drawn(dataset, part, chosen, names, over)


def possible_kinds(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the kinds of picture that a quantity of a dataset can have."""
    if is_scaling(dataset):
        return list(SCALING)
    return [name for name, kind in GRID.items() if kind.load().possible(dataset, variable)]


def _drawn(whole: xr.Dataset, part: xr.Dataset, kind: str, variables: list[str], over: Sequence[str]) -> Figure:
    figure: Figure = GRID[kind].load().draw(part, variables, over)
    _title(figure, whole, part)
    fit_names(figure)
    return figure


def _suitable(dataset: xr.Dataset, variable: str, over: Sequence[str]) -> str:
    varied = varied_parameters(dataset)
    if POINT in dataset[variable].dims and varied and all(name in varied for name in over):
        own = [name for name in numeric_axes(dataset, variable) if dataset[name].size >= CURVE_POINTS]
        return "curves" if own and not over else "points"
    if POINT in dataset[variable].dims and varied and len(over) == 1:
        return "curves"
    if len(over) == 2:
        return "map"
    laws = {(claim.slope.variable, claim.slope.over) for claim in claims_of(dataset) if claim.slope is not None}
    stated = any((variable, axis) in laws for axis in numeric_axes(dataset, variable))
    linear = any(dataset[name].attrs.get(SCALE) == "linear" for name in (variable, *numeric_axes(dataset, variable)))
    if stated and not over and not linear and len(dataset[variable].dims) == 1:
        return "law"
    long = {dataset[a].dims[0] for a in numeric_axes(dataset, variable) if dataset[a].size >= MAP_POINTS}
    panels = int(np.prod([n for d, n in dataset[variable].sizes.items() if d not in long], dtype=int))
    return "map" if not over and len(long) == 2 and panels <= MAP_PANELS else "lines"


def _title(figure: Figure, whole: xr.Dataset, drawn: xr.Dataset) -> None:
    """Write the title of the study, the values that all points share, and whether points are missing."""
    axes = [str(n) for n, c in drawn.coords.items() if not c.dims and not str(n).endswith("_unit")]
    shared = ", ".join(value_text(drawn, name, drawn[name].item()) for name in axes)
    status = drawn["status"].values
    missing = int(np.sum((status != Status.DONE) & (status != Status.EXCLUDED)))
    words = f"INCOMPLETE: {missing:,} of {status.size:,} points are not done" if missing else ""
    lines = filter(None, (str(whole.attrs.get("title", "")), shared, words))
    figure.suptitle(wrapped("\n".join(lines), figure), fontsize="medium")


def _without_single(dataset: xr.Dataset, over: Sequence[str]) -> xr.Dataset:
    """Return the dataset without dimensions of one value, except one to draw along if all are."""
    single = [d for d in _single(dataset) if d not in over]
    if len(single) == dataset["status"].ndim and single:
        single = single[1:]
    return dataset.squeeze(single)


def _single(dataset: xr.Dataset) -> list[Hashable]:
    return [d for d in dataset["status"].dims if dataset.sizes[d] == 1]


def _require_values(dataset: xr.Dataset, names: list[str]) -> None:
    """Raise SweepError for what is no quantity or has several units, and where none has a value."""
    for name in names:
        require_quantity(dataset, name)
        _require_one_unit(dataset, name)
    if not any(np.isfinite(dataset[name].values).any() for name in names):
        unfinished = unfinished_in_words(count_status(dataset["status"].values))
        why = f": of {dataset['status'].size:,} points {unfinished}" if unfinished else ""
        raise SweepError(f"{' and '.join(names)}: there is no value to draw here{why}")


def _require_one_unit(dataset: xr.Dataset, variable: str) -> None:
    """Raise SweepError for components of different units, which cannot share an axis."""
    for dimension in dataset[variable].dims:
        units = dataset.coords.get(f"{dimension}_unit")
        if units is not None and len(set(units.values.tolist())) > 1:
            raise SweepError(
                f"{variable} has components in {' and '.join(dict.fromkeys(units.values.tolist()))}; choose one with "
                f"--at {dimension}={dataset[dimension].values[0]}"
            )
