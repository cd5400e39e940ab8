"""One self-contained HTML page about results: a section for each store in a template, and a policy that allows its own
scripts and no others; and the page of `sweep watch --web` about runs.

A section is a dictionary of what the template shows.  Every string in it is text, except for the SVG of its pictures:
their text stays text, and their colours follow the page's theme.
"""

import base64
import hashlib
import io
import json
import re
import secrets
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import metadata, resources
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any, NamedTuple
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

import numpy as np
import xarray as xr
import yaml
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader, Template
from matplotlib import collections, patheffects, rcParams, text
from matplotlib.figure import Figure

from linksweep.sweep import formatting
from linksweep.sweep.analysis import answer, compare, quantity, sensitivity, tables
from linksweep.sweep.contract import Status, SweepError, refused
from linksweep.sweep.planning.union import REFINED
from linksweep.sweep.plots import KINDS, figure as drawing, style
from linksweep.sweep.result import Result, open_result, write_at_once
from linksweep.sweep.running.progress import Reasons
from linksweep.sweep.running.status import SHARE, Tile, Watched, pause
from linksweep.sweep.stores.location import Where, file_named, located, reading
from linksweep.sweep.stores.store import is_new
from linksweep.sweep.studies.record import CITATION, FUNCTION
from linksweep.sweep.studies.study import POINT, POINT_TABLE
from linksweep.sweep.table_writer import Table

# Pictures are made for paper.  Those of one panel, at most so many inches wide, are scaled with letters of the same
# size, to be read on a phone; others are as wide as the page, and drawn once more, so many mm wide, for a phone.
ONE_PANEL, SHRINK, PAGE, NARROW = 6.4, 0.8, 10.3, 90.0

# The name of the figure of single estimates, which is also its caption.
SAMPLES = "kept samples of two components; the ellipses hold 68 and 95 % of a normal distribution"
SUFFIX = "from_prediction"

MOST_NUMBERS = 200_000  # in a page for all its interactive views together, some 4 MB


class Picture(NamedTuple):
    """A figure as SVG of a width in points, and perhaps of a narrow one, or a sentence that says why there is none."""

    name: str
    svg: str = ""
    width: float = 0.0
    problem: str = ""
    caption: str = ""
    description: str = ""
    narrow: str = ""


# Pictures


def pictures(dataset: xr.Dataset, variables: Sequence[str], number: int) -> list[Picture]:
    """Return the figures of variables that vary, each of the kind that suits it, and of their differences from a
    prediction; those of variables with errors of several kinds are of each component.

    That of the kept samples of a single point comes first.  Of a single point without samples those are drawn that have
    a prediction or a published number.  ``number`` makes the identifiers in them differ from those of other datasets.
    """
    dataset, status = dataset.assign_attrs(title=""), dataset["status"]
    alone, ordered = status.size == 1, POINT not in status.dims
    made = [drawn(dataset, SAMPLES, f"{number}-samples")] if alone and drawing.sampled(dataset) is not None else []
    if chosen := style.form_of(dataset).variable:
        made.append(drawn(dataset, chosen, f"{number}-chosen"))
    varying = [name for name in variables if _varies(dataset[name]) and name != chosen]
    if alone and not made and not varying:
        varying = [name for name in variables if {"predicted", "published"} & quantity.parts_of(dataset, name).keys()]
    for i, name in enumerate(varying):
        if errors := quantity.errors_beside(dataset, name):
            part = quantity.where_they_change(dataset, [name, *errors])
            for k, (title, _, one) in enumerate(quantity.components_of(part, name)):
                if _varies(one[name]):
                    made.append(drawn(one, title, f"{number}-{i}-{k}", (name,)))
        else:
            made.append(drawn(dataset, name, f"{number}-{i}", (name,)))
        residual = residuals(dataset, name) if ordered and _varies(dataset[name]) else None
        if residual is not None:
            words = f"{name} minus its prediction, in units of its one-sigma errors; the band is three of them"
            made.append(drawn(residual, words, f"{number}-{i}-residual", (f"{name}_{SUFFIX}",), "lines"))
    return made


def drawn(dataset: xr.Dataset, name: str, salt: str, variables: Sequence[str] = (), kind: str | None = None) -> Picture:
    """Return the figure that suits a dataset, or one of a given kind; ``salt`` makes the identifiers in it differ from
    those of other figures.
    """

    def draw(width: float | None = None) -> tuple[Figure, str]:
        with style.settings(width), warnings.catch_warnings():
            rcParams.update({"svg.hashsalt": f"linksweep-{salt}-{width}", "svg.fonttype": "none"})
            warnings.filterwarnings("ignore", message="Glyph")  # text stays text: the reader's fonts show it
            figure = drawing.draw_figure(dataset, kind, variables)
            figure.suptitle("")
            if width is None and figure.get_figwidth() <= ONE_PANEL:
                figure.set_size_inches(*(SHRINK * figure.get_size_inches()))
            elif width is None:
                figure.set_figwidth(max(PAGE, figure.get_figwidth()))
            return figure, _svg(figure)

    try:
        figure, svg = draw()
        narrow = draw(NARROW)[1] if figure.get_figwidth() > ONE_PANEL else ""
        words = f"{name}. {style.caption(figure, dataset) if 'status' in dataset else ''}".strip()
        about = style.description(figure, dataset)
        return Picture(name, svg, 72.0 * figure.get_figwidth(), "", words, about, narrow)
    except (SweepError, ValueError) as error:  # a ValueError: a symbol that is no formula
        is_curve = "status" in dataset and variables and quantity.own_dimensions(dataset, variables[0])
        dataset = quantity.without_excluded(dataset) if is_curve else dataset
        sizes = {str(d): n for d, n in dataset["status"].sizes.items() if n > 1 and d != POINT} if is_curve else {}
        if longest := max(sizes, key=lambda d: sizes[d], default=""):  # fewer curves may fit into one picture
            some = np.linspace(0, sizes[longest] - 1, (sizes[longest] + 1) // 2).round().astype(int)
            thinner = dataset.isel({longest: some})
            values = [quantity.place_in_words({longest: v}) for v in quantity.listed(thinner, longest, [longest])]
            name = f"{name.partition(f', only {longest}=')[0]}, only {formatting.first_of(values, 5)}"
            return drawn(thinner, name, salt, variables, kind)
        return Picture(name, problem=" ".join(str(error).split()))


def residuals(dataset: xr.Dataset, variable: str) -> xr.Dataset | None:
    """Return a variable minus its prediction, in units of its one-sigma errors, as a dataset to draw; None where the
    variable has no errors or no prediction.
    """
    parts, error = quantity.parts_of(dataset, variable), quantity.standard_error(dataset, variable)
    if error is None or "predicted" not in parts:
        return None
    apart = ((dataset[variable] - parts["predicted"]) / error.where(error > 0.0)).transpose(*dataset[variable].dims)
    words = {"symbol": "(simulated − predicted)/error", "long_name": f"{variable}, minus predicted"}
    apart = apart.drop_attrs(deep=False).assign_attrs(words).assign_attrs({drawing.BAND: answer.ERRORS_ALLOWED})
    kept = dataset[["status"]].assign_attrs(title=dataset.attrs.get("title", ""))
    return kept.assign({f"{variable}_{SUFFIX}": apart})


def _varies(array: xr.DataArray) -> bool:
    finite = array.values[np.isfinite(array.values)] if array.dtype.kind in "biuf" else np.empty(0)
    return bool(finite.size and finite.min() < finite.max())


def _svg(figure: Figure) -> str:
    """Return the ``svg`` element of a figure; nothing in it affects the rest of the page."""
    for artist in figure.findobj():
        # the sign of a square root fits its bar in matplotlib's fonts only; a text with any effect is saved as paths
        if isinstance(artist, text.Text) and r"\sqrt" in artist.get_text():
            artist.set_path_effects([*artist.get_path_effects(), patheffects.Normal()])
    out = io.StringIO()
    figure.savefig(out, format="svg", dpi=200, transparent=True, metadata={"Date": None, "Creator": None})
    svg = out.getvalue()
    svg = svg[svg.index("<svg") :]
    # a style element would apply to the whole page
    svg = re.sub(r"<metadata>.*?</metadata>|<style[^>]*>.*?</style>", "", svg, flags=re.DOTALL)
    if not any(isinstance(artist, collections.QuadMesh) for artist in figure.findobj()):  # whose colours have a meaning
        svg = svg.replace("<image ", '<image class="points" ')
    used = set(re.findall(r"#([\w.-]+)", svg))
    svg = re.sub(r' id="([^"]*)"', lambda name: name[0] if name[1] in used else "", svg)
    head, rest = svg.split(">", 1)
    head = re.sub(r' (?:width|height)="[^"]*"', "", head)
    return re.sub(r'style="[^"]*"', lambda style: re.sub(r"#[0-9a-f]{6}\b", _themed, style[0]), f"{head}>{rest}")


def _themed(colour: re.Match[str]) -> str:
    """Return a colour for both themes: greys are inverted on dark, others become lighter, so that the darkest of a ramp
    has three times the luminance of the page.
    """
    red, green, blue = (int(colour[0][i : i + 2], 16) for i in (1, 3, 5))
    dark = f"#{255 - red:02x}{255 - green:02x}{255 - blue:02x}"
    if not red == green == blue:
        dark = f"color-mix(in oklab, {colour[0]} 65%, white)"
    return f"light-dark({colour[0]}, {dark})"


# The interactive view


def explorer(dataset: xr.Dataset, first: Sequence[str], room: int) -> tuple[dict[str, Any], int, list[str]]:
    """Return the contents of a grid in at most ``room`` numbers, how many these are, and the quantities left out.

    ``first`` are the quantities that come first; each has flat lists in C order of its own dimensions, None where a
    value is missing.
    """
    dataset = style.with_scales(dataset)
    views, left_out, used = list[dict[str, Any]](), list[str](), 0
    for name in dict.fromkeys([*first, *quantity.quantities(dataset)]):
        if not np.isfinite(dataset[name].values).any():
            continue
        parts = quantity.parts_of(dataset, name)
        size = sum(part.size for part in parts.values())
        if used + size > room:
            left_out.append(name)
            continue
        used += size
        views.append(_quantity(dataset, name, parts))
    dims = list(dict.fromkeys(d for view in views for d in view["dims"]))
    # points that the study leaves out are not missing, and nobody asked for those between the points of a refinement
    at = np.flatnonzero(dataset["status"].values == Status.EXCLUDED).tolist() if views else []
    left = {"dims": list(dataset["status"].dims), "at": at, "refined": REFINED in dataset.attrs}
    return {"quantities": views, "axes": list(_axes(dataset, dims)), "excluded": left}, used, left_out


def _quantity(dataset: xr.Dataset, name: str, parts: dict[str, xr.DataArray]) -> dict[str, Any]:
    array = dataset[name]
    unit, factors, components = formatting.units_of(array.attrs), xr.DataArray(1), {}
    with_units = [str(d) for d in array.dims if f"{d}_unit" in dataset.coords]  # a unit for each component
    if "," in unit and len(with_units) == 1:
        (dim,) = with_units
        units = map(str, dataset[f"{dim}_unit"].values.tolist())
        chosen = [formatting.prefixed(array.isel({dim: i}).values, unit) for i, unit in enumerate(units)]
        factors = xr.DataArray([one.factor for one in chosen], dims=dim)
        unit, components = "", {"unit_dim": dim, "units": [formatting.written(one.unit) for one in chosen]}
    elif "," in unit:  # of each element of a matrix
        unit = ", ".join(dict.fromkeys(part.strip(" ()") for part in unit.split(",")))
    return {
        "name": name,
        "unit": formatting.written(unit),
        **components,
        "meaning": formatting.meaning_beside(name, array.attrs),
        "dims": list(map(str, array.dims)),
        "scale": str(array.attrs.get(style.SCALE, "")),
        "truth": formatting.is_truth(array),
        **{suffix: _numbers((part * factors).transpose(*part.dims)) for suffix, part in parts.items()},
    }


def _axes(dataset: xr.Dataset, dims: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the coordinates along dimensions, and the dimensions without one; those along points without order come
    last, and only if they are numeric.
    """
    names = [n for d in dims for n in dict.fromkeys([d, *quantity.axis_coordinates(dataset, [d])])]
    along = [n for n in names if not n.endswith("_unit")]
    for name in sorted(along, key=lambda n: (dataset[n].dims == (POINT,), n == POINT)):
        array = dataset[name]  # a dimension without a coordinate gives 0, 1, 2, ...
        numeric, ordered = array.dtype.kind in "iuf", array.dims[0] != POINT
        texts = formatting.plain(quantity.listed(dataset, name, [str(array.dims[0])]))
        if numeric or ordered or name == POINT:
            yield {
                "name": name,
                "dim": str(array.dims[0]),
                "unit": formatting.written(formatting.units_of(array.attrs)),
                "numeric": numeric,
                "ordered": ordered,
                "logarithmic": numeric and style.is_logarithmic(array),
                "values": _numbers(array.astype(float).where(np.isfinite(array))) if numeric else texts,
                "texts": texts,
            }


def _numbers(array: xr.DataArray) -> list[Any]:
    """Return the numbers of an array in C order, None where missing, those that JavaScript or JSON lacks as texts."""
    flat = array.values.reshape(-1).tolist()
    texts = (str(n) if (abs(n) > 2**53 if isinstance(n, int) else np.isinf(n)) else n for n in flat)
    return [None if formatting.is_missing(n) else n for n in texts]


# The beginning of every report: a file that does not begin with it is not replaced.
MARK = "<!doctype html>\n<!-- linksweep report -->\n"
CITATION_FILE = "CITATION.cff"
SEVERITY = ("NOT reproduced", "incomplete", "within tolerance", "not comparable", "reproduced")  # what needs attention
MOST_ROWS = 2000  # of a table in the page, some 0.5 MB


# The page


def report_of(stores: Sequence[Where]) -> str:
    """Return the page about stores; raises SweepError for a store that is missing, empty or damaged."""
    return report_page([(place.name, open_result(place, running=True).dataset) for place in map(located, stores)])


def report_page(datasets: Sequence[tuple[str, xr.Dataset]]) -> str:
    """Return one HTML page about named datasets of results, the same for the same datasets."""
    sections, room = list[dict[str, Any]](), MOST_NUMBERS
    for number, (name, dataset) in enumerate(datasets):
        with refused(SweepError, where=name):
            result = Result(dataset)
            is_study = result.kind == "grid"
            one = section(name, dataset, number, room) if is_study else link_section(name, result, number)
        sections.append(one | {"about": dataset.attrs})
        room -= one.get("numbers", 0)
    explored = any(one["explorer"]["quantities"] for one in sections)
    scripts = [template_file("page.js")]
    if explored:  # the library needs no network and no server
        options: dict[str, Any] = {"minified": True, "log_level": "error", "components": ["bokeh", "bokeh-api"]}
        scripts = ["\n".join(Resources(mode="inline", **options).js_raw), *scripts, template_file("explorer.js")]
    comparisons = [comparison for one in sections for comparison in one.get("comparisons", ())]
    versions = list(dict.fromkeys(one["version"] for one in sections))
    cited = list[str]()
    for _, dataset in datasets:
        is_ours = str(dataset.attrs.get("experiment", "linksweep.")).startswith("linksweep.")
        cited += citations(versions[0])[:1] if is_ours else json.loads(dataset.attrs.get(CITATION, "[]"))
    return MARK + template("page.html.j2").render(
        sections=sections,
        explored=explored,
        verdicts=compare.summary_line(comparisons) if comparisons else "",
        unfinished=sum(bool(one.get("gaps")) for one in sections),
        policy=policy(scripts),
        style=template_file("page.css"),
        scripts=scripts,
        cite=list(dict.fromkeys([*cited, *(citations(version)[1] for version in versions)])),
    )


def default_path(stores: Sequence[Where]) -> Path:
    """Return the default path of a report: named after its store, in the working directory."""
    names = [located(store).name for store in stores]
    stem = names[0].removesuffix(".zarr") if len(names) == 1 else "linksweep"
    return Path(file_named(f"{stem}-report.html"))


def check_output(path: Path) -> None:
    """Raise SweepError unless a report can be written to a path: a new file or an earlier report in a folder."""
    with reading(path, "cannot be written"):
        if path.suffix.lower() not in (".html", ".htm"):
            raise SweepError("cannot be a report: its name must end with .html or .htm", str(path))
        if path.exists() and not path.read_bytes().startswith(MARK.encode()):
            raise SweepError("exists and is no report of linksweep; give another name with -o", str(path))


def write_report(page: str, path: Path) -> None:
    """Write a page, whole or not at all; raises SweepError if it cannot."""
    write_at_once(path, lambda new: new.write_text(page, encoding="utf-8", errors="backslashreplace", newline="\n"))


def citations(version: str) -> tuple[str, str]:
    """Return what to cite, in words: the paper, and the software in the version that made the results."""
    # in the wheel the citation file is beside the modules, in a checkout above them
    folders = Path(str(resources.files("linksweep"))), Path(__file__).resolve().parents[2]
    path = next(folder / CITATION_FILE for folder in folders if (folder / CITATION_FILE).is_file())
    software = yaml.safe_load(path.read_text(encoding="utf-8"))
    paper = software["preferred-citation"]
    place = f"{paper['journal']} {paper['volume']}, {paper['start']}"
    return (
        f"{_people(paper['authors'])} ({paper['year']}). {paper['title']}. {place}",
        f"{_people(software['authors'])}. {software['title']}, version {version}. {software['license']}",
    )


def _people(authors: Sequence[Mapping[str, str]]) -> str:
    return " & ".join(a["name"] if "name" in a else f"{a['family-names']}, {a['given-names'][0]}." for a in authors)


def template(name: str) -> Template:
    """Return a template of pages, in which every text is escaped, also what would change the order of text."""
    options: dict[str, Any] = {"autoescape": True, "trim_blocks": True, "lstrip_blocks": True}
    options["finalize"] = lambda value: formatting.harmless(value) if type(value) is str else value
    environment = Environment(loader=PackageLoader("linksweep.sweep.report"), **options)
    environment.filters["micro"] = formatting.with_micro_signs
    return environment.get_template(name)


def template_file(name: str) -> str:
    """Return the content of a file beside the templates."""
    return (resources.files("linksweep.sweep.report") / "templates" / name).read_text(encoding="utf-8")


def policy(scripts: Sequence[str]) -> str:
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
    final = quantity.without_running(dataset)
    explored, numbers, left_out = explorer(quantity.in_readable_units(final), names, room)
    failures, versions = (json.loads(about.get(name, "{}")) for name in ("failures", "versions"))
    title = str(about.get("title", store))
    shown = dict.fromkeys([*answer.said_first(dataset), *names, *quantity.array_outputs(dataset)])
    figures = pictures(dataset, list(shown), number)
    has_errors = any(quantity.standard_error(dataset, name) is not None for name in names)
    further, decided = {}, {}
    for table in tables.tables_with_errors(final, MOST_ROWS):
        meaning = dataset[table.title.split()[0]].attrs["long_name"]
        further[f"{table.title}, {meaning}, with every kind of error"] = _sortable(table)
    for name in names if {POINT_TABLE, FUNCTION} & about.keys() else ():
        if not quantity.own_dimensions(dataset, name):  # one number at each point
            with suppress(SweepError):
                indices = Result(sensitivity.sensitivity(final.squeeze(), name))
                decided[name] = " ".join(indices.headline())
                if POINT_TABLE in about and len(indices.dataset.dims) == 1 < indices.dataset.sizes["parameter"]:
                    further[f"S{indices.notes()[0][1:]}"] = _sortable(indices.tables()[0])
                    untitled = indices.dataset.assign_attrs(title="")
                    figures.append(drawn(untitled, f"sensitivity of {name}", f"{number}-{name}"))
    document = json.loads(about.get("study_document", "{}"))
    return {
        "store": store,
        "title": title,
        "gaps": answer.completeness(dataset),
        "short": answer.answer_in_short(dataset),
        "head": answer.conclusion_in_words(dataset),  # the box says the rest
        "answers": answer.answers(dataset, decided),
        "comparisons": comparisons,
        "verdicts": compare.summary_line(comparisons) if comparisons else "",
        "pictures": figures,
        "explorer": explored | {"title": title},
        "not_explored": left_out,
        "numbers": numbers,
        "results": _sortable(tables.headline_table(dataset, MOST_ROWS), tables.rows_left_out(dataset, MOST_ROWS)),
        "caption": f"Headline results{', ± their one-sigma errors' if has_errors else ''}",
        "tables": further,
        "comparison": _sortable(compare.table(sorted(comparisons, key=_severity))) if comparisons else None,
        "notes": [*tables.warnings_of(dataset), *compare.notes(comparisons), *compare.remarks(dataset)],
        "failures": failures,
        "reasons": Reasons(failures).in_words(),
        "failures_not_named": int((dataset["status"] == Status.FAILED).sum()) - len(failures),
        "provenance": _provenance("study", about) | {name: f"version {one}" for name, one in versions.items()},
        # a run from Python has no file
        "study": about.get("study") or "\n".join(f"{key}: {json.dumps(one)}" for key, one in document.items()),
        "version": str(versions.get("linksweep", "unknown")),
    }


def _severity(c: compare.Comparison) -> tuple[int, float]:
    """Return by what comparisons are sorted, the worst first: the verdict, and the difference in units of what is
    allowed.
    """
    known = c.allowance > 0.0 and bool(np.isfinite(c.difference))
    return SEVERITY.index(c.verdict), -abs(c.difference) / c.allowance if known else 0.0


# Links of real tables, forecasts, and what is derived from results


def link_section(store: str, result: Result, number: int) -> dict[str, Any]:
    """Return what the template shows of a link, a forecast or anything derived, the ``number``-th of a page."""
    first, *others = result.tables()
    kinds = KINDS.get(result.kind, {}).items()
    figures = [drawn(result.dataset, one.caption or result.title, f"{number}-{kind}", kind=kind) for kind, one in kinds]
    about = [line for line in first.title.splitlines() if line and line != result.title]
    notes = [note.removeprefix("note: ") for note in result.notes()]
    return {
        "store": store,
        "title": result.title,
        "head": result.headline(),
        "answers": [
            answer.Answer(name, "", said) for name, said in (("What it is", about), ("Warnings", notes)) if said
        ],
        "pictures": [one for one in figures if one.svg],  # of the others the dataset lacks something
        "explorer": {"quantities": []},
        "results": _sortable(first),
        "caption": "Every unknown, with every kind of error" if result.kind == "tie" else "All numbers",
        "tables": {table.title.removesuffix(":"): _sortable(table) for table in others},
        "provenance": _provenance("link" if "satellite" in result.dataset.attrs else "study", result.dataset.attrs),
        "version": metadata.version("linksweep"),
    }


# What sections have in common


def _provenance(kind: str, attributes: Mapping[Any, Any]) -> dict[str, str]:
    """Return the attributes of a dataset that a page names, by their names there."""
    names = json.loads(template_file("provenance.json"))[kind]
    return {label: str(attributes[key]) for key, label in names.items() if attributes.get(key, "") != ""}


def _sortable(table: Table, left_out: int = 0) -> dict[str, Any]:
    """Return the headings and rows of a table, whose cells are a text and the value to sort by."""
    names, headings, cells = [column.name for column in table.columns], [], []
    for column in table.columns:
        whole = names.count(column.name) > 1 and column.quantity != column.name
        name = f"{column.quantity} {column.name}" if whole else column.name
        headings.append(f"{name} [{formatting.written(column.unit)}]" if column.unit else name)
        pairs = zip(column.shown, column.values, strict=True)
        cells.append([(text, text if hasattr(by, "tolist") else by) for text, by in pairs])
    return {"headings": headings, "rows": list(zip(*cells, strict=True)), "left_out": left_out}


# Runs on a page that is served on loopback, with a random token in its address: made from the stores alone

MOST_TILES = 2000

# The most of a core that drawing takes of a study of few points; of more, it takes no more than looking.
FIGURE_SHARE, FEW_POINTS = 0.1, 10_000

# Names by which a browser asks; under any other, a page of others may have sent it here.
HOSTS = ("127.0.0.1", "localhost")

HEADERS = [("Cache-Control", "no-store"), ("Referrer-Policy", "no-referrer"), ("X-Content-Type-Options", "nosniff")]


class Shown:
    """A store as the page shows it: its ``tiles``, and its ``figure``, drawn again for new results."""

    def __init__(self, where: Where) -> None:
        """Look at nothing yet."""
        self.watched, self.figure = Watched(where), Picture("")
        self.tiles: list[list[Tile]] = []
        self._drawn: Any = None
        self._redraw = 0.0

    def look(self) -> None:
        """Look at the store."""
        self.watched.look()
        self.tiles = self.watched.tiles(MOST_TILES, MOST_TILES, MOST_TILES)

    def draw(self) -> bool:
        """Draw its results if they are new and it is time; return whether they were."""
        opened = self.watched.opened
        waits = not self.watched.is_over and time.monotonic() < self._redraw
        if opened is None or is_new(opened.root) or opened.root is self._drawn or waits:
            return False
        begun = time.process_time()
        try:
            dataset = quantity.with_running(opened.dataset(running=True)).assign_attrs(title="")
            self.figure = drawn(dataset, "", f"watch-{self.watched.location}")
        except SweepError as error:
            self.figure = Picture("", problem="; ".join(error.problems))
        share = FIGURE_SHARE if self.watched.status.size <= FEW_POINTS else SHARE
        took = time.process_time() - begun if self.figure.svg else 0.0
        self._drawn, self._redraw = opened.root, time.monotonic() + took / share
        return bool(self.figure.svg)


class Page:
    """The page about some stores, which are looked at when somebody asks, at most every ``interval`` seconds."""

    def __init__(self, stores: Iterable[Where], interval: float) -> None:
        """Look at nothing yet."""
        self._stores, self._interval = list(map(Shown, stores)), interval
        self._lock, self._next, self._state = threading.Lock(), 0.0, ""
        page, scripts = template("watch.html.j2"), list(map(template_file, ("page.js", "watch.js")))
        about = {"style": "\n".join(map(template_file, ("page.css", "watch.css"))), "interval": 1000 * interval}
        self._whole, self._macros = page.render(stores=self._stores, scripts=scripts, **about), page.module
        self.token = secrets.token_urlsafe(24)
        self._policy = f"{policy(scripts)}; connect-src 'self'; frame-ancestors 'none'"

    def __call__(self, request: Any, start: Callable[..., Any]) -> list[bytes]:
        """Answer a request, as WSGI has it."""
        known = {f"/{self.token}/": "text/html", f"/{self.token}/state": "application/json"}
        is_ours = request.get("HTTP_HOST", "").partition(":")[0] in HOSTS
        kind = known.get(request["PATH_INFO"]) if is_ours and request["REQUEST_METHOD"] == "GET" else None
        about = [("Content-Type", f"{kind or 'text/plain'}; charset=utf-8"), ("Content-Security-Policy", self._policy)]
        start("200 OK" if kind else "404 Not Found" if is_ours else "403 Forbidden", HEADERS + about)
        text = self._seen() if kind == "application/json" else self._whole if kind else ""
        return [text.encode(errors="replace")]

    def _seen(self) -> str:
        if self._state and self._lock.locked():
            return self._state  # another request waits for a figure
        with self._lock:
            if time.monotonic() >= self._next:
                begun = time.process_time()
                for one in self._stores:
                    one.look()
                parts = self._parts("head", "tiles", "failures")
                # The first look makes the points, which it need not do again.
                took = time.process_time() - begun if self._state else 0.0
                self._next = time.monotonic() + pause(self._interval, took)
                # Not before the first answer, and then one at a time: tiles do not wait for figures.
                any(one.draw() for one in self._stores if self._state)
                self._state = json.dumps(parts | self._parts("figure"))
            return self._state

    def _parts(self, *names: str) -> dict[str, str]:
        return {f"{n}-{i}": str(getattr(self._macros, n)(one)) for i, one in enumerate(self._stores) for n in names}


class _Handler(WSGIRequestHandler):
    def log_message(self, *_message: Any) -> None:
        return


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True

    def handle_error(self, *_request: Any) -> None:
        return  # browsers leave, or open connections that they do not use


def serve(stores: Iterable[Where], interval: float, said: Callable[[str], None]) -> None:
    """Serve a page about stores until an interruption; ``said`` is called with its address."""
    page = Page(stores, interval)
    with make_server("127.0.0.1", 0, page, _Server, _Handler) as server:
        said(f"http://127.0.0.1:{server.server_port}/{page.token}/")
        server.serve_forever()
