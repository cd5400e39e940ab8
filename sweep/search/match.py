"""A whole search: read the tables, match them, and write the requested files."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from linksweep.core.constants import ARCSEC, DEGREE, MAS
from linksweep.core.crossmatch import cross_match
from linksweep.core.galaxy_merge import GalaxyCatalogue
from linksweep.core.sky_pairs import Positions, at_epoch
from linksweep.sweep.contract import SweepError
from linksweep.sweep.search.options import Search
from linksweep.sweep.search.outputs import Outputs, check_for_galaxy_table, check_outputs, write_outputs
from linksweep.sweep.search.result import STAR_MOTIONS, Result
from linksweep.sweep.search.tables import SkyTable, read_galaxies, read_stars, table_name, tyc_code


def find_galaxies(search: Search, outputs: Outputs | None = None, overwrite: bool = False) -> Result:
    """Read the tables, match them and write the requested files.

    Raises SweepError as `check_outputs`, `read_tables`, `match_tables` and `write_outputs`; if a table or an option is
    wrong, nothing is written.
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
    """Return the star tables and the galaxy tables of a search; raises SweepError with the problems of all."""
    tables: list[SkyTable] = []
    problems: list[str] = []
    star_paths = [path for path in (search.stars, search.supplement) if path is not None]
    for read, paths in ((read_stars, star_paths), (read_galaxies, list(search.galaxies))):
        for path in paths:
            try:
                tables.append(read(path, search.readings[table_name(path)]))
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
    radii = [search.radius_arcsec[table.name] * ARCSEC for table in galaxies]
    catalogues = [GalaxyCatalogue(_positions(t), t.pgc, radius) for t, radius in zip(galaxies, radii, strict=True)]
    try:
        matches = cross_match(positions, supplement, catalogues, search.rules)
    except ValueError as error:
        raise SweepError(str(error)) from error
    return Result(search, stars, galaxies, matches)


def _positions(table: SkyTable) -> Positions:
    n = table.numbers
    return Positions(n["ra"] * DEGREE, n["dec"] * DEGREE, n["ra_error"] * MAS, n["dec_error"] * MAS)


def _star_positions(table: SkyTable, epoch: float) -> Positions:
    positions, numbers = _positions(table), table.numbers
    if "pmra" not in numbers:
        return positions
    none = np.zeros(len(table))
    motions = {key: np.nan_to_num(numbers.get(key, none)) * MAS for key in STAR_MOTIONS}
    return at_epoch(positions, **motions, years=epoch - numbers["ref_epoch"])


def _check_shared_stars(stars: Sequence[SkyTable]) -> None:
    tyc = [table.tyc for table in stars if table.tyc is not None]
    if len(tyc) == len(stars) == 2:
        main, supplement = (tyc_code(t) for t in tyc)
        both = tyc[1][np.isin(supplement, main)]
        if len(both):
            named = ", ".join("-".join(map(str, t)) for t in both[:5].tolist())
            more = f" and {len(both) - 5} more" if len(both) > 5 else ""
            raise SweepError(f"TYC {named}{more}: in the star table and again in the supplement")
