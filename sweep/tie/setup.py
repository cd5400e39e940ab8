"""The problem that follows from two or more tables and the options: matched rows, what is done to them, unknowns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.frames import GALACTIC_AXES, MAS, Array, Indices, triad
from linksweep.core.link import LinkError
from linksweep.core.tie.astrometry import KINDS, PAIRS, Astrometry, joined, kinds, named_rows
from linksweep.core.tie.clips import SourceTable
from linksweep.core.tie.problem import Problem
from linksweep.core.unknowns import Rotation, SpinByBin, Unknowns, parse_unknowns
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tables.reader import read_table as read_file
from linksweep.sweep.tie.matching import Match, far_rows, match, match_notes
from linksweep.sweep.tie.options import SIGNS, Options, TableOptions
from linksweep.sweep.tie.tables import AstrometricTable, read_table

ICRF3_EPOCH = 2015.0

ALL = "all"
"""Stands for every kind of row that has no jitter of its own."""

ZERO_MOTION = "zero-motion"
"""Stands for a reference whose sources do not move: quasars, for which only the satellite's table is needed."""


@dataclass(frozen=True)
class Setup:
    """The tables as read and matched, and the problem of the matched sources (S) and rows (R).

    ``sources`` (S,) are places in the satellite's table, ``names`` (S,) their names, or numbers.  ``missions`` are the
    further tables by name; the rows of the first one have the frame 1, and so on.
    """

    satellite: AstrometricTable
    reference: AstrometricTable
    matched: Match
    problem: Problem
    sources: Indices
    names: NDArray[Any]
    notes: tuple[str, ...] = ()
    missions: Mapping[str, AstrometricTable] = field(default_factory=dict)

    def only(self, sources: Indices) -> "Setup":
        """Return the setup of some of the matched sources and their rows."""
        problem = self.problem.only(sources)
        return replace(self, problem=problem, sources=self.sources[sources], names=self.names[sources])


def set_up(satellite: str | Path, reference: str | Path, options: Options, all_sources: bool = False) -> Setup:
    """Read, match and combine tables; raises SweepError for whatever is wrong with them or the options.

    ``all_sources`` keeps sources without rows, for forecasts.
    """
    options.check()
    left = read_table(Path(satellite), options.satellite_options)
    n = len(left.astrometry)
    if len(without := np.flatnonzero(~np.isfinite(left.astrometry.values[:2]).all(axis=0))):
        raise SweepError(
            f"each source needs a position, and there is no ra and dec in {named_rows(without)}", left.path
        )
    notes = left.named_notes()
    tables, matches, parts = [], [], []
    for frame, name in enumerate((None, *options.missions)):
        if name is None and str(reference) == ZERO_MOTION:
            table = AstrometricTable(ZERO_MOTION, "", zero_motion(n), left.names)
            matched = Match(np.arange(n), np.arange(n), "the satellite's sources", np.zeros(0, dtype=np.int64))
        else:
            how = options.reference_options if name is None else options.mission_options.get(name, TableOptions())
            table = read_table(Path(reference if name is None else options.missions[name]), how)
            matched = match(left, table, options.by)
            far = far_rows(left, table, matched)
        rows = with_jitter(_taken(table.astrometry, matched.rows), options.jitter_in(name))
        if table.path != ZERO_MOTION:
            notes += [*table.named_notes(), *match_notes(table, matched, rows), *far]
        if name is not None:
            rows = replace(rows, frame=np.full(len(rows), frame))
        elif options.aberration:
            rows = _aberrated(rows, left.astrometry.epoch[matched.source], options.aberration)
        tables.append(table)
        matches.append(matched)
        parts.append(rows)
    sources = np.arange(n) if all_sources else np.unique(np.concatenate([matched.source for matched in matches]))
    place = np.full(n, -1)
    place[sources] = np.arange(len(sources))
    source = place[np.concatenate([matched.source for matched in matches])]
    names = _names(left, tables[0], matches[0])[sources]
    own = replace(_taken(left.astrometry, sources), names=names)
    rows = parts[0] if len(parts) == 1 else joined(*parts)
    epoch = default_epoch(own.epoch) if options.epoch is None else options.epoch
    notes += _resting(own, rows, source)
    try:
        unknowns = unknowns_for(options, own, rows, source, epoch, notes)
        known = None if options.known_spin is None else known_spin(options.known_spin, own, SIGNS[options.sign])
    except ValueError as error:  # LinkError is one
        raise SweepError(str(error)) from error
    problem = Problem(own, rows, source, unknowns, epoch, options.weights, known)
    missions = dict(zip(options.missions, tables[1:], strict=True))
    return Setup(left, tables[0], matches[0], problem, sources, names, tuple(dict.fromkeys(notes)), missions)


def _taken(table: Astrometry, rows: Indices) -> Astrometry:
    return table if np.array_equal(rows, np.arange(len(table))) else table.taken(rows)


def _names(left: AstrometricTable, reference: AstrometricTable, matched: Match) -> NDArray[np.str_]:
    """Return the names of all sources: the satellite's first column of names, else the reference's, else numbers."""
    if left.names:
        return next(iter(left.names.values()))
    names = np.arange(1, len(left.astrometry) + 1).astype(np.str_).astype(object)
    if reference.names:
        names[matched.source] = next(iter(reference.names.values()))[matched.rows]
    return names.astype(np.str_)


def _resting(own: Astrometry, rows: Astrometry, source: Indices) -> list[str]:
    """Return a note if single-epoch positions are of sources without parallaxes and motions, like quasars."""
    if rows.apparent is None or not np.any(seen := rows.apparent & (kinds(rows) == "single epoch")):
        return []
    size = np.where(own.present[2:], (own.values[2:] / np.where(own.present[2:], own.errors[2:], 1.0)) ** 2, np.nan)
    observed = np.unique(source[seen])
    if len(observed) < 5 or not np.nanmean(size[:, observed]) < 4.0:
        return []
    said = "positions of a single epoch are displaced by parallaxes, and these sources have none, nor motions"
    return [f"{said}: if they are quasars, say --extragalactic reference"]


def zero_motion(n: int) -> Astrometry:
    """Return n rows of a reference whose sources do not move."""
    zeros = np.broadcast_to(np.array([np.nan, np.nan, np.nan, 0.0, 0.0])[:, None], (5, n))  # takes no memory
    return Astrometry(zeros, zeros, np.broadcast_to(np.nan, n))


def default_epoch(epochs: Array) -> float:
    """Return the median epoch of the sources (Julian year), or that of ICRF3 if none has an epoch."""
    known = epochs[np.isfinite(epochs)]
    return float(np.median(known)) if len(known) else ICRF3_EPOCH


# ---- what is done to the rows of a reference before the solution


def with_jitter(rows: Astrometry, jitter: Mapping[str, tuple[float, float]]) -> Astrometry:
    """Return rows with (mas, mas/yr) added in quadrature to the errors of each kind, or of "all"; covariances do not
    change.

    Raises SweepError for sizes that are negative or not finite, unknown kinds, and kinds of which there is no row.
    """
    if not jitter:
        return rows
    known = [*KINDS.values(), "single epoch", ALL]
    if unknown := sorted(set(jitter) - set(known)):
        raise SweepError(f"jitter: no kind of row {', '.join(unknown)}; kinds are {', '.join(known)}")
    kind_of_row = kinds(rows)
    if absent := sorted(set(jitter) - {ALL, *kind_of_row.tolist()}):
        there = ", ".join(np.unique(kind_of_row))
        raise SweepError(f"jitter: no row is of the kind {', '.join(absent)}; there are {there}")
    added = np.zeros_like(rows.errors)
    for kind, (position, motion) in jitter.items():
        if not (0.0 <= position < np.inf and 0.0 <= motion < np.inf):
            raise SweepError(f"jitter of {kind}: {position:g}, {motion:g}: must be finite and not negative")
        at = kind_of_row == kind if kind != ALL else ~np.isin(kind_of_row, list(jitter))  # a named kind has its own
        added[:, at] = MAS * np.array([position, position, position, motion, motion])[:, None]
    errors = np.hypot(rows.errors, added)
    correlations = rows.correlations
    if correlations is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            shrunk = np.where(errors > 0.0, rows.errors / errors, 1.0)
        correlations = np.array([c * shrunk[i] * shrunk[j] for c, (i, j) in zip(correlations, PAIRS, strict=True)])
    return replace(rows, errors=errors, correlations=correlations)


def _aberrated(rows: Astrometry, to_epoch: Array, aberration: float) -> Astrometry:
    """Return positions without an epoch carried from 2015.0 to another by the Galactic aberration (uas/yr).

    Sources appear to move towards the Galactic centre.  Source: Charlot et al. 2020, A&A 644, A159.  Raises SweepError
    if there are no such positions.
    """
    if not np.any(rows.present[0] & np.isnan(rows.epoch) & np.isfinite(to_epoch)):
        raise SweepError(
            "aberration carries positions without an epoch from 2015.0 to that of their source, and no row of the "
            "reference is such a position"
        )
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
    mag_max for phot_g_mean_mag, and omega_x, omega_y, omega_z in mas/yr or their unit.  Raises SweepError for anything
    else, and for sources outside its bins.
    """
    if not isinstance(spin, (str, Path)):
        vector = np.asarray(spin, dtype=np.float64)
        if vector.shape != (3,) or not np.all(np.isfinite(vector)):
            raise SweepError(f"known spin {spin!r}: give three numbers in mas/yr, or the path of a table")
        return Unknowns((Rotation(),)), sign * vector * MAS
    from astropy import units

    table = read_file(Path(spin))
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
    components = (table[f"omega_{axis}"] for axis in "xyz")
    in_unit = [np.asarray(c, dtype=np.float64) * units.Unit(c.unit or "mas/yr").to("mas/yr") for c in components]
    vectors = np.stack(in_unit, axis=1)
    edges, used = tuple(low_edges[1:].tolist()), tuple(range(len(low_edges)))
    block = SpinByBin(column=column, edges=edges, used=used)
    return Unknowns((block,)), sign * vectors.ravel() * MAS


# ---- unknowns


def unknowns_for(
    options: Options, own: Astrometry, rows: Astrometry, source: Indices, epoch: float, notes: list[str]
) -> Unknowns:
    """Return the unknowns of the options; if none are named, those of orientation and spin that the rows determine.

    A note is added if these are not both.  Raises ValueError for unknowns that do not exist.
    """
    missions = list(options.missions)
    names = [name.strip() for name in (options.unknowns or "").split(",") if name.strip()]
    of_missions = [name for name in names if name.partition(":")[0] in missions]
    names = [name for name in names if name not in of_missions]
    if options.unknowns is None or (of_missions and not names):
        in_reference = np.arange(len(rows)) if rows.frame is None else np.flatnonzero(rows.frame == 0)
        names = _determined(own, rows.taken(in_reference), source[in_reference], epoch)
        if len(names) == 1:
            notes.append(f"of orientation and spin the tables determine only the {names[0]}")
    for rotation, glide, harmonics in (
        ("orientation", "position_glide", "vsh_position"),
        ("spin", "glide", "vsh_motion"),
    ):
        if options.degree is not None and rotation in names:
            names += [glide] if glide not in names else []
            names += [f"{harmonics}:2-{options.degree}"] if options.degree > 1 else []
    names += of_missions
    for mission in missions:
        if not any(name.startswith(f"{mission}:") for name in of_missions):
            names += _determined(own, rows, source, epoch, names, mission, missions)
    return parse_unknowns(",".join(names), options.bins, own.columns, options.corrections, missions)


def _determined(
    own: Astrometry,
    rows: Astrometry,
    source: Indices,
    epoch: float,
    beside: Sequence[str] = (),
    mission: str = "",
    missions: Sequence[str] = (),
) -> list[str]:
    """Return those of orientation and spin, of the satellite or a mission, that rows determine together with others."""
    for blocks in (("orientation", "spin"), ("orientation",), ("spin",)):
        names = [f"{mission}:{block}" if mission else block for block in blocks]
        unknowns = parse_unknowns(",".join([*beside, *names]), missions=missions)
        try:
            SourceTable(Problem(own, rows, source, unknowns, epoch)).solve(np.ones(len(own)))
        except LinkError:
            continue
        return names
    frame = f"the frame of {mission}" if mission else "the satellite's frame"
    raise LinkError(f"the tables determine neither the orientation nor the spin of {frame}")
