"""The directions of import are the architecture: this test reads them from the source."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# From the ground up: a module may import only what stands before it.
CORE = [
    *("constants", "frames", "sky_pairs", "galaxy_merge", "galaxy_classes", "crossmatch"),
    *("missions", "function_curve", "own_mission", "radio_stars", "catalogue", "quasars", "table_catalogue"),
    *("errors", "link", "noise", "setup", "fixed_design", "normal_sums", "full_path", "projected", "simulate"),
    *("parameters", "scenario", "expected_errors", "checks", "experiment", "calibration"),
]
SWEEP = [
    *("interrupt", "contract", "byaxes", "load", "definitions", "tablefile", "study", "source", "form", "problems"),
    *("axes", "claims", "published", "exclusions", "rules", "reader"),
    *("grid", "plan", "tally", "pending", "limit", "worker", "agreement", "guard", "pin"),
    *("execute", "on_client", "clusterfile", "own_cluster", "clusters"),
    *(
        "provenance",
        "folder",
        "bucket",
        "location",
        "lock",
        "sealed",
        "column",
        "ledger",
        "identity",
        "snapshot",
        "failures",
    ),
    *("results", "store", "covariance", "larger", "writer", "run", "repair", "revisit"),
    *("completion", "status", "tables", "eta", "account", "progress"),
    *("fits", "levelling", "selection", "quantity", "lines", "conditions"),
    *("compare", "compare_tables", "paper", "analysis", "crossings", "analysis_tables"),
    *("calibrate", "scaling", "views", "api", "__main__"),
]
CLI = [
    *("group", "options", "output", "stopping", "watching", "running", "again"),
    *("reading", "analysis", "drawing", "scaling", "paper", "about", "match"),
]
SEARCH = [
    *("columns", "tables", "options", "result", "summary", "ecsv", "galaxy_table", "skymap", "outputs", "match"),
]
PLOTS = [
    *("style", "layout", "lines", "law", "maps", "scatter", "scaling", "sky", "accuracy"),
    *("panels", "figure", "other"),
]
ONLY_IN = {
    "click": {f"sweep.cli.{module}" for module in CLI},
    "distributed": {"sweep.clusters", "sweep.on_client", "sweep.own_cluster", "sweep.pin"},
    "zarr": {"sweep.column", "sweep.snapshot"},
    "matplotlib": {"sweep.search.skymap", *(f"sweep.plots.{module}" for module in PLOTS)},
    "pydantic": {"sweep.study", "sweep.form", "sweep.reader"},
    "astropy": {"sweep.tables", "sweep.tablefile", "sweep.conditions", "sweep.search.columns", "sweep.search.ecsv"},
    "pygaia": {"core.missions"},
    "obstore": {"sweep.bucket"},
}
# The platform knows nothing of astrometry; the calibration and the galaxy search are commands
# beside it, not a part of it.  Only the command line knows the search.
ACROSS = {
    ("core.experiment", "sweep.contract"),
    ("core.parameters", "sweep.contract"),
    ("core.scenario", "sweep.contract"),
    ("core.function_curve", "sweep.contract"),
    ("core.own_mission", "sweep.contract"),
    ("core.expected_errors", "sweep.contract"),
    ("core.checks", "sweep.contract"),
    ("sweep.calibrate", "core.calibration"),
    *(("sweep.views", f"core.{module}") for module in ("calibration", "constants", "missions", "scenario")),
    *(("sweep.plots.sky", f"core.{module}") for module in ("constants", "frames")),
    *(("sweep.cli.drawing", f"sweep.plots.{module}") for module in ("figure", "other", "style")),
    *(("sweep.cli.scaling", f"sweep.plots.{module}") for module in ("figure", "style")),
    ("sweep.__main__", "sweep.cli.main"),
    *(("sweep.cli.match", f"sweep.search.{module}") for module in ("match", "options", "outputs", "summary")),
}
# What the search may import from outside of itself.
SEARCH_MAY_USE = {
    *(f"core.{module}" for module in ("constants", "frames", "sky_pairs", "galaxy_merge", "galaxy_classes")),
    *("core.crossmatch", "sweep.contract", "sweep.tablefile"),
}
# What pictures may import from outside of them: results, and what is derived from them.
PLOTS_MAY_USE = {
    *("sweep.contract", "sweep.tally", "sweep.tables", "sweep.fits", "sweep.selection", "sweep.quantity"),
    *("sweep.lines", "sweep.compare", "sweep.analysis"),
}
CORE_MAY_USE = {
    *("numpy", "scipy", "core", "dataclasses", "typing", "collections", "types", "functools", "itertools", "math"),
}
CORE_EXTRAS = {"pygaia"}


def modules(package):
    folder = ROOT.joinpath(*package.split("."))
    return {f"{package}.{p.stem}": p for p in folder.glob("*.py") if p.stem != "__init__"}


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {path}"
            inside = node.module in FLOORS
            yield from ([f"{node.module}.{alias.name}" for alias in node.names] if inside else [node.module])


FLOORS = {"core": CORE, "sweep": SWEEP, "sweep.search": SEARCH, "sweep.plots": PLOTS, "sweep.cli": CLI}
EVERY = [item for package in FLOORS for item in modules(package).items()]


@pytest.mark.parametrize(("name", "path"), EVERY, ids=[name for name, _ in EVERY])
def test_imports_point_down(name, path):
    package, _, own = name.rpartition(".")
    for other in imported(path):
        top = other.partition(".")[0]
        package_of_other, _, rest = other.rpartition(".")
        if package_of_other == package:
            assert FLOORS[package].index(rest) < FLOORS[package].index(own), f"{name} imports {other}"
        elif package == "sweep.cli" and package_of_other == "sweep":
            assert rest != "__main__", f"{name} imports {other}"
        elif package == "sweep.search" and top in FLOORS:
            assert other in SEARCH_MAY_USE, f"{name} imports {other}"
        elif package == "sweep.plots" and package_of_other == "sweep":
            assert other in PLOTS_MAY_USE, f"{name} imports {other}"
        elif top in FLOORS:
            assert (name, other) in ACROSS, f"{name} imports {other}"
        if top in ONLY_IN:
            assert name in ONLY_IN[top], f"{name} imports {other}"
        if package == "core" and (name, "sweep.contract") not in ACROSS:
            assert top in CORE_MAY_USE | CORE_EXTRAS, f"{name} imports {other}"


def test_every_module_has_its_floor():
    assert sorted(name for name, _ in EVERY) == sorted(f"{package}.{m}" for package in FLOORS for m in FLOORS[package])
    folders = {str(path.parent.relative_to(ROOT)) for top in ("core", "sweep") for path in (ROOT / top).rglob("*.py")}
    assert folders == {package.replace(".", "/") for package in FLOORS}
