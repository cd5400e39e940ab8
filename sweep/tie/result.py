"""What a link or a forecast looks like and where it is kept: text, JSON, CSV, ECSV, and a store of its own."""

import json
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import to_json
from linksweep.sweep.stores.location import Folder, reading

if TYPE_CHECKING:
    import xarray as xr

RESULTS = ("tie", "forecast")
STEPS_SHOWN = 10


def as_format(result: "xr.Dataset", table_format: str) -> str:
    """Return a link or a forecast as text, json, csv or ecsv; the last two are the table of the unknowns."""
    is_tie = result.attrs["result"] == "tie"
    if table_format == "json":
        variables = {n: {"dims": list(map(str, v.dims)), "values": v.values} for n, v in result.data_vars.items()}
        coordinates = {name: values.values for name, values in result.coords.items()}
        return to_json({"attributes": result.attrs, "coordinates": coordinates, "variables": variables})
    if table_format == "text":
        notes = [f"note: {note}" for note in result.attrs["notes"] if note != result.attrs.get("misfit")]
        lines = _link_lines(result) if is_tie else _forecast_lines(result)
        return "\n".join([*lines, *([""] if notes else []), *notes])
    from astropy.table import Table

    columns: dict[str, Any] = {"unknown": result.unknown.values.astype(str), "unit": result.unit.values.astype(str)}
    if is_tie:
        columns["estimate"] = result.estimate.values
        columns |= {f"error_{kind}": result.errors.sel(error_kind=kind).values for kind in result.error_kind.values}
    else:
        columns |= {f"error_{stage}": result.error.sel(stage=stage).values for stage in result.stage.values}
    kept = ("sign", "epoch", "clip") if is_tie else ("epoch_of_forecast", "release")
    written = StringIO()
    table = Table(columns, meta={name: result.attrs[name] for name in kept})
    table.write(written, format=f"ascii.{table_format}")
    return written.getvalue()


def _link_lines(link: "xr.Dataset") -> Iterator[str]:
    """Yield a table of the unknowns with every kind of error, and what is needed to interpret it."""
    attributes = link.attrs
    if attributes.get("misfit"):
        yield from (f"warning: {attributes['misfit']}", "")
    yield f"{attributes['sign'].replace('-', ' - ')}, orientation at {attributes['epoch']:.2f}"
    yield (
        f"{int(link.n_sources)} of {int(link.n_sources_matched)} sources, matched by {attributes['matched_by']}; "
        f"clip {attributes['clip']}; weights {attributes['weights']}"
    )
    for mission, path in attributes["missions"].items():
        yield f"{attributes['sign'].replace('satellite', mission).replace('-', ' - ')}: {path}"
    yield (
        f"chi2 {float(link.chi2):.6g} where {float(link.chi2_expected):.6g} is expected, "
        f"{float(link.dof):.0f} degrees of freedom"
    )
    yield ""
    kinds = [str(kind) for kind in link.error_kind.values]
    width = max(len("unknown"), *(len(str(label)) for label in link.unknown.values))
    yield f"{'unknown':{width}} {'estimate':>12} " + " ".join(f"{kind:>10}" for kind in kinds) + "  unit"
    for k, label in enumerate(link.unknown.values):
        errors = " ".join(f"{value:10.5f}" for value in link.errors.values[:, k])
        yield f"{label!s:{width}} {float(link.estimate[k]):12.5f} {errors}  {link.unit.values[k]}"
    if "power" in link:
        yield from ("", f"{'field':20} {'degree':>6} {'power':>12} {'noise':>12} {'chi2':>9} {'probability':>12}")
        names = ("power", "power_noise", "power_chi2", "power_probability")
        for field in link.field.values:
            for degree in link.degree.values:
                power, noise, chi2, chance = (float(link[name].sel(field=field, degree=degree)) for name in names)
                if np.isfinite(power):
                    yield f"{field:20} {degree:6d} {power:12.5g} {noise:12.5g} {chi2:9.2f} {chance:12.3g}"
    if "step_estimate" in link and any(str(name) for name in link.step_dropped.values):
        yield ""
        yield from _step_lines(link)


def _step_lines(link: "xr.Dataset") -> Iterator[str]:
    chosen = int(link.step_chosen)
    yield f"clip step by step ({chosen} sources dropped):"
    for step in range(min(link.sizes["step"], max(chosen + 3, STEPS_SHOWN))):
        values = " ".join(f"{value:9.4f}" for value in link.step_estimate.values[step][:6])
        ratio = float(link.step_chi2[step] / link.step_dof[step])
        mark = "*" if step == chosen else " "
        yield f"{mark}{step:4d} {str(link.step_dropped.values[step])[:24]:24} chi2/dof {ratio:9.3f}  {values}"


def _forecast_lines(plan: "xr.Dataset") -> Iterator[str]:
    """Yield the errors of each stage, of each new epoch and of each choice."""
    attributes = plan.attrs
    width = max(9, *(len(str(label)) for label in plan.unknown.values))

    def row(name: str, values: Iterable[Any], form: str = f"{width}.5f") -> str:
        return f"{name[:26]:26} " + " ".join(format(value, form) for value in values)

    yield from (f"formal errors, orientation at {attributes['epoch_of_forecast']:.2f}", "")
    yield from (row("", map(str, names), f">{width}") for names in (plan.unknown.values, plan.unit.values))
    for stage, values in zip(plan.stage.values, plan.error.values, strict=True):
        yield row(str(stage), values)
    if "error_with_epoch" in plan:
        for epoch, values in zip(plan.new_epoch.values, plan.error_with_epoch.values, strict=True):
            yield row(f"all observed at {epoch:g}", values)
    if "step_source" in plan:
        yield ""
        yield f"chosen for {attributes['goal']} (criterion {attributes['criterion']}):"
        for step, name in enumerate(plan.step_source.values):
            yield row("none" if step == 0 else f"{step} {name}", plan.step_error.values[step])


def save(result: "xr.Dataset", path: Path) -> None:
    """Write a result to a new store in one step; SweepError where there is something by that name."""
    part = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with warnings.catch_warnings():  # text has no final specification in Zarr 3
            warnings.simplefilter("ignore")
            result.to_zarr(part, mode="w")
        if path.exists():  # a rename would replace an empty folder
            raise SweepError("is there already; nothing is overwritten", str(path))
        part.rename(path)
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def result_at(where: Any) -> "xr.Dataset | None":
    """Return a stored link or forecast, loaded into memory; None for anything else.

    Raises SweepError for one that is damaged.
    """
    folder = Path(str(where))
    try:
        attributes = json.loads(Folder(folder).get("zarr.json") or b"{}").get("attributes", {})
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    if not isinstance(attributes, dict) or attributes.get("result") not in RESULTS:
        return None
    import xarray as xr

    with reading(Folder(folder)):
        Folder(folder).require_plain()
    try:
        with xr.open_zarr(folder) as stored:
            result: xr.Dataset = stored.load()
    except Exception as error:  # decoders of a damaged file may raise anything
        raise SweepError(f"is damaged: {' '.join(str(error).split())}", str(where)) from error
    return result
