"""Loads linksweep's packages `core`, `sweep` and `sweeps`, even where a user's file has the name of one.

Python looks for modules in the folder of the script first, so a ``core.py`` or a folder ``sweep`` there would be
imported in place of ours.
"""

import importlib.util
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

NAMES = ("core", "sweep", "sweeps")
ROOT = Path(__file__).parent.parent


def load_own_packages() -> None:
    """Import our packages from the folder that linksweep itself is in.

    Raises ImportError that names the file if a user's file has already been imported under one of the names.  If the
    user imports such a file later, its attributes are not found, and the error names the file.
    """
    for name in NAMES:
        loaded = sys.modules.get(name)
        if loaded is None:
            _load(name)
        elif not _is_ours(name, getattr(loaded, "__file__", None)):
            file = getattr(loaded, "__file__", None) or f"a folder {name} without an __init__.py"
            raise ImportError(f"{file} has the name of a package of linksweep, {name!r}: rename it")


def _load(name: str) -> None:
    spec = PathFinder.find_spec(name, [str(ROOT)])
    if spec is None or spec.loader is None:
        raise ImportError(f"linksweep is not installed completely: there is no package {name!r} in {ROOT}")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    if hidden := _hidden(name):
        _explain(module, hidden)


def _hidden(name: str) -> str | None:
    """Return the user's file that our package of this name hides, None if there is none."""
    origin: str | None = getattr(PathFinder.find_spec(name), "origin", None)
    return None if _is_ours(name, origin) else origin


def _is_ours(name: str, file: str | None) -> bool:
    return file is not None and Path(file).resolve() == (ROOT / name / "__init__.py").resolve()


def _explain(module: ModuleType, hidden: str) -> None:
    """Let the error for an attribute that our package does not have name the user's file of the same name."""
    ours = getattr(module, "__getattr__", None)
    name = module.__name__

    def explained(attribute: str) -> Any:
        try:
            if ours is not None:
                return ours(attribute)
        except AttributeError:
            pass
        if attribute.startswith("__") or importlib.util.find_spec(f"{name}.{attribute}"):
            raise AttributeError(f"module {name!r} has no attribute {attribute!r}")  # Python looks for a submodule next
        raise ImportError(
            f"{name!r} is a package of linksweep and has no {attribute!r}; {hidden}, which has the same name, cannot "
            "be imported: rename it"
        )

    vars(module)["__getattr__"] = explained
