"""The answer to a study's question in words: its conclusion with values, and sentences about any results."""

from __future__ import annotations  # names of xarray, which is imported only where it computes

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from math import inf
from string import Formatter
from typing import TYPE_CHECKING

import numpy as np

from linksweep.sweep import formatting
from linksweep.sweep.analysis import compare, quantity
from linksweep.sweep.contract import Array, Status, refused
from linksweep.sweep.studies.study import POINT, Conclusion, ConclusionValue

if TYPE_CHECKING:
    import xarray as xr

CONCLUSION = "conclusion"  # the attribute of a dataset that holds the conclusion of its study, as JSON
PLUS_MINUS = " ± "  # between a value and its error in a sentence
MOST_SHORT = 3  # quantities in a short answer
ERRORS_ALLOWED = 3.0  # a value agrees with its prediction if it differs by at most this many of its errors
VISIBLE_FACTOR = 1.005  # an axis that changes a quantity by a smaller factor is not mentioned
ROUNDING = 1e-12  # values that differ by a smaller share are equal except for rounding


@dataclass(frozen=True)
class Answer:
    """What the results say about one quantity: a heading, its meaning, and sentences."""

    name: str
    meaning: str
    sentences: list[str]

    @property
    def in_short(self) -> str:
        """Its heading and meaning, and its first sentence."""
        name = f"{self.name} ({self.meaning})" if self.meaning else self.name
        return f"{name}: {self.sentences[0]}"


def answer_in_short(dataset: xr.Dataset) -> list[str]:
    """Return the answer in a few sentences: the conclusion of the study with its values, or the ranges of the first
    headline quantities if it has none; an empty list for results that are not numbers.  What real data say, as
    `said_first` has it, is said in any case.
    """
    concluded, first = conclusion_in_words(dataset), said_first(dataset)
    some = [answer.in_short for answer in answers(dataset) if not concluded or answer.name in first]
    return [*concluded, *some[:MOST_SHORT]]


def said_first(dataset: xr.Dataset) -> list[str]:
    """Return the headline quantities that have errors of several kinds, as the solution of real data has, and with
    them those without a Monte-Carlo error; none if there are no errors of several kinds.
    """
    names = [name for name in quantity.headlines(dataset) if quantity.standard_error(dataset, name) is None]
    with_errors = [name for name in names if quantity.errors_beside(dataset, name)]
    return list(dict.fromkeys([*with_errors, *names])) if with_errors else []


def answers(
    dataset: xr.Dataset, decided: Mapping[str, str] | None = None, variables: Collection[str] | None = None
) -> list[Answer]:
    """Return what the results say about each headline quantity, or each of some ``variables``, or about each of its
    components if it has any; nothing before a point is done.  ``decided`` has sentences, by quantity, in place of those
    on what changes it.
    """
    made: list[Answer] = []
    dataset = quantity.without_running(dataset)
    if not (dataset["status"].values == Status.DONE).any():
        return made
    first = said_first(dataset)
    for variable in dict.fromkeys([*first, *quantity.headlines(dataset)]) if variables is None else variables:
        meaning = formatting.meaning_beside(variable, dataset[variable].attrs)
        values = dataset[variable].values.astype(float, copy=False)
        low, high = (end.reduce(values, axis=None) for end in (np.fmin, np.fmax))
        if variables is None and made and variable not in first and values.size > 1 and low == high:
            continue  # a number that is the same everywhere answers nothing
        if errors := quantity.errors_beside(dataset, variable):
            made.append(Answer(variable, meaning, [_with_errors(dataset, variable, errors)]))
            continue
        for name, unit, part in quantity.components_of(dataset, variable):
            made.append(Answer(name, meaning, list(_sentences(part, variable, unit, (decided or {}).get(name)))))
    return made


def completeness(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what these results lack; none if every point of the study is done."""
    if not (words := quantity.lacking(dataset)):
        return []
    some = bool((dataset["status"].values == Status.DONE).any())
    return [f"Incomplete: {words}." + (" What follows is about those that are done." if some else "")]


# Sentences about a quantity


def _with_errors(dataset: xr.Dataset, variable: str, errors: list[str]) -> str:
    """Return the range of each component that has values, and of each kind of error in each unit."""
    ranges, by_kind = [], {name: dict[str, list[float]]() for name in errors}
    for name, unit, part in quantity.components_of(dataset, variable):
        if text := _range_of(part[variable].values, unit):
            ranges.append(f"{name.removeprefix(f'{variable} (').removesuffix(')')} {text}")
            for error, by_unit in by_kind.items():
                by_unit.setdefault(unit, []).extend(part[error].values.ravel().tolist())
    texts = {e: [_range_of(np.array(v), u) for u, v in by_unit.items()] for e, by_unit in by_kind.items()}
    known = [f"{error} {' and '.join(filter(None, some)) or 'not known'}" for error, some in texts.items()]
    return "; ".join([", ".join(ranges), *known]) + "."


def _range_of(values: Array, unit: str) -> str:
    """Return the smallest and the largest of some numbers in one unit; '' if none is finite."""
    known = values[np.isfinite(values.astype(float, copy=False))]
    if not known.size:
        return ""
    chosen = formatting.prefixed(known, unit)
    ends = dict.fromkeys(formatting.in_short(end * chosen.factor) for end in (known.min().item(), known.max().item()))
    return f"{' to '.join(ends)} {formatting.in_ascii(chosen.unit)}".rstrip()


def _sentences(part: xr.Dataset, variable: str, unit: str, decided: str | None) -> Iterator[str]:
    """Yield sentences about a variable in a unit."""
    axes, components = quantity.axes_of(part), quantity.own_dimensions(part, variable)
    array = part[variable].transpose(*axes, *components)
    values = array.values.astype(float, copy=False)
    known = np.isfinite(values)
    if not known.any():
        yield "It is a finite number at no point that is done."
        return
    if formatting.is_truth(array):
        noun = "value" if components else "point"
        yield f"It is True at {int(values[known].sum()):,} of {formatting.counted(int(known.sum()), noun)}."
        yield from filter(None, [decided])
        return
    errors = quantity.sigmas(part, variable, [*axes, *components])
    yield _range(part, array, errors, unit)
    if components:
        return
    status, values = part["status"].values, np.where(known, values, np.nan)
    if decided:
        yield decided
    elif not np.isin(status, [Status.MISSING, Status.FAILED]).any():
        yield from _what_changes_it(axes, values, errors, unit)
    for words in quantity.unknown_parts(part, variable):
        sentence = words.removeprefix(f"{variable}: ")
        yield f"{sentence[0].upper()}{sentence[1:]}."
    if (prediction := quantity.prediction_name(part, variable)) in part:
        predicted = part[prediction].transpose(*axes).values
        without_bias = prediction == f"{variable}_{quantity.PREDICTION_SUFFIXES[1]}" and "bias" in part
        yield from _agreement(values, errors, predicted, ", which leaves a bias out" if without_bias else "")
    if infinite := int(((status == Status.DONE) & ~known).sum()):
        yield f"It is not a finite number at {formatting.counted(infinite, 'point')}."


def _range(part: xr.Dataset, array: xr.DataArray, errors: Array, unit: str) -> str:
    values, sigmas = quantity.exact(array.values).reshape(-1), errors.reshape(-1)  # integers are exact
    known = np.flatnonzero(np.isfinite(values.astype(float, copy=False)))
    low, high = (known[end(values[known])] for end in (np.argmin, np.argmax))
    ends, two = [values[flat].item() for flat in (low, high)], sigmas[[low, high]]
    form = partial(formatting.with_error, digits=formatting.digits_of(ends))
    number = [formatting.with_unit(end, float(sigma), unit, form) for end, sigma in zip(ends, two, strict=True)]
    doubt = ("", "; one of the errors is not known", "; errors are not known")[np.isnan(two).sum()]
    if values.size == 1:
        return f"It is {number[0]}{doubt}."
    indices = (map(int, np.unravel_index(flat, array.shape)) for flat in (low, high))
    places = [quantity.place_at(part, dict(zip(map(str, array.dims), i, strict=True))) for i in indices]
    least, largest = (quantity.place_in_words(place, part) for place in places)
    is_of_points, done = len(array.dims) == len(part["status"].dims), int((part["status"].values == Status.DONE).sum())
    points = formatting.counted(len(known), "point" if is_of_points else "value")
    points = f"{len(known):,} of {done:,} points" if is_of_points and done > len(known) else points
    if ends[0] == ends[1] or (number[0] == number[1] and not two.any()):
        doubt = doubt if ends[0] == ends[1] else ", except for rounding"
        return f"It is {number[0]} at {points if len(known) > 1 else least}{doubt}."
    return f"It is between {number[0]} ({least}) and {number[1]} ({largest}), over {points}{doubt}."


def _what_changes_it(axes: list[str], values: Array, errors: Array, unit: str) -> Iterator[str]:
    """Yield by what a quantity changes at most along each axis, all else being equal: a factor where it is above 0.

    Axes along which no two values differ by more than their errors allow are not mentioned: the more pairs of values
    there are, the farther apart noise drives one of them.
    """
    pairs = max(np.isfinite(values).sum(), 2.0) ** 2 / 4.0
    doubt = np.sqrt(ERRORS_ALLOWED**2 / 2.0 + np.log(pairs)) * errors  # NaN where nothing is sure
    is_factor = np.nanmin(values) > 0.0
    change = np.divide if is_factor else np.subtract
    with np.errstate(over="ignore"):  # a change that is no float is not said
        span = np.nanmax(values) - np.nanmin(values)
        ends = {d: (np.fmax.reduce(values, i), np.fmin.reduce(values, i)) for i, d in enumerate(axes)}
        sure = {d: np.fmax.reduce(values - doubt, i) > np.fmin.reduce(values + doubt, i) for i, d in enumerate(axes)}
        changes = {d: np.nanmax(change(*both)) for d, both in ends.items() if sure[d].any()}
    changes.pop(POINT, None)  # points differ in several parameters at once
    least = VISIBLE_FACTOR if is_factor else (VISIBLE_FACTOR - 1.0) * span
    order = sorted((d for d in changes if inf > changes[d] >= least and span > 0.0), key=lambda d: -changes[d])
    by, unit = ("a factor of up to ", "") if is_factor else ("up to ", unit)
    words = [f"{d} by {by}{formatting.in_short(float(changes[d]), 0.0, unit)}" for d in order]
    if words:
        yield f"What changes it: {', '.join(words)}{', all else being equal' if values.ndim > 1 else ''}."


def _agreement(values: Array, errors: Array, predicted: Array, left_out: str) -> Iterator[str]:
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.abs(values / np.where(predicted == 0.0, np.nan, predicted) - 1.0)
        deviations = np.where(np.isnan(relative), np.nan, np.abs(values - predicted) / errors)
    if (farthest := np.fmax.reduce(relative, axis=None)) < ROUNDING:
        yield f"It equals its prediction{left_out}, except for rounding."
    elif np.isfinite(farthest):
        text = f"It differs from its prediction{left_out} by at most {100.0 * farthest:.2g} %"
        if np.isfinite(largest := np.fmax.reduce(deviations, axis=None)):
            text += f" and {largest:.1f} of its errors"
        if far := int((deviations > ERRORS_ALLOWED).sum()):
            text += f", at {formatting.counted(far, 'point')} by more than {ERRORS_ALLOWED:g} of them"
        yield f"{text}."


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
    with refused(ValueError, TypeError, said=f"the attribute {CONCLUSION!r} cannot be read: "):
        conclusion = Conclusion.model_validate_json(dataset.attrs[CONCLUSION])
    filled, missing = [], []
    for sentence in conclusion.sentences:
        try:
            filled.append(_filled(dataset, conclusion, sentence))
        except quantity.OutsideGridError:
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
    pieces, unmet, unjudged = list[str](), dict[str, None](), dict[str, None]()
    before: tuple[float, str] | None = None  # the last number, its unit; its error may follow
    for text, name, form, _ in Formatter().parse(sentence):
        pieces.append(text)
        if name is None:
            continue
        value = conclusion.values[name]
        measured, derived = _measured(dataset, value), value.quantity()
        number, error, unit = measured.value, measured.error, compare.unit_of(dataset, derived)
        if before is not None and text == PLUS_MINUS and not form and before[1] == unit and number > 0.0:
            pieces[-2:] = [formatting.with_unit(before[0], number, unit)]
        elif form == "%":
            pieces.append(f"{formatting.in_short(100.0 * number, 100.0 * error)} %")
        else:
            pieces.append((formatting.with_unit if form == "error" else formatting.in_short)(number, error, unit))
        before = None if form else (number, unit)
        words = compare.in_words(derived)
        if {value.above, value.below, value.equals} != {None} and not np.isfinite(error):
            unjudged[words] = None
        elif bound := _broken_bound(value, number, error):
            unmet[f"{words} is {formatting.in_short(number, error, unit)}, not {bound}"] = None
    text = "".join(pieces)
    if unmet:
        return f"Expected, but not found: “{text}” ({'; '.join(unmet)})."
    if unjudged:
        return f"Not judged: “{text}” (the error of {', '.join(unjudged)} is not known)."
    return text


def _measured(dataset: xr.Dataset, value: ConclusionValue) -> compare.Measured:
    """Return the number for a value of a conclusion; raises _MissingError, and OutsideGridError like `measure`."""
    measured = compare.measure(dataset, value, value.quantity())
    for one in measured:
        if one.missing or not np.isfinite(one.value):
            raise _MissingError(one.missing or "not a finite number")
    pick = max if value.choose == "largest" else min
    return pick(measured, key=lambda one: one.value)


def _broken_bound(value: ConclusionValue, number: float, error: float) -> str:
    """Return in words the bound that a number violates; '' if it violates none."""
    allowed = compare.MC_ERRORS_ALLOWED * error + compare.ARITHMETIC * abs(number)
    if value.above is not None and not number + allowed > value.above:
        return f"above {formatting.plain([value.above])[0]}"
    if value.below is not None and not number - allowed < value.below:
        return f"below {formatting.plain([value.below])[0]}"
    if value.equals is not None and not abs(number - value.equals) <= allowed:
        return f"{formatting.plain([value.equals])[0]} within {compare.MC_ERRORS_ALLOWED:g} of its errors"
    return ""
