"""One self-contained HTML page about results: a section for each store in a template, and a policy that allows its own
scripts and no others.

A section is a dictionary of what the template shows.  Every string in it is text, except for the SVG of its pictures.
"""

import base64
import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version as version_of
from importlib.resources import files
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import xarray as xr
import yaml
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from linksweep.sweep.analysis import derived, sensitivity
from linksweep.sweep.analysis.answer import Answer, answer_in_short, answers, completeness, said_first
from linksweep.sweep.analysis.compare import (
    Comparison,
    compare,
    in_readable_unit,
    notes,
    numbers_in_words,
    remarks,
    summary_line,
)
from linksweep.sweep.analysis.quantity import headlines, in_readable_units, place_in_words, varied_parameters
from linksweep.sweep.analysis.results_table import (
    condition_warning,
    headline_table,
    rows_left_out,
    tables_with_errors,
    warnings_of,
)
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import with_error, with_micro_signs, written
from linksweep.sweep.planning.point_status import Status, count_status
from linksweep.sweep.report.pictures import MOST_NUMBERS, drawn, explorer, link_pictures, pictures
from linksweep.sweep.result import STORED_TABLES, kind_of, open_result
from linksweep.sweep.stores.location import Where, located
from linksweep.sweep.studies.record import CITATION, FUNCTION, outer_draw_of
from linksweep.sweep.studies.study import POINT_TABLE
from linksweep.sweep.table_writer import Table

# The beginning of every report: a file that does not begin with it is not replaced.
MARK = "<!doctype html>\n<!-- linksweep report -->\n"
CITATION_FILE = "CITATION.cff"
SEVERITY = ("NOT reproduced", "incomplete", "within tolerance", "not comparable", "reproduced")  # what needs attention
MOST_ROWS = 2000  # of a table in the page, some 0.5 MB
MOST_STEPS = 40  # of a clip


# The page


def report_of(stores: Sequence[Where]) -> str:
    """Return the page about stores; raises SweepError for a store that is missing, empty or damaged."""
    datasets = []
    for place in map(located, stores):
        datasets.append((place.name, open_result(place).dataset))
    return report_page(datasets)


def report_page(datasets: Sequence[tuple[str, xr.Dataset]]) -> str:
    """Return one HTML page about named datasets of results, the same for the same datasets."""
    sections: list[dict[str, Any]] = []
    room = MOST_NUMBERS
    for number, (name, dataset) in enumerate(datasets):
        try:
            is_table = kind_of(dataset) in STORED_TABLES
            one = link_section(name, dataset, number) if is_table else section(name, dataset, number, room)
        except SweepError as error:
            raise SweepError(error.problems, error.where or name) from error
        sections.append(one)
        room -= one["numbers"]
    explored = any(one["explorer"]["quantities"] for one in sections)
    scripts = [_file("page.js")]
    if explored:  # the library needs no network and no server
        options: dict[str, Any] = {"minified": True, "log_level": "error", "components": ["bokeh", "bokeh-api"]}
        scripts = ["\n".join(Resources(mode="inline", **options).js_raw), *scripts, _file("explorer.js")]
    comparisons = [comparison for one in sections for comparison in one["comparisons"]]
    totals = [f"Published numbers and claims: {summary_line(comparisons)}."] if comparisons else []
    if unfinished := sum(bool(one["gaps"]) for one in sections):
        totals.append(f"Incomplete: {unfinished} of {len(sections)} studies.")
    versions = list(dict.fromkeys(one["version"] for one in sections))
    # whether results are of what comes with linksweep
    ours = [str(dataset.attrs.get("experiment", "linksweep.")).startswith("linksweep.") for _, dataset in datasets]
    cited = [
        citations(versions[0])[:1] if is_ours else json.loads(dataset.attrs.get(CITATION, "[]"))
        for is_ours, (_, dataset) in zip(ours, datasets, strict=True)
    ]
    options = {"autoescape": True, "undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=PackageLoader("linksweep.sweep.report"), **options)
    message = "If you use these results, please cite what made them."
    return MARK + environment.get_template("page.html.j2").render(
        sections=sections,
        explored=explored,
        totals=totals,
        policy=_policy(scripts),
        style=Markup(_file("page.css")),
        scripts=[Markup(script) for script in scripts],
        cite=[citations(version)[1] for version in versions],
        cite_first=list(dict.fromkeys(text for texts in cited for text in texts)),
        cite_message=_citation_file()["message"] if any(ours) else message,
    )


def default_path(stores: Sequence[Where]) -> Path:
    """Return the default path of a report: named after its store, in the working directory."""
    names = [located(store).name for store in stores]
    stem = names[0].removesuffix(".zarr") if len(names) == 1 else "linksweep"
    return Path(f"{stem}-report.html")


def check_output(path: Path) -> None:
    """Raise SweepError unless a report can be written to a path: a new file or an earlier report in a folder."""
    try:
        if path.is_dir():
            raise SweepError("is a directory; give the name of a file with -o", str(path))
        if path.exists():
            with path.open("rb") as file:
                if file.read(len(MARK)) != MARK.encode():
                    raise SweepError("exists and is no report of linksweep; give another name with -o", str(path))
        if not path.parent.is_dir():
            raise SweepError("cannot be written: its directory does not exist", str(path))
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error


def write_report(page: str, path: Path) -> None:
    """Write a page, whole or not at all, to a new file or over an earlier report; raises SweepError if it cannot."""
    check_output(path)
    partial = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        partial.write_text(page, encoding="utf-8", errors="backslashreplace", newline="\n")
        os.replace(partial, path)
    except OSError as error:
        raise SweepError(f"cannot be written: {error.strerror or error}", str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


def citations(version: str) -> tuple[str, str]:
    """Return what to cite, in words: the paper, and the software in the version that made the results."""
    software = _citation_file()
    paper = software["preferred-citation"]
    place = f"{paper['journal']} {paper['volume']}, {paper['start']}"
    return (
        f"{_people(paper['authors'])} ({paper['year']}). {paper['title']}. {place}",
        f"{_people(software['authors'])}. {software['title']}, version {version}. {software['license']}",
    )


def _citation_file() -> Any:
    """Return the contents of the citation file: in the wheel it is beside the modules, in a checkout above them."""
    installed = Path(str(files("linksweep") / CITATION_FILE))
    path = installed if installed.is_file() else Path(__file__).resolve().parents[2] / CITATION_FILE
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _people(authors: Sequence[Mapping[str, str]]) -> str:
    return " & ".join(a["name"] if "name" in a else f"{a['family-names']}, {a['given-names'][0]}." for a in authors)


def _file(name: str) -> str:
    return (files("linksweep.sweep.report") / "templates" / name).read_text(encoding="utf-8")


def _policy(scripts: Sequence[str]) -> str:
    """Return the policy that a browser enforces: these scripts and no others, no network, styles of this page only.

    BokehJS and the pictures need inline styles; the icons of BokehJS, and clouds of points, are images in the page.
    """
    digests = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    rest = "style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    return f"default-src 'none'; script-src {allowed}; {rest}"


# What sections have in common


def _section(store: str, title: str, **known: Any) -> dict[str, Any]:
    """Return what the template needs to know of a store: what is known, and nothing of all else."""
    nothing: dict[str, Any] = dict.fromkeys(("question", "changed", "verdicts", "study"), "")
    nothing |= dict.fromkeys(("gaps", "short", "comparisons", "not_explored", "notes"), ())
    nothing |= {"explorer": {"quantities": []}, "numbers": 0, "comparison": None, "failures": {}}
    return {"store": store, "title": title, **nothing, "failures_not_named": 0, **known}


def _provenance(kind: str, attributes: Mapping[Any, Any]) -> dict[str, str]:
    """Return the attributes of a dataset that a page names, by their names there."""
    names = json.loads(_file("provenance.json"))[kind]
    return {label: str(attributes[key]) for key, label in names.items() if attributes.get(key, "") != ""}


def _table(columns: Mapping[str, Sequence[tuple[str, Any]]], left_out: int = 0) -> dict[str, Any]:
    """Return a sortable table of columns by heading, whose cells are a text and the value to sort by."""
    return {"headings": list(columns), "rows": list(zip(*columns.values(), strict=True)), "left_out": left_out}


def _cells(values: Any, form: str = "") -> list[tuple[str, Any]]:
    return [(format(value, form), value) for value in np.asarray(values).tolist()]


# Results of a study


def section(store: str, dataset: xr.Dataset, number: int, room: int) -> dict[str, Any]:
    """Return the section of the results of a study, the ``number``-th of a page, with at most ``room`` numbers to
    explore; raises SweepError for a dataset whose claims cannot be read.
    """
    names, about, comparisons = headlines(dataset), dataset.attrs, compare(dataset)
    explored, numbers, left_out = explorer(in_readable_units(dataset), names, room)
    indices = _indices(dataset, names)
    failures, versions = (json.loads(about.get(name, "{}")) for name in ("failures", "versions"))
    title = str(about.get("title", store))
    tables = {
        f"{one.title}, {dataset[one.title.split()[0]].attrs['long_name']}, with every kind of error": _of_columns(one)
        for one in tables_with_errors(dataset, MOST_ROWS)
    }
    tables |= {f"S{derived.notes(one)[0][1:]}": _of_columns(derived.tables(one)[0]) for one in indices.values()}
    condition = condition_warning(dataset)
    return _section(
        store,
        title,
        question=str(about.get("question", "")),
        gaps=completeness(dataset),
        short=[with_micro_signs(sentence) for sentence in answer_in_short(dataset)],
        answers=[replace(a, sentences=[with_micro_signs(s) for s in a.sentences]) for a in answers(dataset)],
        changed=str(about.get("study_overrides", "")),
        comparisons=comparisons,
        verdicts=summary_line(comparisons) if comparisons else "",
        pictures=[
            *pictures(dataset, list(dict.fromkeys([*said_first(dataset), *names])), number),
            *(
                drawn(one.assign_attrs(title=""), f"sensitivity of {name}", f"{number}-s{i}")
                for i, (name, one) in enumerate(indices.items())
            ),
        ],
        explorer=explored | {"title": title},
        not_explored=left_out,
        numbers=numbers,
        results=_of_columns(headline_table(dataset, MOST_ROWS), rows_left_out(dataset, MOST_ROWS)),
        caption="Headline results, ± their one-sigma errors",
        tables=tables,
        comparison=_comparison(comparisons) if comparisons else None,
        notes=[*warnings_of(dataset), *([condition] if condition else []), *notes(comparisons), *remarks(dataset)],
        failures=failures,
        failures_not_named=count_status(dataset["status"].values)[Status.FAILED] - len(failures),
        provenance={_worded(label, about): text for label, text in _provenance("study", about).items()}
        | {package: f"version {version}" for package, version in versions.items()},
        study=str(about.get("study", ""))  # a run from Python has no file
        or json.dumps(json.loads(about.get("study_document", "{}")), indent=1),
        version=str(versions.get("linksweep", "unknown")),
    )


def _indices(dataset: xr.Dataset, names: list[str]) -> dict[str, xr.Dataset]:
    """Return the sensitivity indices of those results of a table of points that have one number per point."""
    indices: dict[str, xr.Dataset] = {}
    for name in names if POINT_TABLE in dataset.attrs and len(varied_parameters(dataset)) > 1 else ():
        if dataset[name].squeeze().ndim == 1:
            with suppress(SweepError):
                indices[name] = sensitivity.sensitivity(dataset.squeeze(), name)
    return indices


def _worded(label: str, attributes: Mapping[Any, Any]) -> str:
    """Return the name of an attribute, in the words of its experiment."""
    if FUNCTION in attributes:
        return label.replace("each catalogue", "each point").replace("catalogues of each point", "outer draws")
    return label.replace("catalogue", outer_draw_of(attributes))


def _of_columns(table: Table, left_out: int = 0) -> dict[str, Any]:
    columns = table.columns
    repeated = Counter(c.name for c in columns)
    names = [f"{c.quantity} {c.name}" if repeated[c.name] > 1 and c.quantity != c.name else c.name for c in columns]
    headings = [f"{name} [{written(c.unit)}]" if c.unit else name for name, c in zip(names, columns, strict=True)]
    cells = [list(zip(c.shown, c.values, strict=True)) for c in columns]
    return _table(dict(zip(headings, cells, strict=True)), left_out)


def _comparison(comparisons: list[Comparison]) -> dict[str, Any]:
    """Return the table of published numbers and claims, the worst first, by their difference in units of what is
    allowed.
    """

    def severity(c: Comparison) -> tuple[int, float]:
        known = c.allowance > 0.0 and math.isfinite(c.difference)
        return SEVERITY.index(c.verdict), -abs(c.difference) / c.allowance if known else 0.0

    rows = []
    for c in map(in_readable_unit, sorted(comparisons, key=severity)):
        words = [f"{c.what} [{written(c.unit)}]" if c.unit else c.what, place_in_words(c.where), c.verdict]
        relative = c.difference / abs(c.published) if c.published else c.difference
        values = [*words, c.value, c.published, c.difference, relative, c.allowance]
        rows.append(list(zip([*words, *numbers_in_words(c)], values, strict=True)))
    headings = ["what", "where", "verdict", "computed", "published", "difference", "in percent", "allowance"]
    return _table(dict(zip(headings, map(list, zip(*rows, strict=True)), strict=True)))


# Links of real tables and forecasts


def link_section(store: str, dataset: xr.Dataset, number: int) -> dict[str, Any]:
    """Return the section of a link or a forecast, the ``number``-th of a page."""
    about = dataset.attrs
    is_tie, sign = about["result"] == "tie", str(about.get("sign", "")).replace("-", " − ")
    satellite, reference = (Path(str(about[name])).name for name in ("satellite", "reference"))
    found = [_link_answer(dataset, sign) if is_tie else _forecast_answer(dataset)]
    if remarks := [str(note) for note in np.atleast_1d(about["notes"])]:
        found.append(Answer("Warnings", "", [f"{note[0].upper()}{note[1:]}." for note in remarks]))
    return _section(
        store,
        f"{'Link' if is_tie else 'Forecast of the link'} of {satellite} and {reference}",
        answers=found,
        pictures=link_pictures(dataset, number),
        results=_unknowns(dataset) if is_tie else _errors("stage", dataset, dataset["stage"].values, "error"),
        caption=f"{sign}, with every kind of error" if is_tie else "Formal errors",
        tables=_link_tables(dataset) if is_tie else _forecast_tables(dataset),
        provenance=_provenance("link", about),
        version=version_of("linksweep"),
    )


def _link_answer(link: xr.Dataset, sign: str) -> Answer:
    about, vectors = link.attrs, []
    for block in dict.fromkeys(link["block"].values.tolist()):
        part = link.isel(unknown=link["block"].values == block)
        if part.sizes["unknown"] <= 3:
            values = ", ".join(map(with_error, part["estimate"].values, part["error"].values))
            name, unit = str(block).replace("_", " "), part["unit"].values[0]
            vectors.append(f"{name[0].upper()}{name[1:]}: ({values}) {unit}, {link['error_kind'].values[0]} errors.")
    chi2, expected = float(link["chi2"]), float(link["chi2_expected"])
    clip = "there was no clip" if about["clip"] == "none" else f"the clip is {about['clip']}"
    sentences = [
        f"The sign is {sign}; the orientation is that of {about['epoch']:.2f}.",
        *vectors,
        f"{int(link['n_sources'])} of {int(link['n_sources_matched'])} sources were used, matched by "
        f"{about['matched_by']}; {clip}.",
        f"χ² is {chi2:.6g} where {expected:.6g} is expected ({chi2 / expected if expected > 0.0 else np.nan:.3g} "
        f"times), with {float(link['dof']):.0f} degrees of freedom.",
    ]
    return Answer("The link", "", sentences)


def _forecast_answer(plan: xr.Dataset) -> Answer:
    about = plan.attrs
    sentences = [f"Errors are formal; the orientation is that of {about['epoch_of_forecast']:.2f}."]
    if "step_source" in plan:
        names = ", ".join(str(name) for name in plan["step_source"].values[1:])
        sentences.append(f"Chosen for {about['goal']} (criterion {about['criterion']}): {names}.")
    return Answer("The forecast", "formal errors", sentences)


def _unknowns(link: xr.Dataset) -> dict[str, Any]:
    errors = zip(link["error_kind"].values, link["errors"].values, strict=True)
    columns = {"unknown": _cells(link["unknown"]), "estimate": _cells(link["estimate"], ".5f")}
    columns |= {f"{kind} error": _cells(values, ".5f") for kind, values in errors}
    return _table(columns | {"unit": _cells(link["unit"])})


def _link_tables(link: xr.Dataset) -> dict[str, dict[str, Any]]:
    tables = {}
    if "power" in link:
        rows = link[["power", "power_noise", "power_chi2", "power_probability"]].stack(row=("field", "degree"))
        rows = rows.isel(row=np.isfinite(rows["power"].values))
        headings = ["power [mas²]", "noise [mas²]", "χ²", "probability by chance"]
        numbers = {head: _cells(rows[name], ".4g") for head, name in zip(headings, rows.data_vars, strict=True)}
        columns = {"field": _cells(rows["field"]), "degree": _cells(rows["degree"]), **numbers}
        tables["Power of the vector spherical harmonics (of motions mas²/yr²)"] = _table(columns)
    if "step_estimate" in link and link.sizes["step"] > 1:
        chosen = int(link["step_chosen"])
        steps = link.isel(step=slice(max(chosen + 3, MOST_STEPS)))
        count = steps.sizes["step"]
        estimates = zip(link["unknown"].values[:6], steps["step_estimate"].values.T, strict=False)
        columns = {"step": _cells(range(count)), "dropped": _cells(steps["step_dropped"].values.astype(str))}
        columns["χ²/dof"] = _cells(steps["step_chi2"].values / steps["step_dof"].values, ".4g")
        columns |= {str(name): _cells(values, ".4f") for name, values in estimates}
        columns[""] = _cells(["the solution" if step == chosen else "" for step in range(count)])
        tables["Steps of the clip"] = _table(columns, link.sizes["step"] - count)
    return tables


def _forecast_tables(plan: xr.Dataset) -> dict[str, dict[str, Any]]:
    tables = {}
    if "error_with_epoch" in plan:
        epochs = [f"{epoch:g}" for epoch in plan["new_epoch"].values]
        tables["One more position of each source"] = _errors("epoch", plan, epochs, "error_with_epoch")
    if "step_source" in plan:
        names = ["none", *plan["step_source"].values[1:]]
        caption = f"Chosen one after the other for {plan.attrs['goal']}"
        tables[caption] = _errors("observed", plan, names, "step_error")
    return tables


def _errors(what: str, plan: xr.Dataset, names: Iterable[Any], errors: str) -> dict[str, Any]:
    unknowns = zip(plan["unknown"].values, plan["unit"].values, plan[errors].values.T, strict=True)
    numbers = {f"{name} [{unit}]": _cells(values, ".5f") for name, unit, values in unknowns}
    return _table({what: _cells(list(map(str, names))), **numbers})
