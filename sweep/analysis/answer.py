"""The answer to a study's question in words: its conclusion with values, and sentences about any results."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from string import Formatter

import numpy as np
import xarray as xr

from linksweep.sweep.analysis import compare, quantity
from linksweep.sweep.contract import Array, SweepError
from linksweep.sweep.formatting import (
    counted,
    in_ascii,
    in_short,
    is_truth,
    meaning_beside,
    prefixed,
    units_of,
    with_unit,
)
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.study import POINT, Conclusion, ConclusionValue

CONCLUSION = "conclusion"  # the attribute of a dataset that holds the conclusion of its study, as JSON
PLUS_MINUS = " ± "  # between a value and its error in a sentence
MOST_SHORT = 3  # quantities in a short answer
ERRORS_ALLOWED = 3.0  # a value agrees with its prediction if it differs by at most this many of its errors
VISIBLE_FACTOR = 1.005  # an axis that changes a quantity by a smaller factor is not mentioned
ROUNDING = 1e-12  # values that differ by a smaller share are equal except for rounding
NOTHING_YET = "No point has a value yet."


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
    concluded, first = conclusion_in_words(dataset), said_first(dataset)
    some = [answer for answer in answers(dataset) if answer.sentences and (not concluded or answer.name in first)]
    names = [f"{answer.name} ({answer.meaning})" if answer.meaning else answer.name for answer in some]
    ranges = [f"{name}: {answer.sentences[0]}" for name, answer in zip(names, some, strict=True)]
    return [*concluded, *ranges[:MOST_SHORT]]


def said_first(dataset: xr.Dataset) -> list[str]:
    """Return the headline quantities that have errors of several kinds, as the solution of real data has, and with
    them those without a Monte-Carlo error; none if there are no errors of several kinds.
    """
    names = [name for name in quantity.headlines(dataset) if quantity.standard_error(dataset, name) is None]
    with_errors = [name for name in names if quantity.errors_beside(dataset, name)]
    return list(dict.fromkeys([*with_errors, *names])) if with_errors else []


def answers(dataset: xr.Dataset) -> list[Answer]:
    """Return what the results say about each headline quantity, or about each of its components if it has any; nothing
    before a point is done.
    """
    made: list[Answer] = []
    if not (dataset["status"] == Status.DONE).any():
        return made
    first = said_first(dataset)
    for variable in dict.fromkeys([*first, *quantity.headlines(dataset)]):
        meaning, values = (
            meaning_beside(variable, dataset[variable].attrs),
            dataset[variable].values.astype(float, copy=False),
        )
        finite = values[np.isfinite(values)]
        if made and variable not in first and finite.size > 1 and finite.min() == finite.max():
            continue  # a number that is the same everywhere answers nothing
        if errors := quantity.errors_beside(dataset, variable):
            made.append(Answer(variable, meaning, [_with_errors(dataset, variable, errors)]))
            continue
        for name, unit, part in _components(dataset, variable):
            made.append(Answer(name, meaning, list(filter(None, _sentences(part, variable, unit)))))
    return made


def completeness(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what these results lack; none if every point of the study is done."""
    if not (words := quantity.lacking(dataset)):
        return []
    some = bool((dataset["status"] == Status.DONE).any())
    return [f"Incomplete: {words}." + (" What follows is about those that are done." if some else "")]


# Sentences about a quantity


def _components(dataset: xr.Dataset, variable: str) -> Iterator[tuple[str, str, xr.Dataset]]:
    """Yield name, unit and dataset of a variable, or of each of its components, with one value per point; the values of
    a function along a dimension of its own stay together.
    """
    unit, own = units_of(dataset[variable].attrs), quantity.own_dimensions(dataset, variable)
    if any(d in dataset.coords and dataset[d].dtype.kind in "ifM" for d in own):
        own = []
    for place in quantity.places_along(dataset, own):
        part = dataset.isel(place)
        labels = [str(part[d].item()) if d in part.coords else str(i) for d, i in place.items()]
        units = [str(part[f"{d}_unit"].item()) for d in own if f"{d}_unit" in part.coords]
        each = units[0] if "," in unit and len(units) == 1 else unit
        yield f"{variable} ({', '.join(labels)})" if own else variable, each, part


def _with_errors(dataset: xr.Dataset, variable: str, errors: list[str]) -> str:
    """Return the range of each component that has values, and of each kind of error in each unit."""
    ranges, by_kind = [], {name: dict[str, list[float]]() for name in errors}
    for name, unit, part in _components(dataset, variable):
        if np.isfinite(values := part[variable].values.astype(float, copy=False)).any():
            ranges.append(f"{name.removeprefix(f'{variable} (').removesuffix(')')} {_range_of(values, unit)}")
            for error, by_unit in by_kind.items():
                by_unit.setdefault(unit, []).extend(part[error].values.ravel().tolist())
    known = {
        error: " and ".join(filter(None, (_range_of(np.array(values), unit) for unit, values in by_unit.items())))
        for error, by_unit in by_kind.items()
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


def _sentences(part: xr.Dataset, variable: str, unit: str) -> Iterator[str]:
    """Yield sentences about a variable in a unit; '' for a sentence with nothing to say."""
    array = part[variable].transpose(*part["status"].dims, ...)
    values, error = array.values.astype(float, copy=False), quantity.standard_error(part, variable)
    errors = (xr.zeros_like(array, dtype=float) if error is None else error.transpose(*array.dims)).values
    finite = np.isfinite(values)
    if not finite.any():
        yield NOTHING_YET
        return
    if is_truth(array):
        true, count = int(values[finite].sum()), int(finite.sum())
        yield f"It is True at {true:,} of {counted(count, 'point')}." if count > 1 else f"It is {bool(true)}."
        return
    unfinished = bool(part["status"].isin([Status.MISSING, Status.FAILED]).any())
    yield _range(part, array, errors, unit, all_done=not unfinished)
    if array.ndim > part["status"].ndim:
        return
    values = np.where(finite, values, np.nan)
    yield "" if unfinished else _what_changes_it(list(map(str, array.dims)), values)
    for whole in quantity.unknown_parts(part, variable):
        sentence = whole.removeprefix(f"{variable}: ")
        yield f"{sentence[0].upper()}{sentence[1:]}."
    if (predicted := part.get(quantity.prediction_name(part, variable))) is not None:
        whole_name, errors_alone = (f"{variable}_{suffix}" for suffix in quantity.PREDICTION_SUFFIXES)
        without_bias = whole_name not in part and errors_alone in part and "bias" in part
        left_out = ", which leaves a bias out" if without_bias else ""
        yield _agreement(values, errors, predicted.transpose(*array.dims).values, left_out)
    if infinite := int(np.sum((part["status"].transpose(*array.dims).values == Status.DONE) & ~finite)):
        yield f"It is not a finite number at {counted(infinite, 'point')}."


def _range(part: xr.Dataset, array: xr.DataArray, errors: Array, unit: str, all_done: bool) -> str:
    values = quantity.exact(array.values)  # integers are compared exactly
    known = np.flatnonzero(np.isfinite(values.astype(float, copy=False)))
    some = values.reshape(-1)[known]
    noun = "point" if array.ndim == part["status"].ndim else "value"

    def number(end: int) -> str:
        flat = known[end]
        return with_unit(values.reshape(-1)[flat].item(), float(errors.reshape(-1)[flat]), unit)

    def place(end: int) -> str:
        index = dict(zip(map(str, array.dims), map(int, np.unravel_index(known[end], values.shape)), strict=True))
        return quantity.place_in_words(quantity.place_at(part, index))

    low, high = int(np.argmin(some)), int(np.argmax(some))
    if values.size == 1:
        return f"It is {number(0)}."
    if len(known) == 1:
        return f"One {noun} has a value: {number(0)} at {place(0)}."
    if some[low] == some[high]:
        return f"It is {number(low)} at {'all ' if all_done else ''}{counted(len(known), noun)}."
    ends = f"{number(low)} ({place(low)}) and {number(high)} ({place(high)})"
    return f"It is between {ends}, over {counted(len(known), noun)}."


def _what_changes_it(dims: Sequence[str], values: Array) -> str:
    """Return by what factor a quantity above 0 changes at most along each axis, all else being equal."""
    if values.ndim == 0 or not np.nanmin(values) > 0.0:
        return ""
    factors = {}
    for axis, dim in enumerate(dims):
        if dim == POINT:
            continue  # its points differ in several parameters at once
        lines = np.moveaxis(values, axis, -1).reshape(-1, values.shape[axis])
        seen = lines[np.isfinite(lines).sum(axis=1) > 1]
        factor = float(np.max(np.nanmax(seen, axis=1) / np.nanmin(seen, axis=1))) if len(seen) else 1.0
        if factor >= VISIBLE_FACTOR:
            factors[dim] = factor
    order = sorted(factors, key=lambda dim: -factors[dim])
    words = [f"{dim} by a factor of up to {in_short(factors[dim])}" for dim in order]
    equal = ", all else being equal" if len(dims) > 1 else ""
    return f"What changes it: {', '.join(words)}{equal}." if words else ""


def _agreement(values: Array, errors: Array, predicted: Array, left_out: str) -> str:
    both = np.isfinite(values) & np.isfinite(predicted) & (predicted != 0.0)
    if not both.any():
        return ""
    farthest = float(np.max(np.abs(values[both] / predicted[both] - 1.0)))
    if farthest < ROUNDING:
        return f"It equals its prediction{left_out}, except for rounding."
    text = f"at most {100.0 * farthest:.2g} %"
    if not (errors[both] > 0.0).all():
        return f"It differs from its prediction{left_out} by {text}."
    deviations = np.abs(values[both] - predicted[both]) / errors[both]
    within, n = int(np.sum(deviations <= ERRORS_ALLOWED)), deviations.size
    return (
        f"{within:,} of {n:,} values are within {ERRORS_ALLOWED:g} of their errors of the prediction{left_out}; "
        f"the largest difference is {deviations.max():.1f} errors, {text}."
    )


# Conclusions


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
    filled, missing = [], []
    for sentence in conclusion.sentences:
        try:
            filled.append(_filled(dataset, conclusion, sentence))
        except compare.OutsideGridError:
            continue
        except _MissingError as error:
            missing.append(str(error).partition(":")[0])
    if missing:
        yet = " yet" if missing[0] == compare.NOT_DONE else ""
        none = "No further conclusion" if filled else f"No conclusion{yet}"
        filled.append(f"{none}: numbers that it needs are missing ({', '.join(dict.fromkeys(missing))}).")
    return filled


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
        measured, derived = _measured(dataset, value), value.quantity()
        number, error, unit = measured.value, measured.error, compare.unit_of(dataset, derived)
        if before is not None and text == PLUS_MINUS and not form and before[1] == unit and number > 0.0:
            pieces[-2:] = [with_unit(before[0], number, unit)]
        elif form == "%":
            pieces.append(f"{in_short(100.0 * number, 100.0 * error)} %")
        else:
            pieces.append((with_unit if form == "error" else in_short)(number, error, unit))
        before = None if form else (number, unit)
        words = compare.in_words(derived)
        if value.has_bounds and not math.isfinite(error):
            unjudged.append(words)
        elif bound := _broken_bound(value, number, error):
            unmet.append(f"{words} is {in_short(number, error, unit)}, not {bound}")
    text = "".join(pieces)
    if unmet:
        return f"Expected, but not found: “{text}” ({'; '.join(dict.fromkeys(unmet))})."
    if unjudged:
        return f"Not judged: “{text}” (the error of {', '.join(dict.fromkeys(unjudged))} is not known)."
    return text


def _measured(dataset: xr.Dataset, value: ConclusionValue) -> compare.Measured:
    """Return the number for a value of a conclusion; raises _MissingError, and OutsideGridError like `measure`."""
    places = compare.measure(dataset, value, value.quantity())
    measured = [one for one in places if value.choose is None or not one.missing.startswith("excluded")]
    for one in measured:
        if one.missing or not math.isfinite(one.value):
            raise _MissingError(one.missing or "not a finite number")
    if not measured:
        raise _MissingError(compare.NOT_DONE)
    pick = max if value.choose == "largest" else min
    return pick(measured, key=lambda one: one.value)


def _broken_bound(value: ConclusionValue, number: float, error: float) -> str:
    """Return in words the bound that a number violates; '' if it violates none."""
    allowed = compare.MC_ERRORS_ALLOWED * error + compare.ARITHMETIC * abs(number)
    if value.above is not None and not number + allowed > value.above:
        return f"above {value.above:g}"
    if value.below is not None and not number - allowed < value.below:
        return f"below {value.below:g}"
    if value.equals is not None and not abs(number - value.equals) <= allowed:
        return f"{value.equals:g} within {compare.MC_ERRORS_ALLOWED:g} of its errors"
    return ""
