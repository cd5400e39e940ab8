"""What to search and how, from the options of the command line; no file is read here."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from linksweep.core.constants import ARCSEC
from linksweep.core.galaxy_classes import Rules
from linksweep.core.sky_pairs import MAX_RADIUS
from linksweep.sweep.contract import SweepError, suggest
from linksweep.sweep.formatting import split_assignment
from linksweep.sweep.search.columns import COLUMNS, UNITS
from linksweep.sweep.search.tables import EPOCHS, Reading, table_name

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
    arcsec, years = (0.0, MAX_RADIUS / ARCSEC, "arcsec"), (*EPOCHS, "yr")
    radii = _per_table("--radius", radius, galaxy_names, galaxy_names, arcsec, problems)
    errors = _per_table("--error", error, names, galaxy_names, arcsec, problems)
    epochs = _per_table("--ref-epoch", ref_epoch, star_names, star_names, years, problems)
    columns = _maps("--column", column, COLUMNS, names, star_names, problems)
    units = _maps("--unit", unit, UNITS, names, star_names, problems)
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


def _maps(
    option: str,
    texts: Sequence[str],
    known: Collection[str],
    names: Sequence[str],
    star_names: Sequence[str],
    problems: list[str],
) -> dict[str, dict[str, str]]:
    """Return {table: {key: value}} for an option that is given as KEY=VALUE or NAME:KEY=VALUE."""
    maps: dict[str, dict[str, str]] = {name: {} for name in names}
    for named_first in (False, True):  # values for one table override those for all
        for text in texts:
            key, value = split_assignment(text)
            name, colon, quantity = key.rpartition(":")
            if bool(colon) is not named_first:
                continue
            if not quantity:
                what = option[2:].upper()
                problems.append(f"{option} {text}: write KEY={what} or NAME:KEY={what}")
            elif colon and name not in names:
                problems.append(f"{option} {text}: no table {name!r}{suggest(name, names)}")
            elif quantity not in known:
                problems.append(f"{option} {text}: there is no quantity {quantity!r}{suggest(quantity, list(known))}")
            else:
                for table in [name] if colon else star_names:
                    maps[table][quantity] = value
    return maps


def _per_table(
    option: str,
    texts: Sequence[str],
    names: Sequence[str],
    common_for: Sequence[str],
    limits: tuple[float, float, str],
    problems: list[str],
) -> dict[str, float]:
    """Return {name: number} for an option that is given as NAME=NUMBER for one of ``names``, or NUMBER for
    ``common_for``; ``limits`` are a number below all allowed ones, the largest, and their unit.

    Unknown names, numbers that are not allowed, and repeated ones are added to ``problems``.
    """
    low, high, unit = limits
    found: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.rpartition("=")
        if equals and name not in names:
            problems.append(f"{option} {text}: no table {name!r}{suggest(name, names)}")
        elif name in found:
            problems.append(f"{option} {text}: given twice{f' for {name!r}' if name else ' without a table'}")
        elif low < (number := _number(value)) <= high:
            found[name] = number
        else:
            problems.append(f"{option} {text}: must be a number above {low:g} and at most {high:g} [{unit}]")
    common = found.pop("", None)
    return found if common is None else {**dict.fromkeys(common_for, common), **found}


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
