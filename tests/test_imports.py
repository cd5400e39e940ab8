"""The directions of import are the architecture: this test reads them from the source."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# From the ground up: a module may import only what stands before it.
CORE = [
    *("constants", "frames", "crossmatch", "missions", "radio_stars", "catalogue", "quasars", "table_catalogue"),
    *("errors", "link", "simulate", "parameters", "scenario", "checks", "experiment", "calibration"),
]
SWEEP = [
    *("contract", "load", "tablefile", "study", "axes", "claims", "reader", "grid", "plan", "worker", "pin", "execute"),
    *("provenance", "results", "store", "writer", "run", "status", "tables", "progress", "plots"),
    *("compare", "compare_tables", "reproduce"),
    *("sky_tables", "galaxy_table", "skymap", "match", "calibrate", "cli", "__main__"),
]
ONLY_IN = {
    "click": {"sweep.cli"},
    "distributed": {"sweep.execute", "sweep.pin"},
    "zarr": {"sweep.store"},
    "matplotlib": {"sweep.plots", "sweep.skymap"},
    "pydantic": {"sweep.study", "sweep.reader"},
    "astropy": {"sweep.tables", "sweep.tablefile", "sweep.sky_tables", "sweep.match"},
    "pygaia": {"core.missions"},
}
# The platform knows nothing of astrometry; the calibration and the galaxy search are commands
# beside it, not a part of it.
ACROSS = {
    ("core.experiment", "sweep.contract"),
    ("core.parameters", "sweep.contract"),
    ("core.scenario", "sweep.contract"),
    ("core.checks", "sweep.contract"),
    ("sweep.calibrate", "core.calibration"),
    ("sweep.match", "core.constants"),
    ("sweep.match", "core.crossmatch"),
}
CORE_MAY_USE = {"numpy", "scipy", "core", "dataclasses", "typing", "collections", "types", "functools", "itertools"}
CORE_EXTRAS = {"pygaia"}


def modules(package):
    return {f"{package}.{p.stem}": p for p in (ROOT / package).glob("*.py") if p.stem != "__init__"}


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {path}"
            inside = node.module in ("core", "sweep")
            yield from ([f"{node.module}.{alias.name}" for alias in node.names] if inside else [node.module])


EVERY = [*modules("core").items(), *modules("sweep").items()]


@pytest.mark.parametrize(("name", "path"), EVERY, ids=[name for name, _ in EVERY])
def test_imports_point_down(name, path):
    package, _, own = name.partition(".")
    floors = {"core": CORE, "sweep": SWEEP}
    for other in imported(path):
        top, _, rest = other.partition(".")
        if top == package:
            assert floors[package].index(rest) < floors[package].index(own), f"{name} imports {other}"
        elif top in floors:
            assert (name, other) in ACROSS, f"{name} imports {other}"
        if top in ONLY_IN:
            assert name in ONLY_IN[top], f"{name} imports {other}"
        if package == "core" and (name, "sweep.contract") not in ACROSS:
            assert top in CORE_MAY_USE | CORE_EXTRAS, f"{name} imports {other}"


def test_every_module_has_its_floor():
    assert {name for name, _ in EVERY} == {f"core.{m}" for m in CORE} | {f"sweep.{m}" for m in SWEEP}
