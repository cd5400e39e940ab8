"""Finds the points of a study in a store that already holds a larger one."""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from linksweep.sweep.contract import Named, SweepError, Value
from linksweep.sweep.planning.grid import Grid
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.stores.store import OpenStore
from linksweep.sweep.tables.file import content_digest

if TYPE_CHECKING:
    import xarray as xr


def part_of_larger(store: OpenStore, grid: Grid) -> "xr.Dataset | None":
    """Return the points of a grid from the dataset of a store that has more than them: more values on an axis, another
    axis, more realisations or catalogues.  None where the store lacks some of them, or has nothing more.
    """
    study = grid.study
    try:
        dataset = store.dataset()
    except SweepError:
        return None
    if study.excluded or "sample" in dataset.dims or not _enough_realisations(dataset.attrs, grid):
        return None
    part = dataset
    for name, coordinate in dataset.coords.items():
        if name in study.experiment.defaults() and name not in study.axes and coordinate.ndim:
            value = dict(study.fixed).get(str(name), study.experiment.defaults()[str(name)])
            places = np.flatnonzero(coordinate.values == _as_stored(dataset, str(name), value))
            if len(places) != 1 or coordinate.dims[0] not in part.dims:
                return None
            part = part.isel({coordinate.dims[0]: places[0]})
    for dimension, axes in grid.dimensions.items():
        places_of = _places(part, dimension, axes, grid)
        if places_of is None:
            return None
        part = part.isel({d: places_of for d in (dimension, f"{dimension}_other") if d in part.dims})
    if not bool((part["status"] == Status.DONE).all()) or set(part["status"].dims) != set(grid.dimensions):
        return None
    fewer = part["status"].size < dataset["status"].size
    less = any(dataset.attrs[key] > number for key, number in study.numbers().items())
    less |= dataset.attrs.get("precision") != study.sampling.precision
    own = {"points": part["status"].size, "points_done": part["status"].size, "complete": 1, "failures": "{}"}
    return part.transpose(*grid.dimensions, ...).assign_attrs(own) if fewer or less else None


def _enough_realisations(attributes: dict[str, Any], grid: Grid) -> bool:
    sampling = grid.study.sampling
    if grid.study.experiment.deterministic:
        return True
    stored = attributes.get("precision")
    if stored is not None or sampling.precision is not None:  # these decide how many realisations a point has
        fine_enough = stored is not None and sampling.precision is not None and stored <= sampling.precision
        return fine_enough and all(attributes[key] == getattr(sampling, key) for key in ("n_sim", "n_cat"))
    return bool(attributes["n_sim"] >= sampling.n_sim and attributes["n_cat"] >= sampling.n_cat)


def _places(dataset: "xr.Dataset", dimension: str, axes: tuple[str, ...], grid: Grid) -> list[int] | None:
    """Return where along a dimension of the dataset the values of a study's axes stand, or None where one does not."""
    if any(name not in dataset.coords or dataset[name].dims != (dimension,) for name in axes):
        return None
    rows = list(zip(*(dataset[name].values.tolist() for name in axes), strict=True))
    stored = {values: place for place, values in reversed(list(enumerate(rows)))}  # of equal ones the first
    wanted = zip(*([_as_stored(dataset, name, v) for v in grid.study.axes[name]] for name in axes), strict=True)
    try:
        return [stored[values] for values in wanted]
    except KeyError:
        return None


def _as_stored(dataset: "xr.Dataset", parameter: str, value: Value) -> Value:
    """Return a value as the coordinate has it; None for one that the study defines otherwise than the store's study."""
    if not isinstance(value, Named):
        return value
    defined = json.loads(dataset.attrs.get("defined", "{}")).get(parameter, {})
    return next((name for name, digest in defined.items() if digest == content_digest(value)), None)
