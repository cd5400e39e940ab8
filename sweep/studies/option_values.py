"""Values as options of the command line write them: of a parameter, an axis, a range, a place of the grid."""

import tomllib
from collections.abc import Sequence
from typing import Any

from linksweep.sweep.contract import SweepError, shown
from linksweep.sweep.formatting import split_assignment


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
    parts = text.split(":")
    if len(parts) == 3:
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
    if len(parts) in (2, 3):
        spacing = {"spacing": parts[2]} if len(parts) == 3 else {}
        return {"low": parse_value(parts[0]), "high": parse_value(parts[1]), **spacing}
    return {"values": _split(text)}


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
