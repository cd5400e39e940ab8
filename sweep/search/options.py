"""The options of the search for galaxies."""

from dataclasses import dataclass

from linksweep.sweep.tables.options import Declared, Pairs, mapping, one_of, option


@dataclass(frozen=True)
class SearchOptions(Declared):
    """The options of `sweep match`; angles are in arcsec."""

    radius: Pairs = mapping("match radius, of all or of one catalogue; default 5", "[NAME=]ARCSEC")
    error: Pairs = mapping("position error of each coordinate, instead of columns of errors", "[NAME=]ARCSEC")
    columns: Pairs = mapping("the column with a quantity, e.g. ra=RAmdeg or pgc:PGC=pgc", "[NAME:]KEY=COLUMN")
    units: Pairs = mapping("the unit of a column that has none, e.g. ra=hourangle", "[NAME:]KEY=UNIT")
    where: str = option("only these stars, or rows of NAME, e.g. 'vt_mag < 9'", "[NAME:]CONDITION", joined=";")
    epoch: float = option("epoch of the galaxy positions", "YEAR", 2000.0, "float", minimum=1700.0, maximum=2300.0)
    ref_epoch: Pairs = mapping("epoch of the stars, instead of a column ref_epoch", "[NAME=]YEAR")
    missing_pm: str = one_of("what to do with stars that have no proper motion", "error", "zero")
    merge_radius: float | None = option(
        "entries this close are one galaxy; default the sum of their radii",
        "ARCSEC",
        None,
        "float",
        above=0.0,
        maximum=3600.0,
    )
    k_sigma: float = option("offsets above this many sigma are uncertain", "K", 3.0, "float", above=0.0)
    crowding_radius: float = option(
        "uncertain: --crowding-stars within this radius", "ARCSEC", 120.0, "float", above=0.0, maximum=3600.0
    )
    crowding_stars: int = option("how many other stars make a match uncertain", "N", 3, "int", minimum=1)
    epoch_difference: float = option("years to a second epoch", "YR", 20.0, "float", above=0.0)
    second_epoch_error: float = option("position error at the second epoch", "MAS", 0.0, "float", minimum=0.0)
