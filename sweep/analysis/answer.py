"""The answer to a study's question in words: its conclusion, and what can be said of any results."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.conclusion import conclusion_in_words
from sweep.analysis.quantity import (
    PREDICTION_SUFFIXES,
    headlines,
    main_quantity,
    prediction_name,
    standard_error,
    unknown_parts,
)
from sweep.analysis.selection import coordinates_along, place_in_words, places_along
from sweep.attributes import meaning_of, units_of
from sweep.contract import Array, SweepError
from sweep.formatting import counted
from sweep.planning.point_status import Status, count_status, unfinished_in_words
from sweep.readable import with_unit
from sweep.studies.provenance import outer_draw_of
from sweep.studies.study import POINT

ERRORS_ALLOWED = 3.0
"""A value agrees with its prediction if it is so many of its errors from it."""

ERROR_WORDS = {"mc_error": "Monte Carlo", "catalogue_error": "the choice of catalogues"}
"""Where the errors of `sweep.analysis.quantity.ERROR_SUFFIXES` come from."""

VISIBLE_FACTOR = 1.005
"""An axis that changes a quantity by less is not said to change it."""

NEGLIGIBLE = 1e-4
"""Values that are a smaller share of the largest one are left out where it is said by what factor an axis changes a
quantity: a corner of the grid without errors would make it a number that nobody can use.
"""


MOST_SHORT = 3
"""A short answer has at most so many quantities."""


@dataclass(frozen=True)
class Answer:
    """What the results say of one quantity: a heading, its meaning, and sentences."""

    name: str
    meaning: str
    sentences: list[str]


def answer_in_short(dataset: xr.Dataset) -> list[str]:
    """Return the answer in a few sentences: the conclusion of the study with its values, or the range of each headline
    quantity where it has none; none for results that are no numbers.
    """
    if found := conclusion_in_words(dataset):
        return found
    ranges = [answer for answer in answers(dataset) if answer.sentences]
    return [f"{_named(answer)}: {answer.sentences[0]}" for answer in ranges[:MOST_SHORT]]


def _named(answer: "Answer") -> str:
    return f"{answer.name} ({answer.meaning})" if answer.meaning else answer.name


def headline(dataset: xr.Dataset) -> list[str]:
    """Return the quantities that a study is about: those its experiment calls headline, or the first one there is."""
    try:
        return headlines(dataset) or [main_quantity(dataset)]
    except SweepError:
        return []


def answers(dataset: xr.Dataset) -> list[Answer]:
    """Return what the results say of each headline quantity, of each of its components where it has any."""
    found = []
    for variable in headline(dataset):
        meaning = meaning_of(dataset[variable].attrs)
        if array := _own_axes(dataset, variable):
            found.append(Answer(variable, meaning, [_array_in_words(dataset, variable, array)]))
            continue
        if found and not _varies(dataset[variable]):
            continue  # a number that is the same everywhere answers nothing
        parts = _components(dataset, variable)
        found += [Answer(name, meaning, list(_sentences(part, variable, unit))) for name, unit, part in parts]
    return found


def completeness(dataset: xr.Dataset) -> list[str]:
    """Return sentences about what these results lack; none if every point of the study is done."""
    counts = count_status(dataset["status"].values)
    wanted = sum(counts.values()) - counts[Status.EXCLUDED]
    if lacking := unfinished_in_words(counts):
        return [
            f"Incomplete: {counts[Status.DONE]} of {wanted} points are done, {lacking}. "
            "What follows is about those that are done."
        ]
    if not dataset.attrs.get("complete"):
        return ["Incomplete: the store says that its run did not end."]
    return []


def failed(dataset: xr.Dataset) -> int:
    """Return the number of points that failed."""
    return int(np.sum(dataset["status"].values == Status.FAILED))


def _own_axes(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the dimensions of a variable along which it is a function of numbers, and not a list of components."""
    own = [str(d) for d in dataset[variable].dims if d not in dataset["status"].dims]
    return own if any(d in dataset.coords and dataset[d].dtype.kind in "ifM" for d in own) else []


def _array_in_words(dataset: xr.Dataset, variable: str, own: list[str]) -> str:
    array = dataset[variable]
    values = array.values.astype(float)
    if not np.isfinite(values).any():
        return "No point has a value yet."
    unit = units_of(array.attrs)
    ends = []
    for flat in (np.nanargmin(values), np.nanargmax(values)):
        index = dict(zip(map(str, array.dims), map(int, np.unravel_index(flat, values.shape)), strict=True))
        place = {d: dataset[d].values[i].item() for d, i in index.items() if d in dataset.coords}
        ends.append(f"{with_unit(float(values.reshape(-1)[flat]), 0.0, unit)}, at {place_in_words(place)}")
    along = " and ".join(f"{dataset.sizes[d]} values along {d}" for d in own)
    return f"With {along} at each point it goes from {ends[0]}, to {ends[1]}."


def _components(dataset: xr.Dataset, variable: str) -> Iterator[tuple[str, str, xr.Dataset]]:
    """Yield name, unit and dataset of a variable with one value a point: itself, or each of its components."""
    extra = [str(d) for d in dataset[variable].dims if d not in dataset["status"].dims]
    unit = units_of(dataset[variable].attrs)
    for place in places_along(dataset, extra):
        part = dataset.isel(place)
        labels = [str(part[d].item()) if d in part.coords else str(i) for d, i in place.items()]
        units = [str(part[f"{d}_unit"].item()) for d in extra if f"{d}_unit" in part.coords]
        own = units[0] if "," in unit and len(units) == 1 else unit
        yield f"{variable} ({', '.join(labels)})" if extra else variable, own, part


def _sentences(part: xr.Dataset, variable: str, unit: str) -> Iterator[str]:
    dims = [str(d) for d in part["status"].dims]
    values = part[variable].transpose(*dims).values.astype(float)
    known = standard_error(part, variable)
    errors = np.zeros(values.shape) if known is None else known.transpose(*dims).values.astype(float)
    finite = np.isfinite(values)
    if not finite.any():
        yield "No point has a value yet."
        return
    values = np.where(finite, values, np.nan)
    yield _range(part, values, errors, unit)
    if sentence := _what_changes_it(dims, values):
        yield sentence
    of = {words: part.get(f"{variable}_{suffix}") for suffix, words in ERROR_WORDS.items()}
    known_ones = [words for words, error in of.items() if error is not None and bool(error.notnull().any())]
    origin = " and ".join(known_ones).replace("catalogue", outer_draw_of(part.attrs))
    if sentence := _accuracy(values[finite], errors[finite], origin):
        yield sentence
    for whole in unknown_parts(part, variable):
        sentence = whole.removeprefix(f"{variable}: ")
        yield f"{sentence[0].upper()}{sentence[1:]}."
    predicted = part.get(prediction_name(part, variable))
    if predicted is not None:
        whole_name, errors_alone = (f"{variable}_{suffix}" for suffix in PREDICTION_SUFFIXES)
        without_bias = whole_name not in part and errors_alone in part and "bias" in part
        left_out = ", which leaves a bias out" if without_bias else ""
        if sentence := _agreement(values, errors, predicted.transpose(*dims).values, left_out):
            yield sentence
    if infinite := int(np.sum((part["status"].values == Status.DONE) & ~finite)):
        points = "1 point that is" if infinite == 1 else f"{infinite} points that are"
        yield f"At {points} done it is not a finite number."


def _range(part: xr.Dataset, values: Array, errors: Array, unit: str) -> str:
    def number(index: tuple[Any, ...]) -> str:
        return with_unit(float(values[index]), float(errors[index]), unit)

    low = np.unravel_index(np.nanargmin(values), values.shape)
    high = np.unravel_index(np.nanargmax(values), values.shape)
    count = int(np.isfinite(values).sum())
    if values.size == 1:
        return f"It is {number(low)}."
    if count == 1:
        return f"One point has a value: {number(low)} at {_place(part, low)}."
    if values[low] == values[high]:
        return f"It is {number(low)} at {_all(count, 'point')}."
    return (
        f"Over {count} points it goes from {number(low)}, at {_place(part, low)}, "
        f"to {number(high)}, at {_place(part, high)}."
    )


def _place(part: xr.Dataset, index: tuple[Any, ...]) -> str:
    point = part.isel(dict(zip(part["status"].dims, map(int, index), strict=True)))
    names = [name for d in part["status"].dims for name in coordinates_along(part, str(d))]
    return place_in_words({name: point[name].item() for name in names})


def _what_changes_it(dims: list[str], values: Array) -> str:
    """Say by what factor a positive quantity changes at most along each axis, the others being equal."""
    if values.ndim == 0 or np.nanmin(values) < 0.0 or np.nanmax(values) == np.nanmin(values):
        return ""
    values = np.where(values >= NEGLIGIBLE * np.nanmax(values), values, np.nan)
    factors = {}
    for axis, dim in enumerate(dims):
        if dim == POINT:
            continue  # its points differ in several parameters at once
        lines = np.moveaxis(values, axis, -1).reshape(-1, values.shape[axis])
        seen = lines[np.isfinite(lines).sum(axis=1) > 1]
        if len(seen):
            factors[dim] = float(np.max(np.nanmax(seen, axis=1) / np.nanmin(seen, axis=1)))
    order = sorted((dim for dim in dims if factors.get(dim, 0.0) >= VISIBLE_FACTOR), key=lambda dim: -factors[dim])
    if not order:
        return ""
    words = [f"{dim} by a factor of up to {_factor(factors[dim])}" for dim in order]
    return f"What changes it: {', '.join(words)}{', all else being equal' if len(dims) > 1 else ''}."


def _factor(factor: float) -> str:
    return f"{factor:.2f}" if factor < 10.0 else f"{float(f'{factor:.3g}'):,g}" if factor < 1e6 else f"{factor:.1e}"


def _accuracy(values: Array, errors: Array, origin: str) -> str:
    use = (errors > 0.0) & (values != 0.0)
    if not use.any():
        return ""
    relative = 100.0 * errors[use] / np.abs(values[use])
    low, high = f"{relative.min():.2g}", f"{relative.max():.2g}"
    share = low if low == high else f"{low} to {high}"
    return f"Its one-sigma error, from {origin}, is {share} % of it."


def _all(count: int, noun: str) -> str:
    return f"both {noun}s" if count == 2 else f"all {counted(count, noun)}"


def _varies(array: xr.DataArray) -> bool:
    finite = array.values[np.isfinite(array.values)]
    return not finite.size or finite.size == 1 or bool(finite.min() < finite.max())


def _agreement(values: Array, errors: Array, predicted: Array, left_out: str) -> str:
    both = np.isfinite(values) & np.isfinite(predicted) & (predicted != 0.0)
    count = int(both.sum())
    if not count:
        return ""
    farthest = float(np.max(np.abs(values[both] / predicted[both] - 1.0)))
    text = f"{100.0 * farthest:.2g} %"
    if not (errors[both] > 0.0).all():
        return f"It differs from its prediction{left_out} by {'' if count == 1 else 'at most '}{text}."
    deviations = np.abs(values[both] - predicted[both]) / errors[both]
    within = int(np.sum(deviations <= ERRORS_ALLOWED))
    largest = math.floor(10.0 * float(deviations.max()) + 0.5) / 10.0
    apart = f"{largest:g} {'error' if largest == 1.0 else 'errors'}"
    if count == 1:
        return f"It is {apart}, or {text}, from its prediction{left_out}."
    share = f"{_all(count, 'value')} are" if within == count else f"{within} of {count:,} values are"
    return (
        f"{share.capitalize()} within {ERRORS_ALLOWED:g} of their errors of the prediction{left_out}; "
        f"the largest difference is {apart}, or up to {text}."
    )
