"""Finds which code a store would run, and whether the user must be asked before it is imported.

Looking at a store imports nothing that it names, but computing from it does.  Where that code lies inside the store, or
the store was not written here, the user must allow it with ``--trust``.
"""

import importlib.machinery
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sweep.contract import SweepError
from sweep.stores.folder import Folder
from sweep.stores.location import Location
from sweep.stores.origin import was_written_here
from sweep.stores.root import ROOT

OURS = frozenset({"core.experiment:link"})
"""Experiments that come with linksweep."""

REFERENCE = re.compile(r"(?P<place>[^:\n]+\.py|[A-Za-z_][\w.]*):[A-Za-z_]\w*")


def foreign_code(attributes: Mapping[str, Any]) -> list[str]:
    """Return the references to code other than linksweep's own that making a store's study imports."""
    try:
        document = json.loads(attributes["study_document"])
        named = [str(document.get("experiment", "core.experiment:link")), *_texts(document.get("define", {}))]
    except (KeyError, TypeError, ValueError, AttributeError):
        return []  # nothing can be made of it, so nothing is imported
    return [text for text in dict.fromkeys(named) if text not in OURS and REFERENCE.fullmatch(text)]


def require_trust(location: Location, attributes: Mapping[str, Any], trust: bool) -> None:
    """Raise SweepError that names the code which computing from a store would run, if that must be asked for."""
    code = foreign_code(attributes)
    if trust or not code:
        return
    inside = [reference for reference in code if _is_inside(reference, location)]
    if inside:
        reason = "which lies inside the store"
    elif not was_written_here(location, attributes):
        reason = "and the store was not written here: by this user, on this host, at this place"
    else:
        return
    files = ", ".join(_file(reference) for reference in inside or code)
    raise SweepError(f"would run {files}, {reason}; inspect it, and give --trust if it may run", str(location))


def require_trust_of_study(path: Path, trust: bool) -> None:
    """Raise SweepError for a study file that lies inside a store: what it names came with the store."""
    store = next((folder for folder in path.resolve().parents if (folder / ROOT).is_file()), None)
    if store is not None and not trust:
        raise SweepError(
            f"lies inside the store {store}, and would run what it names; inspect it, and give --trust if it may run",
            str(path),
        )


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def _is_inside(reference: str, location: Location) -> bool:
    file = Path(_file(reference))
    return isinstance(location, Folder) and location.path.resolve() in (file.resolve(), *file.resolve().parents)


def _file(reference: str) -> str:
    """Return the file that a reference names, or its module where there is none; imports nothing."""
    place = reference.rpartition(":")[0]
    if place.endswith(".py"):
        return place
    found = importlib.machinery.PathFinder.find_spec(place.partition(".")[0])
    return found.origin if found is not None and found.origin else f"the module {place}"
