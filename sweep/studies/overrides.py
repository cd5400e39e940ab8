"""Overrides: options of the command line that change a study's document."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from linksweep.sweep.contract import SweepError, shown
from linksweep.sweep.formatting import split_assignment
from linksweep.sweep.studies.form import Sampling
from linksweep.sweep.studies.option_values import parse_axis, parse_range, parse_value
from linksweep.sweep.studies.source import Place


@dataclass(frozen=True)
class Overrides:
    """The options that changed a document: all as written, the one that gave the value at each place, and the problems
    with them.
    """

    written: tuple[str, ...] = ()
    by_place: Mapping[Place, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()


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
    problems: list[str] = []
    by_place: dict[Place, str] = {}
    before = set(document.get("axes", {})) if isinstance(document.get("axes"), dict) else set()
    given: dict[Place, str] = {}
    for flag, option in [*(("--set", setting) for setting in settings), *(("--axis", axis) for axis in axes)]:
        place = _override_value(document, option, problems, as_axis=flag == "--axis")
        by_place[place] = named = f"{flag} {_quoted(option)}"
        _given_once(given, ("fixed", *place[1:]) if place[:1] == ("axes",) else place, named, problems)
    if any(place[:1] == ("fixed",) or (place[:1] == ("axes",) and place[1] not in before) for place in by_place):
        document.pop("conclusion", None)
    chosen = [("--points", points), ("--design", design), *(("--range", text) for text in ranges)]
    laid = [f"{flag} {_quoted(text)}" for flag, text in chosen if text is not None]
    if laid:
        document.pop("conclusion", None)
        kept, ranges_given = _override_points(document, points, design, ranges, problems)
        by_place |= ranges_given
        lost = [option for at, option in given.items() if at[:1] == ("points",) and at[1] not in kept]
        problems += [f"{option} has no effect beside {laid[0]}; leave out one of the two" for option in lost]
        by_place[("points",)] = laid[0]
    written = [f"--set {s}" for s in settings] + [f"--axis {a}" for a in axes] + laid
    return Overrides(tuple(written), by_place, tuple(problems))


def _given_once(given: dict[Place, str], place: Place, option: str, problems: list[str]) -> None:
    """Report an option that sets what another, earlier option has set; one of the two would be lost."""
    if place and given.setdefault(place, option) != option:
        problems.append(f"{given[place]} and {option}: {place[-1]} is given twice; leave out one of the two")


def _override_value(document: dict[str, Any], option: str, problems: list[str], as_axis: bool) -> tuple[str, ...]:
    """Put KEY=VALUE into the document: a sampling key or the title in its own place, a parameter into [fixed] or, as an
    axis, into [axes].  Return the place of the value, empty if there is none.
    """
    flag = "--axis" if as_axis else "--set"
    key, value = split_assignment(option)
    if not key:
        problems.append(f"{flag} {shown(option)}: must be written {'NAME=SPEC' if as_axis else 'KEY=VALUE'}")
        return ()
    sampling_key = key.removeprefix("sampling.")
    if as_axis:
        try:
            section, other, parsed = "axes", "fixed", parse_axis(value)
        except SweepError as error:
            problems.append(f"{flag} {shown(option)}: {error}")
            return ()
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


def _override_points(
    document: dict[str, Any], file: str | None, design: str | None, ranges: Sequence[str], problems: list[str]
) -> tuple[set[str], dict[Place, str]]:
    """Apply --points, --design and --range to the table [points] of a document; return its keys that stay as they were,
    and the place of each range.
    """
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
    stay = kept.keys() - points.keys()
    points = {**kept, **points}
    given: dict[Place, str] = {}
    for option in ranges:
        key, value = split_assignment(option)
        if not key or not isinstance(points.setdefault("ranges", {}), dict):
            problems.append(f"--range {shown(option)}: must be written NAME=LOW:HIGH, NAME=LOW:HIGH:log or NAME=A,B,C")
            continue
        _given_once(given, ("points", "ranges", key), f"--range {_quoted(option)}", problems)
        points["ranges"] = points["ranges"] | {key: parse_range(value)}
    document["points"] = points
    return stay, given


def _quoted(option: str) -> str:
    return option if option.isprintable() and len(option) <= 80 else shown(option)
