"""The options of a link of tables and of its forecast, each declared once: commands, Python and studies have the same.

A shell asks for them at each press of a key, so that nothing heavy is imported here.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Self

from linksweep.sweep.formatting import split_assignment

if TYPE_CHECKING:
    from linksweep.sweep.contract import Parameter

# Those who have options: the commands and functions of a link and a forecast, and studies of links.
TIE, FORECAST, STUDY = "tie", "forecast", "study"
ALL = f"{TIE} {FORECAST} {STUDY}"

# Stands for what a table itself has or says.
TABLE = "table"

# The tables that every link has; missions have names of their own.
SIDES = ("satellite", "reference")

SIGNS: Mapping[str, float] = {"reference-satellite": 1.0, "satellite-reference": -1.0}
RELEASES = (TABLE, "dr1", "dr2", "dr3", "dr4", "dr5")
POSITIONS = ("single-epoch", "mean")
ACCELERATIONS = ("at-epoch", "mean")

Pairs = tuple[tuple[str, str], ...]


def option(
    meaning: str,
    metavar: str = "",
    default: Any = "",
    kind: str = "str",
    only: str = ALL,
    joined: str = "",
    **limits: Any,
) -> Any:
    """Declare an option as a field of a dataclass; ``kind`` and ``limits`` are those of a `Parameter`.

    The command writes its value as ``metavar``; with NAME=VALUE or ``joined`` it may be given several times, and
    elsewhere be a mapping or list.  Text that means a list is ``joined`` by the first of these marks, and by the second
    within.  ``only`` some have the option.
    """
    about = {"meaning": meaning, "kind": kind, **limits}
    return field(default=default, metadata={"about": about, "metavar": metavar, "joined": joined, "only": only.split()})


def _year(meaning: str) -> Any:
    return option(meaning, "YEAR", None, "float", unit="yr", minimum=1800.0, maximum=2200.0)


def _one_of(meaning: str, *choices: str, only: str = ALL) -> Any:
    return option(meaning, f"[{'|'.join(choices)}]", choices[0], only=only, choices=choices)


def _tables(meaning: str) -> Any:
    return option(meaning, "satellite|reference|NAME", joined=",")


def _flag(meaning: str, only: str) -> Any:
    return option(meaning, "", False, "bool", only)


def _mapping(meaning: str, metavar: str, kind: str = "map") -> Any:
    return option(meaning, metavar, (), kind)


def declared(entry: str, *groups: type["Declared"]) -> list[Field[Any]]:
    """Return the options that a command, function or study has."""
    return [one for group in groups for one in fields(group) if entry in one.metadata["only"]]


def parameter(one: Field[Any]) -> "Parameter":
    """Return an option as a parameter of a study, which says what values it may have."""
    from linksweep.sweep.contract import Parameter

    return Parameter(one.name, default=one.default, **one.metadata["about"])


@dataclass(frozen=True)
class Declared:
    """Options with the values that a study would have; text, lists and mappings that mean these are allowed too."""

    def __post_init__(self) -> None:
        from linksweep.sweep.contract import SweepError

        problems = []
        for one in fields(self):
            try:
                object.__setattr__(self, one.name, _checked(one, getattr(self, one.name)))
            except (ValueError, TypeError) as error:
                problems.append(str(error))
        if problems:
            raise SweepError(problems)

    @classmethod
    def named(cls, entry: str, values: Mapping[str, Any], *others: type["Declared"]) -> Self:
        """Return the options among ``values``, of which ``others`` are of other kinds; raises SweepError for those that
        a command, function or study does not have, and for values that are not allowed.
        """
        from linksweep.sweep.contract import SweepError, suggest

        known = [one.name for one in declared(entry, cls, *others)]
        if unknown := [name for name in values if name not in known]:
            raise SweepError(f"no option {unknown[0]} of {entry}{suggest(unknown[0], known)}")
        return cls(**{one.name: values[one.name] for one in fields(cls) if one.name in values})


def _checked(one: Field[Any], value: Any) -> Any:
    """Return the value of an option as a study has it; raises ValueError for one that is not allowed."""
    kind, metavar, joined = one.metadata["about"]["kind"], one.metadata["metavar"], one.metadata["joined"]
    value = value.tolist() if hasattr(value, "tolist") else value
    if value in (None, (), one.default):
        return one.default
    if kind in ("map", "files"):
        some = value.items() if isinstance(value, Mapping) else [value] if isinstance(value, str | PurePath) else value
        pairs = [_pair(one.name, metavar, k, part) for k, part in enumerate(some)]
        if len(named := dict(pairs)) < len(pairs):
            raise ValueError(f"{one.name}: {', '.join(key for key, _ in pairs)}: one is named twice")
        parameter(one).parse(named)
        return tuple(pairs)
    if joined or isinstance(value, PurePath):
        value = _text(value, joined)
    if kind in ("float", "int", "vector") and isinstance(value, str):
        with suppress(ValueError):
            numbers = [int(part) if kind == "int" else float(part) for part in value.split(",")]
            value = numbers if kind == "vector" else numbers[0] if len(numbers) == 1 else value
        if "TABLE" in metavar and isinstance(value, str):
            return value
    return parameter(one).parse(value)


def _pair(name: str, metavar: str, number: int, part: Any) -> tuple[str, str]:
    """Return the key and the value of one part of a mapping, as the command writes it or by its number."""
    if isinstance(part, tuple):
        key, value = part
    else:
        key, value = split_assignment(str(part)) if "=" in metavar else (str(number), part)
    if not key:
        raise ValueError(f"{name} = {part!r}: must be {metavar}")
    return str(key), str(value)


def _text(value: Any, joined: str) -> str:
    if isinstance(value, Mapping):
        value = [f"{key}={_text(one, joined[1:])}" for key, one in value.items()]
    if isinstance(value, str) or not isinstance(value, Iterable):
        return str(value)
    return joined[:1].join(_text(one, joined[1:]) for one in value)


@dataclass(frozen=True)
class Options(Declared):
    """The options of a link of two or more tables."""

    unknowns: str = option("like orientation,spin,glide,parallax; default what is determined", "BLOCKS", joined=",")
    degree: int | None = option("adds harmonics up to this degree", "L", None, "int", minimum=1, maximum=50)
    bins: str = option("a spin for each bin, like phot_g_mean_mag=6,8,10", "COLUMN=EDGES", joined="=,")
    clip: str = option(
        "of outliers: none, rayleigh, median:K, discrepancy[:N], huber:C", "CLIP", "none", only="tie study"
    )
    errors: str = option(
        "first the main: formal, scaled, jackknife, cells, bootstrap, sandwich", "KINDS", "scaled", only=TIE, joined=","
    )
    resamples: int = option("number of bootstrap resamples", "N", 1000, "int", TIE, minimum=2)
    seed: int = option("seed of the bootstrap", "N", 0, "int", TIE, minimum=0)
    sign: str = _one_of("sign of everything that is printed and stored", *SIGNS, only=TIE)
    accept_misfit: bool = _flag("gives the link although chi2 is above 1000 times its expectation", "tie study")
    by: str = option("match by name, COLUMN or position[:ARCSEC]; default name, else position", "HOW")
    weights: str = _one_of("weights of the differences", "covariance", "variance", "equal")
    epoch: float | None = _year("epoch of the orientation; default the satellite's")
    known_orientation: Any = option("subtracted before the fit", "X,Y,Z", None, "vector", unit="mas")
    known_spin: Any = option("subtracted before the fit", "X,Y,Z|TABLE", None, "vector", unit="mas/yr")
    aberration: float = option(
        "Galactic, e.g. 5.8, of positions of 2015.0", "UAS_YR", 0.0, "float", unit="uas/yr", minimum=0.0
    )
    jitter: str = option(
        "added in quadrature to rows of a kind, or of all; or estimate", "KIND=MAS[:MAS_YR]|estimate", joined=",:"
    )
    where: str = option(
        "rows of the satellite, or of TABLE: 'ruwe < 1.4 & ~flag'; a ; divides several", "[TABLE:]CONDITION", joined=";"
    )
    columns: Pairs = _mapping("the column with a quantity, e.g. reference:parallax=plx", "[TABLE:]KEY=COLUMN")
    units: Pairs = _mapping("the unit of a column that says none, e.g. pmra=arcsec/yr", "[TABLE:]KEY=UNIT")
    satellite_epoch: float | None = _year("epoch of the satellite's table, instead of a column")
    reference_epoch: float | None = _year("epoch of the reference's rows, instead of a column")
    mission_epochs: Pairs = _mapping("epoch of a mission's table, instead of a column", "NAME=YEAR")
    positions: str = _one_of("of the reference: displaced by the parallax, or mean", TABLE, *POSITIONS)
    zero_errors: str = _one_of("what an error of 0 means", "error", "missing", "exact")
    without_cos_dec: str = _tables("the table whose pmra is mu_alpha, without cos(dec)")
    extragalactic: str = _tables("the table with mean positions of quasars, which hold at any epoch")
    parallax_zero_point: str = _tables("the table of DR3 whose parallax zero points are subtracted")
    accelerations: str = _one_of("positions and motions of accelerated rows", TABLE, *ACCELERATIONS)
    missions: Pairs = _mapping("a further table of the sources, in a frame of its own", "NAME=TABLE", "files")
    epochs: Pairs = _mapping("files of Gaia's epoch astrometry, instead of catalogue rows", "FILE", "files")
    star_models: Pairs = _mapping("path of a star with epochs, or all: 5, 7, 9 parameters, orbit", "STAR=MODEL")
    orbits: str | None = option("a table of known orbits of stars with epochs", "FILE", None, "file")


@dataclass(frozen=True)
class Plan(Declared):
    """The options of a forecast beside those of the tables."""

    add: str = option("epochs of new positions, e.g. 2026,2030", "YEARS", only=FORECAST, joined=",")
    goal: str = option("blocks for which to choose; default all", "BLOCKS", only="forecast study", joined=",")
    error: float = option("error of each new coordinate", "MAS", 0.1, "float", FORECAST, unit="mas", above=0.0)
    release: str = _one_of("errors of a later release, with its epoch", *RELEASES, only="forecast study")
    from_release: str = _one_of("of the errors, if no release has their epoch", *RELEASES, only="forecast study")
    number: int = option("how many sources to choose", "N", 0, "int", FORECAST, minimum=0)
    criterion: str = _one_of("trace or determinant of the covariance", "A", "D", only=FORECAST)
    all_sources: bool = _flag("also choose among sources without rows of the reference", FORECAST)
