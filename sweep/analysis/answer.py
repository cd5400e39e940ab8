"""The answer to a study's question in words: its conclusion with values, and sentences about any results."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from string import Formatter

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.compare import ARITHMETIC, MC_ERRORS_ALLOWED
from linksweep.sweep.analysis.gaps import ends_of, exact, lacking
from linksweep.sweep.analysis.long_table import own_dimensions
from linksweep.sweep.analysis.measured_claims import NOT_DONE, Measured, OutsideGridError, in_words, measure, unit_of
from linksweep.sweep.analysis.quantity import errors_beside, headlines, standard_error
from linksweep.sweep.analysis.selection import place_in_words, places_along
from linksweep.sweep.analysis.sentences import sentences
from linksweep.sweep.contract import Array, SweepError
from linksweep.sweep.formatting import in_ascii, in_short, meaning_beside, prefixed, units_of, with_unit
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.study import Conclusion, ConclusionValue

CONCLUSION = "conclusion"
"""The attribute of a dataset that holds the conclusion of its study, as JSON."""

PLUS_MINUS = " ± "
"""The text between a value and its error in a sentence."""

MOST_SHORT = 3
"""The largest number of quantities in a short answer."""


@dataclass(frozen=True)
class Answer:
    """What the results say about one quantity: a heading, its meaning, and sentences."""

    name: str
    meaning: str
    sentences: list[str]


def answer_in_short(dataset: xr.Dataset) -> list[str]:
    """Return the answer in a few sentences: the conclusion of the study with its values, or the ranges of the first
    headline quantities if it has none; an empty list for results that are not numbers.  What real data say, as
    `said_first` has it, is said in any case.
    """
    found, first = conclusion_in_words(dataset), said_first(dataset)
    told = [answer for answer in answers(dataset) if answer.sentences and (not found or answer.name in first)]
    ranges = told[:MOST_SHORT]
    names = [f"{answer.name} ({answer.meaning})" if answer.meaning else answer.name for answer in ranges]
    return [*found, *(f"{name}: {answer.sentences[0]}" for name, answer in zip(names, ranges, strict=True))]


def said_first(dataset: xr.Dataset) -> list[str]:
    """Return the headline quantities that have errors of several kinds, as the solution of real data has, and with
    them those without a Monte-Carlo error; none if there are no errors of several kinds.
    """
    names = [name for name in headlines(dataset) if standard_error(dataset, name) is None]
    with_errors = [name for name in names if errors_beside(dataset, name)]
    return [*with_errors, *(name for name in names if name not in with_errors)] if with_errors else []


def answers(dataset: xr.Dataset) -> list[Answer]:
    """Return what the results say about each headline quantity, or about each of its components if it has any; nothing
    before a point is done.
    """
    found: list[Answer] = []
    if not (dataset["status"] == Status.DONE).any():
        return found
    first = said_first(dataset)
    for variable in dict.fromkeys([*first, *headlines(dataset)]):
        meaning, own = meaning_beside(variable, dataset[variable].attrs), own_dimensions(dataset, variable)
        if any(d in dataset.coords and dataset[d].dtype.kind in "ifM" for d in own):  # a function, not components
            found.append(Answer(variable, meaning, [_array_in_words(dataset, variable, own)]))
            continue
        values = dataset[variable].values.astype(float)
        finite = values[np.isfinite(values)]
        if found and variable not in first and finite.size > 1 and finite.min() == finite.max():
            continue  # a number that is the same everywhere answers nothing
        if errors := errors_beside(dataset, variable):
            found.append(Answer(variable, meaning, [_with_errors(dataset, variable, errors)]))
            continue
        for name, unit, part in _components(dataset, variable, own):
            found.append(Answer(name, meaning, list(filter(None, sentences(part, variable, unit)))))
    return found


def completeness(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what these results lack; none if every point of the study is done."""
    if not (words := lacking(dataset)):
        return []
    some = bool((dataset["status"] == Status.DONE).any())
    return [f"Incomplete: {words}." + (" What follows is about those that are done." if some else "")]


def _array_in_words(dataset: xr.Dataset, variable: str, own: list[str]) -> str:
    array = dataset[variable]
    finite = np.isfinite(dataset[variable].values.astype(float))
    if not finite.any():
        return "No point has a value yet."
    unit = units_of(array.attrs)
    ends = []
    values = exact(array.values)
    for end in ends_of(values, finite):
        index = dict(zip(map(str, array.dims), end, strict=True))
        place = {d: dataset[d][i].item() for d, i in index.items() if d in dataset.coords}
        ends.append(f"{with_unit(values[end].item(), 0.0, unit)}, at {place_in_words(place)}")
    along = " and ".join(f"{dataset.sizes[d]} values along {d}" for d in own)
    return f"With {along} at each point it goes from {ends[0]}, to {ends[1]}."


def _with_errors(dataset: xr.Dataset, variable: str, errors: list[str]) -> str:
    """Return the range of each component that has values, and of each kind of error in each unit."""
    ranges, of_errors = [], {name: dict[str, list[float]]() for name in errors}
    for name, unit, part in _components(dataset, variable, own_dimensions(dataset, variable)):
        if np.isfinite(values := part[variable].values.astype(float)).any():
            ranges.append(f"{name.removeprefix(f'{variable} (').removesuffix(')')} {_range_of(values, unit)}")
            for error, by_unit in of_errors.items():
                by_unit.setdefault(unit, []).extend(part[error].values.ravel().tolist())
    known = {
        error: " and ".join(filter(None, (_range_of(np.array(values), unit) for unit, values in by_unit.items())))
        for error, by_unit in of_errors.items()
    }
    return "; ".join([", ".join(ranges), *(f"{error} {text or 'not known'}" for error, text in known.items())]) + "."


def _range_of(values: Array, unit: str) -> str:
    """Return the smallest and the largest of some numbers in one unit; '' if none is finite."""
    known = values[np.isfinite(values)]
    if not known.size:
        return ""
    chosen = prefixed(known, unit)
    ends = dict.fromkeys(in_short(end * chosen.factor) for end in (known.min().item(), known.max().item()))
    return " ".join(filter(None, [" to ".join(ends), in_ascii(chosen.unit)]))


def _components(dataset: xr.Dataset, variable: str, extra: list[str]) -> Iterator[tuple[str, str, xr.Dataset]]:
    """Yield name, unit and dataset of a variable, or of each of its components, with one value per point."""
    unit = units_of(dataset[variable].attrs)
    for place in places_along(dataset, extra):
        part = dataset.isel(place)
        labels = [str(part[d].item()) if d in part.coords else str(i) for d, i in place.items()]
        units = [str(part[f"{d}_unit"].item()) for d in extra if f"{d}_unit" in part.coords]
        own = units[0] if "," in unit and len(units) == 1 else unit
        yield f"{variable} ({', '.join(labels)})" if extra else variable, own, part


def conclusion_in_words(dataset: xr.Dataset) -> list[str]:
    """Return the sentences of the study's conclusion that this grid can fill, with the numbers of its results.

    A sentence of which a number is missing is left out, and the last sentence says so.  If a number does not meet its
    condition, or if its error is not known, the sentence says that.  Sentences about points that this grid does not
    have are left out.
    Raises SweepError for a conclusion that cannot be read.
    """
    if CONCLUSION not in dataset.attrs:
        return []
    try:
        conclusion = Conclusion.model_validate_json(dataset.attrs[CONCLUSION])
    except (ValueError, TypeError) as error:
        raise SweepError(f"the attribute {CONCLUSION!r} cannot be read: {error}") from error
    found, missing = [], []
    for sentence in conclusion.sentences:
        try:
            found.append(_filled(dataset, conclusion, sentence))
        except OutsideGridError:
            continue
        except _MissingError as error:
            missing.append(str(error).partition(":")[0])
    if missing:
        more = "No further conclusion" if found else "No conclusion yet" if missing[0] == NOT_DONE else "No conclusion"
        found.append(f"{more}: numbers that it needs are missing ({', '.join(dict.fromkeys(missing))}).")
    return found


class _MissingError(ValueError):
    """A number of a sentence is missing, for the reason that this says."""


def _filled(dataset: xr.Dataset, conclusion: Conclusion, sentence: str) -> str:
    """Return a sentence with its numbers; raises _MissingError, and OutsideGridError as `measure` does."""
    pieces: list[str] = []
    unmet: list[str] = []
    unjudged: list[str] = []
    before: tuple[float, str] | None = None  # the last number, its unit; its error may follow
    for text, name, form, _ in Formatter().parse(sentence):
        pieces.append(text)
        if name is None:
            continue
        value = conclusion.values[name]
        measured, quantity = _measured(dataset, value), value.quantity()
        if measured.missing:
            raise _MissingError(measured.missing)
        unit = unit_of(dataset, quantity)
        if before is not None and text == PLUS_MINUS and not form and before[1] == unit and measured.value > 0.0:
            pieces[-2:] = [with_unit(before[0], measured.value, unit)]
        else:
            pieces.append(_number(measured, unit, form or ""))
        before = None if form else (measured.value, unit)
        if not value.has_bounds:
            continue
        if not math.isfinite(measured.error):
            unjudged.append(in_words(quantity))
        elif bound := _broken_bound(value, measured):
            unmet.append(f"{in_words(quantity)} is {in_short(measured.value, measured.error, unit)}, not {bound}")
    text = "".join(pieces)
    if unmet:
        return f"Expected, but not found: “{text}” ({'; '.join(dict.fromkeys(unmet))})."
    if unjudged:
        return f"Not judged: “{text}” (the error of {', '.join(dict.fromkeys(unjudged))} is not known)."
    return text


def _measured(dataset: xr.Dataset, value: ConclusionValue) -> Measured:
    """Return the number for a value of a conclusion, or why there is none; raises OutsideGridError like `measure`."""
    places = measure(dataset, value, value.quantity())
    measured = [one for one in places if value.choose is None or not one.missing.startswith("excluded")]
    if not measured:
        return Measured({}, missing=NOT_DONE)
    if missing := [one for one in measured if one.missing or not math.isfinite(one.value)]:
        return missing[0] if missing[0].missing else Measured({}, missing="not a finite number")
    pick = max if value.choose == "largest" else min
    return pick(measured, key=lambda one: one.value)


def _number(measured: Measured, unit: str, form: str) -> str:
    if form == "%":
        return f"{in_short(100.0 * measured.value, 100.0 * measured.error)} %"
    if form == "error":
        return with_unit(measured.value, measured.error, unit)
    return in_short(measured.value, measured.error, unit)


def _broken_bound(value: ConclusionValue, measured: Measured) -> str:
    """Return in words the bound that a number violates; '' if it violates none."""
    number = measured.value
    allowed = MC_ERRORS_ALLOWED * measured.error + ARITHMETIC * abs(number)
    if value.above is not None and not number + allowed > value.above:
        return f"above {value.above:g}"
    if value.below is not None and not number - allowed < value.below:
        return f"below {value.below:g}"
    if value.equals is not None and not abs(number - value.equals) <= allowed:
        return f"{value.equals:g} within {MC_ERRORS_ALLOWED:g} of its errors"
    return ""
