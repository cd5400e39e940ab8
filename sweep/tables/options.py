"""Options that are declared once, as fields of a dataclass: a command, a function and a study have the same, and refuse
a value with the same sentence.

A shell asks for them at each press of a key, so that nothing heavy is imported here.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Self

from linksweep.sweep.formatting import split_assignment

if TYPE_CHECKING:
    from linksweep.sweep.contract import Parameter

Pairs = tuple[tuple[str, str], ...]


def option(
    meaning: str,
    metavar: str = "",
    default: Any = "",
    kind: str = "str",
    only: str = "",
    joined: str = "",
    **limits: Any,
) -> Any:
    """Declare an option as a field of a dataclass; ``kind`` and ``limits`` are those of a `Parameter`.

    The command writes its value as ``metavar``; a "map", "files" or what is ``joined`` it may be given several times,
    elsewhere it is a mapping or list.  Text that means a list is ``joined`` by the first of these marks, and by the
    second within.  ``only`` some have the option, by default all.
    """
    about = {"meaning": meaning, "kind": kind, **limits}
    return field(default=default, metadata={"about": about, "metavar": metavar, "joined": joined, "only": only.split()})


def one_of(meaning: str, *choices: str, only: str = "") -> Any:
    """Declare an option whose value is one of some words, by default the first."""
    return option(meaning, f"[{'|'.join(choices)}]", choices[0], only=only, choices=choices)


def mapping(meaning: str, metavar: str, kind: str = "map") -> Any:
    """Declare an option of several values by name."""
    return option(meaning, metavar, (), kind)


def declared(entry: str, *groups: type["Declared"]) -> list[Field[Any]]:
    """Return the options that a command, function or study has."""
    return [one for group in groups for one in fields(group) if entry in (one.metadata["only"] or [entry])]


def parameter(one: Field[Any]) -> "Parameter":
    """Return an option as a parameter of a study, which says what values it may have."""
    from linksweep.sweep.contract import Parameter

    return Parameter(one.name, default=one.default, **one.metadata["about"])


@dataclass(frozen=True)
class Declared:
    """Options with the values that a study would have; text, lists and mappings that mean these are allowed too."""

    def __post_init__(self) -> None:
        from linksweep.sweep.contract import SweepError

        problems = []
        for one in fields(self):
            try:
                object.__setattr__(self, one.name, _checked(one, getattr(self, one.name)))
            except (ValueError, TypeError) as error:
                problems.append(str(error))
        if problems:
            raise SweepError(problems)

    @classmethod
    def named(cls, entry: str, values: Mapping[str, Any], *others: type["Declared"]) -> Self:
        """Return the options among ``values``, of which ``others`` are of other kinds; raises SweepError for those that
        a command, function or study does not have, and for values that are not allowed.
        """
        from linksweep.sweep.contract import SweepError, suggest

        known = [one.name for one in declared(entry, cls, *others)]
        if unknown := [name for name in values if name not in known]:
            raise SweepError(f"no option {unknown[0]} of {entry}{suggest(unknown[0], known)}")
        return cls(**{one.name: values[one.name] for one in fields(cls) if one.name in values})


def _checked(one: Field[Any], value: Any) -> Any:
    """Return the value of an option as a study has it; raises ValueError for one that is not allowed."""
    kind, metavar, joined = one.metadata["about"]["kind"], one.metadata["metavar"], one.metadata["joined"]
    value = value.tolist() if hasattr(value, "tolist") else value
    if value in (None, (), one.default):
        return one.default
    if kind in ("map", "files"):
        some = value.items() if isinstance(value, Mapping) else [value] if isinstance(value, str | PurePath) else value
        pairs = [_pair(one.name, metavar, k, part) for k, part in enumerate(some)]
        if len(named := dict(pairs)) < len(pairs):
            listed = ", ".join("=".join(pair).removeprefix(":=") for pair in pairs)
            raise ValueError(f"{one.name}: {listed}: one is named twice")
        parameter(one).parse(named)
        return tuple(pairs)
    if joined or isinstance(value, PurePath):
        value = _text(value, joined)
    if value == "none" and one.default in (None, ""):  # as results say it
        return one.default
    if kind == "vector" and isinstance(value, str):
        value = numbers(value) or value
        if "TABLE" in metavar and isinstance(value, str):
            return value
    if kind in ("float", "int") and isinstance(value, str):
        value = number(value)
    return parameter(one).parse(value)


def number(text: str) -> Any:
    """Return the number that a text is, or the text."""
    for kind in (int, float) if "_" not in text else ():  # which Python allows between digits
        with suppress(ValueError):
            return kind(text)
    return text


def numbers(text: str, mark: str = ",") -> list[float]:
    """Return the numbers in a text, divided by a mark; none if a part of it is no number."""
    parts = [number(part) for part in text.split(mark)]
    return [] if any(isinstance(part, str) for part in parts) else list(map(float, parts))


def _pair(name: str, metavar: str, place: int, part: Any) -> tuple[str, str]:
    """Return the key and the value of one part of a mapping, as the command writes it or by its number."""
    if isinstance(part, tuple):
        key, value = part
    elif metavar.startswith("[NAME=]") and "=" not in str(part):
        key, value = ":", part  # of all tables
    else:
        key, value = split_assignment(str(part)) if "=" in metavar else (str(place), part)
    if not key:
        raise ValueError(f"{name} = {part!r}: must be {metavar}")
    return str(key), str(value)


def _text(value: Any, joined: str) -> str:
    if isinstance(value, Mapping):
        value = [f"{key}={_text(one, joined[1:])}" for key, one in value.items()]
    if isinstance(value, str) or not isinstance(value, Iterable):
        return str(value)
    return joined[:1].join(_text(one, joined[1:]) for one in value)


def by_table(
    name: str, pairs: Iterable[tuple[str, Any]], tables: Collection[str], common: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return what an option says of each quantity of each table: TABLE:KEY, or KEY for all ``common`` tables that say
    nothing themselves.  Raises SweepError for a table that does not exist.
    """
    from linksweep.sweep.contract import SweepError, suggest

    said: dict[str, dict[str, Any]] = {}
    for text, value in sorted(pairs, key=lambda pair: bool(pair[0].rpartition(":")[0])):
        table, _, key = text.rpartition(":")
        if table and table not in tables:
            hint = suggest(table, list(tables)) if tables else ", nor any other"
            raise SweepError(f"{name}: no table {table!r}{hint}")
        for one in [table] if table else common:
            said.setdefault(one, {})[key] = value
    return said
