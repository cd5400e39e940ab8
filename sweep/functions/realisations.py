"""What is kept of the random realisations of a plain function: moments, and the realisations that quantiles need."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from linksweep.sweep.contract import Array, Output, ResultError
from linksweep.sweep.functions.layout import NUMBERS, Field, Layout, as_floats, differences
from linksweep.sweep.functions.named_results import Declared
from linksweep.sweep.functions.results import Flat
from linksweep.sweep.functions.statistics import (
    DEFAULT,
    MOMENTS,
    merged,
    moments_of,
    quantile_of,
    quantiles,
    statistic,
    unknown,
)


@dataclass(frozen=True)
class Realisations:
    """The statistics of realisations of a layout, for the outputs that a function ``declared``.

    A row has the number of realisations and the moments of each output, followed by the quantiles and their errors.
    """

    layout: Layout
    declared: tuple[Output, ...]

    @cached_property
    def statistics(self) -> dict[str, tuple[str, ...]]:
        """The statistics of each output, by its name."""
        declared = {output.name: tuple(dict.fromkeys(output.statistics)) for output in self.declared}
        return {field.name: declared.get(field.name) or DEFAULT for field in self.layout.fields}

    @property
    def width(self) -> int:
        """The numbers that moments of all outputs take."""
        return MOMENTS * self.layout.width

    def levels(self, field: Field) -> list[float]:
        """Return the levels of the quantiles of an output, between 0 and 1."""
        return [level for name in self.statistics[field.name] if (level := quantile_of(name)) is not None]

    @cached_property
    def kept_width(self) -> int:
        """The numbers of one realisation that are kept."""
        return sum(math.prod(self.layout.shape(field)) for field in self.layout.fields if self.levels(field))

    @cached_property
    def further_width(self) -> int:
        """The numbers that quantiles and their errors take."""
        return sum(2 * len(self.levels(field)) * math.prod(self.layout.shape(field)) for field in self.layout.fields)

    def _place(self, field: Field) -> slice:
        """Return the place of an output's moments in a row."""
        place = self.layout.places[field.name]
        return slice(1 + MOMENTS * place.start, 1 + MOMENTS * place.stop)

    def merged(self, one: Array, other: Array) -> Array:
        """Return the rows of two sets of realisations as one."""
        row = np.empty_like(one)
        row[0] = one[0] + other[0]
        for place in map(self._place, self.layout.fields):
            mine, theirs = (moments[place].reshape(MOMENTS, -1) for moments in (one, other))
            row[place] = merged(mine, float(one[0]), theirs, float(other[0])).reshape(-1)
        return row

    def of_samples(self, samples: Array) -> Array:
        """Return the quantiles of kept realisations and their errors, as one row."""
        found, start = [], 0
        for field in self.layout.fields:
            if levels := self.levels(field):
                size = math.prod(self.layout.shape(field))
                found.append(quantiles(levels, samples[:, start : start + size]).reshape(-1))
                start += size
        return np.concatenate(found)

    def outputs(self) -> tuple[Output, ...]:
        """Return the statistics of all outputs, each followed by its error."""
        headline = self.layout.headline(self.declared)
        made = []
        for field in self.layout.fields:
            meaning = field.meaning or field.name.replace("_", " ")
            told = Output(field.name, field.unit, dims=field.dims, headline=field.name in headline, nan=True)
            for name in self.statistics[field.name]:
                value = replace(told, name=f"{field.name}_{name}", meaning=f"{_in_words(name)} of {meaning}")
                if name == "count":
                    value = replace(value, unit="")
                made.append(value)
                if name not in ("min", "max"):
                    error = f"one-sigma Monte-Carlo error of {value.name}"
                    if where := unknown(name, field):
                        error += f"; not known (NaN) {where}"
                    made.append(replace(value, name=f"{value.name}_mc_error", meaning=error, headline=False))
        return tuple(made)

    def results(self, rows: Array) -> dict[str, Array]:
        """Return all statistics and errors, (points, *shape), from rows that end with the quantiles."""
        found: dict[str, Array] = {}
        n = rows[:, 0]
        further = 1 + self.width
        for field in self.layout.fields:
            shape = (len(rows), *self.layout.shape(field))
            moments = rows[:, self._place(field)].reshape(len(rows), MOMENTS, -1)
            size = moments.shape[2]
            for name in self.statistics[field.name]:
                value: Array
                error: Array | None
                if quantile_of(name) is not None:
                    value, error = rows[:, further : further + size], rows[:, further + size : further + 2 * size]
                    further += 2 * size
                else:
                    value, error = statistic(name, field, moments, n)
                found[f"{field.name}_{name}"] = value.reshape(shape)
                if error is not None:
                    found[f"{field.name}_{name}_mc_error"] = error.reshape(shape)
        return found


def drawn(flats: Sequence[Flat], declared: Declared) -> Flat:
    """Return the realisations of a block as a row of moments, with the realisations that quantiles need.

    Raises ResultError where they differ in more than their values.
    """
    if strange := [field for field in flats[0].layout.fields if field.type not in NUMBERS | {"bool"}]:
        name, kind = strange[0].name, strange[0].type
        raise ResultError(
            f"{declared.function}: {name!r} is of type {kind}; statistics are made of numbers and truth values"
        )
    layout, values = _values(flats, declared.function)
    own = Realisations(layout, declared.outputs)
    kept = [values[field.name] for field in layout.fields if own.levels(field)]
    moments = [moments_of(values[field.name]).reshape(-1) for field in layout.fields]
    row = np.concatenate(moments).astype("<f8").tobytes()
    return Flat(layout, row, {}, np.concatenate(kept, axis=1) if kept else None)


def _in_words(name: str) -> str:
    level = None if name == "median" else quantile_of(name)
    if level is not None:
        return f"{100.0 * level:g} % quantile"
    words = {"std": "standard deviation", "min": "least", "max": "largest", "count": "number of true"}
    return words.get(name, name)


def _values(flats: Sequence[Flat], function: str) -> tuple[Layout, dict[str, Array]]:
    """Return the layout of realisations, all numbers floats, and their values by name, (n, size)."""
    layout = flats[0].layout.floats
    rows = []
    for flat in flats:
        if wrong := differences(layout, flat.layout):
            raise ResultError(f"{function}: one realisation differs from another: {'; '.join(wrong)}")
        if (row := as_floats(flat.row, flat.layout, layout)) is None:
            raise ResultError(f"{function}: an integer beyond 2**53 is no number that statistics can be made of")
        rows.append(row)
    whole = np.frombuffer(b"".join(rows), dtype="<f8").reshape(len(rows), layout.width)
    return layout, {name: array.reshape(len(rows), -1).astype(float) for name, array in layout.values(whole).items()}
