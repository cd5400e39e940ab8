"""The summary of a search, for JSON and as text: counts and means for each class, chance pairs for each catalogue."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linksweep.core.arrays import Array
from linksweep.core.constants import ARCSEC
from linksweep.core.galaxy_classes import CLASS_NAMES, REASON_NAMES, second_epoch_pm_error
from linksweep.sweep.formatting import reading_table, with_error
from linksweep.sweep.search.options import Search
from linksweep.sweep.search.result import Result, match_columns
from linksweep.sweep.search.tables import MAGNITUDES

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table


def summarise(result: Result) -> dict[str, Any]:
    """Return the summary of a search: what was searched, chance matches, and counts and means for each class.

    The proper-motion error follows from the mean position error and the second epoch of the search; a mean of no
    values is None.
    """
    search, matches = result.search, result.matches
    columns = match_columns(result)
    magnitude = next((name for name in MAGNITUDES if name in columns), None)
    chosen = {name: matches.code == code for code, name in enumerate(CLASS_NAMES)}
    chosen["all"] = np.ones(len(matches), dtype=bool)
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
            name: _of_class({key: column[mine] for key, column in columns.items()}, magnitude, search)
            for name, mine in chosen.items()
        },
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


def _of_class(columns: Mapping[str, NDArray[Any]], magnitude: str | None, search: Search) -> dict[str, Any]:
    errors = {key: _mean_and_scatter(columns[key]) for key in ("ra_error", "dec_error")}
    return {
        "n": len(columns["ra"]),
        "ra_error_mas": errors["ra_error"],
        "dec_error_mas": errors["dec_error"],
        "magnitude": None if magnitude is None else _mean_and_scatter(columns[magnitude]),
        "pm_error_mas_yr": {
            key.removesuffix("_error"): None
            if error["mean"] is None
            else second_epoch_pm_error(error["mean"], search.second_epoch_error_mas, search.epoch_difference_yr)
            for key, error in errors.items()
        },
    }


def _notes(result: Result) -> list[str]:
    notes = []
    for table in result.stars:
        if "pmra" not in table.numbers:
            notes.append(f"{table.name} has no proper motions: its positions were taken as they are")
        elif missing := np.count_nonzero(np.isnan(table.numbers["pmra"])):
            notes.append(f"{missing:,} stars of {table.name} have no proper motion; it was taken as zero")
    return notes


def _mean_and_scatter(values: Array) -> dict[str, float | None]:
    known = values[~np.isnan(values)]
    return {
        "mean": float(known.mean()) if len(known) else None,
        "scatter": float(known.std(ddof=1)) if len(known) > 1 else None,
    }


def summary_text(summary: Mapping[str, Any]) -> "list[RenderableType]":
    """Return the summary as text and tables that rich prints."""
    stars = " + ".join(f"{n:,} in {name}" for name, n in summary["stars"].items())
    reasons = ", ".join(f"{name} {n}" for name, n in summary["reasons"].items())
    lines = [
        f"in doubt (a match may be for several reasons): {reasons}",
        f"stars: {stars}; galaxies after merging: {summary['galaxies']:,}; epoch {summary['epoch']:g}",
        f"second epoch: {summary['epoch_difference_yr']:g} yr later, error {summary['second_epoch_error_mas']:g} mas",
        *summary["notes"],
    ]
    return [_classes_table(summary), "", _catalogues_table(summary), "", *lines]


def _classes_table(summary: Mapping[str, Any]) -> "Table":
    motions = "second-epoch pm error\nra, dec [mas / yr]"
    heads = ["class", "n", "ra_error\n[mas]", "dec_error\n[mas]", summary["magnitude"] or "magnitude", motions]
    rows = (
        (
            name,
            f"{row['n']:,}",
            _plus_minus(row["ra_error_mas"], 0),
            _plus_minus(row["dec_error_mas"], 0),
            _plus_minus(row["magnitude"], 1),
            ", ".join(f"{value:.2g}" for value in row["pm_error_mas_yr"].values() if value is not None),
        )
        for name, row in summary["classes"].items()
    )
    return reading_table("", heads, rows, left="class")


def _catalogues_table(summary: Mapping[str, Any]) -> "Table":
    chances = ("chance pairs\nuniform sky", "\nfrom surroundings")
    heads = ["catalogue", "entries", "radius\n[arcsec]", "pairs", "matches", *chances]
    rows = (
        (
            name,
            f"{row['entries']:,}",
            f"{row['radius_arcsec']:g}",
            f"{row['pairs']:,}",
            f"{row['matches']:,}",
            f"{row['chance_pairs_uniform']:.3g}",
            with_error(row["chance_pairs_local"], row["chance_pairs_local_error"]),
        )
        for name, row in summary["catalogues"].items()
    )
    return reading_table("", heads, rows, left="catalogue")


def _plus_minus(value: Mapping[str, float | None] | None, digits: int) -> str:
    if value is None or (mean := value["mean"]) is None:
        return ""
    scatter = value["scatter"]
    return f"{mean:.{digits}f}" + ("" if scatter is None else f" ± {scatter:.{digits}f}")
