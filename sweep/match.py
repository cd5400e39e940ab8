"""The galaxy search as a command: tables in, matches as ECSV and 46-byte table out, a summary and a sky map."""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from core.constants import DEGREE, MAS
from core.crossmatch import (
    ARCSEC,
    CLASS_NAMES,
    MAX_RADIUS,
    REASON_NAMES,
    GalaxyCatalogue,
    Matches,
    Positions,
    Rules,
    at_epoch,
    cross_match,
    galactic,
    second_epoch_pm_error,
)
from sweep.contract import SweepError, suggest
from sweep.galaxy_table import GalaxyTable, format_galaxy_table
from sweep.sky_tables import (
    COLUMNS,
    EPOCHS,
    MAGNITUDES,
    TYC,
    UNITS,
    Reading,
    SkyTable,
    per_table,
    read_galaxies,
    read_stars,
    table_name,
)
from sweep.tablefile import read_astropy_table

if TYPE_CHECKING:
    from rich.console import RenderableType

Array = NDArray[np.float64]

DEFAULT_RADIUS_ARCSEC = 5.0
DEFAULT_EPOCH = 2000.0
DEFAULT_EPOCH_DIFFERENCE_YR = 20.0
"""The paper's: 117 and 127 mas give about 6 mas/yr."""

MAP_SUFFIXES = (".png", ".svg", ".pdf")
STAR_MOTIONS = {name: f"star_{name}" for name in ("pmra", "pmdec", "pmra_error", "pmdec_error")}
"""A star's proper motion is measured, a galaxy's is zero: so named, a study does not take one for the other."""

COLUMN_UNITS: Mapping[str, str] = {
    **{STAR_MOTIONS.get(name, name): unit for name, unit in UNITS.items()},
    "offset": "arcsec",
    "offset_ra": "arcsec",
    "offset_dec": "arcsec",
    "galaxy_ra": "deg",
    "galaxy_dec": "deg",
}
MATCH_COLUMNS = {
    "class": "certain, uncertain or supplement",
    "reason": "why it is in doubt: crowded, offset, rival; or none",
    "offset": "angle between star and galaxy at the epoch of the search",
    "offset_ra": "galaxy - star along ra, with cos(dec)",
    "offset_dec": "galaxy - star along dec",
    "offset_sigma": "offset in units of the combined position errors",
    "n_near": "other stars within the crowding radius",
    "n_rival": "other stars and galaxies within the match radius",
    "galaxy_table": "catalogue of the closest entry of the galaxy",
    "galaxy_row": "row of that entry, from 1",
    "galaxy_ra": "position of that entry",
    "galaxy_dec": "position of that entry",
    "found_in": "all catalogues with the galaxy within their radius",
    "star_table": "catalogue of the star",
    "star_row": "row of the star, from 1",
}
"""The columns of the ECSV beside those of the star table, and what they mean."""


@dataclass(frozen=True)
class Search:
    """What is searched and how: files, match radius and `Reading` by table name, epoch (Julian year) and rules.

    A second epoch ``epoch_difference_yr`` later with errors of ``second_epoch_error_mas`` is for the summary.
    """

    stars: Path
    galaxies: tuple[Path, ...]
    supplement: Path | None = None
    radius_arcsec: Mapping[str, float] = field(default_factory=dict)
    readings: Mapping[str, Reading] = field(default_factory=dict)
    epoch: float = DEFAULT_EPOCH
    rules: Rules = field(default_factory=Rules)
    epoch_difference_yr: float = DEFAULT_EPOCH_DIFFERENCE_YR
    second_epoch_error_mas: float = 0.0

    def radius(self, name: str) -> float:
        """Return the match radius of a galaxy table in arcsec."""
        return self.radius_arcsec.get(name, DEFAULT_RADIUS_ARCSEC)


@dataclass(frozen=True)
class Outputs:
    """Where results go; None for not at all."""

    ecsv: Path | None = None
    table: Path | None = None
    sky_map: Path | None = None

    def paths(self) -> list[Path]:
        """Return those that are wanted."""
        return [path for f in fields(self) if (path := getattr(self, f.name)) is not None]


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
    missing_pm: Literal["error", "zero"] = "error",
    epoch: float = DEFAULT_EPOCH,
    k_sigma: float = Rules.k_sigma,
    crowding_radius_arcsec: float = Rules.crowding_radius / ARCSEC,
    crowding_stars: int = Rules.crowding_stars,
    merge_radius_arcsec: float | None = None,
    epoch_difference_yr: float = DEFAULT_EPOCH_DIFFERENCE_YR,
    second_epoch_error_mas: float = 0.0,
) -> Search:
    """Return the search that options as on the command line ask for; nothing is read yet.

    ``radius`` and ``error`` (arcsec) and ``ref_epoch`` (yr) are NAME=VALUE, or VALUE for all galaxy tables, for all
    galaxy tables and for all star tables; ``column`` is KEY=COLUMN for the star tables or NAME:KEY=COLUMN for one.
    The others are those of `Rules` and `Search`.
    Raises SweepError for two tables of one name, unknown names and values out of range.
    """
    star_names = [table_name(path) for path in (stars, supplement) if path is not None]
    galaxy_names = [table_name(path) for path in galaxies]
    names = star_names + galaxy_names
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SweepError(f"two tables are called {', '.join(map(repr, twice))}; give the files different names")
    positive = {
        "k_sigma": k_sigma,
        "crowding_radius_arcsec": crowding_radius_arcsec,
        "merge_radius_arcsec": 1.0 if merge_radius_arcsec is None else merge_radius_arcsec,
        "epoch_difference_yr": epoch_difference_yr,
    }
    for name, value in positive.items():
        if not 0.0 < value < math.inf:
            raise SweepError(f"{name} = {value:g}: must be a finite number above 0")
    if not 0.0 <= second_epoch_error_mas < math.inf:
        raise SweepError(f"second_epoch_error_mas = {second_epoch_error_mas:g}: must be a finite number, 0 or above")
    if not EPOCHS[0] <= epoch <= EPOCHS[1]:
        raise SweepError(f"epoch {epoch:g}: must be a Julian year {EPOCHS[0]:g}..{EPOCHS[1]:g}")
    problems: list[str] = []
    values: dict[str, dict[str, float]] = {}
    arcsec = _between(0.0, MAX_RADIUS / ARCSEC, "arcsec")
    for option, texts, allowed, common_for, convert in (
        ("--radius", radius, galaxy_names, galaxy_names, arcsec),
        ("--error", error, names, galaxy_names, arcsec),
        ("--ref-epoch", ref_epoch, star_names, star_names, _between(*EPOCHS, "yr")),
    ):
        try:
            values[option] = per_table(option, texts, allowed, common_for, convert)
        except SweepError as bad:
            problems += bad.problems
    columns = _column_maps(column, names, star_names, problems)
    if problems:
        raise SweepError(problems)
    readings = {
        name: Reading(columns[name], values["--error"].get(name), values["--ref-epoch"].get(name), missing_pm)
        for name in names
    }
    return Search(
        stars,
        tuple(galaxies),
        supplement,
        values["--radius"],
        readings,
        epoch,
        Rules(
            k_sigma,
            crowding_radius_arcsec * ARCSEC,
            crowding_stars,
            None if merge_radius_arcsec is None else merge_radius_arcsec * ARCSEC,
        ),
        epoch_difference_yr,
        second_epoch_error_mas,
    )


def find_galaxies(search: Search, outputs: Outputs | None = None, overwrite: bool = False) -> Result:
    """Read the tables, match them and write what is wanted.

    Raises SweepError as `check_outputs`, `read_tables`, `match_tables` and `write_outputs`; nothing is written then.
    """
    outputs = outputs or Outputs()
    check_outputs(outputs, search, overwrite)
    stars, galaxies = read_tables(search)
    if outputs.table is not None:
        check_for_galaxy_table(stars)
    result = match_tables(search, stars, galaxies)
    write_outputs(result, outputs, overwrite)
    return result


def read_tables(search: Search) -> tuple[tuple[SkyTable, ...], tuple[SkyTable, ...]]:
    """Return the star tables and the galaxy tables of a search; raises SweepError with the problems of them all."""
    tables: list[SkyTable] = []
    problems: list[str] = []
    star_paths = [path for path in (search.stars, search.supplement) if path is not None]
    for read, paths in ((read_stars, star_paths), (read_galaxies, list(search.galaxies))):
        for path in paths:
            try:
                tables.append(read(path, search.readings.get(table_name(path))))
            except SweepError as bad:
                problems += [f"{path}: {problem}" for problem in bad.problems]
    if problems:
        raise SweepError(problems)
    stars, galaxies = tuple(tables[: len(star_paths)]), tuple(tables[len(star_paths) :])
    _check_shared_stars(stars)
    return stars, galaxies


def match_tables(search: Search, stars: tuple[SkyTable, ...], galaxies: tuple[SkyTable, ...]) -> Result:
    """Return the matches; ``stars`` are the star table and, if there is one, the supplement.

    Raises SweepError for a radius that would pair everything with everything.
    """
    parts = [_star_positions(table, search.epoch) for table in stars]
    positions = Positions(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Positions)))
    supplement = np.repeat(np.arange(len(stars)) == 1, [len(table) for table in stars])
    catalogues = [
        GalaxyCatalogue(
            _positions(table),
            np.zeros(len(table), dtype=np.int64) if table.pgc is None else table.pgc,
            search.radius(table.name) * ARCSEC,
        )
        for table in galaxies
    ]
    try:
        matches = cross_match(positions, supplement, catalogues, search.rules)
    except ValueError as error:
        raise SweepError(str(error)) from error
    return Result(search, stars, galaxies, matches)


def match_columns(result: Result) -> dict[str, NDArray[Any]]:
    """Return the matches as columns, a row each: those of the star tables, then those of `MATCH_COLUMNS`.

    A number that a table does not have is NaN, an identifier 0.
    """
    matches = result.matches
    starts = np.cumsum([0, *(len(table) for table in result.stars)])
    which = np.searchsorted(starts, matches.star, side="right") - 1
    row = matches.star - starts[which]
    columns: dict[str, NDArray[Any]] = {}

    def from_stars(values: Callable[[SkyTable], NDArray[Any] | None], missing: float) -> NDArray[Any] | None:
        """Gather a column of the star tables; None if no table has it."""
        gathered: NDArray[Any] | None = None
        for t, table in enumerate(result.stars):
            if (column := values(table)) is not None:
                if gathered is None:
                    gathered = np.full((len(row), *column.shape[1:]), missing, dtype=column.dtype)
                gathered[which == t] = column[row[which == t]]
        return gathered

    tyc = from_stars(lambda table: table.tyc, 0)
    if tyc is not None:
        columns |= dict(zip(TYC, tyc.T, strict=True))
    source_id = from_stars(lambda table: table.source_id, 0)
    if source_id is not None:
        columns["source_id"] = source_id
    columns["PGC"] = matches.identifier
    for name in UNITS:
        number = from_stars(lambda table, name=name: table.numbers.get(name), np.nan)  # type: ignore[misc]
        if number is not None:
            columns[STAR_MOTIONS.get(name, name)] = number
    names = np.array([table.name for table in result.galaxies])
    there = np.empty((2, len(matches)))
    for t, table in enumerate(result.galaxies):
        mine = matches.catalogue == t
        there[:, mine] = [table.numbers[key][matches.entry[mine]] for key in ("ra", "dec")]
    return columns | {
        "class": np.array(CLASS_NAMES)[matches.code],
        "reason": np.array(
            [",".join(n for bit, n in REASON_NAMES.items() if r & bit) or "none" for r in matches.reason], dtype=str
        ),
        "offset": matches.offset / ARCSEC,
        "offset_ra": matches.d_ra / ARCSEC,
        "offset_dec": matches.d_dec / ARCSEC,
        "offset_sigma": matches.n_sigma,
        "n_near": matches.n_near,
        "n_rival": matches.n_rival,
        "galaxy_table": names[matches.catalogue],
        "galaxy_row": matches.entry + 1,
        "galaxy_ra": there[0],
        "galaxy_dec": there[1],
        "found_in": np.array([",".join(names[found]) for found in matches.found_in], dtype=str),
        "star_table": np.array([table.name for table in result.stars])[which],
        "star_row": row + 1,
    }


def matches_table(result: Result) -> Any:
    """Return the matches as an astropy Table with units and descriptions; missing values are masked, ``meta`` is the
    summary.
    """
    from astropy.table import MaskedColumn, Table

    table = Table(meta={"linksweep": version("linksweep"), **summarise(result)})
    for name, values in match_columns(result).items():
        missing = np.isnan(values) if values.dtype.kind == "f" else (values == 0) & (name in (*TYC, "source_id", "PGC"))
        table[name] = MaskedColumn(
            values,
            mask=missing if missing.any() else False,
            unit=COLUMN_UNITS.get(name),
            description=MATCH_COLUMNS.get(name),
        )
    return table


def read_matches(path: Path) -> Any:
    """Return the astropy Table that `write_outputs` wrote as ECSV; its ``meta`` holds the summary.

    Raises SweepError where a column is missing, in another unit or of another kind, or a class unknown.
    """
    table = read_astropy_table(path)
    problems: list[str] = []
    for name in ("ra", "dec", "ra_error", "dec_error", "PGC", *MATCH_COLUMNS):
        if name not in table.colnames:
            problems.append(f"no column {name!r}{suggest(name, table.colnames)}; this is no table of `sweep match`")
            continue
        unit, wanted = table[name].unit, COLUMN_UNITS.get(name)
        if (None if unit is None else str(unit)) != wanted:
            problems.append(f"column {name!r} is in {str(unit)!r}, not in {wanted!r}")
    if not problems:
        bad = sorted({str(name) for name in table["class"]} - set(CLASS_NAMES))
        problems += [f"class {name!r} is not one of {', '.join(CLASS_NAMES)}" for name in bad]
    if problems:
        raise SweepError(problems, str(path))
    return table


def galaxy_table(result: Result) -> GalaxyTable:
    """Return the matches as the paper's table; raises SweepError if stars have no Tycho identifiers."""
    check_for_galaxy_table(result.stars)
    columns = match_columns(result)
    return GalaxyTable(
        tyc=np.stack([columns[name] for name in TYC], axis=1),
        pgc=columns["PGC"],
        ra=columns["ra"],
        dec=columns["dec"],
        code=result.matches.code,
    )


def check_for_galaxy_table(stars: Sequence[SkyTable]) -> None:
    """Raise SweepError unless all star tables have Tycho identifiers."""
    problems = [
        f"{table.path}: the 46-byte table needs columns TYC1, TYC2 and TYC3, or TYC with strings like '1-13-1'"
        for table in stars
        if table.tyc is None
    ]
    if problems:
        raise SweepError(problems)


def summarise(result: Result) -> dict[str, Any]:
    """Return the summary of a search: what was searched, chance matches, and counts and means for each class.

    The proper-motion error is that from the mean position error and the second epoch of the search; a mean of nothing
    is None.
    """
    search, matches = result.search, result.matches
    columns = match_columns(result)
    magnitude = next((name for name in MAGNITUDES if name in columns), None)
    classes = {}
    for name, chosen in [
        *((name, matches.code == code) for code, name in enumerate(CLASS_NAMES)),
        ("all", np.ones(len(matches), dtype=bool)),
    ]:
        errors = {key: _mean_and_scatter(columns[key][chosen]) for key in ("ra_error", "dec_error")}
        classes[name] = {
            "n": int(chosen.sum()),
            "ra_error_mas": errors["ra_error"],
            "dec_error_mas": errors["dec_error"],
            "magnitude": None if magnitude is None else _mean_and_scatter(columns[magnitude][chosen]),
            "pm_error_mas_yr": {
                key.removesuffix("_error"): None
                if error["mean"] is None
                else second_epoch_pm_error(error["mean"], search.second_epoch_error_mas, search.epoch_difference_yr)
                for key, error in errors.items()
            },
        }
    return {
        "stars": {table.name: len(table) for table in result.stars},
        "galaxies": matches.n_galaxies,
        "catalogues": {
            table.name: {
                "entries": len(table),
                "radius_arcsec": search.radius(table.name),
                "pairs": chance.pairs,
                "matches": int(matches.found_in[:, t].sum()),
                "chance_pairs_uniform": chance.uniform,
                "chance_pairs_local": chance.local,
                "chance_pairs_local_error": chance.local_error,
            }
            for t, (table, chance) in enumerate(zip(result.galaxies, matches.chance, strict=True))
        },
        "classes": classes,
        "reasons": {name: int(np.sum((matches.reason & bit) > 0)) for bit, name in REASON_NAMES.items()},
        "magnitude": magnitude,
        "epoch": search.epoch,
        "k_sigma": search.rules.k_sigma,
        "crowding_radius_arcsec": search.rules.crowding_radius / ARCSEC,
        "crowding_stars": search.rules.crowding_stars,
        "merge_radius_arcsec": None if search.rules.merge_radius is None else search.rules.merge_radius / ARCSEC,
        "epoch_difference_yr": search.epoch_difference_yr,
        "second_epoch_error_mas": search.second_epoch_error_mas,
        "notes": _notes(result),
    }


def summary_text(summary: Mapping[str, Any]) -> "list[RenderableType]":
    """Return the summary for reading, as things that rich prints."""
    from rich.table import Table

    stars = " + ".join(f"{n:,} in {name}" for name, n in summary["stars"].items())
    found = Table(box=None, pad_edge=False, header_style="bold")
    for head in ("class", "n", "ra_error\n\\[mas]", "dec_error\n\\[mas]", f"{summary['magnitude'] or 'magnitude'}"):
        found.add_column(head, justify="left" if head == "class" else "right", no_wrap=True)
    found.add_column("second-epoch pm error\nra, dec \\[mas / yr]", justify="right", no_wrap=True)
    for name, row in summary["classes"].items():
        motion = [value for value in row["pm_error_mas_yr"].values() if value is not None]
        found.add_row(
            name,
            f"{row['n']:,}",
            _plus_minus(row["ra_error_mas"], 0),
            _plus_minus(row["dec_error_mas"], 0),
            _plus_minus(row["magnitude"], 1),
            ", ".join(f"{value:.2g}" for value in motion),
        )
    catalogues = Table(box=None, pad_edge=False, header_style="bold")
    for head in ("catalogue", "entries", "radius\n\\[arcsec]", "pairs", "matches", "chance pairs\nuniform sky"):
        catalogues.add_column(head, justify="left" if head == "catalogue" else "right", no_wrap=True)
    catalogues.add_column("\nfrom surroundings", justify="right", no_wrap=True)
    for name, row in summary["catalogues"].items():
        local, error = row["chance_pairs_local"], row["chance_pairs_local_error"]
        catalogues.add_row(
            name,
            f"{row['entries']:,}",
            f"{row['radius_arcsec']:g}",
            f"{row['pairs']:,}",
            f"{row['matches']:,}",
            f"{row['chance_pairs_uniform']:.3g}",
            f"{local:.3g} ± {error:.1g}",
        )
    reasons = ", ".join(f"{name} {n}" for name, n in summary["reasons"].items())
    lines = [
        f"in doubt (a match may be for several reasons): {reasons}",
        f"stars: {stars}; galaxies after merging: {summary['galaxies']:,}; epoch {summary['epoch']:g}",
        f"second epoch: {summary['epoch_difference_yr']:g} yr later, error {summary['second_epoch_error_mas']:g} mas",
        *summary["notes"],
    ]
    return [found, "", catalogues, "", *lines]


def sky_map_of(result: Result) -> Any:
    """Return the all-sky map of a search as a matplotlib Figure."""
    from sweep.skymap import sky_map

    columns = match_columns(result)

    def degrees(ra: Array, dec: Array) -> tuple[Array, Array]:
        longitude, latitude = galactic(ra * DEGREE, dec * DEGREE)
        return longitude / DEGREE, latitude / DEGREE

    classes = {
        name: degrees(columns["ra"][columns["class"] == name], columns["dec"][columns["class"] == name])
        for name in CLASS_NAMES
    }
    ra, dec = (np.concatenate([table.numbers[key] for table in result.galaxies]) for key in ("ra", "dec"))
    return sky_map(classes, degrees(ra, dec))


def check_outputs(outputs: Outputs, search: Search, overwrite: bool) -> None:
    """Raise SweepError if an output cannot or must not be written: better before a long search than after it."""
    problems: list[str] = []
    inputs = {path.resolve() for path in (search.stars, search.supplement, *search.galaxies) if path is not None}
    wanted = [path.resolve() for path in outputs.paths()]
    for path in outputs.paths():
        parent = next(p for p in path.absolute().parents if p.exists())
        if path.resolve() in inputs:
            problems.append(f"{path} is one of the tables that are read")
        elif wanted.count(path.resolve()) > 1:
            problems.append(f"{path} is named for two outputs")
        elif path.is_dir():
            problems.append(f"{path} is a directory")
        elif path.exists() and not overwrite:
            problems.append(f"{path} exists; --overwrite replaces it")
        elif not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            problems.append(f"{path} cannot be written: {parent} is not a directory that can be written")
    for output, suffixes in ((outputs.ecsv, (".ecsv",)), (outputs.sky_map, MAP_SUFFIXES)):
        if output is not None and output.suffix.lower() not in suffixes:
            problems.append(f"{output} must end in {' or '.join(suffixes)}")
    if outputs.sky_map is not None and find_spec("matplotlib") is None:
        problems.append("a map needs matplotlib: install linksweep[plot]")
    if problems:
        raise SweepError(list(dict.fromkeys(problems)))


def write_outputs(result: Result, outputs: Outputs, overwrite: bool = False) -> None:
    """Write the matches as ECSV, as 46-byte table and as map, each in one step; nothing if one cannot be made.

    Raises SweepError as `check_outputs`, and as `galaxy_table` and `format_galaxy_table`.
    """
    check_outputs(outputs, result.search, overwrite)
    writers: list[tuple[Path, Callable[[Path], Any]]] = []
    if outputs.table is not None:
        text = format_galaxy_table(galaxy_table(result))
        writers.append((outputs.table, lambda path: path.write_bytes(text.encode("ascii"))))
    if outputs.ecsv is not None:
        table = matches_table(result)
        writers.append((outputs.ecsv, lambda path: table.write(path, format="ascii.ecsv")))
    if outputs.sky_map is not None:
        figure, kind = sky_map_of(result), outputs.sky_map.suffix[1:].lower()
        writers.append((outputs.sky_map, lambda path: figure.savefig(path, format=kind, dpi=200)))
    for path, write in writers:
        _publish(path, write, overwrite)


def _publish(path: Path, write: Callable[[Path], Any], overwrite: bool) -> None:
    """Write a file under another name and give it its own when it is whole."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(part)
        if overwrite:
            part.replace(path)
        else:
            _rename_new(part, path)
    except FileExistsError as error:
        raise SweepError("exists; --overwrite replaces it", str(path)) from error
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error
    finally:
        part.unlink(missing_ok=True)


def _rename_new(part: Path, path: Path) -> None:
    """Rename a file unless its new name is taken."""
    try:
        os.link(part, path)  # unlike a rename it fails where a file came up in the meantime
    except FileExistsError:
        raise
    except OSError as error:  # a file system without hard links
        if path.exists():
            raise FileExistsError(path) from error
        part.rename(path)


def _positions(table: SkyTable) -> Positions:
    n = table.numbers
    return Positions(n["ra"] * DEGREE, n["dec"] * DEGREE, n["ra_error"] * MAS, n["dec_error"] * MAS)


def _star_positions(table: SkyTable, epoch: float) -> Positions:
    positions, numbers = _positions(table), table.numbers
    if "pmra" not in numbers:
        return positions
    none = np.zeros(len(table))
    pmra, pmdec, pmra_error, pmdec_error = (
        np.nan_to_num(numbers.get(key, none)) * MAS for key in ("pmra", "pmdec", "pmra_error", "pmdec_error")
    )
    return at_epoch(positions, pmra, pmdec, pmra_error, pmdec_error, epoch - numbers["ref_epoch"])


def _check_shared_stars(stars: Sequence[SkyTable]) -> None:
    tyc = [table.tyc for table in stars if table.tyc is not None]
    if len(tyc) == len(stars) == 2:
        main, supplement = (t @ np.array([1_000_000, 10, 1]) for t in tyc)
        both = tyc[1][np.isin(supplement, main)]
        if len(both):
            named = ", ".join("-".join(map(str, t)) for t in both[:5].tolist())
            more = f" and {len(both) - 5} more" if len(both) > 5 else ""
            raise SweepError(f"TYC {named}{more}: in the star table and again in the supplement")


def _notes(result: Result) -> list[str]:
    notes = []
    for table in result.stars:
        if "pmra" not in table.numbers:
            notes.append(f"{table.name} has no proper motions: its positions were taken as they are")
        elif table.n_missing_pm:
            notes.append(f"{table.n_missing_pm:,} stars of {table.name} have no proper motion; it was taken as zero")
    return notes


def _column_maps(
    texts: Sequence[str], names: Sequence[str], star_names: Sequence[str], problems: list[str]
) -> dict[str, dict[str, str]]:
    maps: dict[str, dict[str, str]] = {name: {} for name in names}
    for named_first in (False, True):  # a map for one table goes before one for all
        for text in texts:
            key, equals, column = text.partition("=")
            name, colon, quantity = key.rpartition(":")
            if bool(colon) is not named_first:
                continue
            if not equals or not column or not quantity:
                problems.append(f"--column {text}: write KEY=COLUMN or NAME:KEY=COLUMN")
            elif colon and name not in names:
                problems.append(f"--column {text}: no table {name!r}{suggest(name, names)}")
            elif quantity not in COLUMNS:
                problems.append(f"--column {text}: there is no quantity {quantity!r}{suggest(quantity, COLUMNS)}")
            else:
                for table in [name] if colon else star_names:
                    maps[table][quantity] = column
    return maps


def _between(low: float, high: float, unit: str) -> Callable[[str], float]:
    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low < value <= high:
            raise ValueError(f"must be a number above {low:g} and at most {high:g} [{unit}]")
        return value

    return convert


def _mean_and_scatter(values: Array) -> dict[str, float | None]:
    known = values[~np.isnan(values)]
    return {
        "mean": float(known.mean()) if len(known) else None,
        "scatter": float(known.std(ddof=1)) if len(known) > 1 else None,
    }


def _plus_minus(value: Mapping[str, float | None] | None, digits: int) -> str:
    if value is None or (mean := value["mean"]) is None:
        return ""
    scatter = value["scatter"]
    return f"{mean:.{digits}f}" + ("" if scatter is None else f" ± {scatter:.{digits}f}")
