"""Links and forecasts as text, JSON, CSV and ECSV."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from linksweep.sweep.formatting import to_json

if TYPE_CHECKING:
    import xarray as xr

STEPS_SHOWN = 10


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
        yield ""
        yield f"{'field':20} {'degree':>6} {'power':>12} {'noise':>12} {'chi2':>9} {'probability':>12}"
        for field in link.field.values:
            for degree in link.degree.values:
                one = link.sel(field=field, degree=degree)
                if np.isfinite(one.power):
                    yield (
                        f"{field:20} {degree:6d} {float(one.power):12.5g} {float(one.power_noise):12.5g} "
                        f"{float(one.power_chi2):9.2f} {float(one.power_probability):12.3g}"
                    )
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
    yield f"formal errors, orientation at {attributes['epoch_of_forecast']:.2f}"
    yield ""
    width = 26
    labels = [str(label) for label in plan.unknown.values]
    column = max(9, *map(len, labels))
    yield f"{'':{width}} " + " ".join(f"{label:>{column}}" for label in labels)
    yield f"{'':{width}} " + " ".join(f"{unit:>{column}}" for unit in plan.unit.values)

    def row(name: str, values: Any) -> str:
        return f"{name[:width]:{width}} " + " ".join(f"{value:{column}.5f}" for value in values)

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


def _notes(result: "xr.Dataset") -> list[str]:
    notes = [f"note: {note}" for note in result.attrs["notes"] if note != result.attrs.get("misfit")]
    return ["", *notes] if notes else []


def _as_json(dataset: "xr.Dataset") -> str:
    """Return a dataset as JSON: attributes, coordinates and variables by name, NaN as null."""
    return to_json(
        {
            "attributes": dataset.attrs,
            "coordinates": {str(name): dataset.coords[name].values for name in dataset.coords},
            "variables": {
                str(name): {"dims": list(map(str, one.dims)), "values": one.values}
                for name, one in dataset.data_vars.items()
            },
        }
    )


def as_format(result: "xr.Dataset", table_format: str) -> str:
    """Return a link or a forecast as text, json, csv or ecsv; the last two are the table of the unknowns."""
    if table_format == "json":
        return _as_json(result)
    if table_format == "text":
        lines = _link_lines if result.attrs["result"] == "tie" else _forecast_lines
        return "\n".join([*lines(result), *_notes(result)])
    return _written(result, f"ascii.{table_format}")


def _written(result: "xr.Dataset", table_format: str) -> str:
    """Return a table of the unknowns, with estimate and errors, or with the error at each stage of a forecast."""
    from io import StringIO

    from astropy.table import Table

    columns: dict[str, Any] = {"unknown": result.unknown.values.astype(str), "unit": result.unit.values.astype(str)}
    if result.attrs["result"] == "tie":
        columns["estimate"] = result.estimate.values
        columns |= {f"error_{kind}": result.errors.sel(error_kind=kind).values for kind in result.error_kind.values}
    else:
        columns |= {f"error_{stage}": result.error.sel(stage=stage).values for stage in result.stage.values}
    table = Table(columns)
    kept = ("sign", "epoch", "clip") if result.attrs["result"] == "tie" else ("epoch_of_forecast", "release")
    table.meta = {name: result.attrs[name] for name in kept}
    out = StringIO()
    table.write(out, format=table_format)
    return out.getvalue()
