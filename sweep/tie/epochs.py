"""Epoch astrometry of Gaia: filtered and timed by ESA's gaiasupdate, and put in the place of catalogue rows."""

import io
import json
import logging
import re
import socket
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.units import Unit

from linksweep.core.frames import MAS, Array, Flags, Indices, LinkError
from linksweep.core.tie.astrometry import DAYS_PER_YEAR
from linksweep.core.tie.mistakes import Misfit
from linksweep.core.tie.problem import Problem, Solution
from linksweep.core.tie.transits import COLOUR, ERROR, MODELS, PATH, Paths, Transits, joint, misfit
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import first_of
from linksweep.sweep.tables.columns import JD_FROM, MJD_FROM, Columns, first_found
from linksweep.sweep.tables.reader import read_table as read_file
from linksweep.sweep.tie.tables import SOURCE_NAMES, AstrometricTable, built_in, digest_of

# Seconds that the Gaia archive gets to answer while gaiasupdate is imported.
NEWS_S = 1.0

# Columns of the archive with their units and those in which they are used; DPAC's are called obsTimeTcb and so on.
TIME, ANGLE, LENGTH, NUMBER = ("ns", "ns"), ("deg", "rad"), ("mas", "rad"), ("", "")
NEEDED = {
    **{"obs_time_tcb": TIME, "obs_time_bary_corr": TIME, "scan_pos_angle": ANGLE, "parallax_factor_al": NUMBER},
    **{"centroid_pos_al": LENGTH, "centroid_pos_error_al": LENGTH, "used_by_agis_al": NUMBER},
}
OPTIONAL = {"ra0": ANGLE, "dec0": ANGLE, "colour_factor_al": LENGTH, "agis_source_excess_noise": LENGTH}
# Of the archive's colour_factor_al to nm. Source: gaiasupdate 0.1.2.
COLOUR_FACTOR = -1e3

# What times may be numbers of: the Julian year of 0, and how many of them a year has; and when Gaia observed.
TIMES = {
    "ns since 2010.0": (2010.0, 3.15576e16),
    "Julian years": (0.0, 1.0),
    "Julian dates": (2000.0 - 2451545.0 / DAYS_PER_YEAR, DAYS_PER_YEAR),
    "modified Julian dates": (2000.0 - 51544.5 / DAYS_PER_YEAR, DAYS_PER_YEAR),
    **{f"{unit} since 2010.0": (2010.0, per_year) for unit, per_year in (("years", 1.0), ("days", DAYS_PER_YEAR))},
    **{f"{unit} since 2010.0": (2010.0, 3.15576e7 * per_s) for unit, per_s in (("s", 1.0), ("ms", 1e3), ("us", 1e6))},
    **{f"ns since {year}.0": (float(year), 3.15576e16) for year in (2000, 1970)},
}
OBSERVED = (2014.0, 2025.5)
# The largest and smallest possible numbers.
LIMITS = {"scan_pos_angle": (-2.0 * np.pi, 2.0 * np.pi), "parallax_factor_al": (-1.1, 1.1), ERROR: (1e-6 * MAS, np.inf)}

THIELE_INNES = tuple(f"{letter}_thiele_innes" for letter in "abfg")
CAMPBELL = ("nodeangle", "inclination", "arg_periastron")


class Epochs(NamedTuple):
    """The observations of some stars, what they say of them, the row of each star in the satellite's table (S,), the
    files with their SHA-256, and what is to be said of all that.
    """

    transits: Transits
    paths: Paths
    rows: Indices
    files: Mapping[str, str]
    doubt: Misfit
    notes: Sequence[str]


def read_observations(path: Path) -> Any:
    """Return the observations in a file that AGIS used, a pandas DataFrame with a row for each passage of a CCD.

    Raises SweepError that names columns, units and numbers that are wrong.
    """
    import pandas as pd

    waiting = socket.getdefaulttimeout()
    try:
        # Its import asks the Gaia archive for news, and prints that there are none: behind a silent firewall only after
        # two minutes.
        socket.setdefaulttimeout(NEWS_S)
        with redirect_stdout(io.StringIO()):
            import gaiasupdate.epoch_astrometry  # noqa: F401  (it gives frames their methods)
    except ImportError as error:
        raise SweepError("needs gaiasupdate to be read: install linksweep[epochs]", str(path)) from error
    finally:
        socket.setdefaulttimeout(waiting)
    table = read_file(built_in(path))
    table.rename_columns(table.colnames, [re.sub("(?<=[a-z0-9])([A-Z])", r"_\1", n).lower() for n in table.colnames])
    if missing := [name for name in ("source_id", *NEEDED) if name not in table.colnames]:
        raise SweepError(f"no column {', '.join(missing)}, which epoch astrometry of Gaia has", str(path))
    units = {name: unit for name, unit in (NEEDED | OPTIONAL).items() if name in table.colnames}
    cells = {"transit_id": np.arange(len(table)), "colour_factor_al": 0.0, "agis_source_excess_noise": 0.0}
    try:
        frame = pd.DataFrame(cells | {name: _cells(table[name]) for name in units})
        for name in {"source_id", "transit_id"} & set(table.colnames):
            frame[name] = Columns(table).text(name)
        several = [name for name in units if frame[name].dtype == object]
        frame = frame.explode(several, ignore_index=True).astype(dict.fromkeys(units, np.float64))
        for name, (unit, used) in units.items():
            frame[name] *= Unit(table[name].unit or unit).to(used)
    except (ValueError, TypeError) as error:
        raise SweepError(f"cannot be read as epoch astrometry: {error}", str(path)) from error
    frame["used_by_agis_al"] = frame["used_by_agis_al"].isin([1.0, ord("T")])  # the letter in FITS
    frame = frame.epochastrometryarchive.filter_on_used_by_agis().dropna(subset=list(NEEDED), ignore_index=True)
    problems = [
        f"{name} from {frame[name].min():.4g} to {frame[name].max():.4g} {units[name][1]}: not {low:.4g} to {most:.4g}"
        for name, (low, most) in LIMITS.items()
        if not frame[name].between(low, most).all()
    ]
    low, high = frame["obs_time_tcb"].min(), frame["obs_time_tcb"].max()
    likely = [n for n, (zero, by) in TIMES.items() if OBSERVED[0] < zero + low / by <= zero + high / by < OBSERVED[1]]
    if len(frame) and next(iter(TIMES)) not in likely:
        said = f"obs_time_tcb of {low:.8g} to {high:.8g} is not {next(iter(TIMES))}, when Gaia observed"
        problems.append(f"{said}; the likely cause: {', or '.join(likely)}" if likely else said)
    if problems:
        raise SweepError(problems, str(path))
    frame.epochastrometryarchive.set_relative_time()
    return frame.assign(file=str(path), colour_factor_al=frame["colour_factor_al"] * COLOUR_FACTOR)


def _cells(column: Any) -> Any:
    """Return the numbers of a column, or lists of them where it has several in each row."""
    if column.dtype.kind in "US":  # tuples in CSV, lists in Parquet; gaiasupdate would run them as code
        text = re.sub("(?i)none|null|nan|--", "NaN", ",".join(column.tolist()).translate(str.maketrans("()TF", "[]tf")))
        return json.loads(f"[{text}]")
    if column.ndim == 1 and column.dtype.kind != "O":
        return np.ma.filled(np.ma.asarray(column).astype(np.float64), np.nan)
    return [cell.tolist() for cell in column]


def with_observations(
    left: AstrometricTable, files: Sequence[str | Path], models: Mapping[str, str], orbits: str | Path | None
) -> tuple[AstrometricTable, Epochs]:
    """Return a satellite's table in which the observations in files take the place of the rows of their stars.

    ``models`` are those of `MODELS` by star, or for "all"; ``orbits`` is a table of the elements of orbits.  Raises
    SweepError for what is wrong in the files, sources that are not in the table, and paths that are not determined.
    """
    import pandas as pd

    handlers = logging.root.handlers[:]
    frame = pd.concat([read_observations(Path(file)) for file in files], ignore_index=True)
    from gaiasupdate.constants import DR4_REFERENCE_EPOCH
    from gaiasupdate.solver import estimate_excess_noise

    where, epoch = ", ".join(map(str, files)), float(DR4_REFERENCE_EPOCH.jyear)
    if twice := frame.duplicated(["source_id", "obs_time_tcb", "scan_pos_angle"]).sum():
        raise SweepError(f"{twice} observations are there twice: is a file named twice?", where)
    columns = list(left.names.values())
    place = {key: k for one in columns[::-1] for k, name in enumerate(one) for key in (*name.split()[-1:], name)}
    frame["place"] = frame["source_id"].map(place)
    unknown = frame.loc[frame["place"].isna(), "source_id"].unique().tolist()
    strangers = f"no source {first_of(unknown, 5)}, of which there are observations"
    frame = frame.dropna(subset="place").sort_values(["place", "obs_time_tcb"], kind="stable", ignore_index=True)
    if frame.empty:
        raise SweepError(strangers if unknown else f"no observation in {where} was used by AGIS", left.path)
    rows, star = np.unique(frame["place"].to_numpy(dtype=np.int64), return_inverse=True)
    frame["transit_id"] = frame.groupby(["place", "file", "transit_id"], sort=False).ngroup()
    first, stars, names = frame.groupby(star).first(), left.astrometry.taken(rows), columns[0]
    without = first_of(np.delete(names, rows).tolist(), 5)
    notes = [strangers] * bool(unknown) + [f"no observations of {without}, which keep their rows"] * bool(without)
    origin = stars.values[:2]
    if {"ra0", "dec0"} <= set(frame) and first[["ra0", "dec0"]].notna().all(axis=None):
        origin = first[["ra0", "dec0"]].to_numpy().T
    elif np.any(other := stars.epoch != epoch):
        said = f"the observations are from positions at {epoch:g}, and the rows have those at {stars.epoch[other][0]:g}"
        raise SweepError(f"{said}: take the table of the same release, or files with ra0 and dec0", left.path)
    used = set(rows.tolist())
    model, orbit = _models({name: k for name, k in place.items() if k in used}, models, orbits, epoch)
    observed = {str(name): frame[name].to_numpy() for name in frame.select_dtypes("number")}
    noise = first["agis_source_excess_noise"].to_numpy()
    transits = Transits(star, observed, model, orbit, noise, origin, epoch, names[rows], stars)
    try:
        paths = transits.paths()
        for _ in range(3 if np.any(model != "5") else 0):  # AGIS has no other path, so that its noise is what is left
            left_over = [
                estimate_excess_noise(
                    paths.residuals[star == s], observed[ERROR][star == s], 1.0, max(paths.dof[s], 1.0)
                )
                for s in range(len(rows))
            ]
            transits = replace(transits, noise=np.where(model == "5", noise, np.minimum(noise, left_over)))
            paths = transits.paths()
        doubt = misfit(transits)
    except LinkError as error:
        raise SweepError(str(error), where) from error
    logging.root.handlers[:] = handlers  # gaiasupdate logs in such a way that Python adds one, which repeats our lines
    digests = {str(file): digest_of(built_in(Path(file))) for file in files}
    epochs = Epochs(transits, paths, rows, digests, doubt, notes)
    return replace(left, astrometry=transits.in_place(paths, left.astrometry, rows)), epochs


def _models(
    place: Mapping[str, int], models: Mapping[str, str], orbits: str | Path | None, epoch: float
) -> tuple[Any, Array]:
    """Return the model of each star with observations, in the order of their rows, and its orbit (7, S)."""
    elements = {} if orbits is None else _orbits(place, Path(orbits), epoch)
    chosen = {row: "orbit" if row in elements else models.get("all", "5") for row in sorted(set(place.values()))}
    for star, model in models.items():
        if model not in MODELS or not (star == "all" or star in place):
            known = f"models are {', '.join(MODELS)}, stars with observations {first_of(list(place), 5)}"
            raise SweepError(f"model {model} of {star}: {known}")
        chosen |= {place[star]: model} if star in place else {}
    if absent := [star for star, row in place.items() if chosen[row] == "orbit" and row not in elements]:
        raise SweepError(f"no elements of the orbit of {absent[0]}: give a table with --orbits")
    return np.array(list(chosen.values())), np.array([elements.get(row, np.zeros(7)) for row in chosen]).T


def _orbits(place: Mapping[str, int], path: Path, epoch: float) -> dict[int, Array]:
    """Return the elements of orbits, as `bends` needs them, by row of the satellite's table."""
    from scipy.spatial.transform import Rotation

    table = read_file(path)
    read, star = Columns(table, str(path)), first_found(SOURCE_NAMES, table.colnames)
    shape = THIELE_INNES if THIELE_INNES[0] in table.colnames else CAMPBELL
    for name in ("period", "eccentricity", "t_periastron", *shape, *([] if star else ["source_id"])):
        read.require(name)
    read.finish()
    days = [read.numbers(name) * Unit(table[name].unit or "d").to("d") for name in ("period", "t_periastron")]
    period, time, e = days[0] / DAYS_PER_YEAR, days[1], read.numbers("eccentricity")
    start = read.numbers("ref_epoch") if "ref_epoch" in table.colnames else epoch
    julian = 2000.0 + (time - np.where(time > JD_FROM, 2451545.0, 51544.5)) / DAYS_PER_YEAR
    periastron = np.where(time > MJD_FROM, julian, start + time / DAYS_PER_YEAR) - epoch
    if shape == CAMPBELL:
        angles = [read.numbers(name) * Unit(table[name].unit or "deg").to("rad") for name in CAMPBELL]
        plane = Rotation.from_euler("ZXZ", np.array(angles).T).as_matrix()[:, :2, :2].swapaxes(1, 2)
    else:
        plane = np.array([read.numbers(name) for name in THIELE_INNES]).T.reshape(-1, 2, 2)
    plane /= np.linalg.norm(plane, ord=2, axis=(1, 2), keepdims=True)  # the largest singular value is the semi-axis
    closed = (period > 0.0) & (e >= 0.0) & (e < 1.0) & np.isfinite(periastron + plane.sum(axis=(1, 2)))
    read.check(~closed, "a period, an eccentricity or other elements of no orbit")
    read.finish()
    orbit = np.array([period, e, periastron, *plane.reshape(-1, 4).T])
    return {place[name]: orbit[:, k] for k, name in enumerate(read.text(str(star))) if name in place}


def described(epochs: Epochs, problem: Problem, solution: Solution, factors: Array | Flags) -> dict[str, Any]:
    """Return variables of a dataset: the path of each star in the link, and the residual of each transit."""
    transits, paths = epochs.transits, epochs.paths
    values, covariance = paths.values.copy(), paths.covariance.copy()
    rows, design = problem.differences(), problem.unknowns.matrix(*problem.objects(problem.satellite))
    for s, source in enumerate(epochs.rows):
        if source >= 0 and factors[source] > 0.0:
            at = np.flatnonzero(problem.source == source)
            step, *both = joint(covariance[s], rows, at, design[source], solution.estimate, solution.covariance)
            values[s], covariance[s] = values[s] + step, both
    step = (values - paths.values)[transits.star]
    weights, passage = transits.weights(), transits.observed["transit_id"]
    residuals = paths.residuals - np.einsum("nk,nk->n", transits.design(), step)
    total, first = np.bincount(passage, weights), np.unique(passage, return_index=True)[1]
    error = np.sqrt(np.einsum("sii->si", covariance))
    scale = np.where(error > 0.0, np.array([*[MAS] * COLOUR, 1.0]), np.nan)
    return {
        "path_parameter": ("path_parameter", ["ra_offset", "dec_offset", *PATH[2:]]),
        "path": ("path", transits.names.astype(str)),
        "path_model": ("path", transits.models.astype(str)),
        "path_estimate": (("path", "path_parameter"), values / scale, {"units": "mas, yr, nm"}),
        "path_error": (("path", "path_parameter"), error / scale),
        "path_chi2": ("path", paths.squares, {"long_name": "chi2 of the observations without the link"}),
        "path_dof": ("path", paths.dof),
        "transit_path": ("transit", transits.names[transits.star[first]].astype(str)),
        "transit_epoch": ("transit", transits.epoch + transits.observed["relative_time_year"][first], {"units": "yr"}),
        "transit_residual": ("transit", np.bincount(passage, weights * residuals) / total / MAS, {"units": "mas"}),
        "transit_error": ("transit", 1.0 / np.sqrt(total) / MAS, {"units": "mas"}),
    }
