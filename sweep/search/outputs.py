"""What a search gives: matches as columns, as ECSV and as 46-byte table, the map, and the summary."""

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.crossmatch import CLASS_NAMES, REASON_NAMES
from linksweep.core.frames import ARCSEC, Array, Indices
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import with_error
from linksweep.sweep.search.search import Result, Search, match_tables, read_tables
from linksweep.sweep.search.tables import MAGNITUDES, MOTIONS, NUMBERS, TYC
from linksweep.sweep.stores.location import Folder
from linksweep.sweep.table_writer import Column, Table
from linksweep.sweep.tables.columns import unit_of

MAP_SUFFIXES = (".png", ".svg", ".pdf")

STAR_MOTIONS = {name: f"star_{name}" for name in MOTIONS}
"""Columns for the stars' measured proper motions, so named that a study does not take them for the galaxies' (zero)."""

MATCH_COLUMNS: Mapping[str, tuple[str | None, str]] = {
    "class": (None, "certain, uncertain or supplement"),
    "reason": (None, "why it is in doubt: crowded, offset, rival; or none"),
    "offset": ("arcsec", "angle between star and galaxy at the epoch of the search"),
    "offset_ra": ("arcsec", "galaxy - star along ra, with cos(dec)"),
    "offset_dec": ("arcsec", "galaxy - star along dec"),
    "offset_sigma": (None, "offset in units of the combined position errors"),
    "n_near": (None, "other stars within the crowding radius"),
    "n_rival": (None, "other stars and galaxies within the match radius"),
    "galaxy_table": (None, "catalogue of the closest entry of the galaxy"),
    "galaxy_row": (None, "row of that entry, from 1"),
    "galaxy_name": (None, "name of that entry in its catalogue, if that gives one"),
    "galaxy_ra": ("deg", "position of that entry"),
    "galaxy_dec": ("deg", "position of that entry"),
    "found_in": (None, "all catalogues with the galaxy within their radius"),
    "star_table": (None, "catalogue of the star"),
    "star_row": (None, "row of the star, from 1"),
}
"""The columns of the ECSV beside those of the star table, their units and what they mean."""

LETTERS = "GUS"
"""The class letters of the 46-byte table in order of the codes certain, uncertain, supplement."""

LARGEST = {"TYC1": ("1-4", 9999), "TYC2": ("6-10", 99999), "TYC3": ("12-12", 9), "PGC": ("14-18", 99999)}
"""The bytes of the integers in the 46-byte table, and the largest number that fits."""

PROBLEMS_NAMED = 10


@dataclass(frozen=True)
class Outputs:
    """The files to write; None for those that are not wanted."""

    ecsv: Path | None = None
    table: Path | None = None
    sky_map: Path | None = None

    def paths(self) -> list[Path]:
        """Return the paths of the files that are wanted."""
        return [path for path in (self.ecsv, self.table, self.sky_map) if path is not None]


def find_galaxies(search: Search, outputs: Outputs | None = None, overwrite: bool = False) -> Result:
    """Read the tables, match them and write the requested files, each in one step.

    Raises SweepError for all that is wrong with tables, options and names of files; then nothing is written.
    """
    outputs = outputs or Outputs()
    _check(outputs, search, overwrite)
    stars, galaxies = read_tables(search)
    if outputs.table is not None and (without := [table.path for table in stars if table.tyc is None]):
        needed = "the 46-byte table needs columns TYC1, TYC2 and TYC3, or TYC with strings like '1-13-1'"
        raise SweepError([f"{path}: {needed}" for path in without])
    result = match_tables(search, stars, galaxies)
    contents: dict[Path, bytes] = {}
    if outputs.table is not None:
        contents[outputs.table] = galaxy_table(match_columns(result), result.matches.code).encode("ascii")
    if outputs.ecsv is not None:
        text = io.StringIO()
        matches_table(result).write(text, format="ascii.ecsv")
        contents[outputs.ecsv] = text.getvalue().encode()
    if outputs.sky_map is not None:
        from linksweep.sweep.search.skymap import sky_map

        columns, drawn = match_columns(result), io.BytesIO()
        chosen = {name: columns["class"] == name for name in CLASS_NAMES}
        classes = {name: (columns["ra"][mine], columns["dec"][mine]) for name, mine in chosen.items()}
        ra, dec = (np.concatenate([table.numbers[key] for table in galaxies]) for key in ("ra", "dec"))
        sky_map(classes, (ra, dec)).savefig(drawn, format=outputs.sky_map.suffix[1:].lower(), dpi=200)
        contents[outputs.sky_map] = drawn.getvalue()
    for path, content in contents.items():
        write(path, content, overwrite)
    return result


def _check(outputs: Outputs, search: Search, overwrite: bool) -> None:
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


def write(path: Path, content: bytes, overwrite: bool) -> None:
    """Write a file in one step; raises SweepError for one that exists by now, unless it may be replaced."""
    folder = Folder(path.parent)
    try:
        if overwrite:
            folder.put(path.name, content)
        elif not folder.create(path.name, content):
            raise SweepError("exists; --overwrite replaces it", str(path))
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error


def match_columns(result: Result) -> dict[str, NDArray[Any]]:
    """Return columns with a row for each match: those of the star tables, then those of `MATCH_COLUMNS`.

    Numbers that a table does not have are NaN, identifiers 0.
    """
    stars, galaxies, matches = result.stars, result.galaxies, result.matches
    starts = np.cumsum([0, *(len(table) for table in stars)])
    which = np.searchsorted(starts, matches.star, side="right") - 1
    row = matches.star - starts[which]
    names = np.array([table.name for table in galaxies])

    def of_star(columns: Sequence[NDArray[Any] | None], missing: float) -> NDArray[Any] | None:
        return _gathered(columns, which, row, missing)

    def of_galaxy(columns: Sequence[NDArray[Any] | None], missing: float | str) -> NDArray[Any] | None:
        return _gathered(columns, matches.catalogue, matches.entry, missing)

    tyc = of_star([table.tyc for table in stars], 0)
    columns = {
        **({} if tyc is None else dict(zip(TYC, tyc.T, strict=True))),
        "source_id": of_star([table.source_id for table in stars], 0),
        "PGC": matches.identifier,
        **{
            STAR_MOTIONS.get(name, name): of_star([table.numbers.get(name) for table in stars], np.nan)
            for name in NUMBERS
        },
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
        "galaxy_name": of_galaxy([table.names for table in galaxies], ""),
        "galaxy_ra": of_galaxy([table.numbers["ra"] for table in galaxies], np.nan),
        "galaxy_dec": of_galaxy([table.numbers["dec"] for table in galaxies], np.nan),
        "found_in": np.array([",".join(names[there]) for there in matches.found_in], dtype=str),
        "star_table": np.array([table.name for table in stars])[which],
        "star_row": row + 1,
    }
    return {name: column for name, column in columns.items() if column is not None}


def _gathered(
    columns: Sequence[NDArray[Any] | None], which: Indices, row: Indices, missing: float | str
) -> NDArray[Any] | None:
    """Return rows of one column of several tables, ``missing`` where a table has no such column; None if none has."""
    known = [column for column in columns if column is not None]
    if not known:
        return None
    dtype = np.result_type(*(column.dtype for column in known))  # for text, that of the longest
    gathered = np.full((len(row), *known[0].shape[1:]), missing, dtype=dtype)
    for t, column in enumerate(columns):
        if column is not None:
            gathered[which == t] = column[row[which == t]]
    return gathered


def matches_table(result: Result) -> Any:
    """Return the matches as an astropy Table with units and descriptions; missing values are masked, ``meta`` is the
    summary.
    """
    from astropy.table import MaskedColumn, Table

    table = Table(meta={"linksweep": version("linksweep"), **summarise(result)})
    for name, values in match_columns(result).items():
        missing = np.isnan(values) if values.dtype.kind == "f" else (values == 0) & (name in (*TYC, "source_id", "PGC"))
        unit, meaning = MATCH_COLUMNS.get(name, (unit_of(name.removeprefix("star_")) or None, None))
        table[name] = MaskedColumn(values, mask=missing if missing.any() else False, unit=unit, description=meaning)
    return table


def galaxy_table(columns: Mapping[str, NDArray[Any]], code: Indices) -> str:
    r"""Return the matches in the format of the paper's tables at CDS: one line of 46 bytes and a ``\n`` for each.

    TYC1, TYC2, TYC3 and PGC are integers in the bytes of `LARGEST`, ra (20-31) and dec (33-44) of the star are F12.8,
    byte 46 is the class, one of `LETTERS`.  A right ascension that rounds to 360 is written as 0.  Raises SweepError
    that names each galaxy without a PGC number or with a number that does not fit its field.
    """
    problems: list[str] = []
    lines: list[str] = []
    rows = zip(*(columns[name].tolist() for name in (*TYC, "PGC", "ra", "dec")), code.tolist(), strict=True)
    for *tyc, pgc, ra, dec, letter in rows:
        star = f"TYC {tyc[0]}-{tyc[1]}-{tyc[2]}"
        if pgc == 0:
            problems.append(f"{star} has no PGC number")
        for (name, (place, largest)), number in zip(LARGEST.items(), (*tyc, pgc), strict=True):
            if not 0 <= number <= largest:
                problems.append(f"{star}: {name} = {number} does not fit bytes {place}, at most {largest}")
        wrapped = 0.0 if f"{ra:.8f}" == "360.00000000" else ra
        lines.append(f"{tyc[0]:4d} {tyc[1]:5d} {tyc[2]:1d} {pgc:5d} {wrapped:12.8f} {dec:12.8f} {LETTERS[letter]}\n")
    if problems:
        more = len(problems) - PROBLEMS_NAMED
        raise SweepError([*problems[:PROBLEMS_NAMED], *([f"and {more} more"] if more > 0 else [])])
    return "".join(lines)


def summarise(result: Result) -> dict[str, Any]:
    """Return the summary of a search: what was searched, chance matches, and counts and means for each class.

    A mean of no values is None.
    """
    search, matches, rules = result.search, result.matches, result.search.rules
    columns = match_columns(result)
    magnitude = next((name for name in MAGNITUDES if name in columns), None)
    chosen = {name: matches.code == code for code, name in enumerate(CLASS_NAMES)}
    chosen["all"] = np.ones(len(matches), dtype=bool)
    notes = []
    for table in result.stars:
        if "pmra" not in table.numbers:
            notes.append(f"{table.name} has no proper motions: its positions were taken as they are")
        elif missing := np.count_nonzero(np.isnan(table.numbers["pmra"])):
            notes.append(f"{missing:,} stars of {table.name} have no proper motion; it was taken as zero")
    return {
        "stars": {table.name: len(table) for table in result.stars},
        "galaxies": matches.n_galaxies,
        "catalogues": {
            table.name: {
                "entries": len(table),
                "radius_arcsec": search.radius_arcsec[table.name],
                "pairs": chance.pairs,
                "matches": int(matches.found_in[:, t].sum()),
                "chance_pairs_uniform": chance.uniform,
                "chance_pairs_local": chance.local,
                "chance_pairs_local_error": chance.local_error,
            }
            for t, (table, chance) in enumerate(zip(result.galaxies, matches.chance, strict=True))
        },
        "classes": {
            name: _means({key: column[mine] for key, column in columns.items()}, magnitude, search)
            for name, mine in chosen.items()
        },
        "reasons": {name: int(np.sum((matches.reason & bit) > 0)) for bit, name in REASON_NAMES.items()},
        "magnitude": magnitude,
        "epoch": search.epoch,
        "k_sigma": rules.k_sigma,
        "crowding_radius_arcsec": rules.crowding_radius / ARCSEC,
        "crowding_stars": rules.crowding_stars,
        "merge_radius_arcsec": None if rules.merge_radius is None else rules.merge_radius / ARCSEC,
        "epoch_difference_yr": search.epoch_difference_yr,
        "second_epoch_error_mas": search.second_epoch_error_mas,
        "notes": notes,
    }


def _means(columns: Mapping[str, NDArray[Any]], magnitude: str | None, search: Search) -> dict[str, Any]:
    """Return number, means and scatter of a class, and the proper-motion error from a second epoch,
    sqrt(s1^2 + s2^2)/years.

    Source: Metz & Geffert 2004, Sect. 3.2: 117 and 127 mas give about 6 mas/yr, which is 20 yr with a second epoch
    without error.
    """
    errors = {key: _mean_and_scatter(columns[f"{key}_error"]) for key in ("ra", "dec")}
    second, years = search.second_epoch_error_mas, search.epoch_difference_yr
    return {
        "n": len(columns["ra"]),
        "ra_error_mas": errors["ra"],
        "dec_error_mas": errors["dec"],
        "magnitude": None if magnitude is None else _mean_and_scatter(columns[magnitude]),
        "pm_error_mas_yr": {
            key: None if error["mean"] is None else float(np.hypot(error["mean"], second)) / years
            for key, error in errors.items()
        },
    }


def _mean_and_scatter(values: Array) -> dict[str, float | None]:
    known = values[~np.isnan(values)]
    return {
        "mean": float(known.mean()) if len(known) else None,
        "scatter": float(known.std(ddof=1)) if len(known) > 1 else None,
    }


def summary_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return the tables of a summary for reading: the classes of matches, and the catalogues of galaxies."""

    def column(name: str, cells: Sequence[str], unit: str = "", left: bool = False) -> Column:
        return Column(name, cells, cells, unit, left=left)

    def with_scatter(value: Mapping[str, float | None] | None, digits: int) -> str:
        if value is None or (mean := value["mean"]) is None:
            return ""
        scatter = value["scatter"]
        return f"{mean:.{digits}f}" + ("" if scatter is None else f" ± {scatter:.{digits}f}")

    rows = summary["classes"].values()
    motions = [", ".join(f"{v:.2g}" for v in row["pm_error_mas_yr"].values() if v is not None) for row in rows]
    classes = [
        column("class", list(summary["classes"]), left=True),
        column("n", [f"{row['n']:,}" for row in rows]),
        column("ra_error", [with_scatter(row["ra_error_mas"], 0) for row in rows], "mas"),
        column("dec_error", [with_scatter(row["dec_error_mas"], 0) for row in rows], "mas"),
        column(summary["magnitude"] or "magnitude", [with_scatter(row["magnitude"], 1) for row in rows]),
        column("second-epoch pm error\nra, dec", motions, "mas / yr"),
    ]
    rows = summary["catalogues"].values()
    local = [with_error(row["chance_pairs_local"], row["chance_pairs_local_error"]) for row in rows]
    catalogues = [
        column("catalogue", list(summary["catalogues"]), left=True),
        column("entries", [f"{row['entries']:,}" for row in rows]),
        column("radius", [f"{row['radius_arcsec']:g}" for row in rows], "arcsec"),
        *(column(name, [f"{row[name]:,}" for row in rows]) for name in ("pairs", "matches")),
        column("chance pairs\nuniform sky", [f"{row['chance_pairs_uniform']:.3g}" for row in rows]),
        column("chance pairs\nfrom surroundings", local),
    ]
    return [Table(classes), Table(catalogues)]


def summary_lines(summary: Mapping[str, Any]) -> list[str]:
    """Return the sentences below the tables of a summary."""
    stars = " + ".join(f"{n:,} in {name}" for name, n in summary["stars"].items())
    reasons = ", ".join(f"{name} {n}" for name, n in summary["reasons"].items())
    return [
        f"in doubt (a match may be for several reasons): {reasons}",
        f"stars: {stars}; galaxies after merging: {summary['galaxies']:,}; epoch {summary['epoch']:g}",
        f"second epoch: {summary['epoch_difference_yr']:g} yr later, error {summary['second_epoch_error_mas']:g} mas",
        *summary["notes"],
    ]
