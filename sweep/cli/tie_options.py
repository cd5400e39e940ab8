"""The options that say how the tables of a link are read: columns, units, epochs, missions."""

from collections.abc import Collection, Sequence
from typing import Any

import click

from linksweep.sweep.cli.options import gathered, option_with_default
from linksweep.sweep.formatting import split_assignment


def numbers(option: str, text: str) -> list[float]:
    """Return the numbers in a list with commas; raises click.BadParameter for anything else."""
    try:
        return [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise click.BadParameter(f"{text!r} is no list of numbers", param_hint=option) from None


def _mission_epochs(items: Sequence[str], missions: Collection[str]) -> dict[str, float]:
    epochs = {}
    for name, year in (_named("--mission-epoch", "NAME=YEAR", item) for item in items):
        if name not in missions:
            raise click.BadParameter(f"no --mission {name}", param_hint="--mission-epoch")
        years = numbers("--mission-epoch", year)
        if len(years) != 1:
            raise click.BadParameter(f"{year!r} is not one year", param_hint="--mission-epoch")
        epochs[name] = years[0]
    return epochs


def _by_table(option: str, form: str, items: Sequence[str], tables: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return what the items say of each quantity of each table; an item that names no table is for all."""
    found: dict[str, dict[str, str]] = {name: {} for name in tables}
    for item in items:
        key, value = _named(option, f"[{'|'.join(tables)}:]{form}", item)
        table, colon, quantity = key.partition(":")
        if colon and table not in tables:
            raise click.BadParameter(f"{item!r} is not [{'|'.join(tables)}:]{form}", param_hint=option)
        for one in [table] if colon else tables:
            found[one][quantity if colon else key] = value
    return found


def _named(option: str, form: str, item: str) -> tuple[str, str]:
    name, value = split_assignment(item)
    if not name or not value:
        raise click.BadParameter(f"{item!r} is not {form}", param_hint=option)
    return name, value


def _jitter(item: str) -> tuple[str, tuple[float, float]]:
    kind, text = split_assignment(item)
    values = numbers("--jitter", text.replace(":", ","))
    if len(values) not in (1, 2):
        raise click.BadParameter(f"{item!r} is not KIND=MAS or KIND=MAS:MAS_YR", param_hint="--jitter")
    if kind in ("motion", "three-parameter") and len(values) == 1:
        return kind, (0.0, values[0])
    return kind, (values[0], values[1] if len(values) == 2 else 0.0)


def _tables(
    missions: Sequence[str],
    column: Sequence[str],
    units: Sequence[str],
    satellite_epoch: float | None,
    reference_epoch: float | None,
    mission_epoch: Sequence[str],
    positions: Any,
    zero_errors: Any,
    without_cos_dec: Sequence[str],
    extragalactic: Sequence[str],
    jitter: Sequence[str],
) -> dict[str, Any]:
    """Return the options of the tables as `sweep.tie.options.Options` has them."""
    from linksweep.sweep.tie.options import TableOptions

    further = dict(_named("--mission", "NAME=TABLE", item) for item in missions)
    if len(further) < len(missions):
        raise click.BadParameter("a mission is named twice", param_hint="--mission")
    names = ("satellite", "reference", *further)
    own_columns = _by_table("--column", "KEY=COLUMN", column, names)
    own_units = _by_table("--unit", "KEY=UNIT", units, names)
    epochs = {"satellite": satellite_epoch, "reference": reference_epoch, **_mission_epochs(mission_epoch, further)}
    for option, chosen in (("--without-cos-dec", without_cos_dec), ("--extragalactic", extragalactic)):
        if unknown := set(chosen) - set(names):
            raise click.BadParameter(f"no table {', '.join(sorted(unknown))}", param_hint=option)
    options = {
        name: TableOptions(
            columns=own_columns[name],
            units=own_units[name],
            epoch=epochs.get(name),
            extragalactic=name in extragalactic,
            positions=positions if name == "reference" else None,
            zero_errors=zero_errors,
            pmra_cos_dec=name not in without_cos_dec,
        )
        for name in names
    }
    return {
        "jitter": dict(map(_jitter, jitter)),
        "satellite_options": options["satellite"],
        "reference_options": options["reference"],
        "missions": further,
        "mission_options": {name: options[name] for name in further},
    }


table_options = gathered(
    "tables",
    _tables,
    click.option(
        "--by",
        metavar="HOW",
        help="Match by name, COLUMN, position or position:ARCSEC.  [default: name, else position]",
    ),
    click.option(
        "--mission",
        "missions",
        multiple=True,
        metavar="NAME=TABLE",
        help="A further mission's table of the same sources, in a frame with its own orientation and spin.",
    ),
    click.option(
        "--column",
        multiple=True,
        metavar="[TABLE:]KEY=COLUMN",
        help="The column with a quantity, of all tables or of satellite, reference or a mission, e.g. "
        "reference:parallax=plx.",
    ),
    click.option(
        "--unit",
        "units",
        multiple=True,
        metavar="[TABLE:]KEY=UNIT",
        help="The unit of a quantity whose column says none, e.g. reference:ra=hourangle or pmra=arcsec/yr.",
    ),
    click.option(
        "--satellite-epoch", type=float, metavar="YEAR", help="Epoch of the satellite's table, instead of a column."
    ),
    click.option(
        "--reference-epoch", type=float, metavar="YEAR", help="Epoch of the reference's rows, instead of a column."
    ),
    click.option(
        "--mission-epoch", multiple=True, metavar="NAME=YEAR", help="Epoch of a mission's table, instead of a column."
    ),
    click.option(
        "--positions",
        type=click.Choice(["single-epoch", "mean"]),
        help="Reference positions without parallax: displaced by it, or mean.  [default: what the table says]",
    ),
    option_with_default(
        "--zero-errors",
        type=click.Choice(["error", "missing", "exact"]),
        default="error",
        help="What an error of 0 means.",
    ),
    click.option(
        "--without-cos-dec",
        multiple=True,
        metavar="satellite|reference|NAME",
        help="The table whose pmra is mu_alpha, without cos(dec).",
    ),
    click.option(
        "--extragalactic",
        multiple=True,
        metavar="satellite|reference|NAME",
        help="The table with mean positions of quasars, which hold at any epoch.",
    ),
    option_with_default(
        "--weights",
        type=click.Choice(["covariance", "variance", "equal"]),
        default="covariance",
        help="Weights of the differences.",
    ),
    click.option(
        "--jitter", multiple=True, metavar="KIND=MAS[:MAS_YR]", help="Added in quadrature to rows of a kind, or of all."
    ),
    click.option("--epoch", type=float, metavar="YEAR", help="Epoch of the orientation.  [default: the satellite's]"),
    click.option(
        "--aberration",
        type=float,
        default=0.0,
        metavar="UAS_YR",
        help="Galactic aberration of ICRF3 positions from 2015.0, e.g. 5.8.",
    ),
)
"""The command gets those that `sweep.tie.options.Options` takes as they are written by their names, and the others,
converted to what it takes, as ``tables``.
"""
