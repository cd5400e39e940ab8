"""The answer to a study's question in words: its conclusion, and what can be said of any results."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.conclusion import conclusion_in_words
from sweep.analysis.long_table import own_dimensions
from sweep.analysis.quantity import headlines
from sweep.analysis.selection import place_in_words, places_along
from sweep.analysis.sentences import sentences
from sweep.attributes import meaning_of, units_of
from sweep.planning.point_status import Status, count_status, unfinished_in_words
from sweep.readable import with_unit

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
    ranges = [answer for answer in answers(dataset) if answer.sentences][:MOST_SHORT]
    names = [f"{answer.name} ({answer.meaning})" if answer.meaning else answer.name for answer in ranges]
    return [f"{name}: {answer.sentences[0]}" for name, answer in zip(names, ranges, strict=True)]


def answers(dataset: xr.Dataset) -> list[Answer]:
    """Return what the results say of each headline quantity, of each of its components where it has any."""
    found = []
    for variable in headlines(dataset):
        meaning, own = meaning_of(dataset[variable].attrs), own_dimensions(dataset, variable)
        if any(d in dataset.coords and dataset[d].dtype.kind in "ifM" for d in own):  # a function, and no components
            found.append(Answer(variable, meaning, [_array_in_words(dataset, variable, own)]))
            continue
        values = dataset[variable].values
        finite = values[np.isfinite(values)]
        if found and finite.size > 1 and finite.min() == finite.max():
            continue  # a number that is the same everywhere answers nothing
        for name, unit, part in _components(dataset, variable, own):
            found.append(Answer(name, meaning, list(filter(None, sentences(part, variable, unit)))))
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


def _components(dataset: xr.Dataset, variable: str, extra: list[str]) -> Iterator[tuple[str, str, xr.Dataset]]:
    """Yield name, unit and dataset of a variable with one value a point: itself, or each of its components."""
    unit = units_of(dataset[variable].attrs)
    for place in places_along(dataset, extra):
        part = dataset.isel(place)
        labels = [str(part[d].item()) if d in part.coords else str(i) for d, i in place.items()]
        units = [str(part[f"{d}_unit"].item()) for d in extra if f"{d}_unit" in part.coords]
        own = units[0] if "," in unit and len(units) == 1 else unit
        yield f"{variable} ({', '.join(labels)})" if extra else variable, own, part
