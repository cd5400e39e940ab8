"""The document of a study: its file, the options of the command line that change it, and the problems with it."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.formatting import split_assignment
from linksweep.sweep.studies.study import Sampling

MAX_FILE_BYTES = 1_000_000

DEEPEST = 100
"""The most parts of a dotted key: the parser's time grows with their square, to minutes for a long line of them."""

MAX_PROBLEMS = 50
"""After this many problems of one study no more are looked for."""

REFERENCE = re.compile(r"(?P<place>[^:\n]+\.py|[A-Za-z_][\w.]*):[A-Za-z_]\w*")
"""``file.py:NAME`` and ``module:NAME``."""

Place = tuple[str | int, ...]
"""Keys and indices that lead to a value of the document."""


def built_in_studies() -> dict[str, Path]:
    """Return the studies that ship with the package, by name."""
    return {path.stem: path for path in sorted(Path(str(resources.files("linksweep") / "sweeps")).glob("*.toml"))}


def reference_in(name_or_path: str) -> str | None:
    """Return the argument if it is a reference, ``file.py:NAME`` or ``module:NAME``; None for a file or other name."""
    match = REFERENCE.fullmatch(name_or_path)
    return None if match is None or Path(name_or_path).exists() else name_or_path


def find_study(name_or_path: str) -> Path:
    """Return the file of a built-in name or a path; raises SweepError where there is none."""
    built_in = built_in_studies()
    if name_or_path in built_in:
        return built_in[name_or_path]
    path = Path(name_or_path)
    try:
        if path.is_dir():
            raise SweepError(f"{name_or_path!r} is a directory, not a study file")
        if path.exists():
            return path
    except (OSError, ValueError) as error:  # for example a name that is too long, or a directory without permission
        reason = getattr(error, "strerror", None) or str(error)
        raise SweepError(f"the study {shown(name_or_path)} cannot be read: {reason}") from error
    hint = "" if path.suffix else suggest(name_or_path, list(built_in))
    raise SweepError(f"no study {name_or_path!r}: neither a file nor a built-in study{hint}")


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
    tokens = (token for token in re.findall(r"[^,=\[\]{}#\n]+", text) if token.count(".") > DEEPEST)
    try:
        if any(len(re.findall(r"[\w\"'-]\s*\.\s*(?=[\w\"'-])", token)) > DEEPEST for token in tokens):
            raise RecursionError
        return tomllib.loads(text)
    except ValueError as error:
        number = re.search(r"at line (\d+)", str(error))
        quoted = f": {shown(text.splitlines()[int(number[1]) - 1].strip())}" if number else ""
        raise SweepError(f"not valid TOML: {error}{quoted}", str(path)) from error
    except RecursionError as error:
        raise SweepError("not valid TOML: nested too deeply", str(path)) from error


def _lines_of_keys(text: str) -> dict[Place, int]:
    """Return the 1-based line of every key of a TOML text, as far as patterns find it: the parser gives no lines."""
    table: Place = ()
    counts: dict[str, int] = {}
    lines: dict[Place, int] = {}
    for number, whole in enumerate(text.split("\n"), 1):
        line = whole[:200]  # a key is at the beginning; the patterns are slow on a long line
        if header := re.match(r"\s*(\[\[?)\s*([\w.\"' -]+?)\s*\]\]?\s*(?:#.*)?$", line):
            counts[header[2]] = index = counts.get(header[2], -1) + 1
            table = tuple(part.strip(" \"'") for part in header[2].split("."))
            table = (*table, index) if header[1] == "[[" else table
            lines[table] = number
        elif entry := re.match(r"\s*([\w.\"'-]+)\s*=", line):
            lines[*table, *entry[1].replace('"', "").replace("'", "").split(".")] = number
    return lines


class Problems:
    """Takes problems of a study by their place in its document, so that all are reported at once.

    ``where`` names the study, ``text`` is the text of its file, ``sentences`` are the problems so far, and
    ``overridden`` says which option of the command line gave the value at a place.
    """

    def __init__(
        self, where: str, text: str = "", sentences: Sequence[str] = (), overridden: Mapping[Place, str] | None = None
    ) -> None:
        self.sentences, self.overridden = list(sentences), overridden or {}
        self._where = where
        self._lines = cache(lambda: _lines_of_keys(text))
        self._table: Place = ()

    def inside(self, *table: str | int) -> "Problems":
        """Return an object that takes problems for the same list by their place in one table of the document."""
        inner = copy(self)
        inner._table = (*self._table, *table)
        return inner

    def add(self, place: Place, message: str) -> None:
        """Take one problem; raises SweepError where there are too many."""
        if len(self.sentences) >= MAX_PROBLEMS:
            raise SweepError([*self.sentences, "... and perhaps more problems like these"], self._where)
        whole = (*self._table, *place)
        around = [whole[:n] for n in range(len(whole), 0, -1)]  # the value, and the tables that it is in
        source = next((self.overridden[table] for table in around if self.overridden.get(table)), None)
        if source is None:
            source = next((f"line {self._lines()[table]}" for table in around if table in self._lines()), None)
        key = ".".join(str(p) if re.fullmatch(r"[\w-]{1,60}", str(p)) else shown(p) for p in whole)
        self.sentences.append(f"{key}{f' ({source})' if source else ''}: {message}")

    @contextmanager
    def at(self, place: Place, before: str = "") -> Iterator[None]:
        """Take the message of a ValueError or SweepError as problems of a place, with the text ``before`` it."""
        try:
            yield
        except ValueError as error:
            self.add(place, f"{before}{error}")
        except SweepError as error:
            for problem in error.problems:
                self.add(place, f"{before}{problem}")


@dataclass
class Overrides:
    """The options that changed a document: all as written, the one that gave the value at each place, and the problems
    with them.
    """

    written: list[str] = field(default_factory=list)
    by_place: dict[Place, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    slots: dict[Place, str] = field(default_factory=dict)

    def put(self, place: Place, option: str, slot: Place | None = None) -> None:
        """Note what gave the value at a place; two options that set one ``slot`` are a problem: one would be lost."""
        if not place:
            return
        self.by_place[place] = option
        if (earlier := self.slots.setdefault(slot or place, option)) != option:
            self.problems.append(f"{earlier} and {option}: {place[-1]} is given twice; leave out one of the two")


def override(
    document: dict[str, Any],
    settings: Sequence[str],
    axes: Sequence[str],
    points: str | None,
    design: str | None,
    ranges: Sequence[str],
) -> Overrides:
    """Apply the options of `load_study` to a document.

    The conclusion is removed if they change what it is about: the points, or parameters that the study fixes.
    """
    made = Overrides([f"--set {one}" for one in settings] + [f"--axis {one}" for one in axes])
    before = set(document.get("axes", {})) if isinstance(document.get("axes"), dict) else set()
    for flag, option in [*(("--set", one) for one in settings), *(("--axis", one) for one in axes)]:
        place = _override_value(document, option, made.problems, as_axis=flag == "--axis")
        made.put(place, f"{flag} {_quoted(option)}", ("fixed", *place[1:]) if place[:1] == ("axes",) else None)
    if any(place[0] == "fixed" or (place[0] == "axes" and place[1] not in before) for place in made.by_place):
        document.pop("conclusion", None)
    chosen = [("--points", points), ("--design", design), *(("--range", text) for text in ranges)]
    if laid := [f"{flag} {_quoted(text)}" for flag, text in chosen if text is not None]:
        document.pop("conclusion", None)
        settled = {at: option for at, option in made.by_place.items() if at[0] == "points"}
        kept = _override_points(document, points, design, ranges, made)
        lost = [option for at, option in settled.items() if at[1] not in kept]
        made.problems += [f"{option} has no effect beside {laid[0]}; leave out one of the two" for option in lost]
        made.by_place["points",] = laid[0]
        made.written += laid
    return made


def _override_value(document: dict[str, Any], option: str, problems: list[str], as_axis: bool) -> Place:
    """Put KEY=VALUE into the document: a sampling key or the title in its own place, a parameter into [fixed] or, as an
    axis, into [axes].  Return the place of the value, empty if there is none.
    """
    flag = "--axis" if as_axis else "--set"
    key, value = split_assignment(option)
    section, other = ("axes", "fixed") if as_axis else ("fixed", "axes")
    try:
        if not key:
            raise SweepError(f"must be written {'NAME=SPEC' if as_axis else 'KEY=VALUE'}")
        parsed = parse_axis(value) if as_axis else parse_value(value)
    except SweepError as error:
        problems.append(f"{flag} {shown(option)}: {error}")
        return ()
    if key == "title" and not as_axis:
        document[key] = value
        return (key,)
    if not as_axis and key.removeprefix("sampling.") in Sampling.model_fields:
        section, other, key = "sampling", "", key.removeprefix("sampling.")
    elif not as_axis and key.startswith("points."):
        section, other, key = "points", "", key.removeprefix("points.")
    key = key if as_axis else key.removeprefix("fixed.")
    if not all(isinstance(document.get(table, {}), dict) for table in (section, other) if table):
        return ()  # the form's own check will say what is wrong with this section
    document.setdefault(section, {})[key] = parsed
    document.get(other, {}).pop(key, None)
    return section, key


def _override_points(
    document: dict[str, Any], file: str | None, design: str | None, ranges: Sequence[str], made: Overrides
) -> set[str]:
    """Apply --points, --design and --range to the table [points] of a document; return its keys that stay as they
    were.
    """
    points: dict[str, Any] = {"file": str(Path(file).resolve())} if file is not None else {}
    if design is not None:
        name, *numbers = design.split(":")
        points |= {"design": name} | {key: parse_value(text) for key, text in zip(("n", "seed"), numbers, strict=False)}
        if len(numbers) > 2:
            made.problems.append(f"--design {shown(design)}: must be written NAME:N or NAME:N:SEED")
    old = document.get("points")
    kept = old if isinstance(old, dict) and file is None else {}
    if design is not None:
        kept = {key: kept[key] for key in ("seed", "ranges") if key in kept}
    document["points"] = laid = {**kept, **points}
    for option in ranges:
        key, value = split_assignment(option)
        if not key or not isinstance(laid.setdefault("ranges", {}), dict):
            ways = "NAME=LOW:HIGH, NAME=LOW:HIGH:log or NAME=A,B,C"
            made.problems.append(f"--range {shown(option)}: must be written {ways}")
            continue
        made.put(("points", "ranges", key), f"--range {_quoted(option)}")
        laid["ranges"] = laid["ranges"] | {key: parse_range(value)}
    return kept.keys() - points.keys()


def _quoted(option: str) -> str:
    return option if option.isprintable() and len(option) <= 80 else shown(option)


def parse_value(text: str) -> Any:
    """Return a value as TOML would read it, or the text itself where it is a bare word.

    >>> parse_value("1e3"), parse_value("[1, 2]"), parse_value("true"), parse_value("gaia")
    (1000.0, [1, 2], True, 'gaia')
    """
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text  # a bare word is a string
    return parsed["value"] if len(parsed) == 1 else text


def parse_axis(text: str) -> Any:
    """Return an axis: ``14:20:0.5`` is a range with a step, ``10:1000:log5`` five values in equal ratios, anything else
    a list.

    >>> parse_axis("14:20:0.5")
    {'start': 14, 'stop': 20, 'step': 0.5}
    >>> parse_axis("amex,gaia")
    ['amex', 'gaia']
    """
    if len(parts := text.split(":")) == 3:
        ends = {"start": parse_value(parts[0]), "stop": parse_value(parts[1])}
        if parts[2].startswith("log"):
            return {**ends, "num": parse_value(parts[2][3:]), "spacing": "log"}
        return {**ends, "step": parse_value(parts[2])}
    listed = parse_value(text)
    return listed if isinstance(listed, list) else _split(text)


def _split(text: str) -> list[Any]:
    """Return values with commas between them; raises SweepError where a comma would cut a text in quotes."""
    parts = [part.strip() for part in text.split(",")]
    for part in parts:
        if part[:1] in ("'", '"') and (len(part) == 1 or part[-1] != part[0]):
            raise SweepError(f'{shown(part)}: commas divide values; give texts with commas to --axis as ["a,b", "c"]')
    return [parse_value(part) for part in parts]


def parse_range(text: str) -> Any:
    """Return a range: ``0.1:0.5`` on a linear scale, ``1:100:log`` on a logarithmic one, anything else as a list.

    >>> parse_range("1:100:log"), parse_range("amex,gaia")
    ({'low': 1, 'high': 100, 'spacing': 'log'}, {'values': ['amex', 'gaia']})
    """
    parts = text.split(":")
    if len(parts) not in (2, 3):
        return {"values": _split(text)}
    spacing = {"spacing": parts[2]} if len(parts) == 3 else {}
    return {"low": parse_value(parts[0]), "high": parse_value(parts[1]), **spacing}


def parse_places(texts: Sequence[str]) -> dict[str, str]:
    """Return values of axes by name, from texts like "model=gaia,v_max=16".

    Raises SweepError that lists what is wrong.
    """
    places: dict[str, str] = {}
    problems = []
    for part in (part for text in texts for part in text.split(",")):
        name, value = split_assignment(part)
        if not name:
            problems.append(f"{shown(part)}: a place is AXIS=VALUE, several with commas between them")
        elif places.setdefault(name, value) != value:
            problems.append(f"{name} is given twice, as {places[name]} and {value}")
    if problems:
        raise SweepError(problems, "--at")
    return places
