"""How much of the variation of a result each parameter causes: Sobol indices of grids, designs and tables."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.lines import require_done
from linksweep.sweep.analysis.quantity import (
    main_quantity,
    require_quantity,
    shares_random_numbers,
    standard_error,
    varied_parameters,
)
from linksweep.sweep.analysis.sensitivity_indices import (
    EFFECTS,
    first_order,
    indices_of_grid,
    morris_effects,
    saltelli_indices,
)
from linksweep.sweep.contract import Array, SweepError
from linksweep.sweep.formatting import described, units_of
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.study import POINT, POINT_TABLE
from linksweep.sweep.studies.values import DESIGNS, Range

METHOD = "sensitivity_method"
"""The attribute of a dataset of indices that says how they were made."""

INDICES: tuple[str, ...] = ("first", "first_error", "total", "total_error")

MEANINGS = {
    "first": "first-order index: share of the variance that the parameter causes by itself",
    "total": "total index: share of the variance that it causes, interactions included",
    "mu_star": "mean absolute effect of the parameter over its range",
    "mu": "mean effect of the parameter over its range",
    "sigma": "standard deviation of its effects: interactions and curvature",
}

FEW_VALUES = 8
"""On an axis of real numbers with fewer values, a function may change much between them."""

CORRELATED = 0.3
"""A note names the parameters of a table that are correlated more than this."""


class _Method(NamedTuple):
    """How to compute ``indices``, by their names, from the values and errors of a variable over some dimensions."""

    name: str
    parameters: list[str]
    over: list[str]
    indices: Sequence[str]
    estimate: Callable[[Array, Array | None], Sequence[Array]]
    notes: list[str]


def sensitivity(dataset: xr.Dataset, output: str | None = None, seed: int = 0) -> xr.Dataset:
    """Estimate how much of the variance of an output is due to each parameter.

    For a full grid these are first-order and total Sobol indices by analysis of variance over all axes, in which every
    value of an axis has the same weight.  For a saltelli design they are the same two indices, by SALib; for a morris
    design ``mu_star``, ``mu`` and ``sigma``; for any other points only first-order indices, which need no special
    design.  All points have the same weight: the indices are for the distribution of the design or table.

    Args:
        dataset: results, as `linksweep.run` and `linksweep.open` return them.
        output: the name of an output; the main one by default.
        seed: the seed of the resampling from which errors are computed.

    Returns:
        A dataset over ``parameter``, and over the dimensions that are not parameters of the table or grid (those of the
        output itself, and axes crossed with points), with ``first`` and, if available, ``total``, each with a one-sigma
        ``NAME_error``.  Its attributes say how they were computed; ``notes`` has warnings.

    Raises:
        SweepError: for an unknown output, points that are not done or not finite, and grids that are not full.

    Example:
        >>> import linksweep
        >>> def area(width: float, height: float):
        ...     return width * height
        >>> axes = {"width": [0.5, 1.5, 2.5], "height": [1.0, 2.0, 3.0]}
        >>> found = sensitivity(linksweep.run(area, "area.zarr", axes=axes, pool="serial"))
        >>> found.parameter.values.tolist(), found["first"].values.round(3).tolist()
        (['width', 'height'], [0.578, 0.325])
    """
    output = output or main_quantity(dataset)
    require_quantity(dataset, output)
    require_done(dataset)
    if np.any(dataset["status"].values == Status.EXCLUDED):
        raise SweepError("the study excludes points: indices need every point of a grid or a design")
    method = _of_points(dataset, seed) if POINT in dataset[output].dims else _of_grid(dataset, output, seed)
    array = dataset[output]
    others = [str(d) for d in array.dims if d not in method.over]
    values = array.transpose(*others, *method.over).values.astype(float)
    if not np.isfinite(values).all():
        raise SweepError(f"{output} is not a finite number at {int(np.sum(~np.isfinite(values)))} points")
    error = standard_error(dataset, output)
    errors = None if error is None else error.transpose(*others, *method.over).values
    shape = values.shape[: len(others)]
    made = [method.estimate(values[i], None if errors is None else errors[i]) for i in np.ndindex(*shape)]
    if unknown := sum(bool(np.isnan(one[0]).all()) for one in made):
        where = f" at {unknown} of {len(made)} places" if len(made) > 1 else ""
        method.notes.append(f"{output} does not vary{where}, or no more than its errors: no indices")
    unit = units_of(array.attrs) if method.indices is EFFECTS else ""
    variables = {
        name: (
            (*others, "parameter"),
            np.array([one[k] for one in made]).reshape(*shape, len(method.parameters)),
            described(unit, MEANINGS.get(name, f"one-sigma error of {name.removesuffix('_error')}")),
        )
        for k, name in enumerate(method.indices)
    }
    coordinates = {n: c.variable for n, c in dataset.coords.items() if set(c.dims) <= set(others)}
    about: dict[str, Any] = {"title": str(dataset.attrs.get("title", "")), "output": output, METHOD: method.name}
    about |= {"points": int(np.prod([dataset.sizes[d] for d in method.over])), "notes": json.dumps(method.notes)}
    labels = {"parameter": np.array(method.parameters, dtype=object)}
    return xr.Dataset(variables, {**coordinates, **labels}, about)


def is_sensitivity(dataset: xr.Dataset) -> bool:
    """Return whether a dataset holds sensitivity indices."""
    return METHOD in dataset.attrs


def _of_points(dataset: xr.Dataset, seed: int) -> _Method:
    told = json.loads(dataset.attrs.get(POINT_TABLE, "{}"))
    design, ranges = told.get("design", ""), told.get("ranges", {})
    parameters = [n for n in told.get("ranges", told.get("parameters", [])) if n in dataset.coords]
    whole = design in DESIGNS and DESIGNS[design].size(told["n"], len(parameters)) == dataset.sizes[POINT]
    if design in ("saltelli", "morris") and not whole:
        raise SweepError(f"indices of a {design} design need all of its points")
    if design not in ("saltelli", "morris"):
        parameters = [name for name in varied_parameters(dataset) if name in parameters]
        if not parameters:
            raise SweepError("the points do not differ in any parameter")
    places = [_places(dataset, name, ranges.get(name)) for name in parameters]
    estimate: Callable[[Array], Sequence[Array]]
    if design == "saltelli":
        words, indices = "SALib, of a saltelli design", INDICES
        estimate = partial(saltelli_indices, parameters=len(parameters), seed=seed)
        noise = "Monte-Carlo errors of the points count as interactions: they are in the total indices"
        notes = [noise] if "seed" in dataset.attrs else []  # a function without random numbers has no seed
    elif design == "morris":
        words, indices = "SALib, of a morris design", EFFECTS
        estimate = partial(morris_effects, places=np.stack(places, axis=1), seed=seed)
        notes = ["effects are over the whole range of each parameter; they rank parameters, and are not shares"]
    else:
        words, indices = f"regression on each parameter, of {design or 'given'} points", INDICES[:2]
        estimate = partial(first_order, places=places, even=design not in ("", "random"), seed=seed)
        notes = ["total indices need a full grid or a saltelli design"]
        notes += [] if design else _correlated(parameters, places)
    return _Method(words, parameters, [POINT], indices, lambda values, _: estimate(values), notes)


def _of_grid(dataset: xr.Dataset, output: str, seed: int) -> _Method:
    over = [str(d) for d in dataset["status"].dims if dataset.sizes[d] > 1]
    if not over:
        raise SweepError("indices need several points")
    axes = {str(n): c for n, c in dataset.coords.items() if not str(n).endswith("_unit")}
    joint = {d: [d, *(name for name, c in axes.items() if c.dims == (d,) and name != d)] for d in over}
    parameters = ["+".join(names) for names in joint.values()]
    continuous = [len(joint[d]) == 1 and d in dataset.coords and dataset[d].dtype.kind == "f" for d in over]
    shared = shares_random_numbers(dataset, over)

    def estimate(values: Array, errors: Array | None) -> Sequence[Array]:
        first, first_error, total, total_error = indices_of_grid(values, errors, continuous, seed)
        unknown = np.full(len(over), np.nan)
        return (first, unknown, total, unknown) if shared else (first, first_error, total, total_error)

    notes = ["every value of an axis counts the same: real numbers are midpoints of equal cells"]
    notes += [f"{n}: zipped axes advance together, and have one index" for n in parameters if "+" in n]
    coarse = [n for n, c, d in zip(parameters, continuous, over, strict=True) if c and dataset.sizes[d] < FEW_VALUES]
    if coarse:
        notes.append(
            f"{', '.join(coarse)} with fewer than {FEW_VALUES} values: what happens between them is not in the errors"
        )
    if shared:
        notes.append("points share random numbers, so that the errors are not known")
    return _Method("analysis of variance of the grid", parameters, over, INDICES, estimate, notes)


def _places(dataset: xr.Dataset, name: str, spec: Any) -> Array:
    """Return the places of a parameter's values in the unit interval: by its range in the design, or by their order."""
    array = dataset[name]
    if isinstance(spec, list):
        spec = {"low": spec[0], "high": spec[1]}
    if isinstance(spec, dict) and "low" in spec:
        log = spec.get("spacing") == "log"
        return Range(name, spec["low"], spec["high"], log, whole=array.dtype.kind == "i").places(array.values)
    values = array.values.astype(str) if array.dtype.kind == "O" else array.values
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    before = np.cumsum(counts) - counts
    return np.asarray((before + 0.5 * counts)[place] / array.size)


def _correlated(parameters: Sequence[str], places: Sequence[Array]) -> list[str]:
    """Return a sentence if parameters of a table are correlated, so that each has a part in the index of the other."""
    if len(parameters) < 2:
        return []
    correlation = np.abs(np.corrcoef(np.stack(places)))
    np.fill_diagonal(correlation, 0.0)
    one, other = map(int, np.unravel_index(int(np.argmax(correlation)), correlation.shape))
    if not correlation[one, other] > CORRELATED:
        return []
    return [f"{parameters[one]} and {parameters[other]} go together in these points: their indices share a part"]
