"""What a search found, as a record and as columns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.constants import ARCSEC
from linksweep.core.crossmatch import Matches
from linksweep.core.galaxy_classes import CLASS_NAMES, REASON_NAMES
from linksweep.sweep.search.columns import TYC, UNITS
from linksweep.sweep.search.options import Search
from linksweep.sweep.search.tables import SkyTable

STAR_MOTIONS = {name: f"star_{name}" for name in ("pmra", "pmdec", "pmra_error", "pmdec_error")}
"""Columns for the stars' measured proper motions, so named that a study does not take them for the galaxies' (zero)."""


@dataclass(frozen=True)
class Result:
    """A search, its tables (``stars`` holds the star catalogue and, if there is one, the supplement) and matches."""

    search: Search
    stars: tuple[SkyTable, ...]
    galaxies: tuple[SkyTable, ...]
    matches: Matches


def match_columns(result: Result) -> dict[str, NDArray[Any]]:
    """Return columns with a row for each match: those of the star tables, then those of `ecsv.MATCH_COLUMNS`.

    Numbers that a table does not have are NaN, identifiers 0.
    """
    stars, galaxies, matches = result.stars, result.galaxies, result.matches
    starts = np.cumsum([0, *(len(table) for table in stars)])
    which = np.searchsorted(starts, matches.star, side="right") - 1
    row = matches.star - starts[which]
    tyc = _gathered([table.tyc for table in stars], which, row, 0)
    positions = {
        key: _gathered([table.numbers[key] for table in galaxies], matches.catalogue, matches.entry, np.nan)
        for key in ("ra", "dec")
    }
    names = np.array([table.name for table in galaxies])
    columns = {
        **({} if tyc is None else dict(zip(TYC, tyc.T, strict=True))),
        "source_id": _gathered([table.source_id for table in stars], which, row, 0),
        "PGC": matches.identifier,
        **{
            STAR_MOTIONS.get(name, name): _gathered([table.numbers.get(name) for table in stars], which, row, np.nan)
            for name in UNITS
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
        "galaxy_name": _gathered([table.names for table in galaxies], matches.catalogue, matches.entry, ""),
        "galaxy_ra": positions["ra"],
        "galaxy_dec": positions["dec"],
        "found_in": np.array([",".join(names[found]) for found in matches.found_in], dtype=str),
        "star_table": np.array([table.name for table in stars])[which],
        "star_row": row + 1,
    }
    return {name: column for name, column in columns.items() if column is not None}


def _gathered(
    columns: Sequence[NDArray[Any] | None], which: NDArray[np.int64], row: NDArray[np.int64], missing: float | str
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
