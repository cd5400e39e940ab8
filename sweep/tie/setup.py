"""The problem of two or more tables: the options, which source a row belongs to, what is doubtful about that, what is
done to the rows, and the unknowns; of a Parquet table of millions of quasars one row group at a time.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from linksweep.core import frames
from linksweep.core.frames import ARCSEC, DEGREE, MAS, Array, Flags, Indices, LinkError, Names, triad
from linksweep.core.tie import astrometry as core
from linksweep.core.tie.astrometry import Astrometry, kinds, named_rows
from linksweep.core.tie.forecast import releases_at
from linksweep.core.tie.noise import ALL, ESTIMATE
from linksweep.core.tie.problem import Problem, StreamedSources, sources_of
from linksweep.core.unknowns import Block, Unknowns, parse_unknowns, require_mission_name, spin_by_bin
from linksweep.sweep.contract import SweepError, refused
from linksweep.sweep.executing.executor import Map
from linksweep.sweep.formatting import first_of, split_assignment
from linksweep.sweep.tables import reader
from linksweep.sweep.tables.columns import MJD_OF_2000, Columns, conditions
from linksweep.sweep.tables.options import by_table, number, numbers, parameter
from linksweep.sweep.tie import tables as files
from linksweep.sweep.tie.options import SIDES, SIGNS, TABLE, Options, listed
from linksweep.sweep.tie.tables import SOURCE_NAMES, AstrometricTable, TableOptions, astrometric_table, read_table

DECLARED = {one.name: parameter(one) for one in fields(Options)}

# Options that name the tables for which they hold.
MARKS = ("extragalactic", "without_cos_dec", "parallax_zero_point")

ICRF3_EPOCH = 2015.0

# Its bins may have spins of their own that are known.
MAGNITUDE = "phot_g_mean_mag"

# Kinds of rows whose jitter is one of motions if it is one number.
MOTIONS = ("motion", "three-parameter")

# Stands for a reference whose sources do not move: quasars, for which only the satellite's table is needed.
ZERO_MOTION = "zero-motion"

# How rows without a table are matched.
EVERY_SOURCE = "the satellite's sources"

DEFAULT_RADIUS_ARCSEC = 1.0
# Separations from the source of the same name above which a row is noted, and is refused.
FAR_DEG, FARTHEST_DEG = 10.0 / 3600.0, 1.0

ARE_RIGHT = "are the names, the epochs, and the frame and units of the positions right?"

COARSE_EPOCHS = "the epoch has too few digits for the motion of the star and the errors of the position"

# Rows of a source within two days may be the same measurement.
SAME_EPOCH_YR = 0.005

_NO_NAME = ("", "--", "nan")


# ---- what options say of tables


def table_options(options: Options) -> dict[str, TableOptions]:
    """Return how each table is read, by its name; raises SweepError for tables that do not exist."""
    missions = list(dict(options.missions))
    names = [*SIDES, *missions]
    with refused(ValueError):
        for mission in missions:
            require_mission_name(mission)
        years = [(f"{name}:", DECLARED["epoch"].parse(number(year))) for name, year in options.mission_epochs]
    epochs = by_table("mission_epochs", years, missions, ())
    epochs |= {"satellite": {"": options.satellite_epoch}, "reference": {"": options.reference_epoch}}
    marked = {n: by_table(n, [(f"{one}:", "") for one in listed(getattr(options, n))], names, ()) for n in MARKS}
    columns, units = (by_table(n, getattr(options, n), names, names) for n in ("columns", "units"))
    where = conditions(options.where.split(";"), names, SIDES[:1])
    return {
        name: TableOptions(
            columns.get(name, {}),
            units.get(name, {}),
            epoch=epochs.get(name, {}).get(""),
            extragalactic=name in marked["extragalactic"],
            positions=options.positions if name == "reference" and options.positions != TABLE else None,
            accelerations=None if options.accelerations == TABLE else options.accelerations,
            where=where.get(name),
            parallax_zero_point=name in marked["parallax_zero_point"],
            zero_errors=options.zero_errors,
            pmra_cos_dec=False if name in marked["without_cos_dec"] else None,
        )
        for name in names
    }


def parse_jitter(text: str, missions: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return the jitter by table and kind of row, of a line like ``position=0.2,hipparcos:five-parameter=0.2:0.05`` or
    ``estimate``; raises SweepError for any other line.
    """
    jitter: dict[str, Any] = {}
    for item in filter(None, map(str.strip, text.split(","))):
        kind, size = (ALL, item) if item == ESTIMATE else split_assignment(item)
        sizes = numbers(size, ":") if size != ESTIMATE else [0.0, 0.0]
        finite = all(0.0 <= one < np.inf for one in sizes)
        if kind in jitter or not (kind and 1 <= len(sizes) <= 2 and finite):
            said = "say estimate, or KIND=MAS[:MAS_YR], finite and not negative, in mas and mas/yr, each once"
            raise SweepError(f"jitter {item!r}: {said}")
        # one number is the jitter of motions where a kind of rows has nothing else
        both = (0.0, *sizes) if len(sizes) == 1 and kind.rpartition(":")[2] in MOTIONS else (*sizes, 0.0)[:2]
        jitter[kind] = ESTIMATE if size == ESTIMATE else both
    if jitter.get(ALL, ESTIMATE) != ESTIMATE:  # which is of all tables anyway
        jitter = {f"{name}:{ALL}": jitter[ALL] for name in missions} | jitter
    return by_table("jitter", jitter.items(), [*SIDES[1:], *missions], SIDES[1:])


def parse_bins(text: str) -> tuple[str, list[float]]:
    """Return the column and the edges of a text like phot_g_mean_mag=6,8,10, or none of an empty one; raises SweepError
    for any other text.
    """
    if not text:
        return "", []
    column, edges = split_assignment(text)
    if not (column and numbers(edges)):
        raise SweepError(f"bins {text!r}: must be written COLUMN=EDGE,EDGE and so on")
    return column, numbers(edges)


# ---- the problem


@dataclass(frozen=True)
class Setup:
    """The problem of the matched sources (S) and rows (R), the tables as read, and how they were matched.

    ``names`` (S,) are the names of the sources, or numbers.  ``tables`` are by name: satellite, reference and missions.
    ``jitter`` by table says which noise is still to be estimated.  The rows of ``epochs`` are numbers of sources, -1
    for others.
    """

    tables: Mapping[str, AstrometricTable]
    matched: "Match"
    problem: Problem
    names: Names
    notes: tuple[str, ...] = ()
    epochs: files.Epochs | None = None
    jitter: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def attributes(self) -> dict[str, Any]:
        """Return what a dataset says of the tables."""
        epochs = self.tables[SIDES[0]].astrometry.epoch
        known = epochs[np.isfinite(epochs)].tolist() or [self.problem.epoch]
        said = {"epoch": self.problem.epoch, "satellite_epochs": [min(known), max(known)]}
        for name, table in ((name, self.tables[name]) for name in SIDES):
            said |= {name: table.path, f"{name}_columns": table.columns, f"{name}_sha256": table.digest}
            said[f"{name}_read"] = table.options.changed()
        return said

    def only(self, sources: Indices) -> "Setup":
        """Return the setup of some of the matched sources and their rows."""
        return replace(self, problem=self.problem.only(sources), names=self.names[sources])

    def with_new_rows(self, problem: Problem, epochs: Sequence[Any], error: float, positions: str) -> Problem:
        """Return a problem of the sources with a position added to each at each of ``epochs`` (None for the source's).

        ``error`` (mas) is that of each coordinate; ``positions`` are of a single epoch, "mean", or those of the
        reference's table; those of quasars hold at any epoch.  As rows of the reference they have the jitter of their
        kind.  They are those of the satellite, and so for forecasts, which do not depend on measured values.
        """
        reference, rows = self.tables[SIDES[1]], self.problem.rows
        resting = np.isnan(rows.epoch) & (rows.present[0] | (reference.path == ZERO_MOTION)) & (rows.frame == 0)
        quasars = reference.options.extragalactic or np.any(resting)
        single = np.any(reference.astrometry.apparent) if positions == TABLE else positions != "mean"
        n, source = len(problem.satellite), np.tile(np.arange(len(problem.satellite)), len(epochs))
        values = np.where(np.arange(5)[:, None] < 2, problem.satellite.values[:, source], np.nan)
        errors = np.where(np.isfinite(values), error * MAS, np.nan)
        at = np.repeat(np.array([None] * len(epochs) if quasars else epochs, dtype=np.float64), n)
        new = Astrometry(values, errors, at, apparent=np.full(len(source), single and not quasars))
        jitter = {kind: size for kind, size in self.jitter.get(SIDES[1], {}).items() if kind in (ALL, *kinds(new)[:1])}
        source, old = np.concatenate([problem.source, source]), len(problem.rows)
        if quasars:
            new = quasars_at_rest(problem.satellite, core.joined(problem.rows, new), source).taken(slice(old, None))
        return replace(problem, rows=core.joined(problem.rows, with_jitter(new, jitter)), source=source)


def set_up(satellite: str | Path, reference: str | Path, options: Options, all_sources: bool = False) -> Setup:
    """Read, match and combine tables; raises SweepError for whatever is wrong with them or the options.

    ``all_sources`` keeps sources without rows, for forecasts.
    """
    how, missions = table_options(options), dict(options.missions)
    jitter = parse_jitter(options.jitter, missions)
    if (options.star_models or options.orbits) and not options.epochs:
        raise SweepError("models and orbits are of stars with epoch astrometry: give its files as epochs")
    left = read_table(Path(satellite), how["satellite"])
    n = len(left.astrometry)
    left.require_positions("; each source needs one")
    notes, epochs = [*left.notes], None
    if options.epochs:
        observed = list(dict(options.epochs).values())
        left, epochs = files.with_observations(left, observed, dict(options.star_models), options.orbits)
        notes += epochs.notes
    tables, matches, parts = {SIDES[0]: left}, [], []
    for frame, (name, path) in enumerate({SIDES[1]: str(Path(reference)), **missions}.items()):
        if not frame and path == ZERO_MOTION:
            moving = moving_sources(left.astrometry)
            table = AstrometricTable(ZERO_MOTION, "", zero_motion(len(moving), options), {}, options=how[name])
            matched, rows = Match(moving, EVERY_SOURCE, moving * 0 - 1), table.astrometry
            notes += without_motion(0 if all_sources else n - len(moving), n)
            # sorted faster than both coordinates, and different where they are
            key = np.array([1.0, np.pi]) @ left.astrometry.values[:2, moving]
            if len(again := np.delete(moving, np.unique(key, return_index=True)[1])):
                notes.append(f"{named_rows(again)} of {Path(left.path).name}: the position of another row; both count")
        else:
            table = read_table(Path(path), how[name])
            matched = match(left, table, options.by or None)
            rows = _taken(table.astrometry, matched.rows)
            far = far_rows(left, table, matched)
            notes += [*table.notes, *match_notes(left, table, matched, rows), *far]
        rows = replace(core.of_five(rows), frame=np.broadcast_to(frame, len(rows)))
        rows = rows if frame else quasars_at_rest(left.astrometry, rows, matched.source, options.aberration)
        tables[name] = table
        matches.append(matched)
        parts.append(with_jitter(rows, jitter.get(name, {})))
    source = np.concatenate([matched.source for matched in matches])
    # not np.unique, whose hashes of consecutive integers take a hundred times as long (NumPy 2.4)
    sources = np.arange(n) if all_sources else np.flatnonzero(np.bincount(source))
    names = _names(left, tables[SIDES[1]], matches[0])[sources]
    stars = replace(_taken(left.astrometry, sources), names=names)
    rows, source = parts[0] if len(parts) == 1 else core.joined(*parts), np.searchsorted(sources, source)
    notes += _without_parallax(stars, rows, source)
    stars = satellite_at_rest(stars, rows, source)
    epoch = default_epoch(stars.epoch) if options.epoch is None else options.epoch
    problem = Problem(stars, rows, source, Unknowns(()), epoch, options.weights, tables=tuple(tables)[1:])
    with refused(ValueError):
        unknowns = unknowns_for(options, problem, notes)
        problem = replace(problem, unknowns=unknowns, known=known_unknowns(options, stars))
    if epochs is not None:
        place = {row: k for k, row in enumerate(sources.tolist())}
        epochs = epochs._replace(rows=np.array([place.get(row, -1) for row in epochs.rows]))
    return Setup(tables, matches[0], problem, names, tuple(dict.fromkeys(notes)), epochs, jitter)


def _taken(table: Astrometry, rows: Indices) -> Astrometry:
    return table if np.array_equal(rows, np.arange(len(table))) else table.taken(rows)


def _names(left: AstrometricTable, reference: AstrometricTable, matched: "Match") -> Names:
    """Return the names of all sources: the satellite's first column of names, else the reference's, else numbers; those
    of the reference first if the tables have identifiers of two releases.
    """
    if (left.names and not matched.releases) or not reference.names:
        return left.labels
    names = left.labels.astype(object)
    names[matched.source] = reference.labels[matched.rows]
    return names.astype(np.str_)


def _without_parallax(stars: Astrometry, rows: Astrometry, source: Indices) -> list[str]:
    """Return notes if single-epoch positions are of sources without parallaxes, or like quasars without motions too."""
    observed = np.unique(source[core.kind_numbers(rows) == core.SINGLE_EPOCH])
    if len(absent := observed[stars.present[3, observed] & ~stars.present[2, observed]]):
        said = f"no parallax of {first_of(np.asarray(stars.names)[absent].tolist(), 5)}"
        return [f"{said}: it displaces their positions of a single epoch, and counts as unknown"]
    values, errors = (one[2:, observed][stars.present[2:, observed]] for one in (stars.values, stars.errors))
    squares = np.sum((values / np.maximum(errors, 1e-9 * MAS)) ** 2)  # exact ones have errors of 0
    said = "positions of a single epoch are displaced by parallaxes, and these sources have none, nor motions"
    are_none = len(observed) >= 5 and squares < 4.0 * len(values)
    return [f"{said}: if they are quasars, say --extragalactic reference"] if are_none else []


def quasars_at_rest(stars: Astrometry, rows: Astrometry, source: Indices, aberration: float = 0.0) -> Astrometry:
    """Return rows of a reference with the parallax and motion of quasars, which are zero but for the Galactic
    aberration (uas/yr), in a position that holds at any epoch of each source that has none measured.
    """
    rows = _aberrated(rows, stars.epoch[source], aberration) if aberration else rows
    quasar = np.isnan(rows.epoch) & rows.present[:2].any(axis=0)
    known = np.zeros((5, len(rows)), dtype=bool)
    for k in (2, 3, 4) if np.any(quasar) else ():
        measured = np.isin(source, source[rows.present[k] & (rows.frame == 0)])
        at = np.flatnonzero(quasar & ~measured & (stars.errors[k, source] > 0.0))
        known[k, at[np.unique(source[at], return_index=True)[1]]] = True  # once, as it is exact
    return _exactly(rows, known, _glide(rows, aberration))


def satellite_at_rest(stars: Astrometry, rows: Astrometry, source: Indices) -> Astrometry:
    """Return a satellite's table with the parallax and motion of quasars in positions that hold at any epoch, unless
    rows have them without an error too.
    """
    exact = np.array([np.isin(np.arange(len(stars)), source[errors == 0.0]) for errors in rows.errors])
    return _exactly(stars, np.isnan(stars.epoch) & ~stars.present & ~exact & (np.arange(5)[:, None] > 1))


def _exactly(table: Astrometry, known: Flags, motion: Array | float = 0.0) -> Astrometry:
    """Return a table at rest: with a parallax of zero and a motion (2, N) without errors where ``known`` (5, N)."""
    if not np.any(known):
        return table
    values, errors = np.where(known, 0.0, [table.values, table.errors])
    np.copyto(values[3:], motion, where=known[3:])
    return replace(table, values=values, errors=errors, at_rest=known)


def zero_motion(n: int, options: Options) -> Astrometry:
    """Return n rows of a reference whose sources do not move, and where a zero point is asked for have no parallax."""
    parallax = 0.0 if "parallax" in listed(options.unknowns) else np.nan
    zeros = np.broadcast_to(np.array([np.nan, np.nan, parallax, 0.0, 0.0])[:, None], (5, n))  # takes no memory
    known = np.broadcast_to(np.arange(5)[:, None] == 2, (5, n))
    return Astrometry(zeros, zeros, np.broadcast_to(np.nan, n), at_rest=known)


def moving_sources(stars: Astrometry) -> Indices:
    """Return the sources that have a motion, of which a reference at rest has a row."""
    return np.flatnonzero(stars.present[3:].all(axis=0))


def without_motion(number: int, n: int) -> list[str]:
    """Return a note on sources that a reference at rest leaves out."""
    return [f"{number} of {n} sources have no motion with its error, and are left out"] if number else []


def default_epoch(epochs: Array) -> float:
    """Return the median epoch of the sources (Julian year), or that of ICRF3 if none has an epoch."""
    known = epochs[np.isfinite(epochs)]
    return float(np.median(known)) if len(known) else ICRF3_EPOCH


# ---- which source a row belongs to


@dataclass(frozen=True)
class Match:
    """The source of the satellite for each row of a table (N,), -1 for none; how they were matched; the second nearest
    source (N,) where several were within the radius, so that the nearest was taken, else -1.  ``releases`` are those of
    Gaia whose identifiers the two tables have, where they differ.
    """

    place: Indices
    by: str
    second: Indices
    releases: tuple[str, ...] = ()

    @cached_property
    def rows(self) -> Indices:
        """The rows that were matched (R,)."""
        return np.flatnonzero(self.place >= 0)

    @cached_property
    def source(self) -> Indices:
        """The source of each of these (R,)."""
        return self.place[self.rows]


def match(satellite: AstrometricTable, reference: AstrometricTable, by: str | None = None) -> Match:
    """Match by ``name``, by a column that both tables have, or by ``position`` within 1 arcsec (``position:R``).

    By default by name if columns of names in both tables have a name in common, and by position otherwise.  Identifiers
    of two releases of Gaia are different names.  Raises SweepError if nothing matches, or if the satellite's table has
    a name twice.
    """
    kind, _, radius = (by or "").partition(":")
    if kind == "position":
        return _by_position(satellite, reference, radius)
    by_column, forms = kind not in ("", "name"), (str.casefold, str)
    pairs = sorted(product(satellite.names, reference.names), key=lambda pair: [len(set(map(f, pair))) for f in forms])
    if by_column:
        pairs = [(a, b) for a, b in pairs if kind.casefold() == a.casefold() == b.casefold()]
    releases: tuple[str, ...] = ()
    for a, b in pairs:
        both = satellite.releases.get(a, ""), reference.releases.get(b, "")
        if not by_column and all(both) and both[0] != both[1]:
            releases = releases or both
            continue
        matched = _by_name(satellite, reference, (a, b), strict=by_column or a.casefold() in SOURCE_NAMES)
        if len(matched.rows):
            return matched
    said = [", ".join(f"{name} like {str(one[0])!r}" for name, one in t.names.items()) for t in (satellite, reference)]
    there = f"{satellite.path} has {said[0] or 'none'}, {reference.path} {said[1] or 'none'}"
    problem = f"no name is in both tables; columns of names: {there}"
    if by is None:
        return replace(_by_position(satellite, reference, "", f"; {problem}" * bool(pairs)), releases=releases)
    raise SweepError(f"match by {by!r}: {problem}")


def _by_name(satellite: AstrometricTable, reference: AstrometricTable, pair: tuple[str, str], strict: bool) -> Match:
    """Match by two columns; a name that the satellite has twice is an error if ``strict``, else nothing matches."""
    column, other = pair
    names, wanted = ([n.casefold() for n in t.names[c]] for t, c in zip((satellite, reference), pair, strict=True))
    known = {name: i for i, name in enumerate(names) if name not in _NO_NAME}
    place = np.array([known.get(name, -1) for name in wanted], dtype=np.int64)
    used = {name for name in wanted if name in known}
    if twice := {satellite.names[column][i] for i, name in enumerate(names) if name in used and known[name] != i}:
        if strict:
            raise SweepError(f"{column} {', '.join(sorted(twice)[:5])} is there more than once", satellite.path)
        place[:] = -1
    return Match(place, column if column == other else f"{column} = {other}", np.full(len(place), -1))


def _by_position(satellite: AstrometricTable, reference: AstrometricTable, radius_text: str, hint: str = "") -> Match:
    """Match each row to the nearest source, carried to the row's epoch with its proper motion; raises SweepError, with
    a ``hint``, if there is none.
    """
    radius = number(radius_text) if radius_text else DEFAULT_RADIUS_ARCSEC
    if isinstance(radius, str) or not 0.0 < radius <= 3600.0:
        raise SweepError(f"match by position:{radius_text}: the radius must be above 0 and at most 3600 arcsec")
    sources, rows = satellite.astrometry, reference.astrometry
    reference.require_positions("; match by name")
    chord = 2.0 * np.sin(0.5 * radius * ARCSEC)
    place, second = np.full((2, len(rows)), -1)
    epochs = np.where(np.isfinite(rows.epoch), rows.epoch, np.inf)
    known = epochs[np.isfinite(epochs)]
    years = np.inf, known.min(initial=np.inf), known.max(initial=-np.inf)
    start, *ends = (_directions(sources, np.full(len(sources), year)) for year in years)
    # twice as far as sources move on straight lines: others move little more, or within an arcsecond
    reach = 2.0 * chord + ARCSEC + 2.0 * max(np.linalg.norm(end - start, axis=0).max() for end in ends)
    tree = cKDTree(start.T)
    for epoch in np.unique(epochs):  # the sources move, so that each epoch has a tree of its own
        at = np.flatnonzero(epochs == epoch)
        there, near = triad(*rows.values[:2, at]).r.T, np.arange(len(sources))
        if np.sum(tree.query_ball_point(there, reach, return_length=True)) < len(near):
            near = np.unique(np.concatenate(tree.query_ball_point(there, reach))).astype(np.int64)
        moved = cKDTree(_directions(sources.taken(near), np.full(len(near), epoch)).T)
        # without a bound rows far from all sources take minutes
        distance, nearest = map(np.asarray, moved.query(there, k=2, distance_upper_bound=2.0 * chord))
        place[at], second[at] = np.where(distance <= chord, np.append(near, -1)[nearest], -1).T
    if np.all(place < 0):
        said = f"no row of the reference is within {radius:g} arcsec of a source{hint}"
        raise SweepError(f"{said}; {ARE_RIGHT}", reference.path)
    return Match(place, f"position within {radius:g} arcsec", second)


def _directions(sources: Astrometry, epoch: Array) -> Array:
    """Return unit vectors to sources at epochs, (3, N); their own where either has none."""
    both = np.isfinite(epoch) & np.isfinite(sources.epoch)
    start, end = (np.where(both, one, 0.0) for one in (sources.epoch, epoch))
    ra, dec = core.propagated(sources.values, sources.radial_velocity, start, end)[:2]
    if sources.further is not None:
        bend = core.bends(end - start, sources.orbit, sources.averaged)[:, :2]
        bend = np.einsum("nij,jn->in", bend, sources.further[0])
        ra, dec = core.from_tangent_plane(bend[0], bend[1], ra, dec)
    return triad(ra, dec).r


# ---- what is doubtful about a match


def far_rows(satellite: AstrometricTable, table: AstrometricTable, matched: Match) -> list[str]:
    """Return a note on rows far from their sources; raises SweepError if they cannot be the same objects."""
    there, here = satellite.astrometry.taken(matched.source), table.astrometry.taken(matched.rows)
    between = np.linalg.norm(triad(*here.values[:2]).r - _directions(there, here.epoch), axis=0)
    apart = np.nan_to_num(2.0 * np.arcsin(np.minimum(0.5 * between, 1.0)) / DEGREE)
    refused = np.any(apart > FARTHEST_DEG)
    far = np.flatnonzero(apart > (FARTHEST_DEG if refused else FAR_DEG))
    if not len(far):
        return []
    size = f"{apart[far].max():.3g} deg" if refused else f"{apart[far].max() * 3600.0:.3g} arcsec"
    whose = "their source" if matched.by.startswith("position") else "the source of the same name"
    note = f"{named_rows(matched.rows[far])} of {Path(table.path).name}: up to {size} from {whose}; {ARE_RIGHT}"
    if refused:
        raise SweepError(note)
    return [note]


def _listed(table: AstrometricTable, rows: Indices) -> str:
    """Return the names of rows, at most five, or their numbers."""
    return first_of(list(dict.fromkeys(table.labels[rows].tolist())), 5) if table.names else named_rows(rows)


def match_notes(satellite: AstrometricTable, table: AstrometricTable, matched: Match, rows: Astrometry) -> list[str]:
    """Return notes on rows that match no source, several, or the same one with the same numbers; ``rows`` are those
    that were matched.
    """
    name, notes = Path(table.path).name, []
    if matched.releases:
        releases = " and ".join(matched.releases)
        notes.append(f"identifiers of {releases} are different names; stars are named as in {name}")
    if rows.further is not None:
        notes.append(f"accelerations in {name} are not compared: its rows are of their epochs")
    if len(left := np.flatnonzero(matched.place < 0)):
        said = f"{len(left)} of {len(matched.place)} rows of {name} match no source: {_listed(table, left)}"
        blank = np.flatnonzero(np.isin(satellite.names.get(matched.by.partition(" = ")[0], ()), _NO_NAME))
        notes.append(said + f"; no name in {named_rows(blank)} of {Path(satellite.path).name}" * (len(blank) > 0))
    exact, nearly = _repeated(matched, rows)
    ambiguous = np.flatnonzero(matched.second >= 0)
    both = zip(matched.place[ambiguous][:5], matched.second[ambiguous][:5], strict=True)
    pairs = ", ".join(" and ".join(_listed(satellite, np.array([k])) for k in pair) for pair in both)
    for places, what in (
        (ambiguous, f"several sources are within the radius ({pairs}); the nearest is taken"),
        (exact, "the same numbers as another row of the source; all are used"),
        (nearly, "nearly the numbers of another row of the source; one measurement that is there twice counts twice"),
        (_coarse_epochs(satellite.astrometry, table, matched, rows), COARSE_EPOCHS),
    ):
        if len(places):
            notes.append(f"{named_rows(places)} of {name}: {what}")
    return notes


def _coarse_epochs(stars: Astrometry, table: AstrometricTable, matched: Match, rows: Astrometry) -> Indices:
    """Return the numbers of the rows of a single epoch that is rounded too much for the motions of their stars."""
    if not table.columns or len(np.unique(rows.epoch)) < 2:  # built-in tables are as they were published
        return matched.rows[:0]
    values = np.nan_to_num(stars.values[2:, matched.source])
    with np.errstate(invalid="ignore", divide="ignore"):
        years = np.nanmin(rows.errors[:2], axis=0, initial=np.inf) / (np.hypot(*values[1:]) + 2.0 * np.pi * values[0])
    years[(years <= 0.0) | (years > 0.5) | (core.kind_numbers(rows) != core.SINGLE_EPOCH)] = np.nan
    days = (rows.epoch - 2000.0) * core.DAYS_PER_YEAR + MJD_OF_2000
    in_days = files.too_coarse(days, 2.0 * years * core.DAYS_PER_YEAR, (0.25, 0.5, 1.0))  # half the last decimal
    return matched.rows[np.union1d(in_days, files.too_coarse(rows.epoch, 2.0 * years, (1.0,)))]


def _repeated(matched: Match, rows: Astrometry) -> list[Indices]:
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


# ---- what is done to the rows of a reference before the solution


def with_jitter(rows: Astrometry, jitter: Mapping[str, Any]) -> Astrometry:
    """Return rows with (mas, mas/yr) added in quadrature to the errors of each kind, or of "all"; covariances do not
    change.

    Raises SweepError for unknown kinds, and kinds of which there is no row.
    """
    if not jitter:
        return rows
    known = [*core.KINDS, ALL]
    if unknown := sorted(set(jitter) - set(known)):
        raise SweepError(f"jitter: no kind of row {', '.join(unknown)}; kinds are {', '.join(known)}")
    kind_of_row = kinds(rows)
    if absent := sorted(set(jitter) - {ALL, *kind_of_row.tolist()}):
        there = ", ".join(np.unique(kind_of_row))
        raise SweepError(f"jitter: no row is of the kind {', '.join(absent)}; there are {there}")
    added = np.zeros_like(rows.errors)
    for kind in np.unique(kind_of_row):
        size = jitter.get(kind, jitter.get(ALL, ESTIMATE))  # what is estimated is added later
        position, motion = (0.0, 0.0) if size == ESTIMATE else size
        added[:, kind_of_row == kind] = MAS * np.array([position, position, position, motion, motion])[:, None]
    added[2, rows.at_rest[2]] = 0.0  # a noise of positions is none of a parallax that is known
    return core.with_variance(rows, added**2)


def _aberrated(rows: Astrometry, to_epoch: Array, aberration: float) -> Astrometry:
    """Return positions without an epoch carried from 2015.0 to another by the Galactic aberration (uas/yr).

    Sources appear to move towards the Galactic centre.  Source: Charlot et al. 2020, A&A 644, A159.  Raises SweepError
    if there are no such positions.
    """
    if not np.any(rows.present[0] & np.isnan(rows.epoch) & np.isfinite(to_epoch)):
        said = "aberration carries positions without an epoch from 2015.0 to that of their source, and no row of the"
        raise SweepError(f"{said} reference is such a position")
    years = np.where(np.isfinite(rows.epoch) | ~np.isfinite(to_epoch), 0.0, to_epoch - ICRF3_EPOCH)
    values, glide = rows.values.copy(), _glide(rows, aberration)
    values[0] += years * glide[0] / np.cos(rows.values[1])
    values[1] += years * glide[1]
    return replace(rows, values=values)


def _glide(rows: Astrometry, aberration: float) -> Array:
    """Return the apparent motions (2, N) of a Galactic aberration (uas/yr), rad/yr."""
    glide = frames.GALACTIC_AXES[0] * aberration * MAS / 1000.0
    return np.stack([glide @ axis for axis in triad(rows.values[0], rows.values[1])[:2]])


def known_unknowns(options: Options, stars: Astrometry) -> tuple[Unknowns, Array] | None:
    """Return the blocks and the values (rad, rad/yr) of an orientation and a spin that are known; None without any."""
    known = list[tuple[Block, Array]]()
    for name, said in (("spin", options.known_spin), ("orientation", options.known_orientation)):
        if isinstance(said, str):
            known.append(_spin_by_bin(said, options.sign, stars))
        elif said is not None:
            known.append((parse_unknowns(name).blocks[0], SIGNS[options.sign] * np.array(said) * MAS))
    blocks = tuple(block for block, _ in known)
    return (Unknowns(blocks), np.concatenate([values for _, values in known])) if known else None


def _spin_by_bin(spin: str, sign: str, stars: Astrometry) -> tuple[Block, Array]:
    """Return the block and the values (rad/yr) of a spin that a table has by bins of phot_g_mean_mag.

    The table has columns mag_min, mag_max, and omega_x, omega_y, omega_z with a unit; its metadata may have ``sign``
    and ``release``.  Raises SweepError for anything else, for sources outside its bins, and for those of another
    release.
    """
    read, at = Columns(reader.read_table(files.built_in(Path(spin))), spin), releases_at(stars.epoch)
    if (release := read.table.meta.get("release")) is not None and at != [release]:
        there = " and ".join(at) or "no release"
        raise SweepError(f"spins of {release}, and the satellite's epochs are those of {there}", spin)
    if (said := read.table.meta.get("sign", sign)) not in [*SIGNS]:
        raise SweepError(f"sign {said!r} in its metadata: must be {' or '.join(SIGNS)}", spin)
    axes = [f"omega_{axis}" for axis in "xyz"]
    for name in ("mag_min", "mag_max", *axes):
        if read.require(name) and name in axes and read.table[name].unit is None:
            read.problems.append(f"column {name!r} has no unit, uas/yr or mas/yr")
    read.finish()
    read.table.sort("mag_min")
    low, high = (read.numbers(f"mag_{end}") for end in ("min", "max"))
    vectors = np.array([read.quantity(name) for name in axes]).T
    read.finish()
    if np.any(low[1:] != high[:-1]) or np.any(high <= low):
        raise SweepError("the bins of magnitude do not follow one another", spin)
    values = stars.columns.get(MAGNITUDE, np.full(len(stars), np.nan))
    if np.any(outside := ~((values >= low[0]) & (values < high[-1]))):
        raise SweepError(f"{np.count_nonzero(outside)} matched sources have no {MAGNITUDE} in its bins", spin)
    block = spin_by_bin(MAGNITUDE, tuple(low[1:].tolist()), tuple(range(len(low))))
    return block, SIGNS[said] * vectors.ravel() * MAS


# ---- unknowns


def unknowns_for(options: Options, problem: Problem, notes: list[str]) -> Unknowns:
    """Return the unknowns of the options; if none are named, those of orientation and spin that the rows determine.

    A note is added if these are not both.  Raises ValueError for unknowns that do not exist.
    """
    missions, named = problem.tables[1:], listed(options.unknowns)
    of_missions = [name for name in named if name.partition(":")[0] in missions]
    names = [name for name in named if name not in of_missions]
    if not names:
        here = np.flatnonzero(problem.rows.frame == 0)
        rows, source = problem.rows.taken(here), problem.source[here]
        plain = replace(problem, rows=rows, source=source, tables=problem.tables[:1])
        names = _determined(plain)
        if names == ["orientation"] and _determine(plain, ["spin"]):
            years = np.nanmedian(np.where(plain.rows.present[0], plain.rows.epoch, np.nan)) - problem.epoch
            notes.append(f"the tables determine only epsilon + t omega, here t = {years:.4g} years; omega counts as 0")
        elif len(names) == 1:
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
            names += _determined(problem, names, mission)
    bins = parse_bins(options.bins)
    columns = problem.satellite.columns
    return parse_unknowns(",".join(names), bins if options.bins else None, columns, missions=missions)


def _determine(problem: Problem, names: Sequence[str]) -> bool:
    """Return whether the rows determine some unknowns together."""
    unknowns = parse_unknowns(",".join(names), missions=problem.tables[1:])
    trial = sources_of(replace(problem, unknowns=unknowns, weights="covariance"))
    try:
        trial.solve(np.ones(len(problem.satellite)))
    except LinkError:
        return False
    return True


def _determined(problem: Problem, beside: Sequence[str] = (), mission: str = "") -> list[str]:
    """Return those of orientation and spin, of the satellite or a mission, that rows determine together with others."""
    for blocks in (("orientation", "spin"), ("orientation",), ("spin",)):
        names = [f"{mission}:{block}" if mission else block for block in blocks]
        if _determine(problem, [*beside, *names]):
            return names
    frame = f"the frame of {mission}" if mission else "the satellite's frame"
    raise LinkError(f"the tables determine neither the orientation nor the spin of {frame}")


# ---- a satellite's table of millions of quasars, read again in each pass of `StreamedSources`

# Smaller tables are solved as a whole.
FROM_ROWS = 100_000

# At most so many notes on rows are shown.
MOST_NOTES = 5


def in_row_groups(satellite: str | Path, reference: str | Path, options: Options) -> bool:
    """Return whether a table is read by row groups: many quasars in Parquet, of which no row needs a match."""
    path = Path(satellite)
    whole = ("missions", "where", "epochs", "star_models", "orbits", "aberration")
    alone = str(reference) == ZERO_MOTION and not any(getattr(options, name) for name in whole)
    return alone and path.is_file() and reader.is_parquet(path) and sum(reader.row_groups(path)[0]) >= FROM_ROWS


@dataclass(frozen=True)
class RowGroup:
    """The rows of a table from ``first`` on, and the options.

    ``epoch`` and ``unknowns`` are known when all row groups have been looked through.
    """

    path: Path
    digest: str
    number: int
    first: int
    columns: tuple[str, ...]
    options: Options
    epoch: float = np.nan
    unknowns: Unknowns = Unknowns(())  # noqa: RUF009 (it is frozen)

    def problem(self) -> Problem:
        """Return the problem of the rows; raises SweepError for wrong ones, with their numbers in the row group."""
        stars = self.read().astrometry
        known, source = known_unknowns(self.options, stars), moving_sources(stars)
        jitter = parse_jitter(self.options.jitter, ())
        rows = with_jitter(zero_motion(len(source), self.options), jitter.get("reference", {}))
        return Problem(stars, rows, source, self.unknowns, self.epoch, self.options.weights, known)

    def read(self) -> AstrometricTable:
        """Read the rows."""
        if digest_once(self.path) != self.digest:
            raise SweepError("is not the same file on every worker, or was changed", str(self.path))
        table = reader.read_row_group(self.path, self.number, self.columns)
        where = f"{self.path}, the {len(table)} rows from row {self.first + 1} on"
        options, checked = table_options(self.options)["satellite"], bool(np.isfinite(self.epoch))
        rows = astrometric_table(table, where, self.digest, options, checked)
        rows.require_positions()
        return rows


# Return the SHA-256 of a file, which a process reads only once.
digest_once = lru_cache(maxsize=8)(files.digest_of)


def look_through(group: RowGroup, per_source: bool) -> tuple[Array, Any, Array | None, int, Sequence[str]]:
    """Return what a first look at a row group finds: one value in each bin of the column of bins; the epochs and how
    many sources have each; the positions of the sources (2, n), rad, if ``per_source``; how many move; and notes.
    """
    table = group.read()
    stars, sample = table.astrometry, np.zeros(0)
    name, edges = parse_bins(group.options.bins)
    if name in stars.columns:
        bin_of = np.searchsorted(edges, stars.columns[name], side="right")
        sample = stars.columns[name][np.unique(bin_of, return_index=True)[1]]
    epochs = np.unique(stars.epoch[np.isfinite(stars.epoch)], return_counts=True)
    return sample, epochs, stars.values[:2] if per_source else None, len(moving_sources(stars)), table.notes


def set_up_row_groups(
    satellite: str | Path, options: Options, run: Map, per_source: bool = True
) -> tuple[Setup, StreamedSources]:
    """Look through a table once; raises SweepError for whatever is wrong with it or the options.

    Without ``per_source`` the result has no positions of the sources, which saves memory.
    """
    path = Path(satellite).resolve()
    sizes, without_rows = reader.row_groups(path)
    how = table_options(options)["satellite"]
    read = Columns(without_rows, str(path), how.columns, how.units, files.QUANTITIES)
    further = files.ZERO_POINT if how.parallax_zero_point or isinstance(options.known_spin, str) else ()
    used = {read.name(quantity) for quantity in (*files.QUANTITIES, *further) if quantity != "name"}
    names = tuple(name for name in read.names if name in used | {parse_bins(options.bins)[0]})
    asked = options
    if read.from_archive and "ra" not in how.units and not read.table["ra"].unit:  # of some columns nobody could tell
        asked = replace(options, units=(*options.units, ("satellite:ra", "deg")))
    digest, n = digest_once(path), sum(sizes)
    firsts = np.cumsum([0, *sizes]).tolist()
    groups = [RowGroup(path, digest, k, firsts[k], names, asked) for k, size in enumerate(sizes) if size]
    looks = run(look_through, ((group, per_source) for group in groups))
    samples, epochs, places, moving, notes = zip(*looks, strict=True)
    values = np.broadcast_to(np.nan, (5, n))  # takes no memory
    if per_source:
        values = np.zeros((5, n))
        values[:2] = np.concatenate(places, axis=1)
    noted: dict[str, int] = {}
    for group, some in zip(groups, notes, strict=True):
        for note in some:
            noted.setdefault(note, group.first)
    known = np.concatenate([np.repeat(*one) for one in epochs])
    if mixed := files.of_two_releases(read.names, known):
        raise SweepError(mixed, str(path))
    epoch = default_epoch(known) if options.epoch is None else options.epoch
    said = [f"{path.name}, from row {first + 1} on: {note}" for note, first in noted.items()]
    if (more := len(said) - MOST_NOTES) > 0:
        said[MOST_NOTES:] = [f"{path.name}: {more} more such notes"]
    said += without_motion(n - sum(moving), n)
    with refused(ValueError):
        unknowns = _unknowns(replace(groups[np.argmax(moving)], epoch=epoch), np.concatenate(samples), said)
    problems = [replace(group, epoch=epoch, unknowns=unknowns).problem for group in groups]
    row_numbers = np.arange(n + 1)  # one array for the sources and, from 1, for their names
    stars = Astrometry(values, np.broadcast_to(np.nan, (5, n)), np.broadcast_to(epoch, n))
    problem = Problem(stars, zero_motion(n, options), row_numbers[:-1], unknowns, epoch, options.weights)
    left = AstrometricTable(str(satellite), digest, stars, {}, options=how)
    right = AstrometricTable(ZERO_MOTION, "", problem.rows, {})
    matched = Match(row_numbers[:-1], EVERY_SOURCE, np.broadcast_to(-1, n))
    said.append(f"read in {len(groups)} row groups; sources are named by their row numbers")
    whole = Setup(dict(zip(SIDES, (left, right), strict=True)), matched, problem, row_numbers[1:], tuple(said))
    return whole, StreamedSources(unknowns.labels, problems, [group.first for group in groups], n, run)


def _unknowns(group: RowGroup, sample: Array, notes: list[str]) -> Unknowns:
    """Return the unknowns of the whole table: the first rows say which are determined, all rows which bins are used."""
    stars = group.read().astrometry
    few = stars.taken(moving_sources(stars)[:1000])
    rows = zero_motion(len(few), group.options)
    if group.options.bins:
        few = replace(few, columns={parse_bins(group.options.bins)[0]: sample} if len(sample) else {})
    problem = Problem(few, rows, np.arange(len(few)), group.unknowns, group.epoch)
    try:
        return unknowns_for(group.options, problem, notes)
    except LinkError as error:
        raise LinkError(f"of the first rows: {error}") from error
