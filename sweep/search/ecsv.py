"""Matches as an ECSV table: written with units, descriptions and the summary, read back with its columns checked."""

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from linksweep.core.galaxy_classes import CLASS_NAMES
from linksweep.sweep.contract import SweepError, suggest
from linksweep.sweep.search.columns import TYC, UNITS
from linksweep.sweep.search.result import STAR_MOTIONS, Result, match_columns
from linksweep.sweep.search.summary import summarise
from linksweep.sweep.tables.reader import read_table

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

COLUMNS: Mapping[str, tuple[str | None, str | None]] = {
    **{STAR_MOTIONS.get(name, name): (unit, None) for name, unit in UNITS.items()},
    **MATCH_COLUMNS,
}


def matches_table(result: Result) -> Any:
    """Return the matches as an astropy Table with units and descriptions; missing values are masked, ``meta`` is the
    summary.
    """
    from astropy.table import MaskedColumn, Table

    table = Table(meta={"linksweep": version("linksweep"), **summarise(result)})
    for name, values in match_columns(result).items():
        missing = np.isnan(values) if values.dtype.kind == "f" else (values == 0) & (name in (*TYC, "source_id", "PGC"))
        mask, (unit, meaning) = missing if missing.any() else False, COLUMNS.get(name, (None, None))
        table[name] = MaskedColumn(values, mask=mask, unit=unit, description=meaning)
    return table


def read_matches(path: Path) -> Any:
    """Return the astropy Table that `write_outputs` wrote as ECSV; its ``meta`` holds the summary.

    Raises SweepError if a column is missing or in another unit, or if a class is unknown.
    """
    table = read_table(path)
    problems: list[str] = []
    needed = {"ra", "dec", "ra_error", "dec_error", "PGC", *MATCH_COLUMNS} - {"galaxy_name"}
    for name in sorted(needed):
        if name not in table.colnames:
            problems.append(f"no column {name!r}{suggest(name, table.colnames)}; is this a table of `sweep match`?")
            continue
        unit, (wanted, _) = table[name].unit, COLUMNS.get(name, (None, None))
        if (None if unit is None else str(unit)) != wanted:
            problems.append(f"column {name!r} is in {str(unit)!r}, not in {wanted!r}")
    if not problems:
        bad = sorted({str(name) for name in table["class"]} - set(CLASS_NAMES))
        problems += [f"class {name!r} is not one of {', '.join(CLASS_NAMES)}" for name in bad]
    if problems:
        raise SweepError(problems, str(path))
    return table
