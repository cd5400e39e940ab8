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
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version as version_of
from importlib.resources import files
from pathlib import Path
from typing import Any
from uuid import uuid4

import xarray as xr
import yaml
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from linksweep.sweep.analysis import answer, compare, derived, quantity, results_table
from linksweep.sweep.analysis.sensitivity import sensitivity
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import with_micro_signs, written
from linksweep.sweep.planning.point_status import Status, count_status
from linksweep.sweep.report.pictures import MOST_NUMBERS, drawn, explorer, link_pictures, pictures
from linksweep.sweep.result import Result, open_result
from linksweep.sweep.stores.location import Where, located
from linksweep.sweep.studies.record import CITATION
from linksweep.sweep.studies.study import POINT_TABLE
from linksweep.sweep.table_writer import Table

# The beginning of every report: a file that does not begin with it is not replaced.
MARK = "<!doctype html>\n<!-- linksweep report -->\n"
CITATION_FILE = "CITATION.cff"
SEVERITY = ("NOT reproduced", "incomplete", "within tolerance", "not comparable", "reproduced")  # what needs attention
MOST_ROWS = 2000  # of a table in the page, some 0.5 MB


# The page


def report_of(stores: Sequence[Where]) -> str:
    """Return the page about stores; raises SweepError for a store that is missing, empty or damaged."""
    return report_page([(place.name, open_result(place).dataset) for place in map(located, stores)])


def report_page(datasets: Sequence[tuple[str, xr.Dataset]]) -> str:
    """Return one HTML page about named datasets of results, the same for the same datasets."""
    sections: list[dict[str, Any]] = []
    room = MOST_NUMBERS
    for number, (name, dataset) in enumerate(datasets):
        try:
            result = Result(dataset)
            is_link = result.is_stored_table
            one = link_section(name, result, number) if is_link else section(name, dataset, number, room)
        except SweepError as error:
            raise SweepError(error.problems, error.where or name) from error
        sections.append(one)
        room -= one.get("numbers", 0)
    explored = any(one["explorer"]["quantities"] for one in sections)
    scripts = [_file("page.js")]
    if explored:  # the library needs no network and no server
        options: dict[str, Any] = {"minified": True, "log_level": "error", "components": ["bokeh", "bokeh-api"]}
        scripts = ["\n".join(Resources(mode="inline", **options).js_raw), *scripts, _file("explorer.js")]
    comparisons = [comparison for one in sections for comparison in one.get("comparisons", ())]
    versions = list(dict.fromkeys(one["version"] for one in sections))
    cited: list[str] = []
    ours = False
    for _, dataset in datasets:
        if str(dataset.attrs.get("experiment", "linksweep.")).startswith("linksweep."):
            cited, ours = [*cited, citations(versions[0])[0]], True
        else:
            cited += json.loads(dataset.attrs.get(CITATION, "[]"))
    options = {"autoescape": True, "trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=PackageLoader("linksweep.sweep.report"), **options)
    message = "If you use these results, please cite what made them."
    return MARK + environment.get_template("page.html.j2").render(
        sections=sections,
        explored=explored,
        verdicts=compare.summary_line(comparisons) if comparisons else "",
        unfinished=sum(bool(one.get("gaps")) for one in sections),
        policy=_policy(scripts),
        style=Markup(_file("page.css")),
        scripts=[Markup(script) for script in scripts],
        cite=list(dict.fromkeys([*cited, *(citations(version)[1] for version in versions)])),
        cite_message=_citation_file()["message"] if ours else message,
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


# Results of a study


def section(store: str, dataset: xr.Dataset, number: int, room: int) -> dict[str, Any]:
    """Return what the template shows of the results of a study, the ``number``-th of a page, with at most ``room``
    numbers to explore; raises SweepError for a dataset whose claims cannot be read.
    """
    about, names, comparisons = dataset.attrs, quantity.headlines(dataset), compare.compare(dataset)
    explored, numbers, left_out = explorer(quantity.in_readable_units(dataset), names, room)
    failures, versions = (json.loads(about.get(name, "{}")) for name in ("failures", "versions"))
    title = str(about.get("title", store))
    figures = pictures(dataset, list(dict.fromkeys([*answer.said_first(dataset), *names])), number)
    tables = {}
    for table in results_table.tables_with_errors(dataset, MOST_ROWS):
        meaning = dataset[table.title.split()[0]].attrs["long_name"]
        tables[f"{table.title}, {meaning}, with every kind of error"] = _sortable(table)
    for name in names if POINT_TABLE in about and len(quantity.varied_parameters(dataset)) > 1 else ():
        if dataset[name].squeeze().ndim == 1:  # one number at each point
            with suppress(SweepError):
                indices = sensitivity(dataset.squeeze(), name)
                tables[f"S{derived.notes(indices)[0][1:]}"] = _sortable(derived.tables(indices)[0])
                picture = drawn(indices.assign_attrs(title=""), f"sensitivity of {name}", f"{number}-{name}")
                figures.append(picture)
    warnings = filter(None, [*results_table.warnings_of(dataset), results_table.condition_warning(dataset)])
    return {
        "store": store,
        "title": title,
        "question": str(about.get("question", "")),
        "gaps": answer.completeness(dataset),
        "short": list(map(with_micro_signs, answer.answer_in_short(dataset))),
        "answers": [
            replace(one, sentences=list(map(with_micro_signs, one.sentences))) for one in answer.answers(dataset)
        ],
        "changed": str(about.get("study_overrides", "")),
        "comparisons": comparisons,
        "verdicts": compare.summary_line(comparisons) if comparisons else "",
        "pictures": figures,
        "explorer": explored | {"title": title},
        "not_explored": left_out,
        "numbers": numbers,
        "results": _sortable(
            results_table.headline_table(dataset, MOST_ROWS), results_table.rows_left_out(dataset, MOST_ROWS)
        ),
        "caption": "Headline results, ± their one-sigma errors",
        "tables": tables,
        "comparison": _sortable(compare.table(sorted(comparisons, key=_severity))) if comparisons else None,
        "notes": [*warnings, *compare.notes(comparisons), *compare.remarks(dataset)],
        "failures": failures,
        "failures_not_named": count_status(dataset["status"].values)[Status.FAILED] - len(failures),
        "provenance": _provenance("study", about) | {name: f"version {one}" for name, one in versions.items()},
        # a run from Python has no file
        "study": about.get("study") or json.dumps(json.loads(about.get("study_document", "{}")), indent=1),
        "version": str(versions.get("linksweep", "unknown")),
    }


def _severity(c: compare.Comparison) -> tuple[int, float]:
    """Return by what comparisons are sorted, the worst first: the verdict, and the difference in units of what is
    allowed.
    """
    known = c.allowance > 0.0 and math.isfinite(c.difference)
    return SEVERITY.index(c.verdict), -abs(c.difference) / c.allowance if known else 0.0


# Links of real tables and forecasts


def link_section(store: str, result: Result, number: int) -> dict[str, Any]:
    """Return what the template shows of a link or a forecast, the ``number``-th of a page."""
    first, *others = result.tables()
    answers = [answer.Answer("What it is", "", list(filter(None, first.title.splitlines())))]
    if notes := [note.removeprefix("note: ") for note in result.notes()]:
        answers.append(answer.Answer("Warnings", "", [note[0].upper() + note[1:] for note in notes]))
    return {
        "store": store,
        "title": result.title,
        "answers": answers,
        "pictures": link_pictures(result, number),
        "explorer": {"quantities": []},
        "results": _sortable(first),
        "caption": "Every unknown, with every kind of error",
        "tables": {table.title: _sortable(table) for table in others},
        "provenance": _provenance("link", result.dataset.attrs),
        "version": version_of("linksweep"),
    }


# What sections have in common


def _provenance(kind: str, attributes: Mapping[Any, Any]) -> dict[str, str]:
    """Return the attributes of a dataset that a page names, by their names there."""
    names = json.loads(_file("provenance.json"))[kind]
    return {label: str(attributes[key]) for key, label in names.items() if attributes.get(key, "") != ""}


def _sortable(table: Table, left_out: int = 0) -> dict[str, Any]:
    """Return the headings and rows of a table, whose cells are a text and the value to sort by."""
    repeated = Counter(column.name for column in table.columns)
    headings = []
    for column in table.columns:
        whole = repeated[column.name] > 1 and column.quantity != column.name
        name = f"{column.quantity} {column.name}" if whole else column.name
        headings.append(f"{name} [{written(column.unit)}]" if column.unit else name)
    cells = [
        [(text, text if hasattr(by, "tolist") else by) for text, by in zip(c.shown, c.values, strict=True)]
        for c in table.columns
    ]
    return {"headings": headings, "rows": list(zip(*cells, strict=True)), "left_out": left_out}
