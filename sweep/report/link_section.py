"""What a page says about a link of real tables, or about a forecast."""

from collections.abc import Iterable
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.answer import Answer
from linksweep.sweep.formatting import with_error
from linksweep.sweep.report.figures import link_pictures
from linksweep.sweep.report.section import Section, Table

STEPS_SHOWN = 40

PROVENANCE = {
    "satellite": "satellite",
    "satellite_sha256": "its SHA-256",
    "reference": "reference",
    "reference_sha256": "SHA-256 of the reference",
    "sign": "sign",
    "epoch": "epoch of the orientation",
    "epoch_of_forecast": "epoch of the orientation in the forecast",
    "matched_by": "matched by",
    "clip": "clip",
    "weights": "weights",
    "known_spin": "spin taken out",
    "aberration_uas_yr": "Galactic aberration taken out [uas/yr]",
    "jitter": "jitter",
    "release": "release",
    "from_release": "scaled from release",
    "new_error_mas": "error of new positions [mas]",
    "goal": "chosen for",
    "criterion": "criterion",
}
"""Attributes of a dataset and their names in a page."""


def link_section(store: str, dataset: xr.Dataset, number: int) -> Section:
    """Return the section of a link or a forecast, the ``number``-th of a page."""
    is_tie = dataset.attrs["result"] == "tie"
    satellite, reference = (Path(str(dataset.attrs[name])).name for name in ("satellite", "reference"))
    answers = [_link_answer(dataset) if is_tie else _forecast_answer(dataset)]
    if notes := [str(note) for note in np.atleast_1d(dataset.attrs["notes"])]:
        answers.append(Answer("Warnings", "", [f"{note[0].upper()}{note[1:]}." for note in notes]))
    known = {label: str(dataset.attrs[key]) for key, label in PROVENANCE.items() if dataset.attrs.get(key, "") != ""}
    title = f"{'Link' if is_tie else 'Forecast of the link'} of {satellite} and {reference}"
    return Section(
        store=store,
        title=title,
        answers=answers,
        pictures=link_pictures(dataset, number),
        results=_unknowns(dataset) if is_tie else _error_table("stage", dataset, dataset["stage"].values, "error"),
        caption=f"{dataset.attrs['sign'].replace('-', ' − ')}, with every kind of error" if is_tie else "Formal errors",
        tables=_link_tables(dataset) if is_tie else _forecast_tables(dataset),
        provenance=known,
        version=version("linksweep"),
    )


def _link_answer(link: xr.Dataset) -> Answer:
    main = str(link["error_kind"].values[0])
    vectors = []
    for block in dict.fromkeys(link["block"].values.tolist()):
        part = link.isel(unknown=link["block"].values == block)
        if part.sizes["unknown"] <= 3:
            values = ", ".join(map(with_error, part["estimate"].values, part["error"].values))
            name = str(block).replace("_", " ")
            vectors.append(f"{name[0].upper()}{name[1:]}: ({values}) {part['unit'].values[0]}, {main} errors.")
    ratio = float(link["chi2"] / link["chi2_expected"]) if float(link["chi2_expected"]) > 0.0 else np.nan
    clip = "there was no clip" if link.attrs["clip"] == "none" else f"the clip is {link.attrs['clip']}"
    sentences = [
        f"The sign is {link.attrs['sign'].replace('-', ' − ')}; the orientation is that of {link.attrs['epoch']:.2f}.",
        *vectors,
        f"{int(link['n_sources'])} of {int(link['n_sources_matched'])} sources were used, matched by "
        f"{link.attrs['matched_by']}; {clip}.",
        f"χ² is {float(link['chi2']):.6g} where {float(link['chi2_expected']):.6g} is expected ({ratio:.3g} times), "
        f"with {float(link['dof']):.0f} degrees of freedom.",
    ]
    return Answer("The link", "", sentences)


def _forecast_answer(plan: xr.Dataset) -> Answer:
    sentences = []
    for stage in plan["stage"].values:
        errors = plan["error"].sel(stage=stage).values
        for block in dict.fromkeys(plan["block"].values.tolist()):
            part = plan["block"].values == block
            largest = float(np.max(errors[part]))
            unit = str(plan["unit"].values[part][0])
            sentences.append(f"{str(stage).capitalize()}: largest error of {block} {largest:.4g} {unit}.")
    if "step_source" in plan:
        names = ", ".join(str(name) for name in plan["step_source"].values[1:])
        sentences.append(f"Chosen for {plan.attrs['goal']} (criterion {plan.attrs['criterion']}): {names}.")
    return Answer("The forecast", "formal errors", sentences)


def _unknowns(link: xr.Dataset) -> Table:
    kinds = [str(kind) for kind in link["error_kind"].values]
    numbers = np.vstack([link["estimate"].values, link["errors"].values]).T.tolist()
    unknowns = zip(link["unknown"].values, numbers, link["unit"].values, strict=True)
    rows = [[_cell(name), *(_cell(v, ".5f") for v in values), _cell(unit)] for name, values, unit in unknowns]
    return Table(["unknown", "estimate", *(f"{kind} error" for kind in kinds), "unit"], rows)


def _link_tables(link: xr.Dataset) -> dict[str, Table]:
    found = {}
    if "power" in link:
        rows = []
        for field, degree in product(link["field"].values, link["degree"].values.tolist()):
            one = link.sel(field=field, degree=degree)
            values = [float(one[name]) for name in ("power", "power_noise", "power_chi2", "power_probability")]
            if np.isfinite(values[0]):
                rows.append([_cell(field), _cell(degree), *(_cell(value, ".4g") for value in values)])
        headings = ["field", "degree", "power [mas²]", "noise [mas²]", "χ²", "probability by chance"]
        found["Power of the vector spherical harmonics (of motions mas²/yr²)"] = Table(headings, rows)
    if "step_estimate" in link and link.sizes["step"] > 1:
        chosen = int(link["step_chosen"])
        labels = [str(name) for name in link["unknown"].values[:6]]
        count = min(link.sizes["step"], max(chosen + 3, STEPS_SHOWN))
        rows = []
        for step in range(count):
            ratio = float(link["step_chi2"].values[step] / link["step_dof"].values[step])
            values = link["step_estimate"].values[step][:6].tolist()
            mark = "the solution" if step == chosen else ""
            cells = [_cell(ratio, ".4g"), *(_cell(value, ".4f") for value in values), _cell(mark)]
            rows.append([_cell(step), _cell(str(link["step_dropped"].values[step])), *cells])
        headings = ["step", "dropped", "χ²/dof", *labels, ""]
        found["Steps of the clip"] = Table(headings, rows, link.sizes["step"] - count)
    return found


def _forecast_tables(plan: xr.Dataset) -> dict[str, Table]:
    found = {}
    if "error_with_epoch" in plan:
        names = [f"{epoch:g}" for epoch in plan["new_epoch"].values]
        found["One more position of each source"] = _error_table("epoch", plan, names, "error_with_epoch")
    if "step_source" in plan:
        names = ["none", *plan["step_source"].values[1:]]
        caption = f"Chosen one after the other for {plan.attrs['goal']}"
        found[caption] = _error_table("observed", plan, names, "step_error")
    return found


def _error_table(what: str, plan: xr.Dataset, names: Iterable[str], errors: str) -> Table:
    units = zip(plan["unknown"].values, plan["unit"].values, strict=True)
    values = zip(names, plan[errors].values.tolist(), strict=True)
    rows = [[_cell(name), *(_cell(v, ".5f") for v in row)] for name, row in values]
    return Table([what, *(f"{name} [{unit}]" for name, unit in units)], rows)


def _cell(value: Any, form: str = "") -> tuple[str, Any]:
    return format(value, form), value
