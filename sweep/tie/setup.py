"""The problem that follows from two or more tables and the options."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array, Indices
from linksweep.core.constants import DEGREE
from linksweep.core.tie.astrometry import Astrometry, joined, kinds, named_rows
from linksweep.core.tie.problem import Problem
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tie.column_names import TableOptions
from linksweep.sweep.tie.matching import Match, match, separations
from linksweep.sweep.tie.options import SIGNS, Options
from linksweep.sweep.tie.reference_rows import ICRF3_EPOCH, aberrated, known_spin, with_jitter
from linksweep.sweep.tie.tables import AstrometricTable, read_table
from linksweep.sweep.tie.unknowns_of import unknowns_of

FAR_DEG, FARTHEST_DEG = 10.0 / 3600.0, 1.0
"""Separations from the source of the same name above which a row is noted, and is refused."""

SAME_EPOCH_YR = 0.005
"""Rows of a source within two days may be the same measurement."""

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


@dataclass(frozen=True)
class _Part:
    """A table of rows with its match, the number of its frame, and its rows as they enter the problem."""

    table: AstrometricTable
    matched: Match
    rows: Astrometry
    notes: Sequence[str] = ()


def set_up(satellite: str | Path, reference: str | Path, options: Options, all_sources: bool = False) -> Setup:
    """Read, match and combine tables; raises SweepError for whatever is wrong with them or the options.

    ``all_sources`` keeps sources without rows, for forecasts.
    """
    options.check()
    left = read_table(Path(satellite), options.satellite_options)
    if len(without := np.flatnonzero(~np.isfinite(left.astrometry.values[:2]).all(axis=0))):
        raise SweepError(
            f"each source needs a position, and there is no ra and dec in {named_rows(without)}", left.path
        )
    parts = [_reference(left, reference, options)]
    parts += [_mission(left, name, number, options) for number, name in enumerate(options.missions, 1)]
    matched = np.concatenate([part.matched.source for part in parts])
    sources = np.arange(len(left.astrometry)) if all_sources else np.unique(matched)
    place = np.full(len(left.astrometry), -1)
    place[sources] = np.arange(len(sources))
    names = _names(left, parts[0], sources)
    own = replace(_taken(left.astrometry, sources), names=names)
    rows = parts[0].rows if len(parts) == 1 else joined(*(part.rows for part in parts))
    source = place[matched]
    epoch = default_epoch(own.epoch) if options.epoch is None else options.epoch
    notes = left.named_notes()
    for part in parts:
        notes += [*part.table.named_notes(), *_unmatched(part), *part.notes]
    notes += _resting(own, rows, source)
    try:
        unknowns = unknowns_of(options, own, rows, source, epoch, notes)
        known = None if options.known_spin is None else known_spin(options.known_spin, own, SIGNS[options.sign])
    except ValueError as error:  # LinkError is one
        raise SweepError(str(error)) from error
    problem = Problem(own, rows, source, unknowns, epoch, options.weights, known)
    missions = {name: part.table for name, part in zip(options.missions, parts[1:], strict=True)}
    return Setup(left, parts[0].table, parts[0].matched, problem, sources, names, tuple(dict.fromkeys(notes)), missions)


def _reference(left: AstrometricTable, reference: str | Path, options: Options) -> _Part:
    if str(reference) == ZERO_MOTION:
        n = len(left.astrometry)
        matched = Match(np.arange(n), np.arange(n), "the satellite's sources", np.zeros(0, dtype=np.int64))
        right = AstrometricTable(ZERO_MOTION, "", zero_motion(n), left.names)
        part = _Part(right, matched, with_jitter(right.astrometry, options.jitter_of(None)))
    else:
        part = _matched(left, read_table(Path(reference), options.reference_options), options, None)
    if options.aberration:
        epoch = left.astrometry.epoch[part.matched.source]
        part = replace(part, rows=aberrated(part.rows, epoch, options.aberration))
    return part


def _mission(left: AstrometricTable, name: str, number: int, options: Options) -> _Part:
    table = read_table(Path(options.missions[name]), options.mission_options.get(name, TableOptions()))
    part = _matched(left, table, options, name)
    return replace(part, rows=replace(part.rows, frame=np.full(len(part.rows), number)))


def _matched(left: AstrometricTable, table: AstrometricTable, options: Options, mission: str | None) -> _Part:
    matched = match(left, table, options.by)
    notes = _far(left, table, matched)
    rows = with_jitter(_taken(table.astrometry, matched.rows), options.jitter_of(mission))
    return _Part(table, matched, rows, notes)


def _far(left: AstrometricTable, table: AstrometricTable, matched: Match) -> list[str]:
    """Return a note on rows far from their sources; raises SweepError if they cannot be the same objects."""
    apart = separations(left, table, matched) / DEGREE
    for limit, refused in ((FARTHEST_DEG, True), (FAR_DEG, False)):
        far = np.flatnonzero(apart > limit)
        if len(far):
            worst = far[np.argmax(apart[far])]
            size = f"{apart[worst]:.3g} deg" if refused else f"{apart[worst] * 3600.0:.3g} arcsec"
            row = named_rows(matched.rows[far])
            whose = "their source" if matched.by.startswith("position") else "the source of the same name"
            found = f"{row} of {Path(table.path).name}: up to {size} from {whose}"
            elsewhere = _elsewhere(left, table, matched, far)
            if refused:
                question = "are the names right, the epochs, and the units of the positions?"
                raise SweepError(f"{found}; {elsewhere or question}")
            return [f"{found}; {elsewhere}" if elsewhere else found]
    return []


def _elsewhere(left: AstrometricTable, table: AstrometricTable, matched: Match, far: Indices) -> str:
    """Return a clause that names the other sources at whose positions rows are that are far from their own."""
    rows = matched.rows[far]
    try:
        found = match(left, replace(table, astrometry=table.astrometry.taken(rows)), f"position:{FAR_DEG * 3600.0:g}")
    except SweepError:  # none of them is near any source
        return ""
    names = next(iter(left.names.values())) if left.names else np.arange(1, len(left.astrometry) + 1)
    own, other = names[matched.source[far[found.rows]]], names[found.source]
    pairs = dict.fromkeys(f"{a} is where {b} is" for a, b in zip(own, other, strict=True) if a != b)
    return f"{', '.join(list(pairs)[:3])}: are names exchanged?" if pairs else ""


def _resting(own: Astrometry, rows: Astrometry, source: Indices) -> list[str]:
    """Return a note if single-epoch positions are of sources without parallaxes and motions, like quasars."""
    if rows.apparent is None or not np.any(seen := rows.apparent & (kinds(rows) == "single epoch")):
        return []
    size = np.where(own.present[2:], (own.values[2:] / np.where(own.present[2:], own.errors[2:], 1.0)) ** 2, np.nan)
    of = np.unique(source[seen])
    if len(of) < 5 or not np.nanmean(size[:, of]) < 4.0:
        return []
    said = "positions of a single epoch are displaced by parallaxes, and these sources have none, nor motions"
    return [f"{said}: if they are quasars, say --extragalactic reference"]


def _taken(table: Astrometry, rows: Indices) -> Astrometry:
    return table if np.array_equal(rows, np.arange(len(table))) else table.taken(rows)


def _unmatched(part: _Part) -> list[str]:
    n, total, name = len(part.matched.unmatched), len(part.table.astrometry), Path(part.table.path).name
    found = [f"{n} of {total} rows of {name} match no source"] if n else []
    if len(part.matched.ambiguous):
        rows = named_rows(part.matched.ambiguous)
        found.append(f"{rows} of {name}: several sources are within the radius; the nearest is taken")
    exact, nearly = _repeated(part)
    if len(exact):
        found.append(f"{named_rows(exact)} of {name}: the same numbers as another row of the source; all are used")
    if len(nearly):
        twice = "one measurement that is there twice counts twice"
        found.append(f"{named_rows(nearly)} of {name}: nearly the numbers of another row of the source; {twice}")
    several = np.bincount(part.matched.source)[part.matched.source] > 1
    epochs = part.rows.epoch[part.rows.present[0]]
    if np.any(several & part.rows.present[0]) and len(epochs) > 2 and np.all(epochs == epochs[0]):
        found.append(f"{name}: all positions have the epoch {epochs[0]:g}, although sources have several: is it right?")
    return found


def _repeated(part: _Part) -> tuple[Indices, Indices]:
    """Return the numbers of the table's rows that repeat another row of the same source and epoch: exactly, and nearly,
    which is within a fraction of the errors, or with the same errors.
    """
    source, rows = part.matched.source, part.rows
    order = np.lexsort((rows.epoch, rows.present.T @ (1 << np.arange(5)), source))
    one, other = order[:-1], order[1:]
    present, first, second = rows.present[:, one], rows.errors[:, one], rows.errors[:, other]
    same = (source[one] == source[other]) & np.all(present == rows.present[:, other], axis=0) & present.any(axis=0)
    years = np.nan_to_num(np.abs(rows.epoch[one] - rows.epoch[other]))
    apart = rows.values[:, one] - rows.values[:, other]
    apart[0] *= np.cos(rows.values[1, one])
    with np.errstate(invalid="ignore", divide="ignore"):
        most = np.where(present & (apart != 0.0), np.abs(apart) / np.maximum(first, second), 0.0).max(axis=0)
    alike = np.all(~present | np.isclose(first, second, rtol=0.01, atol=0.0), axis=0)
    exact = same & (most == 0.0) & (years == 0.0) & np.all(~present | (first == second), axis=0)
    nearly = same & ~exact & (years < SAME_EPOCH_YR) & ((most < 0.3) | (alike & (most < 2.0)))
    return np.sort(part.matched.rows[other[exact]]), np.sort(part.matched.rows[other[nearly]])


def zero_motion(n: int) -> Astrometry:
    """Return n rows of a reference whose sources do not move."""
    zeros = np.broadcast_to(np.array([np.nan, np.nan, np.nan, 0.0, 0.0])[:, None], (5, n))  # takes no memory
    return Astrometry(zeros, zeros, np.broadcast_to(np.nan, n))


def _names(left: AstrometricTable, reference: _Part, sources: Indices) -> NDArray[np.str_]:
    """Return the names of the sources: the satellite's first column of names, else the reference's, else numbers."""
    if left.names:
        return next(iter(left.names.values()))[sources]
    named: dict[int, str] = {}
    if reference.table.names:
        column, found = next(iter(reference.table.names.values())), reference.matched
        named = dict(zip(found.source.tolist(), column[found.rows].tolist(), strict=True))
    return np.array([named.get(s, str(s + 1)) for s in sources.tolist()])


def default_epoch(epochs: Array) -> float:
    """Return the median epoch of the sources (Julian year), or that of ICRF3 if none has an epoch."""
    known = epochs[np.isfinite(epochs)]
    return float(np.median(known)) if len(known) else ICRF3_EPOCH
