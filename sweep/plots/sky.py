"""The sky of a catalogue and the accuracy of missions: what they show, as datasets, and their figures."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from linksweep.core import missions
from linksweep.core.frames import DEGREE, GALACTIC_AXES, Array, position
from linksweep.core.scenario import scenario
from linksweep.sweep.contract import Named, SweepError, shown, suggest
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.planning.plan import generators
from linksweep.sweep.plots import style
from linksweep.sweep.running.reproduce import place_of, study_to_look_at
from linksweep.sweep.stores.location import Where
from linksweep.sweep.studies.study import Study
from linksweep.sweep.tables.columns import table_file

MAGNITUDE = {"units": "mag", "long_name": "magnitude V", "symbol": "$V$"}


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
    """Return an all-sky map of ``ra`` and ``dec`` (deg), coloured by the magnitude ``v_mag`` if there is one, with the
    Galactic plane and its centre.
    """
    figure, (axes,) = style.new_figure(7.6, 4.9, subplot_kw={"projection": "mollweide"})
    prepare_sky(axes)
    ra, dec = (dataset[name].values.astype(float) for name in ("ra", "dec"))
    look: dict[str, Any] = {"linewidths": 0.0, "zorder": 3, "rasterized": len(ra) > 2000, "color": style.COLOURS[0]}
    look["s"] = float(np.clip(4000.0 / max(len(ra), 1), 1.5, 18.0))
    if "v_mag" in dataset:
        values = dataset["v_mag"].values.astype(float)
        order = np.argsort(-values, kind="stable")  # bright objects, of small magnitude, on top and dark
        ra, dec = ra[order], dec[order]
        look |= {"c": values[order], "cmap": "viridis", "color": None}
    points = axes.scatter(on_map(ra), dec * DEGREE, **look)
    if "v_mag" in dataset:
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


def catalogue_of_point(store: Where, at: Sequence[str]) -> xr.Dataset:
    """Return the first catalogue of a point of a store as it was drawn: ra, dec (deg) and v_mag of each object.

    Raises SweepError if the store is not of the link, or ``at`` is not one point of it.
    """
    study = study_to_look_at(store)
    if study.experiment.name != "link":
        raise SweepError(f"only the link has a sky; this is the experiment {study.experiment.name}", str(store))
    parameters = place_of(study, ",".join(at), str(store))
    changed = {name: value for name, value in parameters.items() if value != study.experiment.defaults()[name]}
    alone = replace(study, axes={}, zipped=(), points=None, excluded=(), fixed=changed, published=None)
    (point,) = Grid(replace(alone, claims=(), conclusion=None)).points()
    _, rng = generators(study.sampling.seed, point.stream, 0, 0)
    catalogue = scenario(parameters).draw_catalogue(rng)
    title = f"{study.title}: the {len(catalogue)} objects of one catalogue"
    sky = _sky(catalogue.ra / DEGREE, catalogue.dec / DEGREE, ", ".join([title, *at]))
    return sky.assign(v_mag=("object", catalogue.v_mag, MAGNITUDE))


def catalogue_of_table(path: Path) -> xr.Dataset:
    """Return the positions in a table as ra, dec (deg); raises SweepError if there are none."""
    read = table_file(path).columns({}, {}, ())
    if all([read.require("ra"), read.require("dec")]):
        ra, dec = read.quantity("ra"), read.quantity("dec")
        read.check(np.abs(dec) > 90.0, "a dec beyond 90 deg", dec)
    read.finish()
    return _sky(ra, dec, f"{path.name}: {len(ra)} objects")


def _sky(ra_deg: Array, dec_deg: Array, title: str) -> xr.Dataset:
    degrees = {"units": "deg"}
    return xr.Dataset({"ra": ("object", ra_deg, degrees), "dec": ("object", dec_deg, degrees)}, attrs={"title": title})


# The accuracy of missions


def accuracy_figure(dataset: xr.Dataset) -> Figure:
    """Return ``sigma_pm`` beside ``sigma_pos`` (model, v) against the magnitude v, a line for each mission, with a band
    where its error is known.
    """
    figure, grid = style.new_figure(8.4, 4.0, 1, 2, least=1.0, sharex=True)
    v = dataset["v"].values
    for axes, variable in zip(grid, ("sigma_pm", "sigma_pos"), strict=True):
        for number, model in enumerate(dataset["model"].values.tolist()):
            one, look = dataset.sel(model=model), {"color": style.COLOURS[number % len(style.COLOURS)]}
            curve, error = one[variable].values, one[f"{variable}_error"].values
            line = style.LINES[number % len(style.LINES)]
            axes.plot(v, curve, linestyle=line, linewidth=1.2, label=str(model), **look)
            if np.isfinite(error).any():
                axes.fill_between(v, curve - error, curve + error, **look, **style.BAND)
        style.logarithmic(axes, "y", dataset[variable].values)
        axes.set(xlabel=style.label(dataset["v"], "v"), ylabel=style.label(dataset[variable], variable))
    style.complete(figure, str(dataset.attrs.get("title", "")))
    return figure


def accuracy_curves(models: Sequence[str | Named] = ()) -> xr.Dataset:
    """Return sigma_pm (mas/yr) and sigma_pos (mas) of one object, dimensions (model, v), of missions at nominal length.

    ``models`` are by default all built-in ones whose packages are installed.  Values beyond a mission's faint limit are
    NaN.  The curves that were calibrated with the paper's tables have one-sigma errors ``_error`` from that fit; for
    others these are NaN.
    Raises SweepError for an unknown model, one whose package is missing, or a function that has no value somewhere.
    """
    v = np.round(np.linspace(9.0, 21.0, 121), 6)
    rows: dict[str, Sequence[Array]] = {}
    for model in models or missions.MISSIONS:
        name = str(model)
        if isinstance(model, str) and name not in missions.MISSIONS:
            raise SweepError(f"no model {shown(name)}{suggest(name, list(missions.MISSIONS))}")
        try:
            sigma_pos, sigma_pm = missions.mission_of(model).sigmas_to_limit(v)
        except (missions.MissionUnavailableError, missions.CurveError) as error:
            if models:
                raise SweepError(str(error)) from error
            continue
        calibrated = missions.CALIBRATED.get(name) if isinstance(model, str) else None
        relative = np.full(v.shape, np.nan) if calibrated is None else calibrated.relative_error(v)
        rows[name] = sigma_pm, sigma_pm * relative, sigma_pos, sigma_pos * relative
    motion, position = (
        {"units": "mas / yr", "symbol": r"$\sigma_\mu$"},
        {"units": "mas", "symbol": r"$\sigma_\mathrm{pos}$"},
    )
    about = {"sigma_pm": motion, "sigma_pm_error": motion, "sigma_pos": position, "sigma_pos_error": position}
    arrays = zip(about.items(), zip(*rows.values(), strict=True), strict=True)
    variables = {name: (("model", "v"), np.array(array), attributes) for (name, attributes), array in arrays}
    coordinates = {"model": np.array(list(rows), dtype=object), "v": ("v", v, MAGNITUDE)}
    return xr.Dataset(variables, coordinates, {"title": "Accuracy of one object in each mission"})


def models_of(study: Study, chosen: Sequence[str] = ()) -> list[str | Named]:
    """Return the missions of a study of the link, or those of them in ``chosen``.

    Raises SweepError for another experiment, or a mission that the study does not have.
    """
    if study.experiment.name != "link":
        raise SweepError(f"only the link has missions; this is the experiment {study.experiment.name}", study.source)
    whole = study.experiment.defaults() | dict(study.fixed)
    models = list(study.axes.get("model", (whole["model"],)))
    known = [str(model) for model in models]
    if unknown := [name for name in chosen if name not in known]:
        raise SweepError(f"{shown(unknown[0])} is no mission of this study{suggest(unknown[0], known)}", study.source)
    return [model for model in models if not chosen or str(model) in chosen]
