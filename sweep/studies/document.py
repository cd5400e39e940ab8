"""The document of a study: its file, the options of the command line that change it, and the problems with it."""

import os
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from linksweep.sweep.contract import SweepError, shown, suggest
from linksweep.sweep.formatting import split_assignment
from linksweep.sweep.studies import built_in_studies
from linksweep.sweep.studies.form import Sampling

MAX_FILE_BYTES = 1_000_000

DEEPEST = 100
"""The most parts of a dotted key: the parser's time grows with their square, to minutes for a long line of them."""

MAX_PROBLEMS = 50
"""After this many problems of one study no more are looked for."""

REFERENCE = re.compile(r"(?P<place>[^:\n]+\.py|[A-Za-z_][\w.]*):[A-Za-z_]\w*")
"""``file.py:NAME`` and ``module:NAME``."""

KeyPath = tuple[str | int, ...]
"""Keys and indices that lead to a value of the document."""


def reference_in(name_or_path: str) -> str | None:
    """Return the argument if it is a reference, ``file.py:NAME`` or ``module:NAME``; None for a file or other name."""
    match = REFERENCE.fullmatch(name_or_path)
    return None if match is None or Path(name_or_path).exists() else name_or_path


def find_study(name_or_path: str) -> Path:
    """Return the file of a built-in name or a path; raises SweepError where there is none."""
    built_in = built_in_studies()
    if name_or_path not in built_in and not os.path.exists(name_or_path):
        files = [str(path) for end in ("toml", "py") for path in Path(name_or_path).parent.glob(f"*.{end}")]
        hint = suggest(name_or_path, [*built_in, *files])
        raise SweepError(f"no study {shown(name_or_path)}: neither a file nor a built-in study{hint}")
    if os.path.isdir(name_or_path):
        raise SweepError("is a folder, not a study; for a store there is `sweep run --retry STORE`", name_or_path)
    return built_in.get(name_or_path, Path(name_or_path))


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
    """Return the document of a TOML text; raises SweepError where it is not valid."""
    if path.suffix == ".py":
        raise SweepError(f"is Python, not a study; name a function in it, as {path}:NAME", str(path))
    # of what may be a key: texts with many dots are none
    tokens = (token for token in re.findall(r"[^,=\[\]{}#\n]+", text) if token.count(".") > DEEPEST)
    try:
        if any(len(re.findall(r"[\w\"'-]\s*\.\s*(?=[\w\"'-])", token)) > DEEPEST for token in tokens):
            raise RecursionError
        return tomllib.loads(text)
    except ValueError as error:
        raise SweepError(f"not valid TOML: {error}", str(path)) from error
    except RecursionError as error:
        raise SweepError("not valid TOML: nested too deeply", str(path)) from error


def _lines_of_keys(text: str) -> dict[KeyPath, int]:
    """Return the 1-based line of every key of a TOML text, as far as patterns find it: the parser gives no lines."""
    table: KeyPath = ()
    counts: dict[str, int] = {}
    lines: dict[KeyPath, int] = {}
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

    ``where`` names the study, ``text`` is the text of its file, and ``options`` says which option of the command line
    gave the value at a place.
    """

    def __init__(self, where: str, text: str = "", options: Mapping[KeyPath, str] | None = None) -> None:
        self.where, self.text, self.options = where, text, {} if options is None else options
        self.sentences: list[str] = []

    @cached_property
    def _lines(self) -> dict[KeyPath, int]:
        return _lines_of_keys(self.text)

    def add(self, place: KeyPath, message: str) -> None:
        """Take one problem; raises SweepError where there are too many."""
        if len(self.sentences) >= MAX_PROBLEMS:
            raise SweepError([*self.sentences, "... and perhaps more problems like these"], self.where)
        around = [place[:n] for n in range(len(place), 0, -1)]  # the value, and the tables that it is in
        sources = [self.options[table] for table in around if self.options.get(table)]
        sources += [f"line {self._lines[table]}" for table in around if table in self._lines]
        key = ".".join(str(p) if re.fullmatch(r"[\w-]{1,60}", str(p)) else shown(p) for p in place)
        self.sentences.append(f"{key}{f' ({sources[0]})' if sources else ''}: {message}")

    @contextmanager
    def at(self, place: KeyPath, before: str = "") -> Iterator[None]:
        """Take the message of a ValueError or SweepError as problems of a place, with the text ``before`` it."""
        try:
            yield
        except (SweepError, ValueError) as error:
            for problem in error.problems if isinstance(error, SweepError) else [error]:
                self.add(place, f"{before}{problem}")

    def report(self) -> None:
        """Raise SweepError with all problems, if there are any."""
        if self.sentences:
            raise SweepError(self.sentences, self.where)


@dataclass
class Overrides:
    """The options of the command line that change a study, as `load_study` has them; ``by_place`` says which of them
    gave the value at a place of the document.
    """

    settings: Sequence[str] = ()
    axes: Sequence[str] = ()
    points: str | None = None
    design: str | None = None
    ranges: Sequence[str] = ()
    exclude: Sequence[str] = ()
    by_place: dict[KeyPath, str] = field(default_factory=dict)

    @property
    def written(self) -> list[tuple[str, str]]:
        """All options, as pairs of a flag and its text."""
        flags = {"--set": self.settings, "--axis": self.axes, "--points": [self.points], "--design": [self.design]}
        flags |= {"--range": self.ranges, "--exclude": self.exclude}
        return [(flag, text) for flag, texts in flags.items() for text in texts if text is not None]

    def apply(
        self, document: dict[str, Any], parameters: Collection[str], texts: Collection[str], problems: list[str]
    ) -> None:
        """Change a document; ``parameters`` are those that are meant although a key of [sampling] has their name, and
        ``texts`` those whose values are texts.

        The conclusion is removed where the points change, or parameters that the study fixes: it is about these.
        """
        points, axes = (table if isinstance(table := document.get(key), dict) else {} for key in ("points", "axes"))
        axes_before, other = set(axes), {"axes": "fixed", "fixed": "axes"}
        if self.points is not None or self.design is not None:
            kept = ("seed", "ranges") if self.points is None else ()
            document["points"] = {key: points[key] for key in kept if key in points}
        slots: dict[KeyPath, str] = {}  # of two options that set the same, one would be lost
        for flag, text in self.written:
            option = f"{flag} {text if text.isprintable() and len(text) <= 80 else shown(text)}"
            try:
                values = _values_of(flag, text, parameters, texts)
            except SweepError as error:
                problems.append(f"{flag} {shown(text)}: {error}")
                continue
            for place, value in values.items():
                slot = ("fixed", *place[1:]) if place[0] == "axes" else place  # a parameter has one place
                if (earlier := slots.setdefault(slot, option)) != option:
                    problems.append(f"{earlier} and {option}: {place[-1]} is given twice; leave out one of the two")
                self.by_place[place] = option
                if flag in ("--points", "--design", "--range"):  # the table is theirs
                    self.by_place.setdefault(("points",), option)
                if place[0] in ("points", "fixed", "exclude") or (place[0] == "axes" and place[1] not in axes_before):
                    document.pop("conclusion", None)
                # an option decides whether a parameter is an axis or fixed, whatever the file says
                if isinstance(elsewhere := document.get(other.get(str(place[0]), "")), dict):
                    elsewhere.pop(place[1], None)
                _put(document, place, value)


def _put(document: dict[str, Any], place: KeyPath, value: Any) -> None:
    """Set a value of a document, unless it is to be in what is no table: reading the document will say so."""
    if place[0] == "exclude":
        if isinstance(clauses := document.setdefault("exclude", []), list):
            document["exclude"] = [*clauses, value]
        return
    *tables, key = map(str, place)
    for table in tables:
        document = document.setdefault(table, {})
        if not isinstance(document, dict):
            return
    document[key] = value


def _values_of(flag: str, text: str, parameters: Collection[str], texts: Collection[str]) -> dict[KeyPath, Any]:
    """Return the values that an option sets, by their places; raises SweepError that says how it is written."""
    if flag == "--points":
        return {("points", "file"): str(Path(text).resolve())}
    if flag == "--design":
        name, *numbers = text.split(":")
        if len(numbers) > 2:
            raise SweepError("must be written NAME:N or NAME:N:SEED")
        seed_too = zip(("n", "seed"), map(parse_value, numbers), strict=False)
        return {("points", "design"): name, **{("points", key): number for key, number in seed_too}}
    if flag == "--exclude":
        return {("exclude", text): _conditions(text, texts)}
    key, value = split_assignment(text)
    if not key:
        ways = {"--axis": "NAME=SPEC", "--range": "NAME=LOW:HIGH, NAME=LOW:HIGH:log or NAME=A,B,C"}
        raise SweepError(f"must be written {ways.get(flag, 'KEY=VALUE')}")
    if flag != "--set":
        place = ("axes", key) if flag == "--axis" else ("points", "ranges", key)
        return {place: (parse_axis if flag == "--axis" else parse_range)(value, is_text=key in texts)}
    if key == "title":
        return {(key,): value}
    table, _, name = key.partition(".")
    if table not in ("fixed", "points", "sampling") or not name:
        table, name = "sampling" if key in Sampling.model_fields and key not in parameters else "fixed", key
    return {(table, name): parse_value(value, is_text=name in texts and table == "fixed")}


def _conditions(text: str, texts: Collection[str]) -> dict[str, Any]:
    """Return an entry of [[exclude]] written as ``kernel=linear,gamma>1``."""
    conditions: dict[str, Any] = {}
    for part in text.split(","):
        condition = re.fullmatch(r"\s*([\w.-]+)\s*(==|[=<>])\s*([^=<>].*?)\s*", part)
        if condition is None or (condition[2] in ("=", "==") and condition[1] in conditions):
            raise SweepError("must be written NAME=VALUE, NAME>NUMBER or NAME<NUMBER, several with commas between them")
        value = parse_value(condition[3], is_text=condition[1] in texts)
        rule = {"<": "below", ">": "above"}.get(condition[2])
        conditions[condition[1]] = value if rule is None else {**conditions.get(condition[1], {}), rule: value}
    return conditions


def parse_value(text: str, is_text: bool = False) -> Any:
    """Return a value as TOML would read it, or the text itself where it is a bare word, or is to be one.

    >>> parse_value("1e3"), parse_value("[1, 2]"), parse_value("true"), parse_value("gaia")
    (1000.0, [1, 2], True, 'gaia')
    >>> parse_value("1e3", is_text=True), parse_value("'1e3'", is_text=True)
    ('1e3', '1e3')
    """
    try:
        document = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text  # a bare word is a string
    value = document["value"] if len(document) == 1 else text
    return text if is_text and not isinstance(value, str) else value


def parse_axis(text: str, is_text: bool = False) -> Any:
    """Return an axis: ``14:20:0.5`` is a range with a step, ``10:1000:log5`` five values in equal ratios, ``0:1:lin5``
    five with equal steps, anything else a list.

    >>> parse_axis("14:20:0.5")
    {'start': 14, 'stop': 20, 'step': 0.5}
    >>> parse_axis("amex,gaia")
    ['amex', 'gaia']
    """
    if len(parts := text.split(":")) == 3 and not is_text:
        ends = {"start": parse_value(parts[0]), "stop": parse_value(parts[1])}
        if (spacing := parts[2][:3]) in ("log", "lin"):
            more = {"spacing": "log"} if spacing == "log" else {}
            return {**ends, "num": parse_value(parts[2][3:]), **more}
        return {**ends, "step": parse_value(parts[2])}
    listed = parse_value(text)
    return listed if isinstance(listed, list) else _split(text, is_text)


def _split(text: str, is_text: bool = False) -> list[Any]:
    """Return values with commas between them; raises SweepError where a comma would cut a text in quotes."""
    parts = [part.strip() for part in text.split(",")]
    for part in parts:
        if part[:1] in ("'", '"') and (len(part) == 1 or part[-1] != part[0]):
            raise SweepError(f'{shown(part)}: commas divide values; give texts with commas to --axis as ["a,b", "c"]')
    return [parse_value(part, is_text) for part in parts]


def parse_range(text: str, is_text: bool = False) -> Any:
    """Return a range: ``0.1:0.5`` on a linear scale, ``1:100:log`` on a logarithmic one, anything else as a list.

    >>> parse_range("1:100:log"), parse_range("amex,gaia")
    ({'low': 1, 'high': 100, 'spacing': 'log'}, {'values': ['amex', 'gaia']})
    """
    parts = text.split(":")
    if len(parts) not in (2, 3) or is_text:
        return {"values": _split(text, is_text)}
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
