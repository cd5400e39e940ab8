"""What a page says about one store."""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import xarray as xr

from linksweep.sweep.analysis import sensitivity_tables as tables
from linksweep.sweep.analysis.answer import Answer, answer_in_short, answers, completeness, said_first
from linksweep.sweep.analysis.columns import Column
from linksweep.sweep.analysis.compare import Comparison, caveats, compare, in_readable_unit
from linksweep.sweep.analysis.compare_tables import notes, numbers_in_words, summary_line
from linksweep.sweep.analysis.components import condition_warning
from linksweep.sweep.analysis.gaps import with_nan
from linksweep.sweep.analysis.headline_table import headline_columns, rows_left_out, tables_with_errors, warnings_of
from linksweep.sweep.analysis.quantity import headlines, varied_parameters
from linksweep.sweep.analysis.readable_units import in_readable_units
from linksweep.sweep.analysis.selection import place_in_words
from linksweep.sweep.analysis.sensitivity import sensitivity
from linksweep.sweep.contract import SweepError
from linksweep.sweep.formatting import with_micro_signs, written
from linksweep.sweep.planning.point_status import Status, count_status
from linksweep.sweep.report.explorer import explorer
from linksweep.sweep.report.figures import Picture, drawn, pictures
from linksweep.sweep.studies.record import FUNCTION, outer_draw_of
from linksweep.sweep.studies.study import POINT_TABLE

SEVERITY = ("NOT reproduced", "incomplete", "within tolerance", "not comparable", "reproduced")
"""The order of verdicts in the table: those that need attention come first."""

MOST_ROWS = 2000
"""The most rows of a table in the page, some 0.5 MB."""

PROVENANCE = {
    "study_name": "study",
    "study_overrides": "changed on the command line",
    "experiment": "experiment",
    "seed": "seed",
    "n_sim": "realisations of each catalogue",
    "n_cat": "catalogues of each point",
    "precision": "precision wanted",
    "common_random_numbers": "common random numbers",
    "points": "points",
    "points_done": "points done",
    "study_digest": "digest of the study",
    "command": "command",
    "started": "started",
    "finished": "last written",
    "host": "host",
    "machine": "machine",
    "git_commit": "git commit of linksweep",
}
"""Attributes of a dataset and their names in a page."""


@dataclass(frozen=True)
class Table:
    """A sortable table: headings, and rows of (text, value to sort by)."""

    headings: list[str]
    rows: list[list[tuple[str, Any]]]
    left_out: int = 0


@dataclass(frozen=True)
class Section:
    """All that a page says about one store; every string in it is text, except for the SVG of ``pictures``."""

    store: str
    title: str
    answers: list[Answer]
    pictures: list[Picture]
    results: Table
    caption: str
    tables: Mapping[str, Table]
    provenance: Mapping[str, str]
    version: str
    question: str = ""
    gaps: Sequence[str] = ()
    short: Sequence[str] = ()
    changed: str = ""
    comparisons: Sequence[Comparison] = ()
    verdicts: str = ""
    explorer: Mapping[str, Any] = field(default_factory=lambda: {"quantities": []})
    not_explored: Sequence[str] = ()
    numbers: int = 0
    comparison: Table | None = None
    notes: Sequence[str] = ()
    failures: Mapping[str, str] = field(default_factory=dict)
    failures_not_named: int = 0
    study: str = ""


def section(store: str, dataset: xr.Dataset, number: int, room: int) -> Section:
    """Return the section of a dataset, the ``number``-th of a page, with at most ``room`` numbers to explore.

    Raises SweepError for a dataset whose claims cannot be read.
    """
    names = headlines(dataset)
    comparisons = compare(dataset)
    explored, numbers, left_out = explorer(in_readable_units(with_nan(dataset)), names, room)
    indices = _indices(dataset, names)
    attributes = dataset.attrs
    failures = json.loads(attributes.get("failures", "{}"))
    versions = json.loads(attributes.get("versions", "{}"))
    known = {
        _worded(label, attributes): str(attributes[key])
        for key, label in PROVENANCE.items()
        if attributes.get(key, "") != ""
    }
    title = str(attributes.get("title", store))
    return Section(
        store=store,
        title=title,
        question=str(attributes.get("question", "")),
        gaps=completeness(dataset),
        short=[with_micro_signs(sentence) for sentence in answer_in_short(dataset)],
        answers=[replace(a, sentences=[with_micro_signs(s) for s in a.sentences]) for a in answers(dataset)],
        changed=str(attributes.get("study_overrides", "")),
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
        results=_table(headline_columns(dataset, MOST_ROWS), rows_left_out(dataset, MOST_ROWS)),
        caption="Headline results, ± their one-sigma errors",
        tables={
            f"{name}, {dataset[name.split()[0]].attrs['long_name']}, with every kind of error": _table(columns)
            for name, columns in tables_with_errors(dataset, MOST_ROWS).items()
        }
        | {
            f"Sensitivity of {name}: {tables.notes(one)[0]}": _table(tables.columns_of(one))
            for name, one in indices.items()
        },
        comparison=_comparison(comparisons) if comparisons else None,
        notes=[
            *warnings_of(dataset),
            *filter(None, [condition_warning(dataset)]),
            *notes(comparisons),
            *caveats(dataset),
        ],
        failures=failures,
        failures_not_named=count_status(dataset["status"].values)[Status.FAILED] - len(failures),
        provenance=known | {package: f"version {version}" for package, version in versions.items()},
        study=str(attributes.get("study", ""))  # a run from Python has no file
        or json.dumps(json.loads(attributes.get("study_document", "{}")), indent=1),
        version=str(versions.get("linksweep", "unknown")),
    )


def _indices(dataset: xr.Dataset, names: list[str]) -> dict[str, xr.Dataset]:
    """Return the sensitivity indices of those results of a table of points that have one number per point."""
    found: dict[str, xr.Dataset] = {}
    for name in names if POINT_TABLE in dataset.attrs and len(varied_parameters(dataset)) > 1 else ():
        if dataset[name].squeeze().ndim == 1:
            with suppress(SweepError):
                found[name] = sensitivity(dataset.squeeze(), name)
    return found


def _worded(label: str, attributes: Mapping[Any, Any]) -> str:
    """Return the name of an attribute, in the words of its experiment."""
    if FUNCTION in attributes:
        return label.replace("each catalogue", "each point").replace("catalogues of each point", "outer draws")
    return label.replace("catalogue", outer_draw_of(attributes))


def _table(columns: list[Column], left_out: int = 0) -> Table:
    repeated = Counter(c.name for c in columns)
    names = [f"{c.of} {c.name}" if repeated[c.name] > 1 and c.of != c.name else c.name for c in columns]
    headings = [f"{name} [{written(c.unit)}]" if c.unit else name for name, c in zip(names, columns, strict=True)]
    cells = (list(zip(c.cells, c.values, strict=True)) for c in columns)
    return Table(headings, [list(row) for row in zip(*cells, strict=True)], left_out)


def _in_allowances(c: Comparison) -> float:
    """Return the difference from the published number, in units of what is allowed."""
    return abs(c.difference) / c.allowance if c.allowance > 0.0 and math.isfinite(c.difference) else 0.0


def _comparison(comparisons: list[Comparison]) -> Table:
    headings = ["what", "where", "verdict", "computed", "published", "difference", "in percent", "allowance"]
    rows = []
    worst = sorted(comparisons, key=lambda c: (SEVERITY.index(c.verdict), -_in_allowances(c)))
    for c in map(in_readable_unit, worst):
        what = f"{c.what} [{written(c.unit)}]" if c.unit else c.what
        texts = [what, place_in_words(c.where), c.verdict, *numbers_in_words(c)]
        relative = c.difference / abs(c.published) if c.published else c.difference
        values = [what, texts[1], c.verdict, c.value, c.published, c.difference, relative, c.allowance]
        rows.append(list(zip(texts, values, strict=True)))
    return Table(headings, rows)
