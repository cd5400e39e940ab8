"""The directions of import are the architecture: this test reads them from the source."""

import ast
from graphlib import TopologicalSorter

from tests.documents import ROOT

# From the ground up: a module may import its own package and those before it.  The modules directly in sweep/ are the
# ground, but for those of the roof.  Inside a package only a cycle is wrong.
PACKAGES = """
    sweep.formatting sweep.contract sweep.functions sweep.code sweep sweep.tables core
    sweep.studies sweep.planning sweep.executing sweep.stores sweep.running
    sweep.analysis sweep.result sweep.tie sweep.plots sweep.report sweep.search sweep.api
    __init__ sweep.cli sweep.__main__ __main__
""".split()  # noqa: SIM905
# By what is imported, the only modules that may.  The platform knows nothing of astrometry, and the search is a command
# beside it.
ONLY_IN = {
    **{"click": "sweep.cli", "distributed": "sweep.executing", "zarr": "sweep.stores", "obstore": "sweep.stores"},
    **{"erfa": "core.tie.astrometry", "pygaia": "core.missions", "sweep.search": "sweep.search sweep.cli.run"},
    "matplotlib": "sweep.plots sweep.report sweep.api",  # the last for a type
    **dict.fromkeys(("bokeh", "jinja2"), "sweep.report"),
    "pydantic": "sweep.studies sweep.stores sweep.executing sweep.functions.results",  # the last for records alone
    "astropy": "sweep.contract.experiment sweep.tables sweep.table_writer sweep.formatting sweep.analysis "
    "sweep.result sweep.search sweep.tie",
    "pandas": "sweep core.missions.calibrate",  # a script, which nobody imports
    "core": "core __init__ sweep.plots.link sweep.search sweep.tie",
}
# By who imports, the only modules of the platform that it may, and the only other libraries.
OF_THE_PLATFORM = {
    "core": "sweep.contract",
    "sweep.stores": "sweep.stores sweep.contract",
    "sweep.search": "sweep.search sweep.contract sweep.tables sweep.formatting sweep.plots sweep.table_writer "
    "sweep.result sweep.stores.location",
}
OF_LIBRARIES = {"core": "numpy scipy pygaia erfa pandas bisect dataclasses typing collections types functools"}
OF_LIBRARIES["core"] += " itertools math re csv importlib json sys"
# Of the core, the experiment and what it is made of know the contract.
KNOWS_THE_CONTRACT = "core.parameters core.setup core.experiment core.missions core.catalogues core.errors"
FILES = {
    ".".join(path.relative_to(ROOT / folder).with_suffix("").parts): path
    for folder, top in (("", "core"), ("linksweep", "linksweep"), ("", "sweep"))
    for path in sorted((ROOT / top).rglob("*.py"))
}


def file_of(module):
    """The name of a module's file, as in FILES; other modules have their own."""
    name = module.removeprefix("linksweep").lstrip(".") or "__init__"
    return f"{name}.__init__" if f"{name}.__init__" in FILES else name


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (file_of(alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in {path}"
            inner = (file_of(f"{node.module}.{alias.name}") for alias in node.names)
            yield from (name if name in FILES else file_of(node.module) for name in inner)


def is_in(module, places):
    return any(module == place or module.startswith(f"{place}.") for place in places.split())


def package_of(module):
    return max((p for p in PACKAGES if is_in(module, p)), key=len)


def is_wrong(name, other):
    if other in FILES and PACKAGES.index(package_of(other)) > PACKAGES.index(package_of(name)):
        return True
    if any(is_in(other, what) and not is_in(name, who) for what, who in ONLY_IN.items()):
        return True
    if is_in(name, "core") and is_in(other, "sweep") and not is_in(name, KNOWS_THE_CONTRACT):
        return True
    allowed = OF_THE_PLATFORM if is_in(other, "sweep") else {} if other in FILES else OF_LIBRARIES
    return any(is_in(name, who) and not is_in(other, what) for who, what in allowed.items())


def test_imports_point_down_and_never_in_a_circle_and_every_module_is_in_a_package_of_the_list():
    arrows = {name: set(imported(path)) for name, path in FILES.items()}
    assert [f"{name} imports {other}" for name in FILES for other in arrows[name] if is_wrong(name, other)] == []
    graph = {name: others & FILES.keys() for name, others in arrows.items()}
    assert set(TopologicalSorter(graph).static_order()) == set(FILES)
    assert {package_of(name) for name in FILES} == set(PACKAGES)
    assert not [n for n in FILES if package_of(n) == "sweep" and n.count(".") > 1]
