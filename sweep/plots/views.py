"""Datasets for pictures of the link that are not results: the sky of a catalogue, the accuracy of missions."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from linksweep.core.arrays import Array
from linksweep.core.constants import DEGREE
from linksweep.core.missions import MISSIONS, CurveError, MissionUnavailableError
from linksweep.core.missions.calibrate import IN_CODE, Model, all_skies, fit, published_numbers
from linksweep.core.scenario import scenario
from linksweep.core.user_mission import mission_of
from linksweep.sweep.contract import Named, SweepError, shown, suggest
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.planning.streams import generators
from linksweep.sweep.running.reproduce import place_of, study_to_look_at
from linksweep.sweep.stores.location import Where
from linksweep.sweep.studies.study import Study
from linksweep.sweep.tables.file import table_file

BRIGHTEST_MAG, FAINTEST_MAG, STEP_MAG = 9.0, 21.0, 0.1
MAGNITUDE = {"units": "mag", "long_name": "magnitude V", "symbol": "$V$"}

CALIBRATION_CATALOGUES = 50
"""Catalogues for the errors of calibrated curves, a quarter of those of the calibration; errors are known to 10 %."""


def accuracy_curves(models: Sequence[str | Named] = ()) -> xr.Dataset:
    """Return sigma_pm (mas/yr) and sigma_pos (mas) of one object, dimensions (model, v), of missions at nominal length.

    ``models`` are by default all built-in ones whose packages are installed.  Values beyond a mission's faint limit are
    NaN.  The curves that were calibrated with the paper's tables have one-sigma errors ``_error`` from that fit; for
    others these are NaN.
    Raises SweepError for an unknown model, one whose package is missing, or a function that has no value somewhere.
    """
    v = np.round(np.arange(BRIGHTEST_MAG, FAINTEST_MAG + 0.5 * STEP_MAG, STEP_MAG), 6)
    rows: dict[str, tuple[Array, Array, Array]] = {}
    for model in models or MISSIONS:
        name = str(model)
        if isinstance(model, str) and name not in MISSIONS:
            raise SweepError(f"no model {shown(name)}{suggest(name, list(MISSIONS))}")
        try:
            sigma_pos, sigma_pm = mission_of(model).sigmas_to_limit(v)
        except (MissionUnavailableError, CurveError) as error:
            if models:
                raise SweepError(str(error)) from error
            continue
        relative = _relative_error(name, v) if isinstance(model, str) else np.full(v.shape, np.nan)
        rows[name] = (sigma_pm, sigma_pos, relative)
    pm, pos, relative = (np.array(part) for part in zip(*rows.values(), strict=True))
    meanings = {
        "sigma_pm": (pm, "mas / yr", r"$\sigma_\mu$", "error of a proper motion, per coordinate"),
        "sigma_pm_error": (pm * relative, "mas / yr", "", "its one-sigma error, of the calibration"),
        "sigma_pos": (pos, "mas", r"$\sigma_\mathrm{pos}$", "error of a position, per coordinate"),
        "sigma_pos_error": (pos * relative, "mas", "", "its one-sigma error, of the calibration"),
    }
    return xr.Dataset(
        {
            name: (("model", "v"), values, {"units": unit, "symbol": symbol, "long_name": meaning})
            for name, (values, unit, symbol, meaning) in meanings.items()
        },
        {"model": np.array(list(rows), dtype=object), "v": ("v", v, MAGNITUDE)},
        {"title": "Accuracy of one object in each mission"},
    )


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


def catalogue_of_point(store: Where, at: Sequence[str]) -> xr.Dataset:
    """Return the first catalogue of a point of a store as it was drawn: ra, dec (deg) and v_mag of each object.

    Raises SweepError if the store is not of the link, or ``at`` is not one point of it.
    """
    study = study_to_look_at(store)
    if study.experiment.name != "link":
        raise SweepError(f"only the link has a sky; this is the experiment {study.experiment.name}", str(store))
    parameters = place_of(study, ",".join(at), str(store))
    own = {name: value for name, value in parameters.items() if value != study.experiment.defaults()[name]}
    alone = replace(study, axes={}, zipped=(), points=None, excluded=(), fixed=own, published=None)
    (point,) = Grid(replace(alone, claims=(), conclusion=None)).points()
    _, rng = generators(study.sampling.seed, point.stream, 0, 0)
    catalogue = scenario(parameters).draw_catalogue(rng)
    where = ", ".join(part.strip() for text in at for part in text.split(","))
    title = f"{study.title}: the {len(catalogue)} objects of one catalogue" + (f", {where}" if where else "")
    sky = _sky(catalogue.ra / DEGREE, catalogue.dec / DEGREE, title)
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


def _relative_error(name: str, v: Array) -> Array:
    """Return the relative error of a calibrated curve at magnitudes, from the covariance of its log constants."""
    models: dict[str, Model] = {"amex": "amex", "gaia": "gaia"}
    if (model := models.get(name)) is None:
        return np.full(v.shape, np.nan)
    found = fit(model, list(published_numbers(model).values()), all_skies(model, CALIBRATION_CATALOGUES))
    curve = IN_CODE[model]
    parts = [(a * np.exp(slope * (v - pivot)), slope * (v - pivot)) for a, slope, pivot in curve.terms]
    gradient = np.stack([row for term, power in parts for row in (term, term * power)]) / curve(v)
    return np.asarray(np.sqrt(np.einsum("iv,ij,jv->v", gradient, found.log_covariance, gradient)))
