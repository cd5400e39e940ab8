"""Which source of the satellite a row of the reference belongs to: by name or by position."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from linksweep.core.arrays import Array, Indices
from linksweep.core.constants import ARCSEC
from linksweep.core.frames import triad
from linksweep.core.tie.astrometry import named_rows
from linksweep.core.tie.motion import propagated
from linksweep.sweep.contract import SweepError
from linksweep.sweep.tie.column_names import NAMES
from linksweep.sweep.tie.tables import AstrometricTable

DEFAULT_RADIUS_ARCSEC = 1.0

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
        return _by_position(satellite, reference, _radius(radius))
    pairs = _pairs(satellite, reference, kind)
    for own, other in pairs:
        found = _by_name(satellite, reference, own, other, strict=kind == own or own.casefold() in NAMES)
        if len(found.rows):
            return found
    if by is None:
        return _by_position(satellite, reference, DEFAULT_RADIUS_ARCSEC)
    if not pairs:
        raise SweepError(
            f"match by {by!r}: {satellite.path} has names in {', '.join(satellite.names) or 'no column'}, "
            f"{reference.path} in {', '.join(reference.names) or 'no column'}"
        )
    own, other = pairs[0]
    raise SweepError(
        f"match by {by}: no name is in both tables; {satellite.path} has {own} like "
        f"{_example(satellite, own)!r}, {reference.path} has {other} like {_example(reference, other)!r}"
    )


def _example(table: AstrometricTable, column: str) -> str:
    """Return the first name of a column that is not missing."""
    return next((str(name) for name in table.names[column] if name.casefold() not in _NO_NAME), "")


def _pairs(satellite: AstrometricTable, reference: AstrometricTable, kind: str) -> list[tuple[str, str]]:
    if kind and kind != "name":
        both = kind in satellite.names and kind in reference.names
        return [(kind, kind)] if both else []
    same = [(name, name) for name in satellite.names if name in reference.names]
    return same + [(a, b) for a in satellite.names for b in reference.names if a != b]


def _by_name(
    satellite: AstrometricTable, reference: AstrometricTable, own: str, other: str, strict: bool = True
) -> Match:
    """Match by two columns; a name that the satellite has twice is an error if ``strict``, else nothing matches."""
    names = [name.casefold() for name in satellite.names[own]]
    wanted = [name.casefold() for name in reference.names[other]]
    place = {name: i for i, name in enumerate(names) if name not in _NO_NAME}
    rows = np.array([i for i, name in enumerate(wanted) if name in place], dtype=np.int64)
    used = {wanted[i] for i in rows}
    if len(place) < len(names):
        twice = sorted({satellite.names[own][i] for i, name in enumerate(names) if name in used and place[name] != i})
        if twice and strict:
            raise SweepError(f"{own} {', '.join(twice[:5])} occurs more than once in the table", satellite.path)
        rows = rows[:0] if twice else rows
    source = np.array([place[wanted[i]] for i in rows], dtype=np.int64)
    unmatched = np.setdiff1d(np.arange(len(wanted)), rows)
    return Match(rows, source, own if own == other else f"{own} = {other}", unmatched)


def separations(satellite: AstrometricTable, reference: AstrometricTable, found: Match) -> Array:
    """Return the separation (rad) of each row that was matched from its source at the row's epoch; shape (R,).

    NaN where one of them has no position.
    """
    own, rows = satellite.astrometry.taken(found.source), reference.astrometry.taken(found.rows)
    epoch = np.where(np.isfinite(rows.epoch), rows.epoch, own.epoch)
    start = np.where(np.isfinite(own.epoch), own.epoch, epoch)
    moving = np.isfinite(epoch)
    there = propagated(own.values, own.radial_velocity, np.where(moving, start, 0.0), np.where(moving, epoch, 0.0))
    with np.errstate(invalid="ignore"):
        between = triad(*rows.values[:2]).r - triad(there[0], there[1]).r
        return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(between, axis=0), 1.0)))


def _radius(text: str) -> float:
    try:
        radius = float(text) if text else DEFAULT_RADIUS_ARCSEC
    except ValueError:
        radius = np.nan
    if not 0.0 < radius <= 3600.0:
        raise SweepError(f"match by position:{text}: the radius must be above 0 and at most 3600 arcsec")
    return radius


def _by_position(satellite: AstrometricTable, reference: AstrometricTable, radius_arcsec: float) -> Match:
    """Match each row to the nearest source, carried to the row's epoch with its proper motion."""
    sources, rows = satellite.astrometry, reference.astrometry
    if len(without := np.flatnonzero(~np.isfinite(rows.values[:2]).all(axis=0))):
        raise SweepError(f"match by position: no position in {named_rows(without)}; match by name", reference.path)
    chord = 2.0 * np.sin(0.5 * radius_arcsec * ARCSEC)
    found, several = np.full(len(rows), -1), np.zeros(len(rows), dtype=bool)
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
        found[at] = np.where(distance[:, 0] <= chord, nearest[:, 0], -1)
        several[at] = distance[:, 1] <= chord
    matched = np.flatnonzero(found >= 0)
    if not len(matched):
        raise SweepError(f"no row of the reference is within {radius_arcsec:g} arcsec of a source", reference.path)
    how = f"position within {radius_arcsec:g} arcsec"
    return Match(matched, found[matched], how, np.flatnonzero(found < 0), np.flatnonzero(several))
