"""Figures that know the link: the sky of a catalogue, the accuracy of missions, and links and forecasts of real tables.

Those of `sweep tie` and `sweep forecast` are functions of the dataset.  Each raises SweepError, which says how to get
it, where the dataset lacks what it shows.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import chdtrc, ndtri

from linksweep.core import missions
from linksweep.core.frames import DEGREE, GALACTIC_AXES, Array, galactic, position
from linksweep.core.setup import scenario
from linksweep.core.tie.problem import LARGE_SHARE, sky_cells
from linksweep.sweep import formatting
from linksweep.sweep.analysis.quantity import point_in
from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.planning.plan import generators
from linksweep.sweep.plots import figure as drawing, style
from linksweep.sweep.running.reproduce import study_to_look_at
from linksweep.sweep.stores.location import Where
from linksweep.sweep.stores.store import OpenStore
from linksweep.sweep.studies.reader import parse_places
from linksweep.sweep.studies.study import Study

MAGNITUDE = {"units": "mag", "long_name": "magnitude V", "symbol": "$V$"}
SKY_WIDTH = 45.0  # letters that a map of the sky is wide at least
RANKED = 20  # sources in a ranking
MOST_NAMED = 10  # sources with names in a panel
CLASS_MARKERS = {"certain": "o", "uncertain": "^", "supplement": "s"}  # of matches with galaxies
MANY_ROWS = "they are not kept for tables with so many rows"

MARK: dict[str, Any] = {"color": "0.4", "linestyle": "dotted", "linewidth": 1.0, "label": f"{100.0 * LARGE_SHARE:g} %"}


# The sky


class SkyFrame(NamedTuple):
    """What a map shows: the names of longitude and latitude, and the longitude (deg) in the middle."""

    longitude: str
    latitude: str
    centre_deg: float


# In the middle of the map of the ICRS is 180 deg, where the Galactic plane is a single arch.
ICRS = SkyFrame(r"right ascension $\alpha$ (ICRS)", r"declination $\delta$", 180.0)
GALACTIC = SkyFrame("Galactic longitude $l$", "Galactic latitude $b$", 0.0)


def prepare_sky(axes: Any, frame: SkyFrame = ICRS) -> None:
    """Give axes with the projection "mollweide" a grid labelled in degrees, with longitude increasing to the left."""
    axes.grid(color="0.8", linewidth=0.4)
    axes.set_axisbelow(True)
    axes.set_longitude_grid_ends(90.0)
    ticks = np.arange(-120.0, 121.0, 60.0)
    axes.set_xticks(ticks * DEGREE, [""] * len(ticks))
    look: dict[str, Any] = {"fontsize": "x-small", "ha": "center", "va": "center", "zorder": 6, **style.HALO}
    for tick in ticks:  # text of its own, because labels of an axis lie below all that is drawn
        axes.text(tick * DEGREE, 0.04, f"{(frame.centre_deg - tick) % 360:.0f}°", **look)
    latitudes = np.arange(-60.0, 61.0, 30.0)
    names = [f"{b:+.0f}°".replace("-", "\N{MINUS SIGN}") if b else "0°" for b in latitudes]
    axes.set_yticks(latitudes * DEGREE, names, fontsize="x-small")
    axes.set(xlabel=frame.longitude, ylabel=frame.latitude)


def on_map(longitude_deg: Array, frame: SkyFrame = ICRS) -> Array:
    """Return the map's coordinate of a longitude, in radians: it increases to the left, with 0 in the middle."""
    return np.asarray(-((longitude_deg - frame.centre_deg + 180.0) % 360.0 - 180.0) * DEGREE)


def sky_figure(dataset: xr.Dataset) -> Figure:
    """Return an all-sky map of ``ra`` and ``dec`` (deg), coloured by the magnitude ``v_mag``, with the Galactic plane
    and its centre.
    """
    figure, (axes,) = style.new_figure(7.6, 4.9, subplot_kw={"projection": "mollweide"})
    prepare_sky(axes)
    # bright objects, of small magnitude, on top and dark
    dataset = dataset.isel(object=np.argsort(-dataset["v_mag"].values, kind="stable"))
    look = {"c": dataset["v_mag"], "cmap": "viridis", "linewidths": 0.0, "zorder": 3}
    look["s"] = float(np.clip(4000.0 / dataset.sizes["object"], 1.5, 18.0))
    points = axes.scatter(on_map(dataset["ra"].values), dataset["dec"] * DEGREE, **look)
    bar: dict[str, Any] = {"orientation": "horizontal", "shrink": 0.5, "pad": 0.02, "aspect": 30}
    figure.colorbar(points, ax=axes, label=style.label(dataset["v_mag"], "v_mag"), **bar)
    longitude = np.linspace(0.0, 2.0 * np.pi, 721)
    galactic = np.stack([np.cos(longitude), np.sin(longitude), np.zeros_like(longitude)])
    plane_ra, plane_dec = position(GALACTIC_AXES.T @ galactic)
    x = on_map(plane_ra / DEGREE)
    # in pieces that do not jump from one edge of the map to the other
    broken = np.where(np.abs(np.diff(x, append=x[-1])) > 1.0, np.nan, plane_dec)
    axes.plot(x, broken, color="black", linewidth=0.9, zorder=2, label="Galactic plane")
    axes.plot(x[:1], plane_dec[:1], "k+", label="Galactic centre", markersize=9.0, zorder=4)
    style.complete(figure, str(dataset.attrs.get("title", "")))
    return figure


def galaxy_figure(dataset: xr.Dataset) -> Figure:
    """Return a Mollweide map of matches in Galactic coordinates, by class, over a share of the galaxy catalogues."""
    figure, (axes,) = style.new_figure(7.6, 4.2, subplot_kw={"projection": "mollweide"})
    prepare_sky(axes, GALACTIC)

    def places(*names: str) -> tuple[Array, Array]:
        longitude, latitude = galactic(*(dataset[name].values * DEGREE for name in names))
        return on_map(longitude / DEGREE, GALACTIC), latitude

    drawn, entries = dataset.sizes["entry"], int(dataset.attrs["entries"])
    points: dict[str, Any] = {"linestyle": "none", "marker": ".", "markeredgewidth": 0.0, "color": "#b0b0b0"}
    axes.plot(*places("entry_ra", "entry_dec"), **points, markersize=1.2, zorder=1)
    # a point of the map is too small to be seen in the legend
    share = f", 1 in {round(entries / drawn)} drawn" if drawn < entries else ""
    axes.plot([], [], **points, markersize=4.0, label=f"galaxy catalogues ({entries:,}{share})")
    axes.plot([-np.pi, np.pi], [0.0, 0.0], color="black", linewidth=1.0, zorder=2, label="Galactic plane, $b = 0$")
    x, y = places("ra", "dec")
    look: dict[str, Any] = {"markersize": 5.0, "markeredgecolor": "white", "markeredgewidth": 0.5, "zorder": 4}
    # an object at the edge of the map is shown whole; the layout takes a class without any for one at the corner
    look |= {"clip_on": False, "in_layout": False}
    for (name, marker), colour in zip(CLASS_MARKERS.items(), style.COLOURS, strict=False):
        mine = dataset["class"].values == name
        axes.plot(x[mine], y[mine], marker, color=colour, **look, label=f"{name} ({np.count_nonzero(mine):,})")
    return figure


def catalogue_of_point(store: Where, at: Sequence[str]) -> xr.Dataset:
    """Return the first catalogue of a point of a store as it was drawn: ra, dec (deg) and v_mag of each object.

    Raises SweepError if the store is not of the link, or ``at`` is not one point of it.
    """
    study = study_to_look_at(store)
    point = point_in(OpenStore(store).dataset(), study, parse_places(at), str(store))
    _, rng = generators(study.sampling.seed, point.stream, 0, 0)
    catalogue = scenario(point.parameters).draw_catalogue.draw(rng)
    title = f"{study.title}: the {len(catalogue)} objects of one catalogue"
    places = {name: ("object", getattr(catalogue, name) / DEGREE, {"units": "deg"}) for name in ("ra", "dec")}
    columns = places | {"v_mag": ("object", catalogue.v_mag, MAGNITUDE)}
    return xr.Dataset(columns, attrs={"title": ", ".join([title, *at])})


# The accuracy of missions


def accuracy_figure(dataset: xr.Dataset) -> Figure:
    """Return ``sigma_pm`` beside ``sigma_pos`` (model, v) against the magnitude v, a line for each mission, with a band
    where its error is known.
    """
    if (n := dataset.sizes["model"]) > len(style.COLOURS):
        raise SweepError(f"{n} missions are too many for one picture of {len(style.COLOURS)}: choose --model")
    names, dataset = ["sigma_pm", "sigma_pos"], style.with_literal_texts(dataset)
    dataset = dataset.assign({name: dataset[name].assign_attrs({style.SCALE: "log"}) for name in names})
    figure = drawing.lines_of(dataset, names, "v", "model")
    style.complete(figure, str(dataset.attrs.get("title", "")))
    return figure


def accuracy_curves(chosen: Sequence[str] = (), study: Study | None = None) -> xr.Dataset:
    """Return sigma_pm (mas/yr) and sigma_pos (mas) of one object, dimensions (model, v), of missions at nominal length.

    The missions are those of a study, or all built-in ones whose packages are installed; of them those in ``chosen`` if
    there are any.  Values beyond a mission's faint limit are NaN.  The curves that were calibrated with the paper's
    tables have one-sigma errors ``_error`` from that fit; for others these are NaN.
    Raises SweepError for a study of another experiment, a model that is not there, one whose package is missing, or a
    function that has no value somewhere.
    """
    known: dict[str, Any] = {name: name for name in missions.MISSIONS}
    if study is not None:
        if study.experiment.name != "link":
            raise SweepError(f"only the link has missions; this is the experiment {study.experiment.name}")
        known = {str(model): model for model in study.values["model"]}
    if unknown := [name for name in chosen if name not in known]:
        raise SweepError(f"no model {shown(unknown[0])}{suggest(unknown[0], list(known))}")
    v = np.round(np.linspace(9.0, 21.0, 121), 6)
    rows: dict[str, Sequence[Array]] = {}
    for name in chosen or known:
        try:
            sigma_pos, sigma_pm = missions.mission_of(known[name]).sigmas_to_limit(v)
        except SweepError:
            if chosen or study is not None:
                raise
            continue
        calibrated = missions.CALIBRATED.get(name) if isinstance(known[name], str) else None
        relative = np.full(v.shape, np.nan) if calibrated is None else calibrated.relative_error(v)
        rows[name] = sigma_pm, sigma_pm * relative, sigma_pos, sigma_pos * relative
    pm, pos = {"units": "mas / yr", "symbol": r"$\sigma_\mu$"}, {"units": "mas", "symbol": r"$\sigma_\mathrm{pos}$"}
    attributes = {"sigma_pm": pm, "sigma_pm_error": pm, "sigma_pos": pos, "sigma_pos_error": pos}
    arrays = zip(attributes.items(), zip(*rows.values(), strict=True), strict=True)
    variables = {name: (("model", "v"), np.array(array), its) for (name, its), array in arrays}
    coordinates = {"model": np.array(list(rows), dtype=object), "v": ("v", v, MAGNITUDE)}
    return xr.Dataset(variables, coordinates, {"title": "Accuracy of one object in each mission"})


# What figures of links have in common


def _readable(values: Array, unit: str) -> tuple[float, str]:
    """Return the factor to the unit in which numbers read best, and that unit as people write it."""
    chosen = formatting.prefixed(values, unit)
    return chosen.factor, formatting.written(chosen.unit)


def _symbols(dataset: xr.Dataset) -> list[str]:
    return [style.component_symbol(str(name)) for name in dataset["unknown"].values]


def _unknowns_by(dataset: xr.Dataset, key: str) -> dict[str, list[int]]:
    """Return the indices of the unknowns of each "unit" or "block"."""
    keys = dataset[key].values
    return {str(one): np.flatnonzero(keys == one).tolist() for one in dict.fromkeys(keys.tolist())}


def _vectors(dataset: xr.Dataset) -> dict[str, list[int]]:
    """Return the indices of the unknowns of each block that is a vector."""
    return {name: indices for name, indices in _unknowns_by(dataset, "block").items() if len(indices) == 3}


def _require(dataset: xr.Dataset, name: str, why: str) -> Array:
    """Return a variable's values; raises SweepError that says why a result has none."""
    if name not in dataset:
        raise SweepError(f"no {name.replace('_', ' ')} here: {why}")
    return np.asarray(dataset[name].values)


def _is_kept(dataset: xr.Dataset) -> Any:
    """Return which sources the solution uses."""
    return (dataset["weight_factor"].values > 0.0) & (dataset["n_observations"].values > 0.0)


def _name_points(axes: Axes, x: Array, y: Array, names: Array) -> None:
    """Write names beside points, the first ones first; one that would cover another, or leave the axes, is left out.

    To be called when everything else is drawn and has its place (`Figure.draw_without_rendering`).
    """
    inside, taken = axes.get_window_extent(), list[Any]()
    look: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6.5, "va": "center", "in_layout": False}
    for place, name in zip(zip(x, y, strict=True), names.tolist(), strict=True):
        for side, up, alignment in ((4, 0, "left"), (-4, 0, "right"), (0, 7, "center"), (0, -7, "center")):
            text = axes.annotate(name, place, xytext=(side, up), ha=alignment, **look, **style.HALO)
            box = text.get_window_extent()
            if inside.contains(*box.min) and inside.contains(*box.max) and not box.count_overlaps(taken):
                taken.append(box)
                break
            text.remove()


def _name_bars(figure: Figure, axes: Axes, names: list[str]) -> None:
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_ylim(-0.6, len(names) - 0.4)
    rows = axes.get_gridspec().nrows  # type: ignore[union-attr]
    figure.set_figheight(rows * (1.6 + 0.21 * len(names)))  # whatever the width: each name needs its line


# The solution


def solution_figure(dataset: xr.Dataset) -> Figure:
    """Return the estimates with each kind of error, one panel for each unit."""
    panels, symbols = _unknowns_by(dataset, "unit"), _symbols(dataset)
    widths, kinds = [len(panel) + 1 for panel in panels.values()], dataset["error_kind"].values.tolist()
    width = float(np.clip(1.6 * len(panels) + 0.16 * len(kinds) * sum(widths), 6.4, 16.0))
    figure, grid = style.new_figure(width, 4.2, 1, len(panels), least=1.0, width_ratios=widths)
    for axes, (stored, panel) in zip(grid, panels.items(), strict=True):
        values, errors = dataset["estimate"].values[panel], dataset["errors"].values[:, panel]
        factor, unit = _readable(values, stored)
        parts = {f"{kind} error": (factor * values, factor * one) for kind, one in zip(kinds, errors, strict=True)}
        style.draw_beside(axes, "x", [symbols[k] for k in panel], parts)
        axes.set_ylabel(f"estimate [{unit}]")
    style.legend(figure, least=1)
    return figure


def bin_figure(dataset: xr.Dataset) -> Figure:
    """Return the three components of the spin in each bin."""
    values = _require(dataset, "spin_by_bin", "give --bins COLUMN=EDGES")
    factor, unit = _readable(values, "mas/yr")
    figure, (axes,) = style.new_figure(6.8, 4.2)
    both = zip("xyz", factor * values.T, factor * dataset["spin_by_bin_error"].values.T, strict=True)
    parts = {rf"$\omega_{component}$": (value, error) for component, value, error in both}
    edges = zip(dataset["bin_low"].values.tolist(), dataset["bin_high"].values.tolist(), strict=True)
    words = [f"below {b:g}" if np.isinf(a) else f"from {a:g}" if np.isinf(b) else f"{a:g} to {b:g}" for a, b in edges]
    style.draw_beside(axes, "x", words, parts)
    axes.set(xlabel=str(dataset.attrs.get("bin_column", "bin")), ylabel=f"spin [{unit}]")
    return figure


def trajectory_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of each vector and chi2/dof against the step of the clip; a line marks the chosen step."""
    if "step_estimate" not in dataset or dataset.sizes["step"] < 2:
        raise SweepError("no trajectory here: give --clip discrepancy or median:K, which go step by step")
    parts, dropped = dict[str, Any](), [str(name) for name in dataset["step_dropped"].values]
    for name, block in _vectors(dataset).items():
        about = {"units": str(dataset["unit"].values[block[0]]), "symbol": name.replace("_", " ")}
        for key, values in ((name, "step_estimate"), (f"{name}_error", "step_error")):
            parts[key] = ("step", "component"), dataset[values].values[:, block], about
    ratio = dataset["step_chi2"] / dataset["step_dof"].where(dataset["step_dof"] > 0)
    parts["ratio"] = ("step",), ratio.values, {"symbol": r"$\chi^2$/dof"}
    words = "sources dropped, one after the other" if any(dropped) else "iteration of the clip"
    coordinates = {"step": ("step", np.arange(len(dropped)), {"symbol": words}), "component": list("xyz")}
    names = [name for name in parts if not name.endswith("_error")]
    figure = drawing.lines_of(xr.Dataset(parts, coordinates), names, "step", "component")
    for artist in style.labelled(figure.axes[-1]):  # its axis says what it is
        artist.set_label("")
    for axes in figure.axes:
        axes.axvline(int(dataset["step_chosen"]), label="the step of the solution", **style.GUIDE)
        axes.xaxis.set_major_locator(ticker.MaxNLocator(integer=True))
        if any(dropped) and len(dropped) <= RANKED:
            axes.set_xticks(range(len(dropped)), ["all", *dropped[1:]], rotation=90, fontsize=7)
    figure.axes[-1].axhline(1.0, color="0.6", linewidth=0.6, zorder=0)
    return figure


def jackknife_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of each pair of components of each vector, with the solutions without each source and an ellipse
    for each kind of error.  Distances of solutions from the mean are multiplied by sqrt(N - 1), so that
    their scatter is the jackknife error.
    """
    without = _require(dataset, "estimate_without", MANY_ROWS)
    vectors, symbols = _vectors(dataset), _symbols(dataset)
    kept = _is_kept(dataset) & np.isfinite(without).all(axis=1)
    without = without[kept]
    if not vectors or len(without) < 2:
        raise SweepError("no jackknife scatter: no block of unknowns is a vector that more than one source determines")
    stretched = without.mean(axis=0) + np.sqrt(len(without) - 1.0) * (without - without.mean(axis=0))
    figure, grid = style.new_figure(10.0, 3.4 * len(vectors) + 0.5, len(vectors), 3)
    pairs = [pair for block in vectors.values() for pair in combinations(block, 2)]
    for axes, pair in zip(grid, map(list, pairs), strict=True):
        factor, unit = _readable(stretched[:, pair], str(dataset["unit"].values[pair[0]]))
        style.draw_cloud(axes, factor * stretched[:, pair].T, "without one source, displacement × √(N − 1)")
        for number, kind in enumerate(dataset["error_kind"].values):
            covariance = factor**2 * dataset["covariances"].values[number][np.ix_(pair, pair)]
            if np.all(np.isfinite(covariance)):
                look = {"edgecolor": style.COLOURS[1 + number % 7], "linestyle": style.LINES[number % len(style.LINES)]}
                look |= {"label": f"{kind}, 68 %", "zorder": 4}
                style.draw_ellipse(axes, factor * dataset["estimate"].values[pair], covariance, 0.683, **look)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(**{f"{which}label": f"{symbols[k]} [{unit}]" for which, k in zip("xy", pair, strict=True)})
        axes.margins(0.12)
        axes.autoscale_view()
    return figure


def spectrum_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of the root of the power of each field by degree, with the noise, and its significance below."""
    _require(dataset, "power", "no vector spherical harmonics are among the unknowns (--degree)")
    degree, most = dataset["degree"].values, 10.0
    fields = [str(field) for field in dataset["field"].values]
    parts = [part for part in ("position", "motion") if any(name.startswith(part) for name in fields)]
    size = 1.4 + 4.6 * len(parts), 5.4
    figure, grid = style.new_figure(*size, 2, len(parts), least=1.0, sharex=True, height_ratios=(3, 2))
    for part, upper, lower in zip(parts, grid, grid[len(parts) :], strict=False):
        chosen = dataset.sel(field=[name for name in fields if name.startswith(part)])
        for number, field in enumerate(chosen["field"].values):
            one, kind, x = chosen.sel(field=field), str(field).partition(" ")[2], degree + 0.06 * (2 * number - 1)
            look = style.marks(number, 5.0)
            signal, noise = (1000.0 * np.sqrt(one[name].values) for name in ("power", "power_noise"))
            upper.plot(x, signal, label=kind, **look)
            upper.plot(x, noise, color=look["color"], markersize=10.0, label=f"noise, {kind}", **style.DASH)
            significance = -ndtri(np.clip(one["power_probability"].values, 1e-300, 1.0))
            lower.plot(x, np.minimum(significance, most), **look)
        style.logarithmic(upper, "y", 1000.0 * np.sqrt(chosen[["power", "power_noise"]].to_array().values))
        upper.set_ylabel(rf"$\sqrt{{P_l}}$ of the {part}s [µas{'/yr' if part == 'motion' else ''}]")
        lower.axhline(3.0, color="0.4", linestyle="dashed", linewidth=1.0)
        lower.set(ylim=(-2.6, most + 0.8), ylabel=r"significance [$\sigma$]", xlabel="degree $l$")
        lower.set_yticks([0.0, 3.0, most], ["0", "3", f"≥ {most:g}"])
        lower.xaxis.set_major_locator(ticker.MaxNLocator(integer=True))
        lower.set_xlim(degree.min() - 0.5, degree.max() + 0.5)
    return figure


# The sources


def separation_figure(dataset: xr.Dataset) -> Figure:
    """Return the shares of sources beyond each normalised separation, X before the fit and the X that is as rare as Q
    of n observations after it, beside the Rayleigh distribution that they follow if the errors are right.
    """
    before, count = _require(dataset, "normalised_separation", MANY_ROWS), dataset["n_observations"].values
    used = (count > 0.0) & (before > 0.0)
    if not np.any(used):
        raise SweepError("no source has a separation: no row has a position or motion that the satellite predicts")
    before, beyond = before[used], chdtrc(count[used], dataset["discrepancy"].values[used])
    after = np.sqrt(-2.0 * np.log(np.maximum(beyond, 1e-300)))  # which may underflow
    n, top = len(before), max(float(before.max()), 5.0)
    x = np.geomspace(0.1, top, 400)
    figure, (axes,) = style.new_figure(6.4, 4.2)
    for number, (one, label) in enumerate([(before, "before the fit, $X$"), (after, "after it, as rare as $Q_i$")]):
        look = {"color": style.COLOURS[number], "linestyle": style.LINES[number], "linewidth": 1.2, "label": label}
        axes.step([x[0], *np.sort(one)], [1.0, *(np.arange(n, 0, -1) / n)], **look)
    axes.plot(x, np.exp(-0.5 * x**2), color="black", linewidth=1.2, label="Rayleigh: the errors are right")
    limit = np.sqrt(2.0 * np.log(max(int(np.sum(count > 0.0)), 2)))
    axes.axvline(limit, color="0.4", linestyle="dashed", linewidth=1.0, label=rf"$\sqrt{{2\ln N}}$ = {limit:.2f}")
    style.logarithmic(axes, "x", x)
    style.logarithmic(axes, "y", np.array([1.0 / n, 1.0]))
    axes.set(xlim=(x[0], 1.1 * top), ylim=(0.7 / n, 1.3), xlabel="normalised separation")
    axes.set_ylabel(f"share of {n} sources beyond it")
    return figure


def weight_figure(dataset: xr.Dataset) -> Figure:
    """Return a figure of Q/n of each source against its share of the weight of each block that is solved for."""
    share, kept, names = _require(dataset, "share", MANY_ROWS), _is_kept(dataset), dataset["source"].values
    count, discrepancy = dataset["n_observations"].values, dataset["discrepancy"].values
    ratio = np.divide(discrepancy, count, out=np.full(len(names), np.nan), where=count > 0.0)
    ratio = np.maximum(ratio, max(np.min(ratio, where=ratio > 0.0, initial=1e-3), 1e-4))  # 0 has no place on a log axis
    gone, blocks = (count > 0.0) & ~kept, dataset["block_name"].values
    size = max(6.4, 0.8 + 3.8 * len(blocks)), 4.2
    figure, grid = style.new_figure(*size, 1, len(blocks), style.WIDE, sharey=True)
    dots = {"s": 14.0 if len(names) < 300 else 4.0, "color": style.COLOURS[0], "alpha": 0.6, "linewidths": 0.0}
    crosses = {"s": 16.0, "color": style.COLOURS[1], "marker": "x", "linewidths": 0.8}
    for axes, name, weight in zip(grid, blocks, share.T, strict=True):
        some = kept & (weight > 0.0)
        axes.scatter(weight[some], ratio[some], label="kept", **dots)
        if np.any(gone):
            left = np.full(gone.sum(), 0.5 * weight[some].min())
            axes.scatter(left, ratio[gone], label="dropped, of no weight", **crosses)
        axes.axhline(1.0, color="black", linewidth=0.8, zorder=1)
        axes.axvline(LARGE_SHARE, zorder=1, **MARK)
        style.logarithmic(axes, "x", weight[some])
        style.logarithmic(axes, "y", ratio)
        axes.set_xlabel(f"share of the weight in {str(name).replace('_', ' ')}")
        axes.margins(0.08)
        axes.set_title(f"{some.sum()} kept" + (f", {gone.sum()} dropped" if np.any(gone) else ""))
    grid[0].set_ylabel("$Q_i/n_i$ (1 is expected)")
    style.legend(figure)  # which makes the panels what they are when points are named
    figure.draw_without_rendering()
    for axes, weight in zip(grid, share.T, strict=True):
        matters = np.where(kept, weight * np.nan_to_num(ratio), 0.0)  # most at the upper right
        chosen = np.argsort(-matters)[: min(MOST_NAMED, np.count_nonzero(matters))]
        _name_points(axes, weight[chosen], ratio[chosen], names[chosen])
    return figure


def influence_figure(dataset: xr.Dataset) -> Figure:
    """Return the sources with the largest shares of the weight, and how far the solution moves without each."""
    share = _require(dataset, "share", MANY_ROWS)
    order = np.argsort(-share.max(axis=1))[:RANKED]
    order = order[share.max(axis=1)[order] > 0.0][::-1]
    figure, (left, right) = style.new_figure(8.0, 1.4, 1, 2, least=1.0, sharey=True)
    y, height = np.arange(len(order)), 0.8 / share.shape[1]
    for number, name in enumerate(dataset["block_name"].values):
        look = {"color": style.COLOURS[number % len(style.COLOURS)], "label": str(name).replace("_", " ")}
        left.barh(y + 0.4 - (number + 0.5) * height, share[order, number], height, **look)
    if share.max() > LARGE_SHARE / 3.0:  # else the mark would leave the bars no room
        left.axvline(LARGE_SHARE, **MARK)
    right.barh(y, np.nan_to_num(dataset["cook_distance"].values[order]), 0.7, color=style.COLOURS[5])
    for axes, words in ((left, "share of the weight"), (right, "Cook's distance")):
        axes.xaxis.set_major_locator(ticker.MaxNLocator(5 if figure.get_figwidth() > 6.0 else 2))
        axes.set_xlabel(words)
    left.xaxis.set_major_formatter(lambda share, _: f"{100.0 * share:g} %")
    _name_bars(figure, left, dataset["source"].values[order].tolist())
    return figure


# Differences and residuals as arrows on the sky

MOST_ARROWS = 150  # more rows than this are averaged in cells of equal area
BANDS = 9
# Arrows of the length that 90 % of them do not exceed take the share TYPICAL of the width of the map; longer ones are
# cut at LONGEST times that length.  Differences and residuals have one scale unless theirs differ by COMMON_SCALE.
LONGEST, TYPICAL, COMMON_SCALE = 1.5, 0.08, 5.0

# Places (deg), components towards east and north, and which are of sources that the clip dropped.
Arrows = tuple[Array, Array, Array, Array, Any]


def residual_figure(dataset: xr.Dataset) -> Figure:
    """Return maps of the differences before and the residuals after the fit, of positions and of motions."""
    difference, rows = _require(dataset, "difference", MANY_ROWS), []
    for what, pair in (("positions", [0, 1]), ("motions", [3, 4])):
        if number := int(np.isfinite(difference[:, pair]).all(axis=1).sum()):
            rows.append((what, pair, number))
    if not rows:
        raise SweepError("no residuals on the sky: no row has a position or a motion")
    projection = {"projection": "mollweide"}
    figure, grid = style.new_figure(11.0, 3.0 * len(rows), len(rows), 2, SKY_WIDTH, subplot_kw=projection)
    for row, (what, pair, number) in enumerate(rows):
        both = [_arrows(dataset, name, pair) for name in ("difference", "residual")]
        scales = [_typical(arrows) for arrows in both]
        if scales[0] < COMMON_SCALE * scales[1] or scales[1] == 0.0:
            scales = [max(scales)] * 2
        unit = str(dataset["observable_unit"].values[pair[0]])
        for axes, when, arrows, scale in zip(grid[2 * row :], ("before", "after"), both, scales, strict=False):
            prepare_sky(axes)
            words = _draw_arrows(axes, arrows, scale or 1.0, unit)
            averages = f", means of {len(arrows[0])} cells" if number > MOST_ARROWS else ""
            title = f"{what} {when} the fit{averages}{words}"
            axes.set_title(style.in_lines(title, style.panel_size(axes)[0]), pad=10.0)
            axes.label_outer()
    return figure


def _arrows(dataset: xr.Dataset, name: str, pair: list[int]) -> Arrows:
    values, errors = dataset[name].values[:, pair], dataset["difference_error"].values[:, pair]
    rows = np.isfinite(values).all(axis=1)
    source, values, errors = dataset["row_source_index"].values[rows], values[rows], errors[rows]
    ra, dec = dataset["ra"].values[source], dataset["dec"].values[source]
    dropped = dataset["weight_factor"].values[source] == 0.0
    if len(values) <= MOST_ARROWS:
        return ra, dec, values[:, 0], values[:, 1], dropped
    ra, dec, values, weights = ra[~dropped], dec[~dropped], values[~dropped], errors[~dropped] ** -2
    # weighted means at the centres of cells: bands of equal area, each in 2 BANDS steps of right ascension
    cells, index = np.unique(sky_cells(ra * DEGREE, dec * DEGREE, BANDS), return_inverse=True)
    east, north = (np.bincount(index, w * v) / np.bincount(index, w) for w, v in zip(weights.T, values.T, strict=True))
    middle = np.arcsin((cells // (2 * BANDS) + 0.5) / BANDS * 2.0 - 1.0) / DEGREE
    return (cells % (2 * BANDS) + 0.5) * 180.0 / BANDS, middle, east, north, np.zeros(len(cells), dtype=bool)


def _typical(arrows: Arrows) -> float:
    _, _, east, north, dropped = arrows
    return float(np.quantile(np.hypot(east, north)[~dropped], 0.9)) if not np.all(dropped) else 0.0


def _draw_arrows(axes: Any, arrows: Arrows, scale: float, unit: str) -> str:
    """Draw arrows and a key with their scale; return words for the title about arrows that are cut or dropped."""
    ra, dec, east, north, dropped = arrows
    x, y, length = on_map(ra), dec * DEGREE, np.hypot(east, north)
    # a step on the sphere as one of the map's coordinates, of the length of the arrow; longitude grows to the left
    step = np.stack([-east / np.maximum(np.cos(y), 0.02), north])
    u, v = step * np.minimum(length / scale, LONGEST) / np.maximum(np.hypot(*step), 1e-300)
    look = {"angles": "xy", "scale": 1.0 / TYPICAL, "scale_units": "width", "units": "width", "width": 0.0028}
    for chosen, colour in ((dropped, style.COLOURS[1]), (~dropped, style.COLOURS[0])):
        if np.any(chosen):
            axes.scatter(x[chosen], y[chosen], s=5.0, color=colour, linewidths=0.0, zorder=3)
            at = x[chosen], y[chosen], u[chosen], v[chosen]
            drawn = axes.quiver(*at, color=colour, zorder=4, clip_on=False, **look)
            drawn.set_in_layout(False)
    factor, readable_unit = _readable(np.array([scale]), unit)
    key = float(f"{factor * scale:.0e}")  # of one digit
    place: Any = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": 8}}
    axes.quiverkey(drawn, 0.78, 0.02, key / factor / scale, f"{key:g} {readable_unit}", angle=0.0, **place)
    n_cut = np.sum(length > LONGEST * scale)
    words = f"; {formatting.counted(int(n_cut), 'arrow')} cut" if n_cut else ""
    return words + (f"; {np.sum(dropped)} dropped in red" if np.any(dropped) else "")


# Forecasts


def epoch_figure(dataset: xr.Dataset) -> Figure:
    """Return the errors of the unknowns against the epoch of one more position of every source."""
    errors_then = _require(dataset, "error_with_epoch", "`sweep forecast --add EPOCHS` computes them")
    epochs = dataset["new_epoch"].values
    panels, symbols = _unknowns_by(dataset, "unit"), _symbols(dataset)
    stages = list(zip(dataset["stage"].values, dataset["error"].values, style.LINES[1:], strict=False))
    figure, grid = style.new_figure(1.2 + 3.8 * len(panels), 4.4, 1, len(panels), least=1.0)
    for axes, (stored, panel) in zip(grid, panels.items(), strict=True):
        factor, unit = _readable(dataset["error"].values[:, panel], stored)
        for number, k in enumerate(panel[: len(style.COLOURS)]):
            # nothing was computed between the epochs
            axes.plot(epochs, factor * errors_then[:, k], **style.marks(number, 4.0, label=symbols[k]))
            for _, errors, line in stages:
                axes.axhline(factor * errors[k], color=style.COLOURS[number], linestyle=line, linewidth=0.9)
        axes.set_xlabel(style.in_lines("epoch of the new position of each source [yr]", style.panel_size(axes)[0]))
        axes.set_ylabel(f"formal error [{unit}]")
        axes.ticklabel_format(axis="x", useOffset=False)
        if len(epochs) <= 8:
            axes.set_xticks(epochs, [f"{epoch:g}" for epoch in epochs])
        axes.set_ylim(bottom=0.0)
    for stage, _, line in stages:
        axes.plot([], [], color="0.3", linestyle=line, linewidth=0.9, label=str(stage))
    return figure


def ranking_figure(dataset: xr.Dataset) -> Figure:
    """Return the sources whose observation alone helps most, and the error after each one that was chosen."""
    values, about = dataset["criterion_alone"].values, dataset.attrs
    stage = str(about["release"]) or "now"  # that new observations are added to
    now = float(dataset["criterion"].sel(stage=stage))
    goal = [name.strip() for name in str(about["goal"]).split(",")]
    wanted = np.flatnonzero(np.isin(dataset["block"].values, goal))
    gain = 1.0 - (values / now if about["criterion"] == "A" else np.exp(0.5 * (values - now) / len(wanted)))
    if not np.any(gain > 0.0):
        raise SweepError("no ranking here: no new observation, so no source helps; see `sweep forecast --add`")
    order = np.argsort(-np.nan_to_num(gain, nan=-1.0))[:RANKED][::-1]
    chosen = [str(name) for name in dataset["step_source"].values[1:]] if "step_source" in dataset else []
    names = [str(name) for name in dataset["source"].values[order]]
    width, columns = (9.6, 2) if chosen else (5.6, 1)
    figure, (left, *right) = style.new_figure(width, 1.6, 1, columns, style.WIDE)
    colours = [style.COLOURS[1] if name in chosen else style.COLOURS[0] for name in names]
    if set(names) & set(chosen):
        left.barh([0], [0.0], color=style.COLOURS[1], label="chosen")
    left.barh(range(len(order)), 100.0 * gain[order], 0.75, color=colours)
    left.set_xlabel(f"reduction of the error of {about['goal']} [%]\nby this source alone")
    for axes in right:
        steps = dataset["step_error"].values
        for number, k in enumerate(wanted[: len(style.COLOURS)]):
            look = {**style.series(number), "markersize": 4.0, "linestyle": "solid", "linewidth": 1.2}
            axes.plot(steps[:, k] / steps[0, k], label=_symbols(dataset)[k], **look)
        axes.set_xticks(range(len(chosen) + 1), ["none", *chosen], rotation=90, fontsize=7)
        axes.set(xlabel="observed, one after the other", ylabel="error relative to none")
    _name_bars(figure, left, names)
    style.legend(figure, least=1)
    return figure
