"""What a dataset of results holds: its quantities with their errors and axes, parts of it, and what it lacks.

Everything that looks at results asks here, so that tables, laws, figures and pages agree about what belongs together.
"""

from __future__ import annotations  # names of xarray, which is imported only where it computes

import json
from collections.abc import Collection, Container, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import FEW, FEWEST_SAMPLES, RESERVED, Array, Status, SweepError, refused, shown, suggest
from linksweep.sweep.contract.rows import LENGTH, count_status, small_sample_factor, unfinished_in_words
from linksweep.sweep.formatting import ERRORS, RAGGED, first_of, is_missing, is_truth, plain, prefixed, units_of
from linksweep.sweep.planning.grid import Grid, GridPoint
from linksweep.sweep.stores.store import RUNNING, finished
from linksweep.sweep.studies.points import labelled, read_cell
from linksweep.sweep.studies.record import FUNCTION, outer_draw_of
from linksweep.sweep.studies.study import LOST, POINT, POINT_TABLE, Claim, Study

if TYPE_CHECKING:
    import xarray as xr


# Outputs NAME_SUFFIX beside NAME are its one-sigma errors from Monte Carlo; those that exist add in quadrature.
ERROR_SUFFIXES = ("mc_error", "catalogue_error")

# Outputs NAME_SUFFIX beside NAME predict it; the first that exists predicts all of it, the other may be a part.
PREDICTION_SUFFIXES = ("rms_predicted", "predicted")

# Variables NAME_SUFFIX that belong to NAME and are in its unit.
BESIDE = (*ERROR_SUFFIXES, *PREDICTION_SUFFIXES, "published", "published_rounding")

# A variable NAME_mc_covariance_OVER with the dimensions of NAME and OVER_other is the covariance of NAME between points
# along the axis OVER, where these share random numbers.  It includes all of their error, and replaces both error
# variables.  Its attribute ``samples`` is the number of independent samples that it was estimated from; without that
# attribute it is exact.  The coordinate OVER_other has the values of OVER, by which points are found there after OVER
# was cut or sorted.
COVARIANCE_SUFFIX = "mc_covariance"

# Attributes: whether points of the grid share random numbers, and the axes along which they do, all by default.
SHARES_RANDOM_NUMBERS, SHARED_AXES = "common_random_numbers", "shared_axes"

# What is said of places at which a study has no point.
EXCLUDED = "no point in the study"


# Quantities and their errors


def quantities(dataset: xr.Dataset) -> list[str]:
    """Return the variables that are results of their own: numbers at each point, not errors, predictions or samples."""
    if "status" not in dataset:
        raise SweepError("there is no variable status, which says at which points there are results: keep it")
    # integers and truth values are results only of a plain function
    axes, kinds = set(dataset["status"].dims), "fib" if FUNCTION in dataset.attrs else "f"
    of_points = {str(n): v for n, v in dataset.data_vars.items() if str(n) not in RESERVED and axes <= set(v.dims)}
    numbers = [name for name, variable in of_points.items() if variable.dtype.kind in kinds]
    covariances = [f"{COVARIANCE_SUFFIX}_{str(axis).removesuffix('_other')}" for axis in dataset.coords]
    beside = {f"{name}_{suffix}" for name in numbers for suffix in (*BESIDE, *covariances)}
    return [name for name in numbers if name not in beside and "sample" not in dataset[name].dims]


def headline_variables(dataset: xr.Dataset) -> list[str]:
    """Return the headline outputs of an experiment, those with errors first."""
    names = [str(name) for name, variable in dataset.data_vars.items() if variable.attrs.get("headline")]
    return sorted(names, key=lambda name: f"{name}_mc_error" not in dataset)


def with_values(dataset: xr.Dataset, names: Sequence[str]) -> list[str]:
    """Return some variables, those first that have a value at any point; of links only these, if there are any: one
    that does not solve for the spin, for example, has no error of it.
    """
    known = [name for name in names if is_known(dataset[name].values).any()]
    return known if known and FUNCTION not in dataset.attrs else sorted(names, key=lambda name: name not in known)


def is_known(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Return where values of any type are not missing: NaN and NaT differ from themselves."""
    return np.asarray(np.equal(values, values))


def headlines(dataset: xr.Dataset) -> list[str]:
    """Return the quantities that a study is about: the headline outputs as `with_values` has them, or the first
    quantity if there are none.
    """
    known = quantities(dataset)
    return with_values(dataset, [name for name in headline_variables(dataset) if name in known]) or known[:1]


def main_quantity(dataset: xr.Dataset) -> str:
    """Return the variable to use if none is named; raises SweepError if there are no numbers."""
    if names := headlines(dataset):
        return names[0]
    raise SweepError("holds no results that are numbers")


def require_quantity(dataset: xr.Dataset, variable: str) -> None:
    """Raise SweepError unless a variable is one of the dataset's quantities."""
    if variable in (names := quantities(dataset)):
        return
    if variable in dataset.data_vars and dataset[variable].dtype.kind not in "biufc":
        raise SweepError(f"{variable} has no numbers to draw or to fit")
    raise SweepError(f"no quantity {shown(variable)}{suggest(variable, names) if names else '; there are none'}")


def numbers(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """Return a variable as floats, to compute with; raises SweepError for integers, beyond 2**53, that none is."""
    values, floats = dataset[name].values, dataset[name].astype(float)
    beyond = values[np.abs(floats.values) >= 2.0**53].tolist() if values.dtype.kind in "iu" else []
    if lost := [number for number in beyond if number != float(number)]:
        remedy = "return it less a number that is near, or as a float"
        raise SweepError(f"{name} is {lost[0]}, beyond 2**53 and no float: {remedy}")
    return floats


def standard_error(dataset: xr.Dataset, variable: str) -> xr.DataArray | None:
    """Return the one-sigma error of a variable from all its error variables in quadrature; None if it is exact, as what
    has none of them is, except for the largest and the least of random numbers.

    NaN is an error that is not known, such as that of these or of few catalogues; it is left out if another part of the
    error is known.
    """
    parts = [dataset[f"{variable}_{s}"] for s in ERROR_SUFFIXES if f"{variable}_{s}" in dataset]
    if not parts:  # a function without random numbers has no seed
        value, is_drawn = dataset[variable], {FUNCTION, "seed"} <= dataset.attrs.keys()
        return value.copy(data=np.full(value.shape, np.nan)) if is_drawn else None
    values = np.array([part.transpose(*parts[0].dims).values for part in parts])
    total = np.hypot.reduce(np.nan_to_num(values, posinf=np.inf))
    return parts[0].copy(data=np.where(is_known(values).any(axis=0), total, np.nan))


def sigmas(dataset: xr.Dataset, variable: str, dims: Sequence[Hashable]) -> Array:
    """Return the one-sigma error of each value of a variable, over its dimensions in this order; 0 if it is exact."""
    error = standard_error(dataset, variable)
    return np.zeros([dataset.sizes[d] for d in dims]) if error is None else error.transpose(*dims).values


def errors_beside(dataset: xr.Dataset, variable: str) -> list[str]:
    """Return the variables that are declared as errors of a variable, each of another kind."""
    return [name for name in str(dataset[variable].attrs.get(ERRORS, "")).split() if name in dataset]


def unknown_parts(dataset: xr.Dataset, variable: str, status: Status = Status.DONE) -> list[str]:
    """Return a sentence for every part of the error of a variable that is not known at points that are done, or that
    have another ``status``.
    """
    done, axes = dataset["status"].values == status, axes_of(dataset)
    draw = outer_draw_of(dataset.attrs)
    words = {"mc_error": "its Monte-Carlo error", "catalogue_error": f"the choice of {draw}s"}
    needed = "more realisations" if FUNCTION in dataset.attrs else f"{FEWEST_SAMPLES} {draw}s"
    return [
        f"{variable}: {words[suffix]} is not in the error, as {needed} are needed to know it"
        for suffix in ERROR_SUFFIXES
        if (name := f"{variable}_{suffix}") in dataset
        and not is_known(dataset[name].transpose(*axes, *own_dimensions(dataset, name)).values[done]).all()
    ]


def prediction_name(names: Container[Hashable], variable: str) -> str:
    """Return the name of a variable's prediction: the one that includes biases, if ``names`` has it."""
    whole, part = (f"{variable}_{suffix}" for suffix in PREDICTION_SUFFIXES)
    return whole if whole in names else part


def parts_of(dataset: xr.Dataset, name: str) -> dict[str, xr.DataArray]:
    """Return a quantity as ``value`` and what belongs to it and is known, all with its own dimensions: ``error``, the
    standard error or else the first that is declared, ``predicted``, ``published`` and ``published_rounding``.
    """
    value, error, declared = dataset[name], standard_error(dataset, name), errors_beside(dataset, name)
    error = dataset[declared[0]] if error is None and declared else error
    others = {"error": error, "predicted": dataset.get(prediction_name(dataset, name))}
    others |= {suffix: dataset.get(f"{name}_{suffix}") for suffix in ("published", "published_rounding")}
    known = {n: part for n, part in others.items() if part is not None and set(part.dims) <= set(value.dims)}
    # without errors of observation a prediction is 0
    numbers = {n: part for n, part in known.items() if np.nan_to_num(part.values).any()}
    return {"value": value} | {n: part.broadcast_like(value).transpose(*value.dims) for n, part in numbers.items()}


def claims_of(dataset: xr.Dataset) -> list[Claim]:
    """Return the claims that a dataset carries in its attributes; raises SweepError if they cannot be read."""
    with refused(ValueError, TypeError, said="the attribute 'claims' cannot be read: "):
        return [Claim.model_validate(claim) for claim in json.loads(dataset.attrs.get("claims", "[]"))]


# Points that share random numbers


def shares_random_numbers(dataset: xr.Dataset, dimensions: Collection[str]) -> bool:
    """Return whether points that differ along these dimensions, and no others, have random numbers in common: values
    along a dimension of a result's own do, as the same realisations have them all.  Points of a table differ in
    parameters, and not in labels.
    """
    if not (dimensions := {*dimensions} & {*axes_of(dataset)}) or not dataset.attrs.get(SHARES_RANDOM_NUMBERS):
        return not dimensions
    crossed = dimensions - {d for name in _columns(dataset) for d in dataset[name].dims}
    axes = {str(n) for n, c in dataset.coords.items() if crossed & {*c.dims} and not str(n).endswith("_unit")}
    axes |= {name for name in varied_parameters(dataset) if dimensions & {*dataset[name].dims}}
    return SHARED_AXES not in dataset.attrs or axes <= set(json.loads(dataset.attrs[SHARED_AXES]))


def covariance_along(dataset: xr.Dataset, variable: str, dimension: str) -> xr.DataArray | None:
    """Return the covariance of a variable between points along a dimension; None if there is none."""
    name = f"{variable}_{COVARIANCE_SUFFIX}_{dimension}"
    return dataset[name] if name in dataset and f"{dimension}_other" in dataset[name].dims else None


def samples_along(dataset: xr.Dataset, variable: str, dimension: str) -> float:
    """Return the number of independent samples that the covariance of points along a dimension was estimated from:
    infinity if it is exact or points are independent, NaN if they share random numbers and it is not known.
    """
    covariance, error = covariance_along(dataset, variable, dimension), standard_error(dataset, variable)
    if covariance is not None:
        return float(covariance.attrs.get("samples", np.inf))
    is_exact = dimension in own_dimensions(dataset, variable) and (error is None or not error.any())
    return np.nan if shares_random_numbers(dataset, [dimension]) and not is_exact else np.inf


def places_of_others(dataset: xr.Dataset, variable: str, dimension: str) -> list[int]:
    """Return where along DIMENSION_other the covariance of a variable has each point along a dimension, by its label.

    Raises SweepError for a covariance without labels, or without those of these points.
    """
    pair = (dimension, f"{dimension}_other")
    here, there = ([None if is_missing(label) else label for label in dataset[one].values.tolist()] for one in pair)
    place = {label: i for i, label in enumerate(there)}
    if pair[1] not in dataset.coords or (here != there and (len(place) < len(there) or not {*here} <= {*there})):
        words = f"cut or sort {' and '.join(pair)} alike, or open the store with linksweep.open"
        raise SweepError(
            f"{variable}_{COVARIANCE_SUFFIX}_{dimension} does not have the labels of these points: {words}"
        )
    return list(range(len(here))) if here == there else [place[label] for label in here]


@np.errstate(all="ignore")  # what is no number is no ratio
def ratio_at(
    dataset: xr.Dataset, variable: str, one: Mapping[str, int], other: Mapping[str, int]
) -> tuple[Array, Array]:
    """Return a variable at one index along dimensions over that at another, NaN where the denominator is 0, and the
    one-sigma error of this ratio, 0 if it is exact.

    If the two share random numbers, the error includes their covariance, and is NaN if the dataset does not have it;
    otherwise they are independent.
    """
    parts = [dataset.isel(place) for place in (one, other)]
    dims, differing = parts[0][variable].dims, [d for d in one if one[d] != other[d]]
    above, below = (part[variable].transpose(*dims).values.astype(float) for part in parts)
    below = np.where(below == 0.0, np.nan, below)
    ratio = above / below
    if not differing:
        return ratio, 0.0 * ratio
    sigma, tau = (sigmas(part, variable, dims) / below for part in parts)
    variance, dimension = sigma**2 + (ratio * tau) ** 2, differing[0]
    if len(differing) == 1 and covariance_along(dataset, variable, dimension) is not None:
        i, j, name = one[dimension], other[dimension], f"{variable}_{COVARIANCE_SUFFIX}_{dimension}"
        places = places_of_others(dataset, variable, dimension)
        pairs = ({**one, dimension: a, f"{dimension}_other": places[b]} for a, b in ((i, i), (j, j), (i, j)))
        at_one, at_other, both = (dataset.isel(pair)[name].transpose(*dims).values / below**2 for pair in pairs)
        variance = at_one + ratio**2 * at_other - 2.0 * ratio * both
        variance = np.maximum(0.0, variance * small_sample_factor(samples_along(dataset, variable, dimension)))
    elif standard_error(dataset, variable) is not None and shares_random_numbers(
        dataset.isel({d: [one[d], other[d]] for d in differing}), differing
    ):
        variance = np.nan * variance
    return ratio, np.sqrt(variance)


# Axes and places


def axes_of(dataset: xr.Dataset) -> list[str]:
    """Return the dimensions that are axes of the study, or those of what is derived from one."""
    array = dataset["status"] if "status" in dataset else next(iter(dataset.data_vars.values()))
    return list(map(str, array.dims))


def own_dimensions(dataset: xr.Dataset, name: str) -> list[str]:
    """Return the dimensions of an output that are not axes of the study."""
    return [str(d) for d in dataset[name].dims if d not in axes_of(dataset)]


def array_outputs(dataset: xr.Dataset) -> list[str]:
    """Return the outputs of a plain function that have dimensions of their own, besides samples and covariances."""
    further = {n: own_dimensions(dataset, n) for n in map(str, dataset.data_vars) if FUNCTION in dataset.attrs}
    return [n for n, dims in further.items() if dims and not any(d == "sample" or d.endswith("_other") for d in dims)]


def axis_coordinates(dataset: xr.Dataset, dimensions: Sequence[str]) -> list[str]:
    """Return the coordinates along some dimensions in their order, that with the name of the dimension first."""
    names = [str(n) for n, c in dataset.coords.items() if set(c.dims) <= set(dimensions) and c.dims]
    place = {name: list(dimensions).index(str(dataset[name].dims[0])) for name in names}
    return sorted(names, key=lambda name: (place[name], name not in dimensions, name))  # xarray sorts by name


def numeric_axes(dataset: xr.Dataset, variable: str, kinds: str = "if") -> list[str]:
    """Return the numeric coordinates along which a variable has at least two points, longest first: axes of the study,
    and dimensions of its own; with the ``kinds`` "ifM" also those of times.  Points of a table or a design have no
    order, so that they have no such axis.
    """
    dims = [d for d in dataset[variable].dims if d != POINT]
    names = [str(n) for n, c in dataset.coords.items() if c.ndim == 1 and c.dims[0] in dims and c.dtype.kind in kinds]
    sizes = {n: int(dataset[n].notnull().sum()) for n in names}  # an axis may have no effect somewhere
    return sorted((n for n in names if sizes[n] > 1), key=lambda n: (-sizes[n], n not in dims, n))


def varied_parameters(dataset: xr.Dataset) -> list[str]:
    """Return the parameters in which the points of a table or a design differ, in the order of its columns."""
    cells = {name: dataset[name].values.tolist() for name in _columns(dataset)}
    return [name for name, some in cells.items() if len({None if is_missing(cell) else cell for cell in some}) > 1]


def _columns(dataset: xr.Dataset) -> list[str]:
    """Return the columns of a table or a design that are parameters, along ``point`` or what it was swapped for."""
    names = json.loads(dataset.attrs.get(POINT_TABLE, '{"parameters": []}'))["parameters"]
    return [n for n in names if n in dataset.coords and dataset[n].dims]


def require_axis(dataset: xr.Dataset, variable: str, over: str | None) -> str:
    """Return ``over`` if it is an axis of numbers of the variable, or the only one; raises SweepError otherwise, and
    for an unknown quantity.
    """
    require_quantity(dataset, variable)
    axes = numeric_axes(dataset, variable)
    varied = varied_parameters(dataset) if POINT in dataset[variable].dims else []
    if len(varied) == 1 and dataset[varied[0]].dtype.kind in "if":
        axes += varied
    listed_axes = ", ".join(axes) or "none" + (f", as points differ in {', '.join(varied)}" if len(varied) > 1 else "")
    if over is not None and over not in axes:
        raise SweepError(f"{shown(over)} is no axis with several numbers of {variable}; there are {listed_axes}")
    if over is None and len({dataset[axis].dims[0] for axis in axes}) != 1:
        ask = "name the axis with --over; " if axes else ""
        raise SweepError(f"{ask}axes of {variable} with several numbers: {listed_axes}")
    return over or next((axis for axis in axes if axis in dataset.dims), axes[0])


def where_they_change(dataset: xr.Dataset, names: Sequence[str]) -> xr.Dataset:
    """Return a dataset without the axes of the study along which none of some variables changes."""
    arrays = [dataset[name].drop_vars(list(dataset.coords), errors="ignore") for name in names]
    axes = dataset["status"].dims
    alike = [d for d in axes if all(array.isel({d: [0] * array.sizes[d]}).equals(array) for array in arrays)]
    return dataset.isel(dict.fromkeys(alike, 0), drop=True)


def grid_of(dataset: xr.Dataset, dimensions: Sequence[str]) -> xr.Dataset:
    """Return the coordinates along some dimensions and no others, under the title of a dataset."""
    import xarray as xr  # which is not needed where results are only printed

    along = {n: c.variable for n, c in dataset.coords.items() if set(c.dims) <= set(dimensions)}
    title = {"title": str(dataset.attrs.get("title", ""))}
    return xr.Dataset(coords=along | {d: dataset[d].variable for d in dimensions}, attrs=title)


def places_along(dataset: xr.Dataset | xr.DataArray, dimensions: Iterable[Hashable]) -> Iterator[dict[str, int]]:
    """Yield the index of every combination along some dimensions, in C order."""
    names = list(map(str, dimensions))
    for index in np.ndindex(*(dataset.sizes[name] for name in names)):
        yield dict(zip(names, index, strict=True))


def units_along(dataset: xr.Dataset, variable: str, dimensions: Sequence[str]) -> list[str]:
    """Return the unit of a variable at every combination along some dimensions, in C order: that of its components,
    which are chosen by these or already, where they differ; of those of two components the product.
    """
    unit, parts = units_of(dataset[variable].attrs), list[list[str]]()
    if "," in unit:
        names = [str(n) for n, c in dataset.coords.items() if str(n).endswith("_unit") and set(c.dims) <= {*dimensions}]
        parts = [listed(dataset, name, dimensions) for name in names]
    if not parts:
        return [unit] * len(list(places_along(dataset, dimensions)))
    return [one[0] if len(one) == 1 else " ".join(f"({unit})" for unit in one) for one in zip(*parts, strict=True)]


def components_of(dataset: xr.Dataset, variable: str) -> Iterator[tuple[str, str, xr.Dataset]]:
    """Yield name, unit and dataset of a variable, or of each of its components, with one value per point; the values of
    a function along a dimension of its own stay together.
    """
    dims = own_dimensions(dataset, variable)
    if any(d in dataset.coords and dataset[d].dtype.kind in "ifM" for d in dims):
        dims = []
    units = units_along(dataset, variable, dims)
    for place, unit in zip(places_along(dataset, dims), units, strict=True):
        part = dataset.isel(place)
        labels = [str(part[d].values.item()) if d in part.coords else str(i) for d, i in place.items()]
        yield f"{variable} ({', '.join(labels)})" if dims else variable, unit, part


def place_at(dataset: xr.Dataset, index: Mapping[str, int]) -> dict[str, Any]:
    """Return the values of the axes at an index along dimensions, in the order of the grid (Zarr sorts by name)."""
    order = [dim for dim in dict.fromkeys([*axes_of(dataset), *index]) if dim in index]
    along = {name: str(dataset[name].dims[0]) for name in axis_coordinates(dataset, order)}
    return {name: listed(dataset, name, [dim], [index[dim]])[0] for name, dim in along.items()}


def place_in_words(where: Mapping[str, Any], dataset: Any = ()) -> str:
    """Return a place on the axes as ``model=gaia, v_max=16``, its numbers as all of those axes of a dataset."""
    # one that is missing has no effect at this point
    known = {name: value for name, value in where.items() if not is_missing(value) and value != ""}
    return ", ".join(f"{name}={value_in_words(dataset, name, value)}" for name, value in known.items())


def value_in_words(dataset: Any, axis: str, value: Any) -> str:
    """Return a value of an axis as a text that tells it from the other values which a dataset has."""
    others = listed(dataset, axis, [str(d) for d in dataset[axis].dims]) if axis in dataset else []
    return plain([value, *others])[0]


# Parts


def select(dataset: xr.Dataset, places: Mapping[str, Any]) -> xr.Dataset:
    """Return the part of a dataset at values of axes; these become coordinates without a dimension.

    Where several points have the values, as rows of a table may, all of them are returned and keep their dimension.
    A value may be a text, as on a command line.  Raises SweepError like `indices`.
    """
    return dataset.isel({d: hits[0] if len(hits) == 1 else hits for d, hits in indices(dataset, places).items()})


def point_in(dataset: xr.Dataset, study: Study, places: Mapping[str, str], where: str) -> GridPoint:
    """Return the point of the study of a store with a dataset at values of axes, as `select` takes them; raises
    SweepError that names ``where`` that is, unless it is one point, which several rows of a table may be.
    """
    grid = Grid(study)
    number = np.arange(len(grid)).reshape(grid.shape)
    with refused(OutsideGridError, where=where):
        part = select(dataset[["status"]].assign(number=(tuple(grid.dimensions), number)), places)
    dimensions = part["number"].dims
    there = part["status"].transpose(*dimensions).values != Status.EXCLUDED
    points = {point.digest: point for point in grid.points(part["number"].values[there])}
    if not points:
        raise SweepError(f"{', '.join(f'{n} = {v}' for n, v in places.items())}: has no point there", where)
    if len(points) > 1:
        several = [str(d) for d, along in zip(dimensions, there.nonzero(), strict=True) if len({*along}) > 1]
        values = {name: dict.fromkeys(text or "none" for text in plain(listed(part, name, [name]))) for name in several}
        choices = {name: first_of([*texts], FEW) for name, texts in values.items()}
        raise SweepError([f"--at: {name} needs a value, one of {some}" for name, some in choices.items()], where)
    return points.popitem()[1]


class OutsideGridError(SweepError):
    """A place or a result that a dataset does not have."""


def indices(dataset: xr.Dataset, places: Mapping[str, Any]) -> dict[str, list[int]]:
    """Return the indices along each dimension that values of axes stand for.

    Raises OutsideGridError that lists every name that is not an axis, every value that is not in the grid, and values
    of axes along one dimension that are not those of any point.
    """
    problems: list[str] = []
    chosen: dict[str, set[int]] = {}
    axes = [str(n) for n, c in dataset.coords.items() if len(c.dims) == 1 and not str(n).endswith("_unit")]
    axes = [name for name in axes if name not in {f"{dimension}_other" for dimension in axes_of(dataset)}]
    for name, wanted in places.items():
        if name not in axes:
            problems.append(f"{shown(name)} is not an axis{suggest(name, axes) if axes else '; there are none'}")
            continue
        dimension = str(dataset[name].dims[0])
        values = listed(dataset, name, [dimension])
        exact = list(dataset[name].values) if dataset[name].dtype.kind == "M" else values
        texts = [text or "none" for text in plain(values)]  # a parameter without effect, too, is none
        hits = {i for i, value in enumerate(exact) if is_meant(value, wanted)}
        if not hits and not isinstance(wanted, str):
            with suppress(ValueError):  # an axis with objects has their labels; some objects can have none
                label = labelled(wanted).name
                hits = {i for i, value in enumerate(values) if value == label}
        if not hits:  # as tables show it: with fewer digits, say, or as a number beside None, which are both texts
            said = "none" if str(wanted).lower() == "none" else str(wanted)
            hits = {i for i, text in enumerate(texts) if is_meant(read_cell(text, "float"), said)}
        if not hits:
            there = first_of([*dict.fromkeys(texts)], FEW)
            problems.append(f"{name} = {wanted} is not in the grid, which has {there}")
        elif not chosen.setdefault(dimension, hits) & hits:
            problems.append(f"{name} = {wanted} is at no point with the other values that are given along {dimension}")
        else:
            chosen[dimension] &= hits
    if problems:
        raise OutsideGridError(problems)
    return {dimension: sorted(hits) for dimension, hits in chosen.items()}


def is_meant(value: object, wanted: Any) -> bool:
    """Return whether a label or a value of an axis is what is wanted, perhaps as a text."""
    if is_missing(value):  # where a conditional parameter has no effect
        return str(wanted).lower() in ("nan", "none")
    with suppress(ValueError, TypeError, ArithmeticError):  # an array is equal to nothing, and some texts are no number
        if isinstance(value, np.datetime64):
            return bool(value == np.datetime64(wanted))
        if isinstance(value, bool) and isinstance(wanted, str):
            return wanted.lower() == str(value).lower()
        if isinstance(wanted, str) and not isinstance(value, str):
            # a float may be written with 17 digits; an integer beyond 2**53 is no float
            wanted = float(wanted) if isinstance(value, float) else Decimal(wanted)
        return bool(value == wanted)
    return False


# What is missing


def with_running(dataset: xr.Dataset) -> xr.Dataset:
    """Return the results in a store, opened with ``running``, with the values so far of points that are begun in place:
    their ``status`` is then "running", ``n_sim_done`` counts the realisations in them, and the attribute ``running``
    how many points these are.
    """
    so_far = {n.removesuffix(RUNNING): dataset[n] for n in map(str, dataset.data_vars) if n.endswith(RUNNING)}
    if not so_far:
        return dataset
    begun = so_far["n_sim_done"] > 0
    status = dataset["status"].where(~begun, np.int8(Status.RUNNING))
    merged = {n: so_far[n].where(begun, dataset[n]).assign_attrs(dataset[n].attrs) for n in so_far}
    flags = {"flag_values": list(map(int, Status)), "flag_meanings": " ".join(code.word for code in Status)}
    merged["status"] = status.assign_attrs(dataset["status"].attrs | flags)
    done: xr.Dataset = finished(dataset)
    return done.assign(merged).assign_attrs(running=int(begun.sum()))


def without_running(dataset: xr.Dataset) -> xr.Dataset:
    """Return results whose points that are running count as missing: conclusions are about those that are done."""
    if not (dataset["status"].values == Status.RUNNING).any():
        return dataset
    running = dataset["status"] == Status.RUNNING
    axes = set(running.dims)
    floats = {n: v.where(~running) for n, v in dataset.data_vars.items() if v.dtype.kind == "f" and axes <= set(v.dims)}
    names = [n for n in floats if not str(n).endswith(("_published", "_published_rounding"))]
    status = dataset["status"].where(~running, np.int8(Status.MISSING))
    return dataset.assign({n: floats[n] for n in names}).assign(status=status)


def so_far_in_words(dataset: xr.Dataset) -> str:
    """Return how many realisations running points have, '' where there are none."""
    running = dataset["status"].values == Status.RUNNING
    if "n_sim_done" not in dataset or not running.any():
        return ""
    done = dataset["n_sim_done"].values[running]
    ends = dict.fromkeys(f"{int(end):,}" for end in (done.min(), done.max()))
    whole = dataset.attrs.get("n_sim", 0) * dataset.attrs.get("n_cat", 1)
    of_all = f" of {whole:,}" if whole >= done.max() and not dataset.attrs.get("precision") else ""
    return f"{' to '.join(ends)}{of_all} realisations"


def lacking(dataset: xr.Dataset) -> str:
    """Return in words what these results lack; '' if every point of the study, or of the part that was chosen, is done.

    >>> import xarray as xr
    >>> lacking(xr.Dataset({"status": ("x", [1, 1, 2])}))
    '2 of 3 points are done, 1 failed'
    """
    counts = count_status(dataset["status"].values)
    wanted = sum(counts.values()) - counts[Status.EXCLUDED]
    if unfinished := unfinished_in_words(counts):
        lost = f"; lost parts: {dataset.attrs[LOST]}" if LOST in dataset.attrs else ""
        so_far = f"; values so far are of {words}" if (words := so_far_in_words(dataset)) else ""
        return f"{counts[Status.DONE]:,} of {wanted:,} points are done, {unfinished}{so_far}{lost}"
    of_all = wanted == dataset.attrs.get("points", wanted)  # those of a selection may all be done
    return "the store says that its run did not end" if of_all and not dataset.attrs.get("complete") else ""


def without_excluded(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset without the values of axes that the study excludes everywhere, as those of another condition."""
    for dimension in dataset["status"].dims:
        there = dataset["status"] != Status.EXCLUDED
        dataset = dataset.isel({dimension: there.any([d for d in there.dims if d != dimension]).values})
    return dataset


def require_done(dataset: xr.Dataset) -> None:
    """Raise SweepError unless all points of a dataset are done or excluded by the study."""
    counts = count_status(dataset["status"].values)
    if undone := unfinished_in_words(counts):
        total = sum(counts.values()) - counts[Status.EXCLUDED]
        commands = "`sweep run` computes what is missing, `sweep run --retry` what failed"
        raise SweepError(f"is incomplete: {undone} of {total:,} points here; {commands}; or choose other points")


def exact(values: NDArray[Any]) -> NDArray[Any]:
    """Return integers and truth values as they are, to be shown to the last digit, and others as floats."""
    return values if values.dtype.kind in "biu" else values.astype(float, copy=False)


def listed(dataset: xr.Dataset, name: str, dimensions: Sequence[str], rows: Any = slice(None)) -> list[Any]:
    """Return a variable as Python objects, one for each combination along some dimensions in C order, or for the
    ``rows`` among them: an array where the variable has further dimensions, as long as it is at that place, NaN where
    an integer or a truth value is missing, times as texts.
    """
    variable = dataset[name]
    further = [str(d) for d in variable.dims if d not in dimensions]
    values = variable.transpose(*(d for d in dimensions if d in variable.dims), *further).values
    if is_truth(variable) and values.dtype.kind == "f":
        values = np.where(np.isnan(values), np.nan, values.astype(bool).astype(object))
    elif values.dtype.kind == "M":
        values = np.where(np.isnat(values), "", np.datetime_as_string(values, unit="auto").astype(object))
    shape, rest = [dataset.sizes[d] for d in dimensions], values.shape[values.ndim - len(further) :]
    sizes = [n if d in variable.dims else 1 for d, n in zip(dimensions, shape, strict=True)]
    chosen = np.broadcast_to(values.reshape((*sizes, *rest)), (*shape, *rest)).reshape((-1, *rest))[rows]
    if not further:
        return list(chosen.tolist())
    if (ragged := variable.attrs.get(RAGGED)) not in further:
        return list(chosen)  # objects for each number of an image would take gigabytes
    before = (slice(None),) * further.index(ragged)
    lengths = np.nan_to_num(listed(dataset, f"{name}{LENGTH}", dimensions, rows)).astype(int)
    return [values[(*before, slice(length))] for values, length in zip(chosen, lengths, strict=True)]


# Units that read well


def in_readable_units(dataset: xr.Dataset) -> xr.Dataset:
    """Return the results with each quantity, and all that belongs to it, in the unit in which most numbers read well:
    0.54 uas/yr and not 0.00054 mas/yr.  For tables, figures and pages only: computations use the units of the store.

    A single component that was selected has its own unit; several with different units stay as they are.  Axes,
    quantities whose unit takes no prefix, and datasets that are not over points of a study do not change.
    """
    if "status" not in dataset:
        return dataset
    names, changed = quantities(dataset), dict[str, Any]()
    declared = {error for name in names for error in errors_beside(dataset, name)}
    for name in names:
        unit, stored = units_along(dataset, name, [])[0], units_of(dataset[name].attrs)
        if "," in unit or dataset[name].dtype.kind != "f" or name in declared:
            continue
        readable, factor = prefixed(dataset[name].values, unit)
        beside = [name, *errors_beside(dataset, name), *(f"{name}_{suffix}" for suffix in BESIDE)]
        squares = [n for axis in dataset.coords if (n := f"{name}_{COVARIANCE_SUFFIX}_{axis}") in dataset]
        alike = [n for n in beside if n in dataset and units_of(dataset[n].attrs) == stored]
        factors = dict.fromkeys(alike, (factor, readable)) | dict.fromkeys(squares, (factor**2, f"({readable})2"))
        for other, (times, new) in factors.items() if factor != 1.0 else ():
            changed[other] = dataset[other].copy(data=dataset[other].values * times)
            changed[other].attrs["units"] = new
    return dataset.assign(changed)
