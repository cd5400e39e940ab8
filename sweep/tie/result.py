"""Links and forecasts as tables, and the sentences below them."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.contract import SweepError, p_value
from linksweep.sweep.formatting import in_short, prefixed, rounded, with_unit
from linksweep.sweep.table_writer import Column, Table

STEPS_SHOWN, UNKNOWNS_SHOWN = 10, 6  # how many steps of a clip a table has at least, and of how many unknowns
# By how unknowns of positions begin: those of motions, which move them in a year.
RATES = {"epsilon_": "omega_", "position_glide_": "glide_", "vsh_position_": "vsh_motion_"}
META = ("sign", "epoch", "clip", "epoch_of_forecast", "release")  # attributes in the head of an ECSV table


def headline(result: xr.Dataset) -> list[str]:
    """Return in a sentence how far a link turns and flows, with the components of these vectors and other unknowns; of
    a forecast the RMS error of each block of unknowns, now and with new observations.
    """
    units = dict(zip(result.block.values.tolist(), result.unit.values.tolist(), strict=True))
    parts = [(name, unit, np.flatnonzero(result.block.values == name)) for name, unit in units.items()]
    if "estimate" in result:
        words = ", ".join(filter(None, (_block_in_words(result, *part) for part in parts)))
        return [f"{words[:1].upper()}{words[1:]}; {result.error_kind.values[0]} errors."] if words else []
    errors = dict(zip(result.stage.values.tolist(), result.error.values, strict=True))
    if "step_source" in result:
        errors[f"the {result.sizes['step'] - 1} chosen"] = result.step_error.values[-1]
    sentences = []
    for name, unit, its in parts:
        texts = [f"{s} {in_short(np.sqrt(np.mean(e[its] ** 2)).item(), 0.0, unit)}" for s, e in errors.items()]
        sentences.append(f"RMS error of the {name.replace('_', ' ')}: {', '.join(texts)}.")
    return sentences


def _block_in_words(link: xr.Dataset, block: str, unit: str, its: Any) -> str:
    """Return the length of a vector with its components, or a single unknown; '' for others, which have a table."""
    names, values = link.unknown.values[its], link.estimate.values[its]
    if [str(name)[-2:] for name in names] != ["_x", "_y", "_z"]:
        single = with_unit(values[0], link.errors.values[0, its[0]], unit)
        return f"{names[0]} {single}" if len(names) == 1 else ""
    length, covariance = float(np.linalg.norm(values)), link.covariances.values[0][np.ix_(its, its)]
    error = float(np.sqrt(values @ covariance @ values)) / (length or 1.0)
    factor = prefixed(length, unit).factor
    components = ", ".join(rounded(factor * v, factor * error) for v in values.tolist())
    name = "turned by" if block == "orientation" else block.replace("_", " ")
    return f"{name} {with_unit(length, error, unit)} ({components})"


def tables(result: xr.Dataset) -> list[Table]:
    """Return the tables of a link or a forecast for reading.  The first has as its title what is needed to interpret
    them, in several lines.
    """
    return _link_tables(result) if "estimate" in result else _forecast_tables(result)


def notes(result: xr.Dataset) -> list[str]:
    """Return the warnings of a link or a forecast."""
    return [f"note: {note}" for note in np.atleast_1d(result.attrs["notes"]) if note != result.attrs.get("misfit")]


def records(result: xr.Dataset) -> Table:
    """Return the unknowns with estimate and every error, or with the error at each stage of a forecast; in JSON beside
    the whole dataset.
    """
    columns = [Column(name, result[name].values.astype(str).tolist()) for name in ("unknown", "unit")]
    columns += [Column("estimate", result["estimate"].values.tolist())] if "estimate" in result else []
    errors = result["errors"] if "errors" in result else result["error"]
    (kind,) = (str(dim) for dim in errors.dims if dim != "unknown")
    for name, values in zip(result[kind].values, errors.transpose(kind, "unknown").values, strict=True):
        columns.append(Column(f"error_{name}", values.tolist()))
    variables = {str(n): {"dims": list(map(str, v.dims)), "values": v.values} for n, v in result.data_vars.items()}
    coordinates = {str(name): result.coords[name].values for name in result.coords}
    about = {"attributes": result.attrs, "coordinates": coordinates, "variables": variables}
    return Table(columns, about=about, meta={name: result.attrs[name] for name in META if name in result.attrs})


def of_stars(link: xr.Dataset) -> Table:
    """Return a row for each source: chi2 and how many observations it is of, Cook's distance, shares of the weight, and
    how far the solution moves without it (mas, mas/yr); raises SweepError for a dataset without sources.
    """
    if "share" not in link:
        raise SweepError("no values of single sources here: only links have them, of not too many sources")
    frame = link[["discrepancy", "n_observations", "cook_distance"]].reset_coords(drop=True).to_dataframe()
    frame.insert(0, "q_over_n", frame["discrepancy"] / frame["n_observations"].where(frame["n_observations"] > 0))
    frame = frame.join(link["share"].to_pandas().add_prefix("share_"))
    shift = (link["estimate_without"] - link["estimate"]).reset_coords(drop=True).to_pandas().add_prefix("shift_")
    units = dict(zip(shift.columns, link["unit"].values.tolist(), strict=True))
    columns = frame.join(shift).reset_index().items()
    meta = {name: link.attrs[name] for name in META if name in link.attrs}
    return Table([Column(str(name), one.tolist(), unit=units.get(name, "")) for name, one in columns], meta=meta)


def _texts(name: str, values: Iterable[Any], left: bool = True) -> Column:
    return Column(name, [str(value) for value in values], left=left)


def _numbers(name: Any, values: Any, form: str, unit: str = "") -> Column:
    numbers = np.asarray(values).tolist()
    return Column(str(name), numbers, [format(number, form) for number in numbers], unit)


def _estimates(what: str, names: Any, estimate: Any, errors: Mapping[Any, Any], units: Any) -> list[Column]:
    shown = [_numbers("estimate", estimate, ".5f"), *(_numbers(kind, values, ".5f") for kind, values in errors.items())]
    return [_texts(what, names.values), *shown, _texts("unit", units.values)]


def difference(link: xr.Dataset, other: xr.Dataset) -> xr.Dataset:
    """Return one link minus another: ``estimate``, ``error`` and ``covariance`` of the unknowns of both, and chi2.

    Both are taken in the sign of the first, the orientation of the other at the epoch of the first.  The covariance is
    the sum of theirs, as of links that have no data in common; that of links of the same data is smaller.

    Args:
        link: what `tie` returned.
        other: what another `tie` returned.

    Returns:
        A dataset in mas and mas/yr with ``chi2`` of the difference, and the ``probability`` of a larger one by chance:
        that of Hotelling's T^2 if errors are scaled, or from the scatter of sources or cells; NaN for the latter of a
        link of an earlier version, which does not say of how many.

    Raises:
        SweepError: where the links have no unknown in common, or are beside other known ones, or the orientation of
            the other has another epoch and no spin.

    Example:
        >>> import linksweep
        >>> link = linksweep.tie("psrpi-de200", "timing-de200", "orientation")
        >>> float(difference(link, link).chi2)
        0.0
    """
    if any(one is None or "chi2_expected" not in one for one in (link, other)):
        raise SweepError("a difference is one of two links, which sweep tie -o writes")
    for name in ("known_orientation", "known_spin"):
        if len(known := {one.attrs.get(name, "none") for one in (link, other)}) > 1:
            raise SweepError(f"{name} is {' and '.join(sorted(known))}: estimates are beside it, solve with the same")
    labels, sign = other.unknown.values.tolist(), 1.0 if link.attrs["sign"] == other.attrs["sign"] else -1.0
    years, moved = link.attrs["epoch"] - other.attrs["epoch"], np.eye(len(labels))
    for name, rate in [(name, name.replace(old, new)) for name in labels for old, new in RATES.items() if old in name]:
        if rate in labels:
            moved[labels.index(name), labels.index(rate)] = years
        elif years:
            epochs = f"{link.attrs['epoch']:g} and {other.attrs['epoch']:g}"
            raise SweepError(f"{name} is at {epochs}, and the second has no {rate} to move it: solve at one epoch")
    both = [name for name in link.unknown.values.tolist() if name in labels]
    if not both:
        raise SweepError(f"the links have no unknown in common: {', '.join(link.unknown.values)}; {', '.join(labels)}")
    mine, theirs = link.unknown.to_index().get_indexer(both), [labels.index(name) for name in both]
    values = link.estimate.values[mine] - sign * (moved @ other.estimate.values)[theirs]
    there = (moved @ other.covariance.values @ moved.T)[np.ix_(theirs, theirs)]
    covariances = link.covariance.values[np.ix_(mine, mine)], there
    covariance, chi2, samples = covariances[0] + there, np.nan, np.inf
    if np.any(covariance):
        chi2 = float(values @ np.linalg.solve(covariance, values))
        parts = [np.linalg.solve(covariance, part) for part in covariances]
        inverse = 0.0  # of the degrees of freedom of a sum, Krishnamoorthy and Yu 2004
        for one, part in zip((link, other), parts, strict=True):
            square = np.trace(part @ part)
            if one.error.attrs["kind"] == "scaled":  # all of it by one number
                inverse += 2.0 * square / float(one.dof)
            else:
                number = float(one.samples[0]) if "samples" in one else np.nan
                inverse += (square + np.trace(part) ** 2) / (number - 1.0)
        samples = 1.0 + len(both) * (len(both) + 1) / inverse if inverse else np.inf
    return xr.Dataset(
        {
            "estimate": ("unknown", values),
            "error": ("unknown", np.sqrt(np.diag(covariance))),
            "covariance": (("unknown", "unknown_other"), covariance),
            "chi2": ((), chi2),
            "probability": ((), p_value(chi2, len(both), samples)),
        },
        coords={"unknown": both, "unit": ("unknown", link.unit.values[mine])},
        attrs={"sign": link.attrs["sign"], "epoch": link.attrs["epoch"]},
    )


def of_difference(made: xr.Dataset) -> Table:
    """Return the table of a difference of links."""
    about = {name: made[name].item() for name in ("chi2", "probability")} | made.attrs
    title = f"difference of the links, orientation at {about['epoch']:.2f}; chi2 {about['chi2']:.4g} of "
    title += f"{made.sizes['unknown']} unknowns, probability {about['probability']:.3g}"
    columns = _estimates("unknown", made.unknown, made.estimate, {"error": made.error.values}, made.unit)
    return Table(columns, title, about)


def _link_tables(link: xr.Dataset) -> list[Table]:
    about, sign = link.attrs, link.attrs["sign"]
    head = [
        *([f"warning: {about['misfit']}", ""] if about.get("misfit") else []),
        f"{sign.replace('-', ' - ')}, orientation at {about['epoch']:.2f}",
        f"{int(link.n_sources)} of {int(link.n_sources_matched)} sources, matched by {about['matched_by']}; "
        f"clip {about['clip']}; weights {about['weights']}",
    ]
    head += [f"{sign.replace('satellite', name).replace('-', ' - ')}: {p}" for name, p in about["missions"].items()]
    used = {name: about.get(f"{name}_columns") for name in ("satellite", "reference")}
    head += [f"columns of the {name}: {columns}" for name, columns in used.items() if columns]
    expected = f"{float(link.chi2_expected):.6g} is expected, {float(link.dof):.0f} degrees of freedom"
    head += [f"chi2 {float(link.chi2):.6g} where {expected}", ""]
    kinds = link.error_kind.values
    errors = dict(zip(kinds, link.errors.values, strict=True))
    made = [Table(_estimates("unknown", link.unknown, link.estimate, errors, link.unit), "\n".join(head))]
    if "amplitude" in link:
        errors = dict(zip(kinds, link.amplitude_errors.values, strict=True))
        columns = _estimates("amplitude", link.amplitude_name, link.amplitude, errors, link.amplitude_unit)
        made.append(Table(columns, "the harmonics as rotation R, glide G, electric and magnetic quadrupoles E and M"))
    if "noise" in link:
        columns = [_texts("rows:quantity", link.noise.values), _numbers("noise", link.noise_size, ".5f")]
        columns += [_numbers("error", link.noise_error, ".5f"), _texts("unit", link.noise_unit.values)]
        made.append(Table(columns, "noise beyond the stated errors, estimated by restricted maximum likelihood"))
    if "power" in link:
        forms = {"power": ".5g", "power_noise": ".5g", "power_chi2": ".2f", "power_probability": ".3g"}
        powers = link[[*forms]].to_dataframe().dropna(subset="power").reset_index()
        columns = [_texts("field", powers["field"]), _texts("degree", powers["degree"], left=False)]
        columns += [_numbers(name.removeprefix("power_"), powers[name], form) for name, form in forms.items()]
        made.append(Table(columns, "power of the vector spherical harmonics [mas2], of motions [mas2/yr2]"))
    if "step_estimate" in link and any(str(name) for name in link.step_dropped.values):
        chosen = int(link.step_chosen)
        steps = link.isel(step=slice(max(chosen + 3, STEPS_SHOWN)))
        marks = (f"{'*' if step == chosen else ' '}{step:4d}" for step in range(steps.sizes["step"]))
        estimates = zip(link.unknown.values[:UNKNOWNS_SHOWN], steps.step_estimate.values.T, strict=False)
        columns = [
            _texts("step", marks, left=False),
            _texts("dropped", steps.step_dropped.values),
            _numbers("chi2/dof", steps.step_chi2.values / steps.step_dof.values, ".3f"),
            *(_numbers(name, values, ".4f") for name, values in estimates),
        ]
        made.append(Table(columns, f"clip step by step ({chosen} sources dropped; * is the solution):"))
    return made


def _forecast_tables(plan: xr.Dataset) -> list[Table]:
    about = plan.attrs

    def errors(names: Iterable[Any], values: Any, title: str) -> Table:
        units = zip(plan.unknown.values, plan.unit.values, values.T, strict=True)
        return Table([_texts("", names), *(_numbers(n, column, ".5f", str(unit)) for n, unit, column in units)], title)

    names, values = list(plan.stage.values), plan.error.values
    if "error_with_epoch" in plan:
        names += [f"all observed at {epoch:g}" for epoch in plan.new_epoch.values]
        values = np.concatenate([values, plan.error_with_epoch.values])
    made = [errors(names, values, f"formal errors, orientation at {about['epoch_of_forecast']:.2f}")]
    if "step_source" in plan:
        chosen = [f"{step} {name}" for step, name in enumerate(plan.step_source.values.tolist())][1:]
        title = f"chosen for {about['goal']} (criterion {about['criterion']}):"
        made.append(errors(["none", *chosen], plan.step_error.values, title))
    return made
