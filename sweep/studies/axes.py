"""Values of an axis, and overrides from the command line laid over a study's document."""

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sweep.contract import SweepError, shown
from sweep.formatting import split_assignment
from sweep.studies.study import Sampling

MAX_AXIS_VALUES = 1_000_000


def axis_values(spec: object, whole: bool = False) -> list[Any]:
    """Return the values of an axis written as a list, {values}, {start, stop, step} or {start, stop, num, spacing}.

    A range includes its stop; values are rounded to 12 digits, so that 14.1 from a range is the 14.1 of a list, and to
    integers if ``whole`` and log-spaced.  Raises ValueError that says what is allowed.

    >>> axis_values({"start": 14, "stop": 16, "step": 0.5})
    [14.0, 14.5, 15.0, 15.5, 16.0]
    >>> axis_values({"start": 10, "stop": 1000, "num": 5, "spacing": "log"}, whole=True)
    [10.0, 32.0, 100.0, 316.0, 1000.0]
    """
    if isinstance(spec, list):
        return spec
    if not isinstance(spec, dict):
        raise ValueError(f"{shown(spec)}: write a list, {{ start, stop, step }} or {{ start, stop, num, spacing }}")
    keys = set(spec)
    if keys == {"values"}:
        if not isinstance(spec["values"], list):
            raise ValueError(f"values = {shown(spec['values'])}: must be a list")
        return list(spec["values"])
    spacing = spec.get("spacing", "linear")
    if keys - {"spacing"} not in ({"start", "stop", "step"}, {"start", "stop", "num"}) or (
        "step" in keys and "spacing" in keys
    ):
        raise ValueError(
            f"keys {shown(sorted(map(str, keys)))}: allowed are values; start, stop, step; start, stop, num and spacing"
        )
    for key in ("start", "stop", "step", "num"):
        if key in spec and not is_number(spec[key]):
            raise ValueError(f"{key} = {shown(spec[key])}: must be a finite number")
    start, stop = spec["start"], spec["stop"]
    if "step" in spec:
        return _stepped(start, stop, spec["step"])
    return _numbered(start, stop, spec["num"], spacing, whole)


def _numbered(start: float, stop: float, num: object, spacing: object, whole: bool) -> list[float]:
    if not isinstance(num, int) or not 1 <= num <= MAX_AXIS_VALUES:
        raise ValueError(f"num = {shown(num)}: must be an integer from 1 to {MAX_AXIS_VALUES}")
    if spacing == "linear":
        return [_rounded(start + (stop - start) * i / max(num - 1, 1)) for i in range(num)]
    if spacing != "log":
        raise ValueError(f"spacing = {shown(spacing)}: must be 'linear' or 'log'")
    if start <= 0 or stop <= 0:
        raise ValueError(f"log spacing needs start and stop > 0, not {shown(start)} and {shown(stop)}")
    values = [_rounded(start * (stop / start) ** (i / max(num - 1, 1))) for i in range(num)]
    return [float(round(v)) if math.isfinite(v) else v for v in values] if whole else values


def _stepped(start: float, stop: float, step: float) -> list[float]:
    if step == 0 or (stop - start) / step < 0:
        raise ValueError(f"step = {shown(step)}: does not lead from start = {shown(start)} to stop = {shown(stop)}")
    count = (stop - start) / step
    if count > MAX_AXIS_VALUES:
        raise ValueError(f"start, stop, step make about {count:.3g} values; at most {MAX_AXIS_VALUES} are allowed")
    return [_rounded(start + step * i) for i in range(math.floor(count + 1e-9) + 1)]


def _rounded(x: float) -> float:
    return float(f"{x:.12g}")


def is_number(x: object) -> bool:
    """Return whether x is a finite number."""
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) < 1e300


def override(document: dict[str, Any], option: str, problems: list[str], as_axis: bool) -> tuple[str, ...]:
    """Lay KEY=VALUE over the document: a sampling key or the title goes there, a parameter to [fixed] or, as an axis,
    to [axes].  Return the place of the value, empty if it could not be laid anywhere.
    """
    flag = "--axis" if as_axis else "--set"
    key, value = split_assignment(option)
    if not key:
        problems.append(f"{flag} {shown(option)}: must be written {'NAME=SPEC' if as_axis else 'KEY=VALUE'}")
        return ()
    sampling_key = key.removeprefix("sampling.")
    if as_axis:
        section, other, parsed = "axes", "fixed", _parse_axis_option(value)
    elif sampling_key in Sampling.model_fields:
        section, other, key, parsed = "sampling", "", sampling_key, parse_value(value)
    elif key.startswith("points.") and isinstance(document.setdefault("points", {}), dict):
        document["points"][key.removeprefix("points.")] = parse_value(value)
        return ("points", key.removeprefix("points."))
    elif key == "title":
        document[key] = value
        return (key,)
    else:
        section, other, key, parsed = "fixed", "axes", key.removeprefix("fixed."), parse_value(value)
    for table in (section, other):
        if table and not isinstance(document.get(table, {}), dict):
            return ()  # the form's own check will say what is wrong with this section
    document.setdefault(section, {})[key] = parsed
    document.get(other, {}).pop(key, None)
    return section, key


def override_points(
    document: dict[str, Any], file: str | None, design: str | None, ranges: Sequence[str], problems: list[str]
) -> None:
    """Lay --points, --design and --range over the table [points] of a document."""
    points: dict[str, Any] = {"file": str(Path(file).resolve())} if file is not None else {}
    if design is not None:
        name, *numbers = design.split(":")
        points |= {"design": name} | {key: parse_value(text) for key, text in zip(("n", "seed"), numbers, strict=False)}
        if len(numbers) > 2:
            problems.append(f"--design {shown(design)}: must be written NAME:N or NAME:N:SEED")
    old = document.get("points")
    kept = old if isinstance(old, dict) and file is None else {}
    if design is not None:
        kept = {key: kept[key] for key in ("seed", "ranges") if key in kept}
    points = {**kept, **points}
    for option in ranges:
        key, value = split_assignment(option)
        if not key or not isinstance(points.setdefault("ranges", {}), dict):
            problems.append(f"--range {shown(option)}: must be written NAME=LOW:HIGH, NAME=LOW:HIGH:log or NAME=A,B,C")
            continue
        points["ranges"] = points["ranges"] | {key: _parse_range_option(value)}
    document["points"] = points


def _parse_range_option(text: str) -> Any:
    """``0.1:0.5`` is a range, ``1:100:log`` one on a logarithmic scale, anything else a list of values.

    >>> _parse_range_option("1:100:log"), _parse_range_option("amex,gaia")
    ({'low': 1, 'high': 100, 'spacing': 'log'}, {'values': ['amex', 'gaia']})
    """
    parts = text.split(":")
    if len(parts) in (2, 3):
        spacing = {"spacing": parts[2]} if len(parts) == 3 else {}
        return {"low": parse_value(parts[0]), "high": parse_value(parts[1]), **spacing}
    return {"values": [parse_value(part.strip()) for part in text.split(",")]}


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


def _parse_axis_option(text: str) -> Any:
    """``14:20:0.5`` is a range with a step, ``10:1000:log5`` five values in equal ratios, anything else a list.

    >>> _parse_axis_option("14:20:0.5")
    {'start': 14, 'stop': 20, 'step': 0.5}
    >>> _parse_axis_option("amex,gaia")
    ['amex', 'gaia']
    """
    parts = text.split(":")
    if len(parts) == 3:
        start, stop, last = parts
        if last.startswith("log"):
            return {
                "start": parse_value(start),
                "stop": parse_value(stop),
                "num": parse_value(last[3:]),
                "spacing": "log",
            }
        return {"start": parse_value(start), "stop": parse_value(stop), "step": parse_value(last)}
    listed = parse_value(text)
    return listed if isinstance(listed, list) else [parse_value(part.strip()) for part in text.split(",")]
