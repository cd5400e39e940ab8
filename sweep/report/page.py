"""The page: sections and citations in a template, and a policy that allows its own scripts and no others."""

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any
from uuid import uuid4

import xarray as xr
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from linksweep.sweep.analysis.compare_tables import summary_line
from linksweep.sweep.contract import SweepError
from linksweep.sweep.plots.figure import is_link
from linksweep.sweep.report.explorer import MOST_NUMBERS, library
from linksweep.sweep.report.link_section import link_section
from linksweep.sweep.report.section import Section, section
from linksweep.sweep.stores.location import Where, located
from linksweep.sweep.stores.store import open_dataset
from linksweep.sweep.studies.record import CITATION
from linksweep.sweep.tie.stored import result_at

MARK = "<!doctype html>\n<!-- linksweep report -->\n"
"""The beginning of every report: a file that does not begin with it is not replaced."""

TEMPLATES = "templates"

CITATION_FILE = "CITATION.cff"

MESSAGE = "If you use these results, please cite what made them."


def report_of(stores: Sequence[Where]) -> str:
    """Return the page about stores; raises SweepError for a store that is missing, empty or damaged."""
    datasets = []
    for place in map(located, stores):
        result = result_at(place)
        datasets.append((place.name, open_dataset(place) if result is None else result))
    return report_page(datasets)


def report_page(datasets: Sequence[tuple[str, xr.Dataset]]) -> str:
    """Return one HTML page about named datasets of results, the same for the same datasets."""
    sections: list[Section] = []
    room = MOST_NUMBERS
    for number, (name, dataset) in enumerate(datasets):
        try:
            one = link_section(name, dataset, number) if is_link(dataset) else section(name, dataset, number, room)
        except SweepError as error:
            raise SweepError(error.problems, error.where or name) from error
        sections.append(one)
        room -= one.numbers
    explored = any(one.explorer["quantities"] for one in sections)
    scripts = [library(), _file("page.js"), _file("explorer.js")] if explored else [_file("page.js")]
    pages = PackageLoader("linksweep.sweep.report", TEMPLATES)
    environment = Environment(
        loader=pages, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    versions = list(dict.fromkeys(one.version for one in sections))
    body = environment.get_template("page.html.j2").render(
        sections=sections,
        explored=explored,
        totals=_totals(sections),
        policy=_policy(scripts),
        style=Markup(_file("page.css")),
        scripts=[Markup(script) for script in scripts],
        cite=[citations(version)[1] for version in versions],
        cite_first=_cited([dataset for _, dataset in datasets], versions[0]),
        cite_message=_citation_file()["message"] if any(_is_ours(dataset) for _, dataset in datasets) else MESSAGE,
    )
    return MARK + body


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


def _totals(sections: Sequence[Section]) -> list[str]:
    """Return sentences about all sections together."""
    comparisons = [comparison for one in sections for comparison in one.comparisons]
    open_ones = sum(bool(one.gaps) for one in sections)
    sentences = [f"Published numbers and claims: {summary_line(comparisons)}."] if comparisons else []
    return [*sentences, f"Incomplete: {open_ones} of {len(sections)} studies."] if open_ones else sentences


def _is_ours(dataset: xr.Dataset) -> bool:
    """Return whether results are of what comes with linksweep."""
    return is_link(dataset) or str(dataset.attrs.get("experiment", "linksweep.")).startswith("linksweep.")


def _cited(datasets: Sequence[xr.Dataset], version: str) -> list[str]:
    """Return what to cite besides the software: what experiments ask for, and the paper for our own."""
    found: list[str] = []
    for dataset in datasets:
        own = citations(version)[:1] if _is_ours(dataset) else json.loads(dataset.attrs.get(CITATION, "[]"))
        found += [text for text in own if text not in found]
    return found


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
    names = [a["name"] if "name" in a else f"{a['family-names']}, {a['given-names'][0]}." for a in authors]
    return " & ".join(names)


def _file(name: str) -> str:
    return (files("linksweep.sweep.report") / TEMPLATES / name).read_text(encoding="utf-8")


def _policy(scripts: Sequence[str]) -> str:
    """Return the policy that a browser enforces: these scripts and no others, no network, styles of this page only.

    BokehJS and the pictures need inline styles; the icons of BokehJS, and clouds of points, are images in the page.
    """
    digests = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    rest = "style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    return f"default-src 'none'; script-src {allowed}; {rest}"
