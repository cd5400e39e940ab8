"""The directions of import are the architecture: this test reads them from the source."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# From the ground up, rooms and the modules in each: a module may import only what stands before it.
GROUND = [
    *("sweep.interrupt", "sweep.contract.errors", "sweep.contract.units", "sweep.contract.parameter"),
    "sweep.contract.output",
    *("sweep.contract.declaration", "sweep.contract.checked", "sweep.contract.experiment", "sweep.contract.__init__"),
    *("sweep.sources", "sweep.load", "sweep.code_identity", "sweep.tablefile"),
]
HOUSE = {
    "core": [
        *("constants", "frames", "sky_pairs", "galaxy_merge", "galaxy_classes", "crossmatch"),
        *("missions", "function_curve", "user_mission", "radio_stars", "catalogue", "quasars", "table_catalogue"),
        *(
            "shared_arrays",
            "errors",
            "link",
            "noise",
            "prepared",
            "fixed_design",
            "normal_equations",
            "noisy_design",
            "projected",
        ),
        *("simulate", "parameters", "scenario", "expected_errors", "checks", "experiment", "calibration"),
    ],
    "sweep.studies": [
        *("definitions", "study", "source", "form", "schema", "template", "problems", "axes"),
        *("claims", "published", "exclusions", "rules", "reader", "provenance"),
    ],
    "sweep.planning": ["point_cache", "unused", "grid", "plan", "accumulator", "work_queue"],
    "sweep.executing": [
        *("captured", "deadlines", "worker", "versions", "clock", "isolated", "worker_plugin", "execute"),
        *("forkserver", "dask_executor", "clusterfile", "local_cluster", "clusters", "choose"),
    ],
    "sweep.stores": [
        *(
            "folder",
            "bucket",
            "location",
            "lock",
            "checksums",
            "chunked_rows",
            "ledger",
            "identity",
            "snapshot",
            "failures",
        ),
        *("store", "code", "fresh", "repair"),
    ],
    "sweep.running": [
        *("results", "covariance", "subset", "writer", "run", "reproduce"),
        *("axis_progress", "status", "eta", "run_summary", "progress", "scaling"),
    ],
    "sweep.analysis": [
        *("tables", "fits", "levelling", "selection", "quantity", "lines", "conditions"),
        *("compare", "compare_tables", "laws", "crossings", "law_tables"),
    ],
    "sweep.paper": ["published_stores", "calibrate"],
    "sweep.plots": [
        *("style", "layout", "lines", "law", "maps", "scatter", "scaling", "sky", "missions", "views"),
        *("panels", "figure", "standalone"),
    ],
    "sweep.report": ["cite", "answer", "figures", "explorer", "section", "page"],
    "sweep.search": [
        *("columns", "tables", "options", "result", "summary", "ecsv", "galaxy_table", "skymap", "outputs", "match"),
    ],
    "sweep.cli": [
        *("group", "shell_completion", "options", "output", "signals", "log_options", "running", "rerun"),
        *("store", "analysis", "plot", "paper", "report", "scaling", "studies", "match"),
    ],
}
ROOF = ["sweep.api", "sweep.__init__", "sweep.__main__"]
ONLY_IN = {
    "click": {"sweep.cli"},
    "distributed": {"sweep.executing"},
    "zarr": {"sweep.stores"},
    "obstore": {"sweep.stores"},
    "matplotlib": {"sweep.plots", "sweep.report", "sweep.search"},
    "bokeh": {"sweep.report"},
    "jinja2": {"sweep.report"},
    "pydantic": {"sweep.studies"},
    "astropy": {"sweep.contract.units", "sweep.tablefile", "sweep.analysis", "sweep.search"},
    "pygaia": {"core.missions"},
}
# The platform knows nothing of astrometry; of the core, the experiment and what it is made of know the contract.
KNOWS_THE_CORE = {"sweep.paper.calibrate", "sweep.plots.views", "sweep.plots.sky", "sweep.search"}
KNOWS_THE_CONTRACT = {
    *("core.parameters", "core.scenario", "core.checks", "core.experiment"),
    *("core.function_curve", "core.user_mission", "core.expected_errors"),
}
# The search is a command beside the platform.
SEARCH_MAY_USE = {"sweep.contract.__init__", "sweep.tablefile"}
KNOWS_THE_SEARCH = {"sweep.cli.match"}
CORE_MAY_USE = {
    *("numpy", "scipy", "pygaia"),
    *("dataclasses", "typing", "collections", "types", "functools", "itertools", "math"),
}

ORDER = [*GROUND, *(f"{room}.{m}" for room, modules in HOUSE.items() for m in [*modules, "__init__"]), *ROOF]
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): path
    for top in ("core", "sweep")
    for path in sorted((ROOT / top).rglob("*.py"))
}


def imported(path):
    """Yield the modules that a file imports: those of the house by their own names."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {path}"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                package = f"{node.module}.__init__"
                yield inner if inner in FILES else package if package in FILES else node.module


def is_in(module, places):
    return any(module == place or module.startswith(f"{place}.") for place in places)


@pytest.mark.parametrize("name", FILES)
def test_imports_point_down(name):
    for other in imported(FILES[name]):
        top = other.partition(".")[0]
        if other in FILES:
            assert ORDER.index(other) < ORDER.index(name), f"{name} imports {other}"
        if name.startswith("core.") and top == "sweep":
            assert name in KNOWS_THE_CONTRACT, f"{name} imports {other}"
            assert other == "sweep.contract.__init__", f"{name} imports {other}"
        if name.startswith("core.") and top not in ("core", "sweep"):
            assert top in CORE_MAY_USE, f"{name} imports {other}"
        if name.startswith("sweep.") and top == "core":
            assert is_in(name, KNOWS_THE_CORE), f"{name} imports {other}"
        if is_in(name, ["sweep.search"]) and top == "sweep" and not is_in(other, ["sweep.search"]):
            assert other in SEARCH_MAY_USE, f"{name} imports {other}"
        if is_in(other, ["sweep.search"]) and not is_in(name, ["sweep.search"]):
            assert name in KNOWS_THE_SEARCH, f"{name} imports {other}"
        if top in ONLY_IN:
            assert is_in(name, ONLY_IN[top]), f"{name} imports {other}"


def test_every_module_has_its_place():
    assert sorted(ORDER) == sorted(FILES)
