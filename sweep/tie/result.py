"""Links and forecasts as tables, and the sentences below them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from linksweep.sweep.table_writer import Column, Table

if TYPE_CHECKING:
    import xarray as xr

STEPS_SHOWN, UNKNOWNS_SHOWN = 10, 6
"""How many steps of a clip a table has at least, and of how many unknowns."""

META = {"tie": ("sign", "epoch", "clip"), "forecast": ("epoch_of_forecast", "release")}
"""The attributes in the head of an ECSV table."""


def tables(result: "xr.Dataset") -> list[Table]:
    """Return the tables of a link or a forecast for reading."""
    return _link_tables(result) if result.attrs["result"] == "tie" else _forecast_tables(result)


def notes(result: "xr.Dataset") -> list[str]:
    """Return the warnings of a link or a forecast."""
    return [f"note: {note}" for note in result.attrs["notes"] if note != result.attrs.get("misfit")]


def records(result: "xr.Dataset") -> Table:
    """Return the unknowns with estimate and every error, or with the error at each stage of a forecast; in JSON beside
    the whole dataset.
    """
    columns = [Column(name, result[name].values.astype(str).tolist()) for name in ("unknown", "unit")]
    if result.attrs["result"] == "tie":
        columns.append(Column("estimate", result["estimate"].values.tolist()))
        kinds, errors = result["error_kind"].values, result["errors"].transpose("error_kind", "unknown").values
    else:
        kinds, errors = result["stage"].values, result["error"].transpose("stage", "unknown").values
    columns += [Column(f"error_{kind}", one.tolist()) for kind, one in zip(kinds, errors, strict=True)]
    variables = {str(n): {"dims": list(map(str, v.dims)), "values": v.values} for n, v in result.data_vars.items()}
    coordinates = {str(name): result.coords[name].values for name in result.coords}
    return Table(
        columns,
        about={"attributes": result.attrs, "coordinates": coordinates, "variables": variables},
        meta={name: result.attrs[name] for name in META[result.attrs["result"]]},
    )


def _texts(name: str, values: Any, left: bool = True) -> Column:
    return Column(name, [str(value) for value in values], left=left)


def _numbers(name: str, values: Any, form: str, unit: str = "") -> Column:
    numbers = np.asarray(values).tolist()
    return Column(name, numbers, [format(number, form) for number in numbers], unit)


def _link_tables(link: "xr.Dataset") -> list[Table]:
    """Return a table of the unknowns with every kind of error under what is needed to interpret it, and those of the
    power of harmonics and of the steps of a clip.
    """
    attributes, sign = link.attrs, link.attrs["sign"]
    lines = [f"warning: {attributes['misfit']}", ""] if attributes.get("misfit") else []
    lines += [
        f"{sign.replace('-', ' - ')}, orientation at {attributes['epoch']:.2f}",
        f"{int(link.n_sources)} of {int(link.n_sources_matched)} sources, matched by {attributes['matched_by']}; "
        f"clip {attributes['clip']}; weights {attributes['weights']}",
        *(
            f"{sign.replace('satellite', mission).replace('-', ' - ')}: {path}"
            for mission, path in attributes["missions"].items()
        ),
        f"chi2 {float(link.chi2):.6g} where {float(link.chi2_expected):.6g} is expected, "
        f"{float(link.dof):.0f} degrees of freedom",
        "",
    ]
    errors = zip(link.error_kind.values, link.errors.values, strict=True)
    unknowns = [
        _texts("unknown", link.unknown.values),
        _numbers("estimate", link.estimate, ".5f"),
        *(_numbers(str(kind), values, ".5f") for kind, values in errors),
        _texts("unit", link.unit.values),
    ]
    made = [Table(unknowns, "\n".join(lines))]
    if "power" in link:
        powers = link[["power", "power_noise", "power_chi2", "power_probability"]].stack(row=("field", "degree"))
        powers = powers.isel(row=np.flatnonzero(np.isfinite(powers["power"].values)))
        forms = {"power": ".5g", "power_noise": ".5g", "power_chi2": ".2f", "power_probability": ".3g"}
        columns = [_texts("field", powers["field"].values), _texts("degree", powers["degree"].values, left=False)]
        columns += [_numbers(n.removeprefix("power_"), powers[n].values, form) for n, form in forms.items()]
        made.append(Table(columns))
    if "step_estimate" in link and any(str(name) for name in link.step_dropped.values):
        chosen = int(link.step_chosen)
        shown = slice(min(link.sizes["step"], max(chosen + 3, STEPS_SHOWN)))
        estimates = link.step_estimate.values[shown, :UNKNOWNS_SHOWN]
        steps = range(len(estimates))
        columns = [
            _texts("step", (f"{'*' if step == chosen else ' '}{step:4d}" for step in steps), left=False),
            _texts("dropped", link.step_dropped.values[shown]),
            _numbers("chi2/dof", link.step_chi2.values[shown] / link.step_dof.values[shown], ".3f"),
            *(_numbers(str(n), v, ".4f") for n, v in zip(link.unknown.values, estimates.T, strict=False)),
        ]
        made.append(Table(columns, f"clip step by step ({chosen} sources dropped; * is the solution):"))
    return made


def _forecast_tables(plan: "xr.Dataset") -> list[Table]:
    """Return the errors of each stage and of each new epoch, and of each choice of sources."""
    attributes = plan.attrs

    def errors(names: Sequence[str], values: Any, title: str) -> Table:
        units = zip(plan.unknown.values, plan.unit.values, values.T, strict=True)
        return Table([_texts("", names), *(_numbers(str(n), v, ".5f", str(unit)) for n, unit, v in units)], title)

    names, values = list(map(str, plan.stage.values)), plan.error.values
    if "error_with_epoch" in plan:
        names += [f"all observed at {epoch:g}" for epoch in plan.new_epoch.values]
        values = np.concatenate([values, plan.error_with_epoch.values])
    made = [errors(names, values, f"formal errors, orientation at {attributes['epoch_of_forecast']:.2f}")]
    if "step_source" in plan:
        chosen = [
            "none",
            *(f"{step} {name}" for step, name in enumerate(plan.step_source.values.tolist()[1:], start=1)),
        ]
        title = f"chosen for {attributes['goal']} (criterion {attributes['criterion']}):"
        made.append(errors(chosen, plan.step_error.values, title))
    return made
