"""The options of a link of tables and of its forecast, for commands, Python and studies."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from linksweep.sweep.tables.options import Declared, Pairs, mapping, one_of, option

# Those who have options: the commands and functions of a link and a forecast, and studies of links.
TIE, FORECAST, STUDY = "tie", "forecast", "study"

# Stands for what a table itself has or says.
TABLE = "table"

# The tables that every link has; missions have names of their own.
SIDES = ("satellite", "reference")

SIGNS: Mapping[str, float] = {"reference-satellite": 1.0, "satellite-reference": -1.0}
RELEASES = (TABLE, "dr1", "dr2", "dr3", "dr4", "dr5")
POSITIONS = ("single-epoch", "mean")
ACCELERATIONS = ("at-epoch", "mean")


def _year(meaning: str) -> Any:
    return option(meaning, "YEAR", None, "float", unit="yr", minimum=1800.0, maximum=2200.0)


def _tables(meaning: str) -> Any:
    return option(meaning, "satellite|reference|NAME", joined=",")


def _flag(meaning: str, only: str = "") -> Any:
    return option(meaning, "", False, "bool", only)


@dataclass(frozen=True)
class Options(Declared):
    """The options of a link of two or more tables."""

    unknowns: str = option("what to solve for, e.g. orientation,spin; default what is determined", "BLOCKS", joined=",")
    degree: int | None = option("also solve for harmonics up to this degree", "L", None, "int", minimum=1, maximum=50)
    bins: str = option("solve for a spin in each bin, e.g. phot_g_mean_mag=6,8,10", "COLUMN=EDGES", joined="=,")
    clip: str = option("outliers: none, rayleigh, median:K, discrepancy[:N], huber:C", "CLIP", "none", only="tie study")
    errors: str = option(
        "main first: formal, scaled, jackknife, cells, bootstrap, sandwich", "KINDS", "scaled", only=TIE, joined=","
    )
    resamples: int = option("number of bootstrap resamples", "N", 1000, "int", TIE, minimum=2)
    seed: int = option("seed of the bootstrap", "N", 0, "int", TIE, minimum=0)
    sign: str = one_of("sign of everything that is printed and stored", *SIGNS, only=TIE)
    accept_misfit: bool = _flag("write the link although chi2 is above 1000 times its expectation", "tie study")
    by: str = option("match by name, COLUMN or position[:ARCSEC]; default name, else position", "HOW")
    weights: str = one_of("weights of the differences", "covariance", "variance", "equal")
    epoch: float | None = _year("epoch of the orientation; default the satellite's")
    known_orientation: Any = option("taken out before the fit, in mas", "X,Y,Z", None, "vector", unit="mas")
    known_spin: Any = option("taken out before the fit, in mas/yr", "X,Y,Z|TABLE", None, "vector", unit="mas/yr")
    aberration: float = option(
        "Galactic aberration of positions of 2015.0, e.g. 5.8", "UAS_YR", 0.0, "float", unit="uas/yr", minimum=0.0
    )
    jitter: str = option(
        "noise added to rows of a kind, or of all; or estimate", "[TABLE:]KIND=MAS[:MAS_YR]|estimate", joined=",:"
    )
    where: str = option(
        "only these rows, of the satellite or of TABLE: 'ruwe < 1.4 & ~flag'", "[TABLE:]CONDITION", joined=";"
    )
    columns: Pairs = mapping("the column with a quantity, e.g. reference:parallax=plx", "[TABLE:]KEY=COLUMN")
    units: Pairs = mapping("the unit of a column without one, e.g. pmra=arcsec/yr", "[TABLE:]KEY=UNIT")
    satellite_epoch: float | None = _year("epoch of the satellite's table, instead of a column")
    reference_epoch: float | None = _year("epoch of the reference's rows, instead of a column")
    mission_epochs: Pairs = mapping("epoch of a mission's table, instead of a column", "NAME=YEAR")
    positions: str = one_of("those of the reference: displaced by the parallax, or mean", TABLE, *POSITIONS)
    zero_errors: str = one_of("what an error of 0 means", "error", "missing", "exact")
    without_cos_dec: str = _tables("the table whose pmra is mu_alpha, without cos(dec)")
    extragalactic: str = _tables("the table with mean positions of quasars, which hold at any epoch")
    parallax_zero_point: str = _tables("the table of DR3 whose parallax zero points are subtracted")
    accelerations: str = one_of("what accelerated rows have: values at the epoch, or means", TABLE, *ACCELERATIONS)
    missions: Pairs = mapping("a further table of the sources, in a frame of its own", "NAME=TABLE", "files")
    epochs: Pairs = mapping("files of Gaia's epoch astrometry, which replace catalogue rows", "FILE", "files")
    star_models: Pairs = mapping("path of a star in --epochs, or of all: 5, 7, 9 parameters, orbit", "STAR=MODEL")
    orbits: str | None = option("a table of known orbits of stars in --epochs", "FILE", None, "file")


@dataclass(frozen=True)
class ForecastOptions(Declared):
    """The options of a forecast beside those of the tables."""

    add: str = option("epochs of new positions, e.g. 2026,2030", "YEARS", only=FORECAST, joined=",")
    goal: str = option("unknowns for which to choose; default all", "BLOCKS", only="forecast study", joined=",")
    error: float = option("error of each new coordinate", "MAS", 0.1, "float", FORECAST, unit="mas", above=0.0)
    release: str = one_of("scale the satellite's errors to this one", *RELEASES, only="forecast study")
    from_release: str = one_of("from this one, if the epoch does not say it", *RELEASES, only="forecast study")
    number: int = option("how many sources to choose", "N", 0, "int", FORECAST, minimum=0)
    criterion: str = one_of("minimise the trace or the determinant of the covariance", "A", "D", only=FORECAST)
    all_sources: bool = _flag("also choose among sources without rows of the reference", FORECAST)


@dataclass(frozen=True)
class ApplyOptions(Declared):
    """How the table of `apply` is read, where that differs from what the link says."""

    epoch: float | None = _year("epoch of a table without a column of epochs")
    columns: Pairs = mapping("the column with a quantity, e.g. pmra=mua; default as the link read it", "KEY=COLUMN")
    units: Pairs = mapping("the unit of a column without one; default as the link read it", "KEY=UNIT")
    without_cos_dec: bool = _flag("the table's pmra is mu_alpha, without cos(dec)")
    zero_errors: str = one_of("what an error of 0 means", TABLE, "error", "missing", "exact")


def listed(text: str) -> list[str]:
    """Return the names in a text, which commas divide."""
    return [name for part in text.split(",") if (name := part.strip())]
