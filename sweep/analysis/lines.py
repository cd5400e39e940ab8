"""One quantity of a dataset along one axis: values, errors and places as arrays, for every line of the grid."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.analysis.quantity import (
    COVARIANCE_SUFFIX,
    OLD_ERRORS,
    covariance_along,
    has_old_errors,
    require_axis,
    samples_along,
    standard_error,
)
from linksweep.sweep.analysis.selection import place_in_words
from linksweep.sweep.contract import FEW, FEWEST_SAMPLES, Array, SweepError
from linksweep.sweep.formatting import described, units_of
from linksweep.sweep.planning.point_status import Status, count_status, unfinished_in_words
from linksweep.sweep.studies.record import outer_draw_of
from linksweep.sweep.studies.study import POINT


@dataclass(frozen=True)
class Lines:
    """A quantity along the axis ``over``: ``value``, ``error`` and ``used`` (lines, n) at ``x`` (n,), which ascends.

    ``error`` is one sigma, NaN or 0 where there is none; ``covariance`` (lines, n, n) is there if the dataset has it.
    Points that a study excludes are not ``used``.  The lines are those of the dimensions ``dims`` in C order, whose
    coordinates are in ``grid``; ``unit`` (lines,) is the unit of each, ``errors`` says where the errors come from.
    ``samples`` is the number of independent samples from which the covariance was estimated: infinity if it is exact
    or points are independent, NaN if they share random numbers and their covariance is not known.
    """

    title: str
    variable: str
    over: str
    over_unit: str
    x: Array
    value: Array
    error: Array
    used: NDArray[np.bool_]
    covariance: Array | None
    dims: tuple[str, ...]
    grid: xr.Dataset
    unit: tuple[str, ...]
    errors: str
    samples: float = np.inf

    def __len__(self) -> int:
        return len(self.value)

    def place(self, line: int) -> dict[str, Any]:
        """Return the coordinates of a line by name, those of dimensions first."""
        index = dict(zip(self.dims, map(int, np.unravel_index(line, self.shape)), strict=True)) if self.dims else {}
        names = [*self.dims, *(n for n in map(str, self.grid.coords) if n not in self.dims and not n.endswith("_unit"))]
        return {n: self.grid[n].isel({d: index[str(d)] for d in self.grid[n].dims}).item() for n in names}

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each of ``dims``."""
        return tuple(self.grid.sizes[d] for d in self.dims)

    @property
    def common_unit(self) -> str:
        """The unit of all lines; '' if they differ: the coordinate of the components' units then gives them."""
        return self.unit[0] if len(set(self.unit)) == 1 else ""

    def with_variables(self, columns: Mapping[str, tuple[Any, str, str]]) -> xr.Dataset:
        """Return the grid with variables, each given by values (lines,), unit and meaning, and with attributes."""
        variables = {
            name: (self.dims, np.reshape(values, self.shape), described(unit, meaning))
            for name, (values, unit, meaning) in columns.items()
        }
        return self.grid.assign(variables).assign_attrs(title=self.title, variable=self.variable, over=self.over)

    def errors_of(self, line: int) -> Array:
        """Return the errors (k,) or the covariance (k, k) of the k used points of a line."""
        used = self.used[line]
        return np.asarray(
            self.error[line, used] if self.covariance is None else self.covariance[line][np.ix_(used, used)]
        )


def lines(
    dataset: xr.Dataset, variable: str, over: str, covariance: xr.DataArray | None = None, least: int = 2
) -> Lines:
    """Return a quantity along an axis, for every combination of the others.

    ``covariance`` takes the place of NAME_mc_covariance_OVER in the dataset.  Points that the study excludes do not
    belong to a line, and a line may have none.  Raises SweepError for an unknown quantity or axis, points that are not
    done, values that are not finite, and lines of fewer than ``least`` points.
    """
    require_axis(dataset, variable, over)
    dimension = str(dataset[over].dims[0])
    if dimension == POINT:  # a table may repeat a point
        dataset = dataset.isel({POINT: np.unique(dataset[over].values, return_index=True)[1]})
    others = [str(d) for d in dataset[variable].dims if d != dimension]
    order = np.argsort(dataset[over].values, kind="stable")
    ordered = dataset.isel({dimension: order})
    template = ordered[variable].astype(float)  # integers too: errors may be NaN
    status = ordered["status"].broadcast_like(template)
    error = standard_error(ordered, variable)
    covariance = _covariance(ordered, variable, dimension, order, covariance)
    samples = samples_along(dataset, dimension, covariance)
    along = {n: c.variable for n, c in dataset.coords.items() if set(c.dims) <= set(others)}
    found = Lines(
        title=str(dataset.attrs.get("title", "")),
        variable=variable,
        over=over,
        over_unit=units_of(dataset[over].attrs),
        x=ordered[over].values.astype(float),
        value=_rows(template, others, dimension),
        error=_rows(xr.full_like(template, np.nan) if error is None else error, others, dimension),
        used=_rows(status, others, dimension) != Status.EXCLUDED,
        covariance=None if covariance is None else _rows(covariance, others, dimension, f"{dimension}_other"),
        dims=tuple(others),
        grid=xr.Dataset(coords=along | {d: dataset[d].variable for d in others}),
        unit=_units(dataset, variable, others),
        errors=_errors_in_words(dataset, error is not None, covariance is not None, samples),
        samples=samples,
    )
    require_done(dataset)
    if problems := _unusable(found, least):
        raise SweepError(problems[:FEW])
    return found


def require_done(dataset: xr.Dataset) -> None:
    """Raise SweepError unless all points of a dataset are done or excluded by the study."""
    counts = count_status(dataset["status"].values)
    if undone := unfinished_in_words(counts):
        commands = {
            Status.MISSING: "`sweep run` computes what is missing",
            Status.FAILED: "`sweep run --retry` what failed",
        }
        help_ = ", ".join(words for code, words in commands.items() if counts[code])
        raise SweepError(
            f"is incomplete: {undone} of {sum(counts.values()):,} points here; {help_}; or choose other points"
        )


def _rows(array: xr.DataArray, others: Sequence[str], *last: str) -> NDArray[Any]:
    """Return values of shape (lines, *last)."""
    values = array.transpose(*others, *last).values
    return values.reshape(-1, *values.shape[len(others) :])


def _units(dataset: xr.Dataset, variable: str, others: Sequence[str]) -> tuple[str, ...]:
    """Return the unit of each line: that of the variable, or of the components that its own unit lists."""
    own = units_of(dataset[variable].attrs)
    listed = [c.variable.astype(object) for n, c in dataset.coords.items() if str(n).endswith("_unit")]
    parts = [part for part in listed if set(part.dims) <= set(others)] if "," in own else []
    unit = xr.Variable(others, np.full([dataset.sizes[d] for d in others], "" if parts else own, dtype=object))
    for part in parts:
        unit = unit + (part if len(parts) == 1 else "(" + part + ") ")
    return tuple(str(each).strip() for each in unit.values.reshape(-1))


def _covariance(
    dataset: xr.Dataset, variable: str, dimension: str, order: NDArray[np.intp], given: xr.DataArray | None
) -> xr.DataArray | None:
    """Return the covariance between the points of every line, with both of its dimensions in the order of the axis."""
    name, other = f"{variable}_{COVARIANCE_SUFFIX}_{dimension}", f"{dimension}_other"
    found = covariance_along(dataset, variable, dimension) if given is None else given.isel({dimension: order})
    if found is None:
        return None
    found = found.isel({other: order})
    wanted = {*dataset[variable].dims, other}
    if extra := set(found.dims) - wanted:
        raise SweepError(f"{name} has the dimensions {', '.join(map(str, extra))} that {variable} does not have")
    if found.sizes[other] != found.sizes[dimension]:
        raise SweepError(f"{name} is not square: {dict(found.sizes)}")
    return found.broadcast_like(dataset[variable].expand_dims({other: found.sizes[other]}))


def _errors_in_words(dataset: xr.Dataset, known: bool, correlated: bool, samples: float) -> str:
    if has_old_errors(dataset):
        return OLD_ERRORS
    if correlated:
        return "covariance between points" + (f", from {samples:.0f} samples" if np.isfinite(samples) else "")
    if np.isnan(samples):
        return (
            "not known, as points share random numbers and the store has no covariance of them "
            f"(it needs {FEWEST_SAMPLES} {outer_draw_of(dataset.attrs)}s, or as many blocks of one, and no `precision`)"
        )
    if not known:
        return "none: points weigh the same, errors come from the scatter"
    return "Monte Carlo, independent points"


def _unusable(found: Lines, least: int) -> list[str]:
    problems = []
    finite = np.isfinite(found.value) | ~found.used
    count = found.used.sum(axis=1)
    for line in map(int, np.flatnonzero(~finite.all(axis=1))):
        at = found.x[~finite[line]][0]
        problems.append(
            f"{found.variable} is not a finite number at {place_in_words(found.place(line) | {found.over: at})}"
        )
    for line in map(int, np.flatnonzero((count > 0) & (count < least))):
        where = place_in_words(found.place(line))
        problems.append(
            f"at least {least} points are needed along {found.over}; there are {count[line]}{where and ' at ' + where}"
        )
    if not count.any():
        problems.append("every point is excluded by the study")
    return problems
