"""What a search found, as a record and as columns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.constants import ARCSEC
from core.crossmatch import Matches
from core.galaxy_classes import CLASS_NAMES, REASON_NAMES
from sweep.search.columns import TYC, UNITS
from sweep.search.options import Search
from sweep.search.tables import SkyTable

STAR_MOTIONS = {name: f"star_{name}" for name in ("pmra", "pmdec", "pmra_error", "pmdec_error")}
"""A star's proper motion is measured, a galaxy's is zero: so named, a study does not take one for the other."""


@dataclass(frozen=True)
class Result:
    """A search, its tables (``stars`` holds the star catalogue and, if there is one, the supplement) and matches."""

    search: Search
    stars: tuple[SkyTable, ...]
    galaxies: tuple[SkyTable, ...]
    matches: Matches


def match_columns(result: Result) -> dict[str, NDArray[Any]]:
    """Return the matches as columns, a row each: those of the star tables, then those of `ecsv.MATCH_COLUMNS`.

    A number that a table does not have is NaN, an identifier 0.
    """
    matches = result.matches
    starts = np.cumsum([0, *(len(table) for table in result.stars)])
    which = np.searchsorted(starts, matches.star, side="right") - 1
    row = matches.star - starts[which]
    columns: dict[str, NDArray[Any]] = {}

    if (tyc := _gathered([table.tyc for table in result.stars], which, row, 0)) is not None:
        columns |= dict(zip(TYC, tyc.T, strict=True))
    if (source_id := _gathered([table.source_id for table in result.stars], which, row, 0)) is not None:
        columns["source_id"] = source_id
    columns["PGC"] = matches.identifier
    for name in UNITS:
        if (number := _gathered([t.numbers.get(name) for t in result.stars], which, row, np.nan)) is not None:
            columns[STAR_MOTIONS.get(name, name)] = number
    entry_names = _gathered([table.names for table in result.galaxies], matches.catalogue, matches.entry, "")
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
        **({} if entry_names is None else {"galaxy_name": entry_names}),
        "galaxy_ra": there[0],
        "galaxy_dec": there[1],
        "found_in": np.array([",".join(names[found]) for found in matches.found_in], dtype=str),
        "star_table": np.array([table.name for table in result.stars])[which],
        "star_row": row + 1,
    }


def _gathered(
    columns: Sequence[NDArray[Any] | None], which: NDArray[np.int64], row: NDArray[np.int64], missing: float | str
) -> NDArray[Any] | None:
    """Return rows of one column of several tables, ``missing`` where a table has no such column; None if none has."""
    gathered: NDArray[Any] | None = None
    for t, column in enumerate(columns):
        if column is not None:
            if gathered is None:
                dtype = np.result_type(*(c.dtype for c in columns if c is not None))  # of the longest text
                gathered = np.full((len(row), *column.shape[1:]), missing, dtype=dtype)
            gathered[which == t] = column[row[which == t]]
    return gathered
