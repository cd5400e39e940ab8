"""One quantity of a dataset along one axis: values, errors and places as arrays, for every line of the grid."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.contract import FEW, SweepError, shown, suggest
from sweep.tally import DONE, EXCLUDED, STATUS_WORDS

Array = NDArray[np.float64]

ERROR_SUFFIXES = ("mc_error", "catalogue_error")
"""Outputs NAME_SUFFIX beside NAME are its one-sigma errors from Monte Carlo; those that exist add in quadrature."""

COVARIANCE_SUFFIX = "mc_covariance"
"""A variable NAME_mc_covariance_OVER with the dimensions of NAME and OVER_other is the covariance of NAME between
points along the axis OVER, where these share random numbers.  It has all of their error: it stands for both error
variables.
"""

SHARES_RANDOM_NUMBERS = "common_random_numbers"
"""An attribute that is true where points of the grid share random numbers."""


@dataclass(frozen=True)
class Lines:
    """A quantity along the axis ``over``: ``value``, ``error`` and ``used`` (lines, n) at ``x`` (n,), which ascends.

    ``error`` is one sigma, NaN or 0 where there is none; ``covariance`` (lines, n, n) is there if the dataset has it.
    Points that a study excludes are not ``used``.  The lines are those of the dimensions ``dims`` in C order, whose
    coordinates are in ``grid``; ``unit`` (lines,) is the unit of each, ``errors`` says where the errors come from.
    """

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

    def errors_of(self, line: int) -> Array:
        """Return the errors (k,) or the covariance (k, k) of the k used points of a line."""
        used = self.used[line]
        return np.asarray(
            self.error[line, used] if self.covariance is None else self.covariance[line][np.ix_(used, used)]
        )


def standard_error(dataset: xr.Dataset, variable: str) -> xr.DataArray | None:
    """Return the one-sigma error of a variable from all its error variables in quadrature; None if it has none.

    A NaN in one of several is an error that is not known, such as that of one catalogue, and does not count.
    """
    parts = [dataset[f"{variable}_{s}"] for s in ERROR_SUFFIXES if f"{variable}_{s}" in dataset]
    if not parts:
        return None
    squares: xr.DataArray = sum((part.fillna(0.0) ** 2 for part in parts[1:]), parts[0].fillna(0.0) ** 2)
    return squares**0.5


def covariance_between(
    dataset: xr.Dataset, variable: str, dimension: str, one: int, other: int
) -> xr.DataArray | float:
    """Return the covariance of a variable between two indices along a dimension, 0 where the dataset has none."""
    name, partner = f"{variable}_{COVARIANCE_SUFFIX}_{dimension}", f"{dimension}_other"
    if name not in dataset or partner not in dataset[name].dims:
        return 0.0
    return dataset[name].isel({dimension: one, partner: other}, drop=True)


def quantities(dataset: xr.Dataset) -> list[str]:
    """Return the variables that are results of their own: numbers, with one value a point, no errors or predictions."""
    axes = set(dataset["status"].dims)
    numbers = [str(n) for n, v in dataset.data_vars.items() if v.dtype.kind == "f" and axes <= set(v.dims)]
    covariances = {f"{COVARIANCE_SUFFIX}_{axis}" for axis in dataset.coords}
    attached = (*ERROR_SUFFIXES, *covariances, "predicted", "published", "published_rounding")
    beside = {f"{name}_{suffix}" for name in numbers for suffix in attached}
    return [name for name in numbers if name not in beside and "sample" not in dataset[name].dims]


def main_quantity(dataset: xr.Dataset) -> str:
    """Return the variable to use where none is named: the first headline with an error, headline, or quantity."""
    names = quantities(dataset)
    if not names:
        raise SweepError("holds no results that are numbers")
    headline = [name for name in names if dataset[name].attrs.get("headline")]
    with_error = [name for name in headline if standard_error(dataset, name) is not None]
    return (with_error or headline or names)[0]


def require_quantity(dataset: xr.Dataset, variable: str) -> None:
    """Raise SweepError unless a variable is one of the dataset's quantities."""
    names = quantities(dataset)
    if variable not in names:
        raise SweepError(f"no quantity {shown(variable)}{suggest(variable, names)}")


def numeric_axes(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the coordinates of numbers along which a variable has at least two points, longest first."""
    dims = dataset[variable].dims
    names = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] in dims and c.dtype.kind in "if"]
    axes = [n for n in names if dataset[n].size > 1 and dataset[n].dims[0] in dataset["status"].dims]
    return sorted(axes, key=lambda n: (-dataset[n].size, n not in dims, n))


def require_axis(dataset: xr.Dataset, variable: str, over: str | None) -> str:
    """Return ``over`` if it is an axis of numbers of the variable, or the only one; raises SweepError otherwise, and
    for an unknown quantity.
    """
    require_quantity(dataset, variable)
    axes = numeric_axes(dataset, variable)
    if over is None:
        dimensions = {dataset[axis].dims[0] for axis in axes}
        if len(dimensions) == 1:
            return next(axis for axis in axes if axis in dimensions or len(axes) == 1)
        raise SweepError(f"name the axis; {variable} has {', '.join(axes) or 'none with several numbers'}")
    if over not in axes:
        raise SweepError(
            f"{shown(over)} is no axis with several numbers of {variable}; there are {', '.join(axes) or 'none'}"
        )
    return over


def select(dataset: xr.Dataset, places: Mapping[str, Any]) -> xr.Dataset:
    """Return the part of a dataset at values of axes; these become coordinates without a dimension.

    A value may be given as text, as on a command line.  Raises SweepError as `indices`.
    """
    return dataset.isel(indices(dataset, places))


def between(dataset: xr.Dataset, axis: str, low: float, high: float) -> xr.Dataset:
    """Return the part of a dataset where low <= axis <= high; raises SweepError if that is nowhere."""
    inside = (dataset[axis].values >= low) & (dataset[axis].values <= high)
    if not inside.any():
        values = dataset[axis].values
        raise SweepError(
            f"{axis} has no value from {low:g} to {high:g}; it goes from {values.min():g} to {values.max():g}"
        )
    dimension = str(dataset[axis].dims[0])
    both = [d for d in (dimension, f"{dimension}_other") if d in dataset.dims]
    return dataset.isel({d: np.flatnonzero(inside) for d in both})


def indices(dataset: xr.Dataset, places: Mapping[str, Any]) -> dict[str, int]:
    """Return the index along each dimension that values of axes stand for.

    Raises SweepError that lists every name that is no axis, every value that is not in the grid, and values of axes
    along one dimension that are not those of one point.
    """
    problems: list[str] = []
    found: dict[str, set[int]] = {}
    axes = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and not str(n).endswith("_unit")]
    for name, wanted in places.items():
        if name not in axes:
            problems.append(f"{shown(name)} is not an axis{suggest(name, axes) if axes else '; there are none'}")
            continue
        values = dataset[name].values.tolist()
        hits = {i for i, value in enumerate(values) if _is_meant(value, wanted)}
        dimension = str(dataset[name].dims[0])
        if not hits:
            listed = ", ".join(map(str, values[:FEW])) + (", ..." if len(values) > FEW else "")
            problems.append(f"{name} = {wanted} is not in the grid, which has {listed}")
        elif not found.setdefault(dimension, hits) & hits:
            problems.append(f"{name} = {wanted} is at no point with the other values that are given along {dimension}")
        else:
            found[dimension] &= hits
    if problems:
        raise SweepError(problems)
    return {dimension: min(hits) for dimension, hits in found.items()}


def lines(
    dataset: xr.Dataset, variable: str, over: str, covariance: xr.DataArray | None = None, least: int = 2
) -> Lines:
    """Return a quantity along an axis, for every combination of the others.

    ``covariance`` takes the place of the variable NAME_mc_covariance.  Points that the study excludes do not belong to
    a line, and a line may have none.  Raises SweepError for an unknown quantity or axis, points that are not done,
    values that are not finite, and lines of fewer than ``least`` points.
    """
    require_axis(dataset, variable, over)
    dimension = str(dataset[over].dims[0])
    value = dataset[variable]
    others = [str(d) for d in value.dims if d != dimension]
    order = np.argsort(dataset[over].values, kind="stable")
    ordered = dataset.isel({dimension: order})
    template = ordered[variable]
    status = ordered["status"].broadcast_like(template)
    error = standard_error(ordered, variable)
    covariance = _covariance(ordered, variable, dimension, order, covariance)
    found = Lines(
        variable=variable,
        over=over,
        over_unit=str(dataset[over].attrs.get("units", "")),
        x=ordered[over].values.astype(float),
        value=_rows(template, others, dimension),
        error=_rows(xr.full_like(template, np.nan) if error is None else error, others, dimension),
        used=_rows(status, others, dimension) != EXCLUDED,
        covariance=None if covariance is None else _rows(covariance, others, dimension, f"{dimension}_other"),
        dims=tuple(others),
        grid=_grid(dataset, others),
        unit=_units(dataset, variable, others),
        errors=_errors_inplace_in_words(dataset, error is not None, covariance is not None),
    )
    require_done(dataset)
    if problems := _unusable(found, least):
        raise SweepError(problems[:FEW])
    return found


def require_done(dataset: xr.Dataset) -> None:
    """Raise SweepError unless all points of a dataset are done or excluded by the study."""
    status = dataset["status"].values
    counts = {word: int(np.sum(status == code)) for code, word in enumerate(STATUS_WORDS)}
    undone = [f"{n} {word}" for word, n in counts.items() if n and STATUS_WORDS.index(word) not in (DONE, EXCLUDED)]
    if undone:
        raise SweepError(
            f"is incomplete: {' and '.join(undone)} of {status.size} points here; `sweep run` the study to go on, "
            "or choose a complete part"
        )


def place_in_words(where: Mapping[str, Any]) -> str:
    """Return a place on the axes as ``model=gaia, v_max=16``."""
    return ", ".join(f"{k}={f'{v:g}' if isinstance(v, float) else v}" for k, v in where.items())


def _is_meant(value: object, wanted: object) -> bool:
    """Return whether a value of a grid is the one wanted, which may be its text on a command line."""
    if not isinstance(wanted, str) or isinstance(value, str):
        return value == wanted
    if isinstance(value, bool):
        return wanted.lower() == str(value).lower()
    try:
        return value == float(wanted)
    except ValueError:
        return False


def _rows(array: xr.DataArray, others: Sequence[str], *last: str) -> NDArray[Any]:
    """Return values of shape (lines, *last)."""
    values = array.transpose(*others, *last).values
    return values.reshape(-1, *values.shape[len(others) :])


def _grid(dataset: xr.Dataset, others: Sequence[str]) -> xr.Dataset:
    names = [n for n, c in dataset.coords.items() if set(c.dims) <= set(others)]
    return xr.Dataset(coords={n: dataset.coords[n].variable for n in names} | {d: dataset[d].variable for d in others})


def _units(dataset: xr.Dataset, variable: str, others: Sequence[str]) -> tuple[str, ...]:
    """Return the unit of each line: that of the variable, or of the components that its own unit lists."""
    shape = tuple(dataset.sizes[d] for d in others)
    own = str(dataset[variable].attrs.get("units", ""))
    unit = np.full(shape, own, dtype=object)
    kinds = [n for n in map(str, dataset.coords) if n.endswith("_unit")] if "," in own else []
    parts = []
    for kind in kinds:
        values, dims = dataset[kind].values.astype(object), dataset[kind].dims
        if set(dims) <= set(others):
            parts.append(np.broadcast_to(values.reshape([-1 if d in dims else 1 for d in others]), shape))
    if parts:
        unit = parts[0] if len(parts) == 1 else sum(("(" + part + ") " for part in parts), np.full(shape, ""))
    return tuple(str(each).strip() for each in np.asarray(unit, dtype=object).reshape(-1))


def _covariance(
    dataset: xr.Dataset, variable: str, dimension: str, order: NDArray[np.intp], given: xr.DataArray | None
) -> xr.DataArray | None:
    """Return the covariance between the points of every line, with both of its dimensions in the order of the axis."""
    name, other = f"{variable}_{COVARIANCE_SUFFIX}_{dimension}", f"{dimension}_other"
    if given is not None:
        found = given.isel({dimension: order})
    elif name in dataset and other in dataset[name].dims:
        found = dataset[name]
    else:
        return None
    found = found.isel({other: order})
    wanted = {*dataset[variable].dims, other}
    if extra := set(found.dims) - wanted:
        raise SweepError(f"{name} has the dimensions {', '.join(map(str, extra))} that {variable} has not")
    if found.sizes[other] != found.sizes[dimension]:
        raise SweepError(f"{name} is not square: {dict(found.sizes)}")
    return found.broadcast_like(dataset[variable].expand_dims({other: found.sizes[other]}))


def _errors_inplace_in_words(dataset: xr.Dataset, known: bool, correlated: bool) -> str:
    if correlated:
        return "covariance between points"
    if not known:
        return "none: points weigh the same, errors come from the scatter"
    if dataset.attrs.get(SHARES_RANDOM_NUMBERS):
        return "Monte Carlo, taken as independent although points share random numbers: their covariance is not known"
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
