"""The commands of the link of real tables: tie and forecast."""

import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sweep.cli.group import main
from sweep.cli.options import json_option
from sweep.formatting import split_assignment

if TYPE_CHECKING:
    import xarray as xr

    from sweep.tie.column_names import TableOptions

_TABLE_OPTIONS = [
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
    click.option("--satellite-epoch", type=float, metavar="YEAR", help="Epoch of the satellite's table, for a column."),
    click.option("--reference-epoch", type=float, metavar="YEAR", help="Epoch of the reference's rows, for a column."),
    click.option(
        "--mission-epoch", multiple=True, metavar="NAME=YEAR", help="Epoch of a mission's table, for a column."
    ),
    click.option(
        "--positions",
        type=click.Choice(["single-epoch", "mean"]),
        help="Reference positions without parallax: displaced by it, or mean.  [default: what the table says]",
    ),
    click.option(
        "--zero-errors",
        type=click.Choice(["error", "missing", "exact"]),
        default="error",
        show_default=True,
        help="What an error of 0 means.",
    ),
    click.option(
        "--without-cos-dec",
        multiple=True,
        metavar="satellite|reference|NAME",
        help="The table whose pmra is mu_alpha, without cos(dec).",
    ),
    click.option(
        "--weights",
        type=click.Choice(["covariance", "variance", "equal"]),
        default="covariance",
        show_default=True,
        help="Of the differences.",
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
]

_RESULT_OPTIONS = [
    click.option(
        "-o", "--output", type=click.Path(path_type=Path), metavar="STORE.zarr", help="Write the labelled result."
    ),
    click.option(
        "--figures",
        type=click.Path(path_type=Path, file_okay=False),
        metavar="FOLDER",
        help="Draw every figure that `sweep plot STORE.zarr --kind KIND` has, as KIND.png.",
    ),
    json_option,
]


def _table_options(command: Callable[..., None]) -> Callable[..., None]:
    for option in reversed([*_TABLE_OPTIONS, *_RESULT_OPTIONS]):
        command = option(command)
    return command


@main.command()
@click.argument("satellite", type=click.Path(path_type=Path))
@click.argument("reference")
@click.option(
    "--unknowns",
    metavar="BLOCKS",
    help="Like orientation,spin,glide,parallax,vsh_motion:3.  [default: what the tables determine of orientation,spin]",
)
@click.option("--degree", type=click.IntRange(1), help="Vector spherical harmonics up to this degree.")
@click.option("--bins", metavar="COLUMN=EDGES", help="A spin for each bin, e.g. phot_g_mean_mag=6,8,10.")
@click.option(
    "--known-spin",
    metavar="X,Y,Z|TABLE",
    help="Subtracted before the fit: mas/yr with the sign of --sign, or a table by magnitude.",
)
@click.option("--clip", default="none", show_default=True, help="none, rayleigh, median:K, discrepancy[:N] or huber:C.")
@click.option(
    "--errors",
    default="scaled",
    show_default=True,
    help="Kinds of errors, the main one first: formal, scaled, jackknife, cells, bootstrap, sandwich.",
)
@click.option("--resamples", type=click.IntRange(2), default=1000, show_default=True, help="Of the bootstrap.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the bootstrap.")
@click.option(
    "--sign",
    type=click.Choice(["reference-satellite", "satellite-reference"]),
    default="reference-satellite",
    show_default=True,
    help="Of everything that is printed and stored.",
)
@click.option("--workers", type=click.IntRange(1, 4096), help="Local workers, for millions of quasars in Parquet.")
@click.option("--scheduler", metavar="ADDRESS", help="A Dask scheduler for them, e.g. tcp://host:8786.")
@click.option(
    "--no-sources",
    is_flag=True,
    help="Leave what belongs to single sources and rows out of STORE.zarr and of JSON: for millions of them.",
)
@_table_options
def tie(
    satellite: Path, reference: str, as_json: bool, output: Path | None, figures: Path | None, **given: Any
) -> None:
    """Solve for the link of two real tables, REFERENCE - SATELLITE.

    SATELLITE has positions, parallaxes and proper motions (Gaia archive, Hipparcos-2, ICRF text, or any table with such
    columns), REFERENCE measurements of the same objects, or zero-motion for quasars.

    \b
    sweep tie gaia.fits vlbi.ecsv --unknowns orientation,spin -o tie.zarr
    """
    from sweep.tie import text
    from sweep.tie.link_tables import tie as solve
    from sweep.tie.options import parse_bins

    _refuse_existing(output)
    _require_drawing(figures)
    bins, known = given.pop("bins"), given.pop("known_spin")
    result = solve(
        satellite,
        reference,
        given.pop("unknowns"),
        clip=given.pop("clip"),
        errors=given.pop("errors"),
        resamples=given.pop("resamples"),
        seed=given.pop("seed"),
        workers=given.pop("workers"),
        scheduler=given.pop("scheduler"),
        per_source=not given.pop("no_sources") and (as_json or output is not None or figures is not None),
        degree=given.pop("degree"),
        sign=given.pop("sign"),
        bins=None if bins is None else parse_bins(bins),
        known_spin=None if known is None else _spin(known),
        **_tables(given),
    )
    _put(result, output, figures, text.as_json(result) if as_json else text.link_text(result))


@main.command()
@click.argument("satellite", type=click.Path(path_type=Path))
@click.argument("reference")
@click.option("--unknowns", metavar="BLOCKS", help="Like orientation,spin.")
@click.option("--add", metavar="YEARS", default="", help="Epochs of new positions, e.g. 2026,2030.")
@click.option("--error", type=float, default=0.1, show_default=True, metavar="MAS", help="Of each new coordinate.")
@click.option("--release", help="Scale the satellite's errors to dr4 or dr5.")
@click.option("--from-release", default="dr3", show_default=True, help="Release of the satellite's table.")
@click.option("--choose", "number", type=click.IntRange(0), default=0, metavar="N", help="Choose the N best sources.")
@click.option("--for", "goal", default="", metavar="BLOCKS", help="What they are best for.  [default: all unknowns]")
@click.option(
    "--criterion",
    type=click.Choice(["A", "D"]),
    default="A",
    show_default=True,
    help="Trace or determinant of the covariance.",
)
@click.option("--all-sources", is_flag=True, help="Sources without any row of the reference are candidates too.")
@_table_options
def forecast(
    satellite: Path, reference: str, as_json: bool, output: Path | None, figures: Path | None, **given: Any
) -> None:
    """Forecast the errors of a link with new observations, and choose what to observe.

    \b
    sweep forecast gaia.fits vlbi.ecsv --add 2026,2030 --choose 5 --for spin
    """
    from sweep.tie import text
    from sweep.tie.planning import forecast as plan

    _refuse_existing(output)
    _require_drawing(figures)
    result = plan(
        satellite,
        reference,
        given.pop("unknowns"),
        add=_numbers("--add", given.pop("add")),
        goal=[name.strip() for name in given.pop("goal").split(",") if name.strip()],
        **{
            name: given.pop(name) for name in ("error", "release", "from_release", "number", "criterion", "all_sources")
        },
        **_tables(given),
    )
    _put(result, output, figures, text.as_json(result) if as_json else text.forecast_text(result))


def _tables(given: dict[str, Any]) -> dict[str, Any]:
    """Return the options of both tables as `Options` has them."""
    from sweep.tie.column_names import TableOptions

    missions = dict(_named("--mission", "NAME=TABLE", item) for item in given["missions"])
    if len(missions) < len(given["missions"]):
        raise click.BadParameter("a mission is named twice", param_hint="--mission")
    tables = ("satellite", "reference", *missions)
    columns = _by_table("--column", "KEY=COLUMN", given["column"], tables)
    units = _by_table("--unit", "KEY=UNIT", given["units"], tables)
    epochs = {"satellite": given["satellite_epoch"], "reference": given["reference_epoch"]}
    for name, year in (_named("--mission-epoch", "NAME=YEAR", item) for item in given["mission_epoch"]):
        if name not in missions:
            raise click.BadParameter(f"no --mission {name}", param_hint="--mission-epoch")
        epochs[name] = _numbers("--mission-epoch", year)[0]
    if unknown := set(given["without_cos_dec"]) - set(tables):
        raise click.BadParameter(f"no table {', '.join(sorted(unknown))}", param_hint="--without-cos-dec")

    def options(table: str) -> "TableOptions":
        return TableOptions(
            columns=columns[table],
            units=units[table],
            epoch=epochs.get(table),
            positions=given["positions"] if table == "reference" else None,
            zero_errors=given["zero_errors"],
            pmra_cos_dec=table not in given["without_cos_dec"],
        )

    return {
        "by": given["by"],
        "weights": given["weights"],
        "jitter": dict(_jitter(item) for item in given["jitter"]),
        "epoch": given["epoch"],
        "aberration": given["aberration"],
        "satellite_options": options("satellite"),
        "reference_options": options("reference"),
        "missions": missions,
        "mission_options": {name: options(name) for name in missions},
    }


def _by_table(option: str, form: str, items: Sequence[str], tables: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return what is said of each quantity of each table; what names no table is for all."""
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
    kind, numbers = split_assignment(item)
    values = _numbers("--jitter", numbers.replace(":", ","))
    if len(values) not in (1, 2):
        raise click.BadParameter(f"{item!r} is not KIND=MAS or KIND=MAS:MAS_YR", param_hint="--jitter")
    if kind in ("motion", "three-parameter") and len(values) == 1:
        return kind, (0.0, values[0])
    return kind, (values[0], values[1] if len(values) == 2 else 0.0)


def _spin(text: str) -> list[float] | str:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return text


def _numbers(option: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise click.BadParameter(f"{text!r} is no list of numbers", param_hint=option) from None


def _refuse_existing(output: Path | None) -> None:
    from sweep.contract import SweepError

    if output is not None and output.suffix != ".zarr":
        raise SweepError("a result is written to a store whose name ends in .zarr", str(output))
    if output is not None and output.exists():
        raise SweepError("is there already; nothing is overwritten", str(output))


def _require_drawing(figures: Path | None) -> None:
    if figures is not None and find_spec("matplotlib") is None:
        raise click.UsageError("drawing needs matplotlib: pip install 'linksweep[plot]'")


def _put(result: "xr.Dataset", output: Path | None, figures: Path | None, text: str) -> None:
    if output is not None:
        with warnings.catch_warnings():  # text has no final specification in Zarr 3
            warnings.simplefilter("ignore")
            result.to_zarr(output, mode="w-")
    if figures is not None:
        _draw(result, figures)
    click.echo(text)


def _draw(result: "xr.Dataset", folder: Path) -> None:
    from sweep.contract import SweepError
    from sweep.plots import style
    from sweep.plots.tie.figure import link_figures

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SweepError(f"cannot draw there: {error.strerror or error}", str(folder)) from error
    with style.settings():
        for kind, figure in link_figures(result).items():
            style.save(figure, folder / f"{kind}.png")
            click.echo(f"wrote {folder / f'{kind}.png'}", err=True)
