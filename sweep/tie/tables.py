"""Astrometric tables from files, in rad and rad/yr: Gaia archive, Hipparcos-2, ICRF, VLBI rows and such columns; and
epoch astrometry of Gaia, filtered and timed by ESA's gaiasupdate, in the place of catalogue rows.
"""

import hashlib
import io
import logging
import re
import socket
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, field, replace
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from astropy.units import Unit
from scipy.spatial.transform import Rotation

from linksweep.core.frames import ARCSEC, DEGREE, MAS, Array, Flags, Indices, LinkError, Texts
from linksweep.core.tie import astrometry as core, mistakes
from linksweep.core.tie.forecast import RELEASES, releases_at
from linksweep.core.tie.problem import Problem, Solution
from linksweep.core.tie.transits import COLOUR, ERROR, MODELS, NOISE, PATH, VALUE, Paths, Transits, joint, misfit
from linksweep.core.unknowns import PARAMETERS
from linksweep.sweep.contract import SweepError, needed, refused, shown, suggest
from linksweep.sweep.formatting import first_of
from linksweep.sweep.tables import columns as archives
from linksweep.sweep.tables.columns import ACCELERATIONS, CORRELATIONS, Columns, first_found, rows_where
from linksweep.sweep.tables.reader import has_unit, read_table as read_file
from linksweep.sweep.tie.options import POSITIONS, SIDES, TABLE, ApplyOptions

# Columns that name a source, in upper or lower case, best first; other columns of text come after them.
SOURCE_NAMES = ("name", "star", "source", "source_id", "designation", "psr_name", "hip", "iers_name", "icrf_name")

# The quantities that ``columns`` and ``units`` may name.
QUANTITIES = (
    *(*PARAMETERS, *ACCELERATIONS, "ref_epoch", "radial_velocity"),
    *(*(f"{name}_error" for name in (*PARAMETERS, *ACCELERATIONS)), *CORRELATIONS, "corr_vec", "name"),
    *("calibrator", "calibrator_error"),
)

HIPPARCOS_EPOCH = 1991.25

# No star is faster: larger radial velocities are redshifts, or stand for missing ones.
FASTEST_KM_S = 5000.0

# Positions that are rounded by more than this fraction of their errors are too coarse.
COARSE = 0.1

# By how much, in units of the last decimal, numbers may differ from rounded ones; and the units of angles.
LIKE_ROUNDED = 1e-3
ANGLES = (1.0, DEGREE, ARCSEC, 15.0 * ARCSEC)

# By how much a correlation in a column may differ from that in corr_vec, rounded to two decimals.
ROUNDED = 0.01

# Errors after a mistake in their unit is corrected, mas or mas/yr.
TYPICAL = (0.005, 300.0)

# Errors seldom differ by more between the coordinates, and never, in a year, between motions and positions.
UNEQUAL = {(0, 1): 10.0, (3, 4): 10.0, (3, 0): 500.0, (4, 1): 500.0}

# Errors of the positions of calibrators, mas.
CALIBRATORS = (0.005, 50.0)

# Of values, and of the errors of positions.
UNITS = {name: archives.unit_of(f"{name}_error").replace(" ", "") for name in (*PARAMETERS, *ACCELERATIONS)}

# Of solutions that are not of single stars; in DR3 their positions and motions are averages.
SOLUTION_TYPE = "nss_solution_type"

# What the documentation and papers of Gaia recommend.
USUAL = {
    "ruwe": "ruwe < 1.4",
    "duplicated_source": "~duplicated_source",
    "astrometric_params_solved": "astrometric_params_solved == 31",
}

_DESIGNATION = re.compile(r"Gaia E?(DR\d)\b", re.IGNORECASE)
ZERO_POINT = ("phot_g_mean_mag", "nu_eff_used_in_astrometry", "pseudocolour", "ecl_lat", "astrometric_params_solved")

# Of the text of an array: numbers, what stands for a missing one, and truth values.
_ELEMENT = re.compile(
    r"[+-]?(?:inf(?:inity)?|(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)|nan|none|null|--|\b[tf]\b|true|false", re.IGNORECASE
)
_IN_NUMBERS = dict.fromkeys(("none", "null", "--"), "nan") | dict.fromkeys(("t", "true"), "1")
_IN_NUMBERS |= dict.fromkeys(("f", "false"), "0")
# Names of columns that are like those of correlations, but for those with the colour in the Gaia archive.
_LIKE_CORRELATION = re.compile(
    r"^(corr?|rho|cov)(?![a-z])|^(?!.*colour)(ra|de|plx|parallax|pm..)\w\w+_?(corr?\w*|rho|cov)$", re.I
)
_ELEMENT_OF_HIPPARCOS = re.compile(r"[+-]?\d*\.\d\d")  # of six characters, which may touch

_BUILT_IN = Path(str(resources.files("linksweep.sweeps") / "data")).resolve()


@dataclass(frozen=True)
class TableOptions:
    """How a table is read.

    ``columns`` gives the table's names of quantities, ``units`` the units of quantities whose columns have none.
    ``epoch`` (Julian year) is for a table without a column of epochs.  ``extragalactic``: positions are mean ones of
    quasars, which neither move nor have parallaxes, and hold at any epoch.
    ``positions`` says whether positions without parallax and motion are of a single epoch, displaced by the parallax,
    or mean ones; by default as the table's metadata say, else of a single epoch.  Those without an epoch are mean.
    ``accelerations``: whether positions and motions of rows with accelerations are those "at-epoch", or "mean" ones as
    in the acceleration solutions of DR3; by default mean in tables of those.
    ``where`` is a condition that the rows must meet, as in `rows_where`.  ``parallax_zero_point``: whether that of DR3
    is subtracted, by magnitude, colour and latitude.  ``zero_errors``: what an error of 0 means.  ``pmra_cos_dec``:
    whether pmra is mu_alpha*; by default it is, unless its unit is one of time.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    epoch: float | None = None
    extragalactic: bool = False
    positions: str | None = None
    accelerations: str | None = None
    where: str | None = None
    parallax_zero_point: bool = False
    zero_errors: str = "error"
    pmra_cos_dec: bool | None = None

    def changed(self) -> dict[str, Any]:
        """Return the options that are not the default."""
        return {name: value for name, value in vars(self).items() if value != getattr(TableOptions(), name)}


@dataclass(frozen=True)
class AstrometricTable:
    """The astrometry in a file, the file's path and SHA-256, the columns with names, notes for the user, which columns
    were used, the release of Gaia whose identifiers columns of names have, and how the file was read.
    """

    path: str
    digest: str
    astrometry: core.Astrometry
    names: Mapping[str, Texts]
    notes: Sequence[str] = ()
    columns: str = ""
    releases: Mapping[str, str] = field(default_factory=dict)
    options: TableOptions = field(default_factory=TableOptions)

    @property
    def labels(self) -> Texts:
        """The names of the rows (N,): those of the first column of names, else numbers from 1."""
        return next(iter(self.names.values()), np.arange(1, len(self.astrometry) + 1).astype(np.str_))

    def require_positions(self, hint: str = "") -> None:
        """Raise SweepError, with a hint, that names the rows without a position."""
        if len(without := np.flatnonzero(~np.isfinite(self.astrometry.values[:2]).all(axis=0))):
            raise SweepError(f"no position in {core.named_rows(without)}{hint}", self.path)


def read_table(path: Path, options: TableOptions | None = None) -> AstrometricTable:
    """Return the astrometry of a file, or of a built-in table by name (icrf2, icrf3, psrpi ...).

    A table whose metadata say ``extragalactic: true`` needs no epoch: its positions hold at any.  Raises
    SweepError with all that is wrong and the rows (counted from 1).
    """
    path, options = built_in(path), options or TableOptions()
    table, where = read_file(path), str(path)
    notes = []
    if options.where:
        kept = rows_where(table, options.where, where)
        notes.append(f"where {options.where!r} keeps {np.count_nonzero(kept)} of {len(kept)} rows")
        table, where = table[kept], f"{path}, the {np.count_nonzero(kept)} rows that {options.where!r} keeps"
    read = astrometric_table(table, where, digest_of(path), options)
    ours = path.resolve().parent == _BUILT_IN  # which are as they were published
    notes += [] if ours else [*read.notes, *_usual_choices(table, options)]
    columns = "" if ours else read.columns
    return replace(read, path=str(path), columns=columns, notes=[f"{path.name}: {note}" for note in notes])


def as_read(link: Mapping[str, Any], table: Any, digest: str, asked: ApplyOptions) -> TableOptions:
    """Return how a table is to be read: as the options say, else as the ``link`` (attributes of `tie`) read the same
    file, or its satellite's table as far as this one has the columns and says no units itself.
    """
    side = next((name for name in SIDES if digest and digest == link.get(f"{name}_sha256")), "")
    before = TableOptions(**link.get(f"{side or SIDES[0]}_read", {}))
    columns = {key: name for key, name in before.columns.items() if name in table.colnames} | dict(asked.columns)
    there = {key: archives.column_of(key, table.colnames, columns) for key in before.units}
    without = {key for key, name in there.items() if name in table.colnames and not has_unit(table[name])}
    units = {key: unit for key, unit in before.units.items() if key in without} | dict(asked.units)
    as_before = asked.epoch is None and (side or archives.column_of("ref_epoch", table.colnames, columns) is None)
    cos_dec = before.pmra_cos_dec if "pmra" not in dict(asked.units) else None
    return TableOptions(
        columns,
        units,
        epoch=before.epoch if as_before else asked.epoch,
        extragalactic=bool(as_before and before.extragalactic),
        zero_errors=before.zero_errors if asked.zero_errors == TABLE else asked.zero_errors,
        pmra_cos_dec=False if asked.without_cos_dec else cos_dec,
    )


def built_in(path: Path) -> Path:
    """Return the file of a built-in table by its name; any other path as it is, unless it is a mere name of nothing."""
    if path.suffix or len(path.parts) > 1 or path.exists():
        return path
    known = {file.name.split(".")[0]: file for file in sorted(_BUILT_IN.glob("*.ecsv*"))}
    if path.name not in known:
        raise SweepError(f"neither a file nor a built-in table{suggest(path.name, [*known])}", str(path))
    return known[path.name]


def _usual_choices(table: Any, options: TableOptions) -> list[str]:
    """Return a note on the rows that the usual choices would drop, unless the options make them."""
    dropped = []
    for name, choice in USUAL.items():
        if name in table.colnames and name not in (options.where or ""):
            with suppress(SweepError):  # the choice keeps none
                if number := np.count_nonzero(~rows_where(table, choice)):
                    dropped.append(f"{choice} ({number} rows)")
    return [f"all rows are used; the usual choices would drop some (where): {', '.join(dropped)}"] if dropped else []


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def astrometric_table(
    table: Any, where: str, digest: str, options: TableOptions, checked: bool = False
) -> AstrometricTable:
    """Return what an astropy Table holds; raises SweepError as `read_table`.

    Rows that an earlier pass has ``checked`` are read without looking for mistakes in them again.
    """
    read = Columns(table, where, options.columns, options.units, QUANTITIES)
    read.finish()
    if not len(read):
        raise SweepError("has no rows", where)
    values, errors = _measured(read, PARAMETERS, options)
    read.finish()
    if not checked:
        _note_lost(read, np.isfinite(values) & ~np.isfinite(errors))
        _note_unlikely(read, PARAMETERS, values, errors)
        _note_unequal(read, errors)
        _check_positions(read, values, errors)
    present = np.isfinite(values) & np.isfinite(errors)
    further = _accelerations(read, np.all(present, axis=0), options)
    whole = present if further is None else np.concatenate([present, further[1] > 0.0])
    correlations = _correlations(read, whole, checked)
    if correlations is None and np.any(np.all(present, axis=0)):
        read.notes.append("no correlations of the five parameters: they count as 0")
    epoch = _epochs(read, options)
    if options.parallax_zero_point:
        values[2] -= _zero_points(read, epoch)
    if len(wrong := epoch[mistakes.impossible(errors, epoch)]):
        span = f"{wrong.min():g} to {wrong.max():g}"
        read.notes.append(f"epochs from {span}, {mistakes.WHEN_NONE}: are they right?")
    positions = options.positions or table.meta.get("positions", "single-epoch")
    if positions not in POSITIONS:
        read.problems.append(f"positions {positions!r}: must be {' or '.join(POSITIONS)}")
    astrometry = core.Astrometry(
        values=values,
        errors=errors,
        epoch=epoch,
        correlations=correlations,
        radial_velocity=_radial_velocity(read),
        columns={name: read.numbers(name) for name in read.names if read.kind(name) in "fiu"},
        apparent=(positions == "single-epoch") & np.isfinite(epoch),
        further=further,
        averaged=None if further is None else _averaged(read, epoch, further, options),
        **_calibrators(read),
    )
    try:
        core.kind_numbers(astrometry)
    except ValueError as error:
        read.problems.append(str(error))
    names = _names(read)
    releases = _releases(read, names, epoch[np.all(present[3:], axis=0)])
    read.finish()
    if np.any(astrometry.shared):
        astrometry = core.with_variance(astrometry, np.outer([1.0, 1.0, 0.0, 0.0, 0.0], astrometry.shared**2))
    return AstrometricTable(where, digest, astrometry, names, read.notes, _used(read), releases, options)


def of_two_releases(names: Iterable[str], epochs: Array) -> list[str]:
    """Return a problem where a table with columns of these names has rows at the epochs of two releases of Gaia."""
    there = sorted({*releases_at(epochs)} - {"dr5"})
    are_two = len(there) > 1 and {*map(str.casefold, names)} >= archives.GAIA_MARKS
    return [f"rows have the epochs of {' and '.join(there)}, each in its own frame"] if are_two else []


def _releases(read: Columns, names: Mapping[str, Texts], epochs: Array) -> dict[str, str]:
    """Return the release of Gaia by column of its designations, and that of source_id, which is theirs or that of the
    ``epochs`` of rows with motions; rows of two are a problem.
    """
    releases = {}
    for name, column in names.items():
        there = {said[1].lower() for text in column.tolist() if (said := _DESIGNATION.match(text))}
        if there:
            releases[name] = min(there)
        if len(there) > 1:
            read.problems.append(f"column {name!r} has rows of {' and '.join(sorted(there))}, each in its own frame")
    read.problems += of_two_releases(read.names, epochs)
    near = releases_at(epochs)
    release = next(iter(releases.values()), near[0] if len(near) == 1 else "")
    return {name: release for name in names if name.casefold() == "source_id"} | releases


def _used(read: Columns) -> str:
    """Return which columns hold quantities, with the numbers of those of errors and correlations."""
    there = [quantity for quantity in QUANTITIES if quantity != "name" and read.has(quantity)]
    plain = [str(read.name(quantity)) for quantity in there if not quantity.endswith(("_error", "_corr"))]
    return f"{', '.join(plain)}; {len(there) - len(plain)} of errors and correlations"


def _zero_points(read: Columns, epoch: Array) -> Array:
    """Return the zero points of the parallaxes of DR3 (N,), rad, 0 for rows that are out of their range.

    Source: Lindegren et al. 2021, A&A 649, A4, as the authors' package has them.
    """
    with needed("gaiadr3-zeropoint for parallax zero points", "zeropoint"):
        from zero_point import zpt
    shift, there = np.full(len(read), np.nan), " and ".join(releases_at(epoch)) or "no release"
    if there != "dr3":
        read.problems.append(f"parallax zero points are those of dr3, and the epochs are of {there}")
    elif sum(read.require(name) for name in ZERO_POINT) == len(ZERO_POINT):
        columns = np.array([read.quantity(name, "allowed") for name in ZERO_POINT])
        known = np.isin(columns[-1], (31, 95))
        zpt.load_tables()
        shift[known] = zpt.get_zpt(*columns[:, known], _warnings=False)
    number = np.isfinite(shift).sum()
    read.notes.append(f"zero points of {number} of {len(read)} parallaxes subtracted (Lindegren et al. 2021)")
    return np.asarray(np.nan_to_num(shift) * MAS)


def _measured(read: Columns, names: Sequence[str], options: TableOptions) -> Array:
    """Return values and errors (2, P, N) of parameters in rad and years, NaN where there are none."""
    measured = np.full((2, len(names), len(read)), np.nan)
    for value, error, name in zip(*measured, names, strict=True):
        if read.has(name):
            value[:] = _in_radians(read, name, options)
            read.check(np.isinf(value), f"an infinite {name}")
        if read.has(f"{name}_error"):
            error[:] = _errors(read, name, options)
        elif np.any(np.isfinite(value)):
            read.notes.append(f"no errors of {name}, which counts as not measured")
    return measured


def _in_radians(read: Columns, quantity: str, options: TableOptions) -> Array:
    """Return a quantity in rad or rad/yr, pmra and its error with cos(dec) also where the options say they lack it."""
    cos_dec = options.pmra_cos_dec if quantity.startswith("pmra") else None
    return read.quantity(quantity, "allowed", DEGREE if quantity in ("ra", "dec") else MAS, cos_dec)


def _errors(read: Columns, parameter: str, options: TableOptions) -> Array:
    quantity = f"{parameter}_error"
    name, column = read.name(quantity), read.name(parameter)
    if column in read.names and read.table[name].unit is None and quantity not in read.units:
        unit, of_value, said = UNITS[parameter], read.table[column].unit, ""
        if parameter in ("ra", "dec"):
            said = "sexagesimal" * (read.kind(column) in "USO")
        elif of_value is not None and of_value.is_equivalent(unit) and not np.isclose(of_value.to(unit), 1.0):
            said = f"in {of_value}"
        if said:
            say = f"say --unit {quantity}={unit}, or what it is in"
            read.problems.append(f"column {column!r} is {said}, and {name!r} has no unit; {say}")
    errors = _in_radians(read, quantity, options)
    if options.zero_errors == "error":
        read.check(errors == 0.0, f"a {name} of 0 (say --zero-errors missing, or exact)")
    return np.where(errors == 0.0, np.nan, errors) if options.zero_errors == "missing" else errors


def _note_lost(read: Columns, lost: Flags) -> None:
    """Note values (5, N) that have no error, and so decide the kind of their rows."""
    alike: dict[bytes, list[str]] = {}
    for row, name in zip(lost, PARAMETERS, strict=True):
        if row.any() and read.has(f"{name}_error"):
            alike.setdefault(row.tobytes(), []).append(name)
    for flags, names in alike.items():
        rows, what = np.flatnonzero(np.frombuffer(flags, dtype=bool)), f"no error of {', '.join(names)}"
        read.notes.append(f"{len(rows)} rows have {what}, which is not used: {core.named_rows(rows)}")


def _note_unlikely(read: Columns, names: Sequence[str], values: Array, errors: Array) -> None:
    """Note numbers of a size that no star and no instrument has, with the likely mistake in their unit."""
    for name, value, error in zip(names, values, errors, strict=True):
        unit = UNITS[name]
        most = np.inf if name in ("ra", "dec") else mistakes.LARGEST[unit]
        if len(beyond := np.flatnonzero((np.abs(value) > most * MAS) & np.isfinite(error))):
            what = f"{name} beyond {most:g} {unit}, which no star has"
            read.notes.append(f"{what}: is its unit right, or a value missing? {core.named_rows(beyond)}")
        known = error[np.isfinite(error) & (error > 0.0)] / MAS
        low, high = mistakes.PLAUSIBLE
        if len(known) and not low <= (median := float(np.median(known))) <= high:
            units = (mistakes.SMALLER if median < low else mistakes.LARGER).items()
            likely = [said for factor, said in units if TYPICAL[0] <= median * factor <= TYPICAL[1]]
            cause = f" The likely cause: {', or '.join(likely)}." if likely else ""
            what = f"errors of {name} of {median:.2g} {unit}, which no instrument has."
            read.notes.append(f"{what}{cause} Say --unit {name}_error=UNIT")


def _note_unequal(read: Columns, errors: Array) -> None:
    """Note errors of two coordinates, or of a motion and its position, of which one is likely in another unit."""
    for (one, other), most in UNEQUAL.items():
        both = errors[[one, other]]
        both = both[:, ((both > 0.0) & (both < np.inf)).all(axis=0)]
        if both.size and not 1.0 / most < (ratio := np.divide(*np.median(both, axis=1))) < most:
            names = f"{PARAMETERS[one]} are {ratio:.3g} times those of {PARAMETERS[other]}"
            read.notes.append(f"errors of {names}: is one of them in another unit?")


def _check_positions(read: Columns, values: Array, errors: Array) -> None:
    for name, row, error in zip(PARAMETERS, values, errors, strict=True):
        if not read.has(name):
            if np.any(np.isfinite(error)) or (name in ("ra", "dec") and not np.any(np.isfinite(values[2:]))):
                read.require(name)
            continue
        is_position, column = name in ("ra", "dec"), str(read.name(name))
        if is_position and _in_single_precision(read, column):
            size = np.abs(row) * (np.cos(values[1]) if name == "ra" else 1.0)
            what = f"positions in single precision (column {column!r}), too coarse for their errors,"
            read.check(size * 2.0**-24 > COARSE * error, what)
        elif is_position and len(lost := too_coarse(row, error / np.cos(values[1] * (name == "ra")), ANGLES)):
            what = f"{name} is written with a last decimal that is worth more than its error"
            read.notes.append(f"{what}: were digits lost? {core.named_rows(lost)}")
        read.check(np.isfinite(error) & ~np.isfinite(row), f"an error but no value of {name}")


def _in_single_precision(read: Columns, name: str) -> bool:
    """Return whether numbers are of single precision, stored as float64 too, where few digits (10.5) say nothing."""
    if read.kind(name) != "f":
        return False
    values = np.nan_to_num(read.numbers(name))
    few = read.table[name].dtype.itemsize == 8 and not np.any(values * 1024.0 % 1.0)
    return not few and np.array_equal(values, values.astype(np.float32))


def too_coarse(values: Array, errors: Array, units: Iterable[float]) -> Indices:
    """Return the rows of values (N,) whose last decimal, in any of some units, is worth more than their errors."""
    values, errors = values[:10_000], errors[:10_000]  # which tell of a million
    at = np.zeros(len(values), dtype=bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        for unit in units:
            step = unit / 10.0 ** np.floor(np.log10(unit / (1.01 * errors)))  # a value like 0.12(1) is well written
            at |= np.abs(values / step - np.round(values / step)) < LIKE_ROUNDED
    # some values are round by chance
    return np.flatnonzero(at) if np.count_nonzero(at) > 1 + 0.1 * len(at) else np.zeros(0, dtype=np.int64)


def _accelerations(read: Columns, five: Flags, options: TableOptions) -> Array | None:
    """Return values and errors of `FURTHER` (2, 5, N), zero where a row has none; None for a table without
    accelerations.  ``five`` are the rows with five parameters.
    """
    if not read.has("accel_ra") and not read.has("accel_dec"):
        return None
    both = _measured(read, ACCELERATIONS, replace(options, zero_errors="missing"))  # 0 in rows of five parameters
    _note_unlikely(read, ACCELERATIONS, *both)
    there = np.logical_and(*np.isfinite(both))
    half = np.any((np.nan_to_num(both) != 0.0).any(axis=0) & ~there, axis=0)
    half |= (there[0] != there[1]) | (there[2] != there[3]) | (there[2] & ~there[0])
    read.check(half, "an acceleration without one of its coordinates or errors, or a derivative alone,")
    read.check(there[0] & ~five, "an acceleration, but not all of the five parameters with their errors,")
    if not np.any(there):
        return None
    sizes = zip(*np.unique((5 + 2 * there[0].astype(int) + 2 * there[2])[five], return_counts=True), strict=True)
    counted = ", ".join(f"{number} of {size}" for size, number in sizes)
    read.notes.append(f"rows by the number of parameters of their model: {counted}; each is propagated with its own")
    return np.pad(np.where(there, both, 0.0), ((0, 0), (0, 1), (0, 0)))  # there are no orbits


def _averaged(read: Columns, epoch: Array, further: Array, options: TableOptions) -> Array:
    """Return half the time (N,) over which positions and motions of accelerated rows are averages; 0 for none."""
    of_dr3 = first_found([SOLUTION_TYPE], read.names) and releases_at(epoch[further[1, 0] > 0.0]) == ["dr3"]
    how = options.accelerations or ("mean" if of_dr3 else "at-epoch")
    words = "averages, as in DR3" if how == "mean" else "those at their epoch"
    read.notes.append(f"positions and motions of rows with accelerations are {words}: --accelerations mean or at-epoch")
    return np.full(len(epoch), core.HALF_SPAN if how == "mean" else 0.0)


def _numbers(cell: Any, number: re.Pattern[str] = _ELEMENT) -> Array:
    """Return the numbers of an array, or of its text: tuples in CSV, lists in Parquet; raises ValueError for a text
    with other words, such as np.float32(0.5).
    """
    if isinstance(cell, str):
        if re.search(r"\w", number.sub("", cell)):
            raise ValueError(f"{shown(cell)} is not a list of numbers")
        return np.array([_IN_NUMBERS.get(part.lower(), part) for part in number.findall(cell)], float)
    return np.ravel(np.ma.filled(np.ma.asarray(cell, dtype=np.float64), np.nan))


def _vectors(read: Columns, name: str, size: int, number: re.Pattern[str] = _ELEMENT) -> Array:
    """Return the numbers (size, N) in a column of arrays, or of texts of such numbers; NaN beyond their end."""
    vectors, column = np.full((size, len(read)), np.nan), read.table[name]
    if np.ndim(column) == 2:  # a loop takes minutes for a million rows
        cells = np.ma.filled(np.ma.asarray(column).astype(np.float64), np.nan)[:, :size]
        vectors[: cells.shape[1]] = cells.T
        return vectors
    with refused(ValueError, said=f"column {name!r}: ", where=read.where):
        for k, cell in enumerate(column):
            numbers = _numbers(cell, number)[:size]
            vectors[: len(numbers), k] = numbers
    return vectors


def put_vector(read: Columns, new: Mapping[str, Array]) -> str:
    """Put correlations (N,) by name in the place of those in corr_vec, in its form, and return its column."""
    name = str(read.name("corr_vec"))
    column, vectors = read.table[name], _vectors(read, name, len(CORRELATIONS))
    for key, (i, j) in zip(CORRELATIONS, core.ALL_PAIRS, strict=False):
        row, values = vectors[j * (j - 1) // 2 + i], new.get(key, np.nan)
        np.copyto(row, values, where=np.isfinite(row) & np.isfinite(values))
    if column.ndim == 2:
        cells, rows = column.astype(np.float64), vectors.T[:, : column.shape[1]]
        known = np.isfinite(rows)
        cells[:, : len(vectors)][known] = rows[known]
    else:
        cells = column.astype(object)
        for k in np.flatnonzero(np.isfinite(vectors).any(axis=0)):
            numbers = _numbers(column[k])
            numbers[: len(vectors)] = vectors[: len(numbers), k]
            cells[k] = str(numbers.tolist()) if isinstance(column[k], str) else numbers
    read.table[name] = cells.astype(str) if column.dtype.kind in "SU" else cells
    return name


def _correlations(read: Columns, present: Flags, checked: bool) -> Array | None:
    """Return the correlations (10 or 36, N), 0 unless both parameters are ``present`` (5 or 9, N); None if there are
    none.
    """
    if (elements := hipparcos_elements(read)) is not None:
        return hipparcos_correlations(elements)
    keys = [*CORRELATIONS][: len(core.PAIRS) if len(present) == 5 else None]
    first, second = core.FIRST[: len(keys)], core.SECOND[: len(keys)]
    vector, named = read.name("corr_vec"), [read.name(key) for key in keys]
    names = [name or vector for name in named]
    known = {*names, *map(read.name, CORRELATIONS)}
    if alike := [name for name in read.names if _LIKE_CORRELATION.search(name) and name not in known]:
        said = f"{first_of(alike, 5)}: not used; if these are correlations"
        read.notes.append(f"{said}, say --column ra_dec_corr=NAME")
    if not any(names):
        return None
    correlations = np.array([np.full(len(read), np.nan) if name is None else read.numbers(name) for name in named])
    if vector:
        elements = _vectors(read, vector, 36)[second * (second - 1) // 2 + first]  # by columns
        differ = np.any(np.abs(correlations - elements) > ROUNDED, axis=0)
        read.check(differ, f"correlations in columns that contradict {vector}", hint="; leave out one of the two")
        correlations = np.where(np.isfinite(correlations), correlations, elements)
    elif len(keys) > 10 and not any(names[10:]):
        read.notes.append("no correlations of the accelerations: they count as 0, although they are large")
    both, known = present[first] & present[second], np.isfinite(correlations)
    blank = ~known.any(axis=1)  # which counts as no column
    gone = both & ~known & ~blank[:, None]
    for flags, name in zip(gone, names, strict=True):
        read.check(flags, f"no {name} (write 0 for none)")
    needed = both.any(axis=1) & ((second < len(PARAMETERS)) | any(names[10:]))
    absent = [key for key, lacks in zip(keys, blank & needed, strict=True) if lacks]
    correlations = np.where(both & known, correlations, 0.0)
    zero = f"no {first_of(absent, 5)}: a correlation without a column counts as 0" if absent else ""
    read.notes += [zero] if zero else []
    zero += "of corr_vec, the columns of the upper triangle one after the other" if vector else ""
    if checked:
        return correlations
    acting = correlations.any(axis=1)  # parameters that are correlated with none change nothing
    used, at = np.unique([first[acting], second[acting]], return_inverse=True)
    matrices, (i, j) = np.tile(np.eye(len(used)), (len(read), 1, 1)), at.reshape(2, -1)
    matrices[:, i, j] = matrices[:, j, i] = correlations[acting].T
    wrong, hint = ~(core.positive_definite(matrices) | gone.any(axis=0)), f"; {zero}" if zero else ""
    read.check(wrong, "correlations that are impossible (not positive definite)", hint=hint)
    return correlations


def _epochs(read: Columns, options: TableOptions) -> Array:
    """Return the Julian years of the rows, NaN for positions that hold at any."""
    epoch, any_epoch = options.epoch, options.extragalactic or read.table.meta.get("extragalactic") is True
    if options.extragalactic and epoch is not None:
        read.problems.append("positions of quasars hold at any epoch: give no epoch, or not --extragalactic")
    if epoch is None and not options.extragalactic and read.has("ref_epoch"):
        return read.epochs()
    # positions alone may be of quasars, or of a single epoch
    stated = HIPPARCOS_EPOCH if _is_hipparcos(read) else read.stated_epoch() if read.has("pmra") else None
    if not any_epoch and stated not in (None, epoch):
        instead = "" if epoch is None else f", not of {epoch:g}"
        read.notes.append(f"positions are of {stated:g}{instead}, says column {read.name('ra')!r}")
        epoch = stated if epoch is None else epoch
    if epoch is None and not any_epoch and read.has("ra"):
        said = "no column ref_epoch; give the epochs in one, or with --satellite-epoch, --reference-epoch or --epoch"
        if read.has("source_id"):
            said += f" ({', '.join(f'{name} is of {one.epoch:g}' for name, one in RELEASES.items() if name < 'dr5')})"
        read.problems.append(f"{said}, or say of quasars --extragalactic satellite or --extragalactic reference")
    return np.full(len(read), np.nan if epoch is None else epoch)


def _calibrators(read: Columns) -> dict[str, Any]:
    """Return the calibrators of rows and the errors (rad) that rows of a source share by them, if there are any."""
    there = read.has("calibrator"), read.has("calibrator_error")
    if any(there) and not all(there):
        said = "the errors of the calibrators' positions (mas), 0 where rows share none"
        read.problems.append(f"a column calibrator needs calibrator_error, {said}; the latter needs the former")
    if not all(there):
        return {}
    names = read.text(str(read.name("calibrator")), "")
    shared = np.where(names == "", 0.0, read.quantity("calibrator_error", "allowed", MAS))
    read.check(~((shared >= 0.0) & (shared < np.inf)), "a calibrator without an error that is 0 or more")
    low, high = CALIBRATORS
    if len(unlikely := np.flatnonzero((shared > 0.0) & ~((shared >= low * MAS) & (shared <= high * MAS)))):
        unit = "arcsec" if (median := np.median(shared[unlikely]) / MAS) < low else "uas"
        said = f"calibrator_error of {median:.2g} mas, {core.named_rows(unlikely)}"
        read.notes.append(f"{said}: is it in {unit}? Say --unit")
    return {"calibrator": names, "shared": shared}


def _radial_velocity(read: Columns) -> Array | None:
    if not read.has("radial_velocity"):
        return None
    velocity = read.quantity("radial_velocity", "allowed")
    fast = np.abs(velocity) > FASTEST_KM_S
    if np.any(fast):
        what = f"{read.name('radial_velocity')} beyond {FASTEST_KM_S:g} km/s, which no star has, is not used"
        read.notes.append(f"{what}: is its unit right? {core.named_rows(np.flatnonzero(fast))}")
    return np.where(fast, np.nan, velocity)


def _names(read: Columns) -> dict[str, Texts]:
    """Return the columns of names, best first, and after them all other text."""
    wanted = [read.columns["name"]] if "name" in read.columns else SOURCE_NAMES
    best = filter(None, (first_found([key], read.names) for key in wanted))
    others = [name for name in read.names if read.kind(name) in "US" and name != read.name("calibrator")]
    return {name: read.text(name) for name in dict.fromkeys([*best, *others])}


def _is_hipparcos(read: Columns) -> bool:
    """Return whether a table has the column RArad, by which Hipparcos-2 is recognised."""
    return any(name.casefold() == "rarad" for name in read.names)


def hipparcos_elements(read: Columns) -> Array | None:
    """Return U1..U15 of Hipparcos-2 from fifteen columns, one column of arrays or one of text; None without them."""
    for stem in ("UW", "U") if _is_hipparcos(read) else ():
        if all(f"{stem}{k}" in read.names for k in range(1, 16)):
            return np.array([read.numbers(f"{stem}{k}") for k in range(1, 16)])
    if "UW" not in read.names or not _is_hipparcos(read):
        return None
    elements = _vectors(read, "UW", 15, _ELEMENT_OF_HIPPARCOS)
    read.check(np.isnan(elements[-1]), "no fifteen numbers in column 'UW'")
    return np.nan_to_num(elements, nan=1.0)


def hipparcos_correlations(elements: Array) -> Array:
    """Return the ten correlations (10, N) from the elements U1..U15 (15, N): C is (U'U)^-1 up to a factor.

    U is stored column by column.  Source: Michalik et al. 2014, A&A 571, A85, appendix B.
    """
    upper = np.zeros((elements.shape[1], 5, 5))
    upper[:, *np.tril_indices(5)[::-1]] = elements.T
    half = np.linalg.inv(upper)
    return np.asarray(core.by_errors(half @ half.swapaxes(1, 2))[1][*np.array(core.PAIRS).T])


# ---- epoch astrometry

# Seconds that the Gaia archive gets to answer while gaiasupdate is imported.
NEWS_S = 1.0

# Columns of the archive with their units, those in which they are used, and the smallest and largest possible numbers
# in the former; DPAC's are called obsTimeTcb and so on. Light takes 520 s from the Earth to the barycentre at most.
TIME, ANGLE, LENGTH, NUMBER, ARC = ("ns", "ns"), ("deg", "rad"), ("mas", "rad"), ("", ""), 3.6e6
NEEDED = {
    **{"obs_time_tcb": (*TIME, -np.inf, np.inf), "obs_time_bary_corr": (*TIME, -6e11, 6e11)},
    **{"scan_pos_angle": (*ANGLE, -360.0, 360.0), "parallax_factor_al": (*NUMBER, -1.1, 1.1)},
    **{VALUE: (*LENGTH, -ARC, ARC), ERROR: (*LENGTH, 1e-6, ARC)},
}
USED = "used_by_agis_al"
PER_STAR = {"ra0": (*ANGLE, -180.0, 360.0), "dec0": (*ANGLE, -90.0, 90.0), NOISE: (*LENGTH, 0.0, ARC)}
OPTIONAL = PER_STAR | {"colour_factor_al": (*LENGTH, -ARC, ARC)}
# Of the archive's colour_factor_al to nm. Source: gaiasupdate 0.1.2.
COLOUR_FACTOR = -1e3

# When Gaia observed, in ns since 2010.0.
OBSERVED = (4.0 * 3.15576e16, 15.5 * 3.15576e16)

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
    doubt: mistakes.Misfit
    notes: Sequence[str]


def read_observations(path: Path) -> tuple[Any, list[str]]:
    """Return the observations in a file that AGIS used, a pandas DataFrame with a row for each passage of a CCD, and
    notes on those in which a number is missing, which are left out.

    Raises SweepError that names columns, units and numbers that are wrong, and their rows.
    """
    waiting = socket.getdefaulttimeout()
    try:
        # Its import asks the Gaia archive for news, and prints that there are none: behind a silent firewall only after
        # two minutes.
        socket.setdefaulttimeout(NEWS_S)
        with needed("gaiasupdate", "epochs", path), redirect_stdout(io.StringIO()):
            import gaiasupdate.epoch_astrometry  # noqa: F401  (it gives frames their methods)
    finally:
        socket.setdefaulttimeout(waiting)
    table = read_file(built_in(path))
    table.rename_columns(table.colnames, [re.sub("(?<=[a-z0-9])([A-Z])", r"_\1", n).lower() for n in table.colnames])
    if missing := [name for name in ("source_id", USED, *NEEDED) if name not in table.colnames]:
        raise SweepError(f"no column {', '.join(missing)}, which epoch astrometry of Gaia has", str(path))
    units = {name: unit for name, unit in (NEEDED | OPTIONAL).items() if name in table.colnames}
    cells = {"transit_id": np.arange(len(table)), "colour_factor_al": 0.0, NOISE: 0.0}
    read = Columns(table, str(path))
    with refused(ValueError, TypeError, said="cannot be read as epoch astrometry: ", where=path):
        frame = pd.DataFrame(cells | {name: _cells(table[name]) for name in (USED, *units)})
        for name in {"source_id", "transit_id"} & set(table.colnames):
            frame[name] = read.text(name)
        several = [name for name in (USED, *units) if frame[name].dtype == object]
        frame = (frame.explode(several) if several else frame).astype(dict.fromkeys((USED, *units), np.float64))
    frame = frame[frame.pop(USED).isin([1.0, ord("T")])].copy()  # the letter in FITS
    known = [name for name in units if name not in ("ra0", "dec0")]

    def rows(flags: Any) -> Flags:
        return np.isin(np.arange(len(table)), frame.index[flags])

    for name, (unit, used, low, most) in units.items():
        with refused(ValueError, TypeError, said=f"column {name!r}: ", where=path):
            frame[name] *= Unit(table[name].unit or unit).to(used)
        by, gone = Unit(unit).to(used), frame[name].isna()
        wrong = rows(~gone & ~frame[name].between(low * by, most * by))
        read.check(wrong, f"{name} outside {low:g}..{most:g} {unit}".rstrip())
        if name in known and gone.any():
            said = f"{path.name}: {gone.sum()} observations have no {name} and are not used, in row"
            read.notes.append(f"{said} {archives.rows_listed(rows(gone))}")
    frame = frame.dropna(subset=known, ignore_index=True)
    low, high = frame["obs_time_tcb"].min(), frame["obs_time_tcb"].max()
    if len(frame) and not OBSERVED[0] < low <= high < OBSERVED[1]:
        read.problems.append(f"obs_time_tcb of {low:.8g} to {high:.8g} is not ns since 2010.0, when Gaia observed")
    read.finish()
    frame.epochastrometryarchive.set_relative_time()
    return frame.assign(file=str(path), colour_factor_al=frame["colour_factor_al"] * COLOUR_FACTOR), read.notes


def _cells(column: Any) -> Any:
    """Return the numbers of a column, or lists of them where it has several in each row."""
    if column.dtype.kind in "USO":  # text, which gaiasupdate would run as code, or arrays of several lengths
        return [_numbers(cell) for cell in column]
    values = np.ma.filled(np.ma.asarray(column).astype(np.float64), np.nan)
    return values if column.ndim == 1 else list(values)


def with_observations(
    left: AstrometricTable, files: Sequence[str | Path], models: Mapping[str, str], orbits: str | Path | None
) -> tuple[AstrometricTable, Epochs]:
    """Return a satellite's table in which the observations in files take the place of the rows of their stars.

    ``models`` are those of `MODELS` by star, or for "all"; ``orbits`` is a table of the elements of orbits.  Raises
    SweepError for what is wrong in the files, sources that are not in the table, and paths that are not determined.
    """
    handlers = logging.root.handlers[:]
    frames, remarks = zip(*(read_observations(Path(file)) for file in files), strict=True)
    frame, notes = pd.concat(frames, ignore_index=True), [note for one in remarks for note in one]
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
        unused = f"no observation in {where} was used by AGIS and is whole"
        raise SweepError(strangers if unknown else unused, left.path)
    rows, star = np.unique(frame["place"].to_numpy(dtype=np.int64), return_inverse=True)
    frame["transit_id"] = frame.groupby(["place", "file", "transit_id"], sort=False).ngroup()
    stars, names = left.astrometry.taken(rows), columns[0]
    others = first_of(np.delete(names, rows).tolist(), 5)
    notes += [strangers] * bool(unknown) + [f"no observations of {others}, which keep their rows"] * bool(others)
    of_star = frame.reindex(columns=[*PER_STAR]).groupby(star)
    changes = {name: names[rows][(of_star[name].nunique() > 1).to_numpy()] for name in PER_STAR}
    if problems := [f"{name} changes within {first_of([*at], 5)}" for name, at in changes.items() if len(at)]:
        raise SweepError(problems, where)
    *origin, _ = of_star.first().to_numpy().T
    blank = np.isnan(origin).any(axis=0)
    without = f"without ra0 and dec0 transits are relative to the row: {first_of(names[rows][blank].tolist(), 5)}"
    notes += [without] * bool(blank.any())
    if np.any(other := blank & (stars.epoch != epoch)):
        said = f"the observations are from positions at {epoch:g}, and the rows have those at {stars.epoch[other][0]:g}"
        raise SweepError(f"{said}: take the table of the same release, or files with ra0 and dec0", left.path)
    origin = np.where(blank, stars.values[:2], origin)
    used = set(rows.tolist())
    model, orbit = _models({name: k for name, k in place.items() if k in used}, models, orbits, epoch, notes)
    observed = {str(name): frame[name].to_numpy() for name in frame.select_dtypes("number")}
    transits = Transits(star, observed, model, orbit, origin, epoch, names[rows], stars)
    with refused(LinkError, where=where):
        paths = transits.paths()
        for _ in range(3 if np.any(model != "5") else 0):  # AGIS has no other path, so that its noise is what is left
            each = ((star == s, max(paths.dof[s], 1.0)) for s in range(len(rows)))
            left_over = [estimate_excess_noise(paths.residuals[at], observed[ERROR][at], 1.0, n) for at, n in each]
            least = np.where(model == "5", np.inf, left_over)[star]
            transits = replace(transits, observed=observed | {NOISE: np.minimum(observed[NOISE], least)})
            paths = transits.paths()
        doubt = misfit(transits)
    logging.root.handlers[:] = handlers  # gaiasupdate logs in such a way that Python adds one, which repeats our lines
    digests = {str(file): digest_of(built_in(Path(file))) for file in files}
    epochs = Epochs(transits, paths, rows, digests, doubt, [*notes, *_coarse_angles(observed)])
    return replace(left, astrometry=transits.in_place(paths, left.astrometry, rows)), epochs


def _coarse_angles(observed: Mapping[str, Array]) -> list[str]:
    """Return a note on angles that are rounded too much: they turn positions, by distances as large as those along."""
    angles = observed[ERROR] / (np.abs(observed[VALUE]) + observed[ERROR])
    said = "scan_pos_angle has too few digits for the errors of the positions: were digits lost?"
    return [said] if len(too_coarse(observed["scan_pos_angle"], angles, (1.0, DEGREE))) else []


def _models(
    place: Mapping[str, int], models: Mapping[str, str], orbits: str | Path | None, epoch: float, notes: list[str]
) -> tuple[Any, Array]:
    """Return the model of each star with observations, in the order of their rows, and its orbit (7, S); add notes."""
    elements = {} if orbits is None else _orbits(place, Path(orbits), epoch, notes)
    said = dict.fromkeys(elements, "orbit")
    for star, model in models.items():
        if model not in MODELS or not (star == "all" or star in place):
            known = f"models are {', '.join(MODELS)}, stars with observations {first_of(list(place), 5)}"
            raise SweepError(f"model {model} of {star}: {known}")
        if star in place and model != (other := said.setdefault(place[star], model)):
            raise SweepError(f"model {model} of {star}, which has the model {other} too: which of them?")
    chosen = {row: said.get(row, models.get("all", "5")) for row in sorted(set(place.values()))}
    if absent := [star for star, row in place.items() if chosen[row] == "orbit" and row not in elements]:
        raise SweepError(f"no elements of the orbit of {absent[0]}: give a table with --orbits")
    return np.array(list(chosen.values())), np.array([elements.get(row, np.zeros(7)) for row in chosen]).T


def _orbits(place: Mapping[str, int], path: Path, epoch: float, notes: list[str]) -> dict[int, Array]:
    """Return the elements of orbits, as `bends` needs them, by row of the satellite's table; add notes."""
    table = read_file(path)
    read, star = Columns(table, str(path)), first_found(SOURCE_NAMES, table.colnames)
    shapes = [shape for shape in (THIELE_INNES, CAMPBELL) if shape[0] in table.colnames] or [CAMPBELL]
    for name in ("period", "eccentricity", "t_periastron", *chain(*shapes), *([] if star else ["source_id"])):
        read.require(name)
    read.finish()
    days, time, e = (read.quantity(name, "allowed") for name in ("period", "t_periastron", "eccentricity"))
    period = days / core.DAYS_PER_YEAR
    start = read.julian_years("ref_epoch") if "ref_epoch" in table.colnames else epoch
    of_dates, since = archives.years_of_days(time), start + time / core.DAYS_PER_YEAR
    periastron = np.where(time > archives.MJD_FROM, of_dates, since) - epoch
    planes = []
    if THIELE_INNES in shapes:
        planes.append(np.array([read.numbers(name) for name in THIELE_INNES]).T.reshape(-1, 2, 2))
    if CAMPBELL in shapes:
        angles = [read.quantity(name, "allowed", DEGREE) for name in CAMPBELL]
        planes.append(Rotation.from_euler("ZXZ", np.array(angles).T).as_matrix()[:, :2, :2].swapaxes(1, 2))
    whole = np.isfinite(np.array(planes)).all(axis=(2, 3)) & np.any(planes, axis=(2, 3))
    plane = np.where(whole[..., None, None], planes, np.eye(2))
    plane /= np.linalg.norm(plane, ord=2, axis=(2, 3), keepdims=True)  # the largest singular value is the semi-axis
    rows = np.array([place.get(name, -1) for name in read.text(str(star))])
    used = (rows >= 0) & whole.any(axis=0)
    if np.any(gone := (rows >= 0) & ~used):
        notes.append(f"{path.name}: no orbit on the sky, and so none that is used, in row {archives.rows_listed(gone)}")
    orbit = np.array([period, e, periastron, *plane[whole.argmax(axis=0), np.arange(len(rows))].reshape(-1, 4).T])
    closed = (period > 0.0) & (e >= 0.0) & (e < 1.0) & np.isfinite(periastron)
    read.check(used & ~closed, "a period, an eccentricity or other elements of no orbit")
    unlike = whole.all(axis=0) & (np.ptp(plane, axis=0).max(axis=(1, 2)) > 0.02)
    read.check(used & unlike, "Thiele-Innes elements and angles of two orbits")
    stars, number = np.unique(rows[used], return_counts=True)
    read.check(used & np.isin(rows, stars[number > 1]), "one of several orbits of a star")
    read.problems += [] if len(stars) else ["has no whole orbit of a star with observations"]
    read.finish()
    return {row: orbit[:, k] for k, row in enumerate(rows.tolist()) if used[k]}


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
