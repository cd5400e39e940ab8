"""The directions of import are the architecture: this test reads them from the source."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# From the ground up: a module may import its own package and those before it.  The modules directly in sweep/ are the
# ground, but for those of the roof.  Inside a package only a cycle is wrong.
GROUND = "linksweep.sweep"
PACKAGES = [
    *(
        "linksweep.sweep.formatting",
        "linksweep.sweep.contract",
        "linksweep.sweep.functions",
        "linksweep.sweep.code",
        GROUND,
    ),
    *("linksweep.sweep.tables", "linksweep.core"),
    *(
        "linksweep.sweep.studies",
        "linksweep.sweep.planning",
        "linksweep.sweep.executing",
        "linksweep.sweep.stores",
        "linksweep.sweep.running",
    ),
    *(
        "linksweep.sweep.analysis",
        "linksweep.sweep.result",
        "linksweep.sweep.tie",
        "linksweep.sweep.plots",
        "linksweep.sweep.report",
        "linksweep.sweep.search",
        "linksweep.sweep.api",
    ),
    *("linksweep.__init__", "linksweep.sweep.cli", "linksweep.sweep.__main__", "linksweep.__main__"),
]
ONLY_IN = {
    "click": {"linksweep.sweep.cli"},
    "distributed": {"linksweep.sweep.executing"},
    "zarr": {"linksweep.sweep.stores"},
    "obstore": {"linksweep.sweep.stores"},
    "matplotlib": {
        "linksweep.sweep.plots",
        "linksweep.sweep.report",
        "linksweep.sweep.search",
        "linksweep.sweep.api",
    },  # there for a type
    "bokeh": {"linksweep.sweep.report"},
    "jinja2": {"linksweep.sweep.report"},
    "pydantic": {
        *("linksweep.sweep.studies", "linksweep.sweep.stores", "linksweep.sweep.executing"),
        "linksweep.sweep.functions.results",  # of records alone, inside a function
    },
    "astropy": {
        *(
            "linksweep.sweep.contract.declaration",
            "linksweep.sweep.tables",
            "linksweep.sweep.table_writer",
            "linksweep.sweep.formatting",
            "linksweep.sweep.analysis",
            "linksweep.sweep.result",
            "linksweep.sweep.search",
            "linksweep.sweep.tie",
        )
    },
    "erfa": {"linksweep.core.tie.astrometry"},
    "pygaia": {"linksweep.core.missions"},
}
# The platform knows nothing of astrometry; of the core, the experiment and what it is made of know the contract.
KNOWS_THE_CORE = {
    *("linksweep.sweep.plots.sky", "linksweep.sweep.plots.tie", "linksweep.sweep.search", "linksweep.sweep.tie")
}
KNOWS_THE_CONTRACT = {
    *("linksweep.core.parameters", "linksweep.core.scenario", "linksweep.core.checks", "linksweep.core.experiment"),
    *("linksweep.core.missions", "linksweep.core.catalogues", "linksweep.core.errors"),
}
# The search is a command beside the platform.
SEARCH_MAY_USE = {
    *("linksweep.sweep.contract", "linksweep.sweep.tables", "linksweep.sweep.formatting", "linksweep.sweep.plots.sky"),
    "linksweep.sweep.stores.location",
    "linksweep.sweep.table_writer",
}
KNOWS_THE_SEARCH = {"linksweep.sweep.cli.tables"}
CORE_MAY_USE = {
    *("numpy", "scipy", "pygaia", "erfa"),
    *("bisect", "dataclasses", "typing", "collections", "types", "functools", "itertools", "math", "re"),
    *("csv", "importlib", "json", "sys"),
}

FILES = {
    ".".join(("linksweep", *path.relative_to(ROOT / folder).with_suffix("").parts)): path
    for folder, top in (("", "core"), ("linksweep", "linksweep"), ("", "sweep"))
    for path in sorted((ROOT / top).rglob("*.py"))
}


def imported(path):
    """Yield the modules that a file imports: those of the project by the names of their files."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (_file_of(alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {path}"
            for alias in node.names:
                inner = _file_of(f"{node.module}.{alias.name}")
                yield inner if inner in FILES else _file_of(node.module)


def _file_of(module):
    package = f"{module}.__init__"
    return package if package in FILES else module


def is_in(module, places):
    return any(module == place or module.startswith(f"{place}.") for place in places)


def package_of(module):
    """The longest entry of PACKAGES that a module is in; that of a package's own __init__ is the package."""
    return max((p for p in PACKAGES if is_in(module, [p])), key=len)


@pytest.mark.parametrize("name", FILES)
def test_imports_point_down(name):
    for other in imported(FILES[name]):
        top = other.removeprefix("linksweep.").partition(".")[0]
        if other in FILES:
            above = PACKAGES.index(package_of(other)) > PACKAGES.index(package_of(name))
            assert not above, f"{name} imports {other}"
        if is_in(name, ["linksweep.core"]) and top == "sweep":
            assert is_in(name, KNOWS_THE_CONTRACT), f"{name} imports {other}"
            assert is_in(other, ["linksweep.sweep.contract"]), f"{name} imports {other}"
        if is_in(name, ["linksweep.core"]) and top not in ("core", "sweep"):
            script = name == "linksweep.core.missions.calibrate"  # which nobody imports
            assert top in CORE_MAY_USE or (script and top == "pandas"), f"{name} imports {other}"
        if is_in(name, ["linksweep.sweep"]) and top == "core":
            assert is_in(name, KNOWS_THE_CORE), f"{name} imports {other}"
        if is_in(name, ["linksweep.sweep.search"]) and top == "sweep" and not is_in(other, ["linksweep.sweep.search"]):
            assert is_in(other, SEARCH_MAY_USE), f"{name} imports {other}"
        if is_in(other, ["linksweep.sweep.search"]) and not is_in(name, ["linksweep.sweep.search"]):
            assert name in KNOWS_THE_SEARCH, f"{name} imports {other}"
        if is_in(name, ["linksweep.sweep.stores"]) and top == "sweep":
            assert is_in(other, ["linksweep.sweep.stores", "linksweep.sweep.contract"]), f"{name} imports {other}"
        if top in ONLY_IN:
            assert is_in(name, ONLY_IN[top]), f"{name} imports {other}"


def test_no_import_goes_in_a_circle():
    """Raises CycleError, which names the modules of one."""
    graph = {name: {other for other in imported(path) if other in FILES} for name, path in FILES.items()}
    assert set(TopologicalSorter(graph).static_order()) == set(FILES)


def test_every_module_is_in_a_package_of_the_list():
    assert {package_of(name) for name in FILES} == set(PACKAGES)
    strangers = [n for n in FILES if package_of(n) == GROUND and n.count(".") > 2]
    assert not strangers, f"a package that is not in PACKAGES: {strangers}"
