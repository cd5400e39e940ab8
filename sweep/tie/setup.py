"""The problem that two tables and some options make."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.constants import GALACTIC_AXES, MAS
from core.frames import triad
from core.link import LinkError
from core.tie.astrometry import KINDS, Astrometry, kinds
from core.tie.elimination import Weights
from core.tie.normal_sums import Problem, inverted
from core.tie.sources import SourceTable
from core.unknowns import Rotation, SpinByBin, Unknowns, parse_unknowns
from sweep import table_reader
from sweep.contract import SweepError
from sweep.tie.matching import Match, match
from sweep.tie.tables import AstrometricTable, TableOptions, read_table

Array = NDArray[np.float64]
Sign = Literal["reference-satellite", "satellite-reference"]
SIGNS: Mapping[str, float] = {"reference-satellite": 1.0, "satellite-reference": -1.0}

ZERO_MOTION = "zero-motion"
"""Stands for a reference whose sources do not move: quasars, with the satellite's table alone."""

ICRF3_EPOCH = 2015.0


@dataclass(frozen=True)
class Options:
    """What is asked of two tables.

    ``unknowns`` as in `parse_unknowns`, None for those of orientation and spin that the tables determine; ``degree``
    adds vector spherical harmonics up to it.  ``bins`` are a column and edges.  ``epoch`` (Julian year) is that of the
    orientation, by default the satellite's.  ``known_spin`` is a vector (mas/yr, in the sign of ``sign``) or the path
    of a table by magnitude.  ``jitter`` maps kinds of rows to (mas, mas/yr) added in quadrature.  ``aberration``
    (uas/yr) carries reference positions without an epoch from 2015.0 to the satellite's.
    """

    unknowns: str | None = None
    degree: int | None = None
    bins: tuple[str, Sequence[float]] | None = None
    by: str | None = None
    epoch: float | None = None
    weights: Weights = "covariance"
    known_spin: Sequence[float] | str | Path | None = None
    jitter: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sign: Sign = "reference-satellite"
    corrections: bool = True
    aberration: float = 0.0
    satellite_options: TableOptions = field(default_factory=TableOptions)
    reference_options: TableOptions = field(default_factory=TableOptions)


@dataclass(frozen=True)
class Setup:
    """The tables as read and matched, and the problem of the matched sources (S) and rows (R).

    ``sources`` (S,) are places in the satellite's table, ``names`` (S,) their names.
    """

    satellite: AstrometricTable
    reference: AstrometricTable
    matched: Match
    problem: Problem
    sources: NDArray[np.int64]
    names: NDArray[np.str_]
    notes: tuple[str, ...] = ()


def set_up(satellite: str | Path, reference: str | Path, options: Options, all_sources: bool = False) -> Setup:
    """Read, match and combine two tables; raises SweepError for whatever is wrong with them or the options.

    ``all_sources`` keeps sources without rows, for forecasts.
    """
    if options.sign not in SIGNS:
        raise SweepError(f"sign {options.sign!r}: it is {' or '.join(SIGNS)}")
    if options.weights not in ("covariance", "variance", "equal"):
        raise SweepError(f"weights {options.weights!r}: they are covariance, variance or equal")
    left = read_table(Path(satellite), options.satellite_options)
    if not np.all(np.isfinite(left.astrometry.values[:2])):
        raise SweepError("sources without a position", left.path)
    if str(reference) == ZERO_MOTION:
        right = _zero_motion(left)
        n = len(left.astrometry)
        matched = Match(np.arange(n), np.arange(n), "the satellite's sources", np.zeros(0, dtype=np.int64))
    else:
        right = read_table(Path(reference), options.reference_options)
        matched = match(left, right, options.by)
    sources = np.arange(len(left.astrometry)) if all_sources else np.unique(matched.source)
    everything = len(sources) == len(left.astrometry)
    own = left.astrometry if everything else left.astrometry.taken(sources)
    all_rows = np.array_equal(matched.rows, np.arange(len(right.astrometry)))
    rows = right.astrometry if all_rows else right.astrometry.taken(matched.rows)
    place = np.full(len(left.astrometry), -1)
    place[sources] = np.arange(len(sources))
    names = _names(left, right, matched, sources)
    own = replace(own, names=names)
    rows = with_jitter(rows, options.jitter)
    epoch = _epoch(own, options.epoch)
    if options.aberration:
        rows = aberrated(rows, own.epoch[place[matched.source]], options.aberration)
    notes: list[str] = []
    try:
        unknowns = _unknowns(options, own, rows, place[matched.source], epoch, notes)
        known = None if options.known_spin is None else known_spin(options.known_spin, own, SIGNS[options.sign])
    except ValueError as error:  # LinkError is one
        raise SweepError(str(error)) from error
    problem = Problem(own, rows, place[matched.source], unknowns, epoch, options.weights, known)
    return Setup(left, right, matched, problem, sources, names, tuple(notes))


def with_jitter(rows: Astrometry, jitter: Mapping[str, tuple[float, float]]) -> Astrometry:
    """Return rows with (mas, mas/yr) added in quadrature to the errors of each kind; correlations keep covariances."""
    if not jitter:
        return rows
    known = [*KINDS.values(), "single epoch"]
    if unknown := sorted(set(jitter) - set(known)):
        raise SweepError(f"jitter: no kind of row {', '.join(unknown)}; kinds are {', '.join(known)}")
    of = kinds(rows)
    added = np.zeros_like(rows.errors)
    for kind, (position, motion) in jitter.items():
        if not (0.0 <= position < np.inf and 0.0 <= motion < np.inf):
            raise SweepError(f"jitter of {kind}: {position:g}, {motion:g}: errors are finite and not negative")
        added[:, of == kind] = MAS * np.array([position, position, position, motion, motion])[:, None]
    errors = np.hypot(rows.errors, added)
    correlations = rows.correlations
    if correlations is not None:
        from core.tie.astrometry import PAIRS

        with np.errstate(invalid="ignore", divide="ignore"):
            shrunk = np.where(errors > 0.0, rows.errors / errors, 1.0)
        correlations = np.array([c * shrunk[i] * shrunk[j] for c, (i, j) in zip(correlations, PAIRS, strict=True)])
    return replace(rows, errors=errors, correlations=correlations)


def aberrated(rows: Astrometry, to_epoch: Array, aberration: float) -> Astrometry:
    """Return positions without an epoch carried from 2015.0 to another by the Galactic aberration (uas/yr).

    Sources seem to move towards the Galactic centre.  Source: Charlot et al. 2020, A&A 644, A159.
    """
    p, q, _ = triad(rows.values[0], rows.values[1])
    years = np.where(np.isfinite(rows.epoch) | ~np.isfinite(to_epoch), 0.0, to_epoch - ICRF3_EPOCH)
    glide = GALACTIC_AXES[0] * aberration * MAS / 1000.0
    values = rows.values.copy()
    values[0] += years * (glide @ p) / np.cos(rows.values[1])
    values[1] += years * (glide @ q)
    return replace(rows, values=values)


def known_spin(spin: Sequence[float] | str | Path, own: Astrometry, sign: float) -> tuple[Unknowns, Array]:
    """Return the block and the values (rad/yr) of a spin that is known: a vector, or a table by bins of a column.

    A table has columns COLUMN_min and COLUMN_max of the satellite's magnitude (or other) COLUMN, or mag_min and
    mag_max of phot_g_mean_mag, and omega_x, omega_y, omega_z in mas/yr or their unit.  Raises SweepError for anything
    else, and for sources outside its bins.
    """
    if not isinstance(spin, (str, Path)):
        vector = np.asarray(spin, dtype=np.float64)
        if vector.shape != (3,) or not np.all(np.isfinite(vector)):
            raise SweepError(f"known spin {spin!r}: give three numbers in mas/yr, or the path of a table")
        return Unknowns((Rotation(),)), sign * vector * MAS
    from astropy import units

    table = table_reader.read_table(Path(spin))
    lows = [name for name in table.colnames if name.endswith("_min")]
    if len(lows) != 1 or (high := lows[0][:-4] + "_max") not in table.colnames:
        raise SweepError("a table of spins has one column COLUMN_min and one COLUMN_max", str(spin))
    if missing := [f"omega_{axis}" for axis in "xyz" if f"omega_{axis}" not in table.colnames]:
        raise SweepError(f"no column {', '.join(missing)}", str(spin))
    table.sort(lows[0])
    low_edges, high_edges = (np.asarray(table[name], dtype=np.float64) for name in (lows[0], high))
    column = {"mag": "phot_g_mean_mag", "G": "phot_g_mean_mag"}.get(lows[0][:-4], lows[0][:-4])
    if column not in own.columns:
        raise SweepError(f"the satellite has no column {column!r} of numbers for the known spin", str(spin))
    if np.any(low_edges[1:] != high_edges[:-1]) or np.any(high_edges <= low_edges):
        raise SweepError(f"the bins of {lows[0]} and {high} do not follow one another", str(spin))
    values = own.columns[column]
    outside = ~((values >= low_edges[0]) & (values < high_edges[-1]))
    if np.any(outside):
        raise SweepError(f"{np.count_nonzero(outside)} matched sources have a {column} outside its bins", str(spin))
    vectors = np.stack(
        [
            np.asarray(table[f"omega_{axis}"], dtype=np.float64)
            * (units.Unit(table[f"omega_{axis}"].unit or "mas/yr").to("mas/yr"))
            for axis in "xyz"
        ],
        axis=1,
    )
    block = SpinByBin(column, tuple(low_edges[1:].tolist()), tuple(range(len(low_edges))))
    return Unknowns((block,)), sign * vectors.ravel() * MAS


def _zero_motion(satellite: AstrometricTable) -> AstrometricTable:
    n = len(satellite.astrometry)
    zeros = np.broadcast_to(np.array([np.nan, np.nan, np.nan, 0.0, 0.0])[:, None], (5, n))  # takes no memory
    rows = Astrometry(zeros, zeros, np.broadcast_to(np.nan, n))
    return AstrometricTable(ZERO_MOTION, "", rows, satellite.names)


def _names(
    left: AstrometricTable, right: AstrometricTable, found: Match, sources: NDArray[np.int64]
) -> NDArray[np.str_]:
    """Return what sources are called: the satellite's first column of names, else the reference's, else numbers."""
    if left.names:
        return next(iter(left.names.values()))[sources]
    named = {int(s): str(s + 1) for s in sources}
    if right.names:
        column = next(iter(right.names.values()))
        named |= {int(s): str(column[r]) for r, s in zip(found.rows, found.source, strict=True)}
    return np.array([named[int(s)] for s in sources])


def _epoch(own: Astrometry, asked: float | None) -> float:
    if asked is not None:
        return asked
    known = own.epoch[np.isfinite(own.epoch)]
    return float(np.median(known)) if len(known) else ICRF3_EPOCH


def _unknowns(
    options: Options, own: Astrometry, rows: Astrometry, source: NDArray[np.int64], epoch: float, notes: list[str]
) -> Unknowns:
    text = options.unknowns
    if text is None:
        text = _determined(own, rows, source, epoch)
        if text != "orientation,spin":
            notes.append(f"the tables determine the {text} only")
    if options.degree is not None:
        names = [name.strip() for name in text.split(",")]
        if options.degree < 1:
            raise SweepError(f"degree {options.degree}: it is at least 1")
        for first, glide, harmonics in (
            ("orientation", "position_glide", "vsh_position"),
            ("spin", "glide", "vsh_motion"),
        ):
            if first in names:
                names += [glide] if glide not in names else []
                names += [f"{harmonics}:2-{options.degree}"] if options.degree > 1 else []
        text = ",".join(names)
    return parse_unknowns(text, options.bins, own.columns, options.corrections)


def _determined(own: Astrometry, rows: Astrometry, source: NDArray[np.int64], epoch: float) -> str:
    """Return those of orientation and spin that the tables determine."""
    for text in ("orientation,spin", "orientation", "spin"):
        table = SourceTable(Problem(own, rows, source, parse_unknowns(text), epoch))
        try:
            if table.single:
                inverted(table.sums.normal.sum(axis=0))
            else:
                table.solve(np.ones(len(own)))
        except LinkError:
            continue
        return text
    raise LinkError("the tables determine neither the orientation nor the spin")
