"""Finds and reads the files of a study, and finds the line of a key in them."""

import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

from linksweep.sweep.contract import SweepError, shown, suggest

DEFAULT_EXPERIMENT = "linksweep.core.experiment:link"
"""The experiment of a study that names none; any store may name it, as it comes with linksweep."""

MAX_FILE_BYTES = 1_000_000

DEEPEST = 100
"""The most parts of a dotted key: the parser's time grows with their square, to minutes for a long line of them."""

TOO_DEEP = "not valid TOML: nested too deeply"

REFERENCE = re.compile(r"(?P<place>[^:\n]+\.py|[A-Za-z_][\w.]*):[A-Za-z_]\w*")
"""``file.py:NAME`` and ``module:NAME``."""

Place = tuple[str | int, ...]
"""Keys and indices that lead to a value of the document."""


def built_in_studies() -> dict[str, Path]:
    """Return the studies that ship with the package, by name."""
    return {path.stem: path for path in sorted(Path(str(resources.files("linksweep") / "sweeps")).glob("*.toml"))}


def reference_in(name_or_path: str) -> str | None:
    """Return the argument if it is a reference, ``file.py:NAME`` or ``module:NAME``; None for a file or other name."""
    found = REFERENCE.fullmatch(name_or_path)
    return None if found is None or Path(name_or_path).exists() else name_or_path


def find_study(name_or_path: str) -> Path:
    """Return the file of a built-in name or a path; raises SweepError where there is none."""
    built_in = built_in_studies()
    if name_or_path in built_in:
        return built_in[name_or_path]
    path = Path(name_or_path)
    try:
        if path.is_dir():
            raise SweepError(f"{name_or_path!r} is a directory, not a study file")
        exists = path.exists()
    except (OSError, ValueError) as error:  # for example a name that is too long, or a directory without permission
        reason = getattr(error, "strerror", None) or str(error)
        raise SweepError(f"the study {shown(name_or_path)} cannot be read: {reason}") from error
    if not exists:
        hint = "" if path.suffix else suggest(name_or_path, list(built_in))
        raise SweepError(f"no study {name_or_path!r}: neither a file nor a built-in study{hint}")
    return path


def read_text(path: Path) -> str:
    """Return the text of a file of bounded size; raises SweepError where it cannot be read or is no UTF-8."""
    try:
        with path.open("rb") as file:  # no stat: a device or a pipe has no size
            content = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise SweepError(f"cannot be read: {getattr(error, 'strerror', None) or error}", str(path)) from error
    if len(content) > MAX_FILE_BYTES:
        raise SweepError(f"is larger than {MAX_FILE_BYTES:,} bytes", str(path))
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise SweepError(f"not UTF-8 text: byte 0x{content[error.start]:02x} in line {line}", str(path)) from error


def parsed(text: str, path: Path) -> dict[str, Any]:
    """Return the document of a TOML text; raises SweepError that quotes the line where it is not valid."""
    if path.suffix == ".py":
        raise SweepError(f"is Python, not a study; name a function in it, as {path}:NAME", str(path))
    if _has_deep_key(text):
        raise SweepError(TOO_DEEP, str(path))
    try:
        return tomllib.loads(text)
    except ValueError as error:  # a TOMLDecodeError, or an integer of too many digits
        raise SweepError(f"not valid TOML: {error}{_quoted_line(text, str(error))}", str(path)) from error
    except RecursionError as error:
        raise SweepError(TOO_DEEP, str(path)) from error


def lines_of_keys(text: str) -> dict[Place, int]:
    """Return the 1-based line of every key of a TOML text, as far as patterns find it: the parser gives no lines."""
    table: Place = ()
    counts: dict[str, int] = {}
    lines: dict[Place, int] = {}
    for number, whole in enumerate(text.split("\n"), 1):
        line = whole[:200]  # a key is at the beginning; the patterns are slow on a long line
        if header := re.match(r"\s*(\[\[?)\s*([\w.\"' -]+?)\s*\]\]?\s*(?:#.*)?$", line):
            name = header[2]
            keys = tuple(part.strip(" \"'") for part in name.split("."))
            index = counts[name] = counts.get(name, -1) + 1
            table = (*keys, index) if header[1] == "[[" else keys
            lines[table] = number
        elif entry := re.match(r"\s*([\w.\"'-]+)\s*=", line):
            lines[*table, *entry[1].replace('"', "").replace("'", "").split(".")] = number
    return lines


def _has_deep_key(text: str) -> bool:
    tokens = (token for token in re.findall(r"[^,=\[\]{}#\n]+", text) if token.count(".") > DEEPEST)
    return any(len(re.findall(r"[\w\"'-]\s*\.\s*(?=[\w\"'-])", token)) > DEEPEST for token in tokens)


def _quoted_line(text: str, message: str) -> str:
    """Return the line that a message of the TOML parser is about, after a colon; '' if it names none."""
    number = re.search(r"at line (\d+)", message)
    return f": {shown(text.splitlines()[int(number[1]) - 1].strip())}" if number else ""
