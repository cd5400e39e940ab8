"""How to cite, from the CITATION.cff that ships with the package."""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml

FILE = "CITATION.cff"


def citations(version: str) -> list[str]:
    """Return what to cite, in words: the paper, then the software in the version that made the results."""
    document = _document()
    software = f"{_people(document['authors'])}. {document['title']}, version {version}. {document['license']}"
    preferred = document.get("preferred-citation")
    return [*([_article(preferred)] if preferred else []), software]


def message() -> str:
    """Return what the authors ask of those who cite."""
    return str(_document()["message"])


def _document() -> Any:
    """Return what is in the file: in the wheel it is beside the package's modules, in a checkout above them."""
    installed = Path(str(files("sweep") / FILE))
    path = installed if installed.is_file() else Path(__file__).parents[2] / FILE
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _article(entry: Mapping[str, Any]) -> str:
    people = _people(entry["authors"])
    return f"{people} ({entry['year']}). {entry['title']}. {entry['journal']} {entry['volume']}, {entry['start']}"


def _people(authors: list[Mapping[str, str]]) -> str:
    names = [a["name"] if "name" in a else f"{a['family-names']}, {a['given-names'][0]}." for a in authors]
    return " & ".join(names)
