"""A search for galaxies in a star catalogue: what to search, from the options of the command line, and its matches."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from linksweep.core.crossmatch import MAX_RADIUS, GalaxyCatalogue, Matches, Positions, Rules, at_epoch, cross_match
from linksweep.core.frames import ARCSEC, DEGREE, MAS
from linksweep.sweep.contract import SweepError, suggest
from linksweep.sweep.formatting import split_assignment
from linksweep.sweep.search.tables import (
    MOTIONS,
    QUANTITIES,
    WITH_UNITS,
    Reading,
    SkyTable,
    read_sky_table,
    table_name,
    tyc_code,
)
from linksweep.sweep.tables.columns import EPOCHS

DEFAULT_RADIUS_ARCSEC = 5.0


@dataclass(frozen=True)
class Search:
    """What to search and how: files, match radius and `Reading` by table name, epoch (Julian year) and rules.

    The summary assumes a second epoch ``epoch_difference_yr`` later, with errors of ``second_epoch_error_mas``.
    """

    stars: Path
    galaxies: tuple[Path, ...]
    supplement: Path | None
    radius_arcsec: Mapping[str, float]
    readings: Mapping[str, Reading]
    epoch: float
    rules: Rules
    epoch_difference_yr: float
    second_epoch_error_mas: float


@dataclass(frozen=True)
class Result:
    """A search, its tables (``stars`` holds the star catalogue and, if there is one, the supplement) and matches."""

    search: Search
    stars: tuple[SkyTable, ...]
    galaxies: tuple[SkyTable, ...]
    matches: Matches


def plan_search(
    stars: Path,
    galaxies: Sequence[Path],
    supplement: Path | None = None,
    *,
    radius: Sequence[str] = (),
    error: Sequence[str] = (),
    ref_epoch: Sequence[str] = (),
    column: Sequence[str] = (),
    unit: Sequence[str] = (),
    missing_pm: Literal["error", "zero"] = "error",
    epoch: float = 2000.0,
    k_sigma: float = Rules.k_sigma,
    crowding_radius_arcsec: float = Rules.crowding_radius / ARCSEC,
    crowding_stars: int = Rules.crowding_stars,
    merge_radius_arcsec: float | None = None,
    epoch_difference_yr: float = 20.0,  # the paper's: 117 and 127 mas give about 6 mas/yr
    second_epoch_error_mas: float = 0.0,
) -> Search:
    """Return the search that the options of the command line ask for; no file is read yet.

    ``radius`` and ``error`` (arcsec) are NAME=VALUE, or VALUE for all galaxy tables; ``ref_epoch`` (yr) is NAME=VALUE,
    or VALUE for all star tables.  ``column`` is KEY=COLUMN for the star tables or NAME:KEY=COLUMN for one table;
    ``unit``, KEY=UNIT or NAME:KEY=UNIT, gives the unit of a column for which the file gives none.
    The other arguments are those of `Rules` and `Search`.
    Raises SweepError for two tables with the same name, unknown names and values out of range.
    """
    star_names = [table_name(path) for path in (stars, supplement) if path is not None]
    galaxy_names = [table_name(path) for path in galaxies]
    names = star_names + galaxy_names
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise SweepError(f"two tables are called {', '.join(map(repr, twice))}; give the files different names")
    for name, value in (
        ("k_sigma", k_sigma),
        ("crowding_radius_arcsec", crowding_radius_arcsec),
        ("merge_radius_arcsec", 1.0 if merge_radius_arcsec is None else merge_radius_arcsec),
        ("epoch_difference_yr", epoch_difference_yr),
    ):
        if not 0.0 < value < math.inf:
            raise SweepError(f"{name} = {value:g}: must be a finite number above 0")
    if not 0.0 <= second_epoch_error_mas < math.inf:
        raise SweepError(f"second_epoch_error_mas = {second_epoch_error_mas:g}: must be a finite number, 0 or above")
    if not EPOCHS[0] <= epoch <= EPOCHS[1]:
        raise SweepError(f"epoch {epoch:g}: must be a Julian year {EPOCHS[0]:g}..{EPOCHS[1]:g}")
    problems: list[str] = []

    def number(option: str, texts: Sequence[str], tables: Sequence[str], common: Sequence[str], unit: str) -> Any:
        low, high = EPOCHS if unit == "yr" else (0.0, MAX_RADIUS / ARCSEC)

        def checked(_key: str, text: str) -> float:
            try:
                value = float(text)
            except ValueError:
                value = math.nan
            if not low < value <= high:
                raise ValueError(f"must be a number above {low:g} and at most {high:g} [{unit}]")
            return value

        return {
            table: found[""] for table, found in _by_table(option, texts, tables, common, checked, problems).items()
        }

    def quantity(option: str, texts: Sequence[str], known: Sequence[str]) -> dict[str, dict[str, str]]:
        def checked(key: str, value: str) -> str:
            if not key:
                raise ValueError(f"write KEY={option[2:].upper()} or NAME:KEY={option[2:].upper()}")
            if key not in known:
                raise ValueError(f"there is no quantity {key!r}{suggest(key, known)}")
            return value

        return {name: {} for name in names} | _by_table(option, texts, names, star_names, checked, problems)

    radii = number("--radius", radius, galaxy_names, galaxy_names, "arcsec")
    errors = number("--error", error, names, galaxy_names, "arcsec")
    epochs = number("--ref-epoch", ref_epoch, star_names, star_names, "yr")
    columns, units = quantity("--column", column, QUANTITIES), quantity("--unit", unit, WITH_UNITS)
    if problems:
        raise SweepError(problems)
    merge_radius = None if merge_radius_arcsec is None else merge_radius_arcsec * ARCSEC
    return Search(
        stars,
        tuple(galaxies),
        supplement,
        dict.fromkeys(galaxy_names, DEFAULT_RADIUS_ARCSEC) | radii,
        {name: Reading(columns[name], units[name], errors.get(name), epochs.get(name), missing_pm) for name in names},
        epoch,
        Rules(k_sigma, crowding_radius_arcsec * ARCSEC, crowding_stars, merge_radius),
        epoch_difference_yr,
        second_epoch_error_mas,
    )


def _by_table(
    option: str,
    texts: Sequence[str],
    tables: Sequence[str],
    common: Sequence[str],
    checked: Callable[[str, str], Any],
    problems: list[str],
) -> dict[str, dict[str, Any]]:
    """Return {table: {key: value}} from texts like VALUE, NAME=VALUE, KEY=VALUE and NAME:KEY=VALUE.

    A value for one table overrides that for all ``common`` ones.  What is wrong is added to ``problems``: unknown
    tables, what was said twice, and what ``checked`` raises as a ValueError.
    """
    keyed = option in ("--column", "--unit")
    said: dict[tuple[str, str], Any] = {}
    for text in texts:
        name, value = split_assignment(text) if keyed or "=" in text else ("", text)
        table, key = name.rpartition(":")[::2] if keyed else (name, "")
        try:
            if table and table not in tables:
                raise ValueError(f"no table {table!r}{suggest(table, tables)}")
            if (table, key) in said:
                raise ValueError(f"given twice{f' for {table!r}' if table else ''}")
            said[table, key] = checked(key, value)
        except ValueError as error:
            problems.append(f"{option} {text}: {error}")
    found: dict[str, dict[str, Any]] = {}
    for (table, key), value in sorted(said.items(), key=lambda item: bool(item[0][0])):
        for one in [table] if table else common:
            found.setdefault(one, {})[key] = value
    return found


def read_tables(search: Search) -> tuple[tuple[SkyTable, ...], tuple[SkyTable, ...]]:
    """Return the star tables and the galaxy tables of a search; raises SweepError with the problems of all."""
    stars: list[SkyTable] = []
    galaxies: list[SkyTable] = []
    problems: list[str] = []
    star_paths = [path for path in (search.stars, search.supplement) if path is not None]
    for path in (*star_paths, *search.galaxies):
        try:
            table = read_sky_table(path, search.readings[table_name(path)], path in star_paths)
            (stars if path in star_paths else galaxies).append(table)
        except SweepError as bad:
            problems += [f"{path}: {problem}" for problem in bad.problems]
    if problems:
        raise SweepError(problems)
    tyc = [table.tyc for table in stars if table.tyc is not None]
    if len(tyc) == 2 and len(both := tyc[1][np.isin(tyc_code(tyc[1]), tyc_code(tyc[0]))]):
        named = ", ".join("-".join(map(str, t)) for t in both[:5].tolist())
        more = f" and {len(both) - 5} more" if len(both) > 5 else ""
        raise SweepError(f"TYC {named}{more}: in the star table and again in the supplement")
    return tuple(stars), tuple(galaxies)


def match_tables(search: Search, stars: tuple[SkyTable, ...], galaxies: tuple[SkyTable, ...]) -> Result:
    """Return the matches; ``stars`` are the star table and, if there is one, the supplement.

    Raises SweepError for a radius that would pair everything with everything.
    """
    parts = [_star_positions(table, search.epoch) for table in stars]
    positions = Positions(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Positions)))
    supplement = np.repeat(np.arange(len(stars)) == 1, [len(table) for table in stars])
    radii = [search.radius_arcsec[table.name] * ARCSEC for table in galaxies]
    catalogues = [GalaxyCatalogue(_positions(t), t.pgc, radius) for t, radius in zip(galaxies, radii, strict=True)]
    try:
        return Result(search, stars, galaxies, cross_match(positions, supplement, catalogues, search.rules))
    except ValueError as error:
        raise SweepError(str(error)) from error


def _positions(table: SkyTable) -> Positions:
    n = table.numbers
    return Positions(n["ra"] * DEGREE, n["dec"] * DEGREE, n["ra_error"] * MAS, n["dec_error"] * MAS)


def _star_positions(table: SkyTable, epoch: float) -> Positions:
    positions, numbers = _positions(table), table.numbers
    if "pmra" not in numbers:
        return positions
    none = np.zeros(len(table))
    motions = {key: np.nan_to_num(numbers.get(key, none)) * MAS for key in MOTIONS}
    return at_epoch(positions, **motions, years=epoch - numbers["ref_epoch"])
