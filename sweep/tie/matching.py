"""Which source of the satellite a row of the reference belongs to, by name or by position, and what is doubtful."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from linksweep.core.frames import ARCSEC, DEGREE, Array, Indices, triad
from linksweep.core.tie.astrometry import Astrometry, named_rows, propagated
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tie.tables import SOURCE_NAMES, AstrometricTable

DEFAULT_RADIUS_ARCSEC = 1.0
FAR_DEG, FARTHEST_DEG = 10.0 / 3600.0, 1.0
"""Separations from the source of the same name above which a row is noted, and is refused."""

SAME_EPOCH_YR = 0.005
"""Rows of a source within two days may be the same measurement."""

_NO_NAME = ("", "--", "nan")


@dataclass(frozen=True)
class Match:
    """The rows that were matched (R,), the source of the satellite for each (R,), how they were matched, the rows left
    over, and those for which several sources were within the radius, so that the nearest was taken.
    """

    rows: Indices
    source: Indices
    by: str
    unmatched: Indices
    ambiguous: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def match(satellite: AstrometricTable, reference: AstrometricTable, by: str | None = None) -> Match:
    """Match by ``name``, by a column that both tables have, or by ``position`` within 1 arcsec (``position:R``).

    By default by name if columns of names in both tables have a name in common, and by position otherwise.
    Raises SweepError if nothing matches, or if the satellite's table has a name twice.
    """
    kind, _, radius = (by or "").partition(":")
    if kind == "position":
        return _by_position(satellite, reference, radius)
    pairs = [(name, name) for name in satellite.names if name in reference.names and kind in ("", "name", name)]
    if kind in ("", "name"):
        pairs += [(a, b) for a in satellite.names for b in reference.names if a != b]
    for pair in pairs:
        matched = _by_name(satellite, reference, pair, strict=kind == pair[0] or pair[0].casefold() in SOURCE_NAMES)
        if len(matched.rows):
            return matched
    if by is None:
        return _by_position(satellite, reference, "")
    if not pairs:
        raise SweepError(
            f"match by {by!r}: {satellite.path} has names in {', '.join(satellite.names) or 'no column'}, "
            f"{reference.path} in {', '.join(reference.names) or 'no column'}"
        )
    examples = []
    for table, column in zip((satellite, reference), pairs[0], strict=True):
        example = next((str(name) for name in table.names[column] if name.casefold() not in _NO_NAME), "")
        examples.append(f"{table.path} has {column} like {example!r}")
    raise SweepError(f"match by {by}: no name is in both tables; {', '.join(examples)}")


def _by_name(satellite: AstrometricTable, reference: AstrometricTable, pair: tuple[str, str], strict: bool) -> Match:
    """Match by two columns; a name that the satellite has twice is an error if ``strict``, else nothing matches."""
    column, other = pair
    names, wanted = ([n.casefold() for n in t.names[c]] for t, c in zip((satellite, reference), pair, strict=True))
    place = {name: i for i, name in enumerate(names) if name not in _NO_NAME}
    rows = np.array([i for i, name in enumerate(wanted) if name in place], dtype=np.int64)
    if len(place) < len(names):
        used = {wanted[i] for i in rows}
        twice = {satellite.names[column][i] for i, name in enumerate(names) if name in used and place[name] != i}
        if twice and strict:
            raise SweepError(
                f"{column} {', '.join(sorted(twice)[:5])} occurs more than once in the table", satellite.path
            )
        rows = rows[:0] if twice else rows
    source = np.array([place[wanted[i]] for i in rows], dtype=np.int64)
    how = column if column == other else f"{column} = {other}"
    return Match(rows, source, how, np.setdiff1d(np.arange(len(wanted)), rows))


def _by_position(satellite: AstrometricTable, reference: AstrometricTable, radius_text: str) -> Match:
    """Match each row to the nearest source, carried to the row's epoch with its proper motion."""
    try:
        radius = float(radius_text) if radius_text else DEFAULT_RADIUS_ARCSEC
    except ValueError:
        radius = np.nan
    if not 0.0 < radius <= 3600.0:
        raise SweepError(f"match by position:{radius_text}: the radius must be above 0 and at most 3600 arcsec")
    sources, rows = satellite.astrometry, reference.astrometry
    if len(without := np.flatnonzero(~np.isfinite(rows.values[:2]).all(axis=0))):
        raise SweepError(f"match by position: no position in {named_rows(without)}; match by name", reference.path)
    chord = 2.0 * np.sin(0.5 * radius * ARCSEC)
    place, several = np.full(len(rows), -1), np.zeros(len(rows), dtype=bool)
    epochs = np.where(np.isfinite(rows.epoch), rows.epoch, np.inf)
    for epoch in np.unique(epochs):
        at = np.flatnonzero(epochs == epoch)
        values = sources.values
        if np.isfinite(epoch):
            start = np.where(np.isfinite(sources.epoch), sources.epoch, epoch)
            values = propagated(values, sources.radial_velocity, start, np.full(len(sources), epoch))
        tree = cKDTree(triad(values[0], values[1]).r.T)
        both = tree.query(triad(rows.values[0, at], rows.values[1, at]).r.T, k=2)
        distance, nearest = np.asarray(both[0]), np.asarray(both[1])
        place[at] = np.where(distance[:, 0] <= chord, nearest[:, 0], -1)
        several[at] = distance[:, 1] <= chord
    matched = np.flatnonzero(place >= 0)
    if not len(matched):
        raise SweepError(f"no row of the reference is within {radius:g} arcsec of a source", reference.path)
    how = f"position within {radius:g} arcsec"
    return Match(matched, place[matched], how, np.flatnonzero(place < 0), np.flatnonzero(several))


def far_rows(satellite: AstrometricTable, table: AstrometricTable, matched: Match) -> list[str]:
    """Return a note on rows far from their sources; raises SweepError if they cannot be the same objects."""
    apart = np.nan_to_num(_separations(satellite.astrometry, table.astrometry, matched) / DEGREE)
    far = np.flatnonzero(apart > FAR_DEG)
    if not len(far):
        return []
    refused = np.any(apart > FARTHEST_DEG)
    far = np.flatnonzero(apart > FARTHEST_DEG) if refused else far
    largest = apart[far].max()
    size = f"{largest:.3g} deg" if refused else f"{largest * 3600.0:.3g} arcsec"
    whose = "their source" if matched.by.startswith("position") else "the source of the same name"
    note = f"{named_rows(matched.rows[far])} of {Path(table.path).name}: up to {size} from {whose}"
    elsewhere = _elsewhere(satellite, table, matched, far)
    if refused:
        question = "are the names right, the epochs, and the units of the positions?"
        raise SweepError(f"{note}; {elsewhere or question}")
    return [f"{note}; {elsewhere}" if elsewhere else note]


def _separations(sources: Astrometry, rows: Astrometry, matched: Match) -> Array:
    """Return the separation (rad) of each row from its source at the row's epoch; NaN where one has no position."""
    there, here = sources.taken(matched.source), rows.taken(matched.rows)
    epoch = np.where(np.isfinite(here.epoch), here.epoch, there.epoch)
    start = np.where(np.isfinite(there.epoch), there.epoch, epoch)
    moving = np.isfinite(epoch)
    values = propagated(there.values, there.radial_velocity, np.where(moving, start, 0.0), np.where(moving, epoch, 0.0))
    with np.errstate(invalid="ignore"):
        between = triad(*here.values[:2]).r - triad(values[0], values[1]).r
        return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(between, axis=0), 1.0)))


def _elsewhere(satellite: AstrometricTable, table: AstrometricTable, matched: Match, far: Indices) -> str:
    """Return a clause that names the other sources at whose positions rows are that are far from their own."""
    rows = replace(table, astrometry=table.astrometry.taken(matched.rows[far]))
    try:
        near = match(satellite, rows, f"position:{FAR_DEG * 3600.0:g}")
    except SweepError:  # none of them is near any source
        return ""
    names = next(iter(satellite.names.values()), np.arange(1, len(satellite.astrometry) + 1).astype(str))
    both = zip(names[matched.source[far[near.rows]]], names[near.source], strict=True)
    pairs = dict.fromkeys(f"{a} is where {b} is" for a, b in both if a != b)
    return f"{', '.join(list(pairs)[:3])}: are names exchanged?" if pairs else ""


def match_notes(table: AstrometricTable, matched: Match, rows: Astrometry) -> list[str]:
    """Return notes on rows that match no source, several, or the same one with the same numbers; ``rows`` are those
    that were matched.
    """
    total, name = len(table.astrometry), Path(table.path).name
    notes = [f"{len(matched.unmatched)} of {total} rows of {name} match no source"] if len(matched.unmatched) else []
    exact, nearly = _repeated(matched, rows)
    for numbers, what in (
        (matched.ambiguous, "several sources are within the radius; the nearest is taken"),
        (exact, "the same numbers as another row of the source; all are used"),
        (nearly, "nearly the numbers of another row of the source; one measurement that is there twice counts twice"),
    ):
        if len(numbers):
            notes.append(f"{named_rows(numbers)} of {name}: {what}")
    several = np.bincount(matched.source)[matched.source] > 1
    epochs = rows.epoch[rows.present[0]]
    if np.any(several & rows.present[0]) and len(epochs) > 2 and np.all(epochs == epochs[0]):
        notes.append(f"{name}: all positions have the epoch {epochs[0]:g}, although sources have several: is it right?")
    return notes


def _repeated(matched: Match, rows: Astrometry) -> Sequence[Indices]:
    """Return the numbers of the table's rows that repeat another row of the same source and epoch: exactly, and nearly,
    which is within a fraction of the errors, or with the same errors.
    """
    source = matched.source
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
    return [np.sort(matched.rows[other[which]]) for which in (exact, nearly)]
