"""Results in the units in which they read best: 0.54 uas/yr and not 0.0005411 mas/yr.

For tables, figures and pages only: computations use results in the units of the store.
"""

from typing import Any

import xarray as xr

from linksweep.sweep.analysis.quantity import BESIDE, COVARIANCE_SUFFIX, errors_beside, quantities
from linksweep.sweep.formatting import prefixed, units_of


def in_readable_units(dataset: xr.Dataset) -> xr.Dataset:
    """Return the results with each quantity, and all that belongs to it, in the unit in which most numbers read well.

    A single component that was selected has its own unit; several with different units stay as they are.  Axes,
    quantities whose unit takes no prefix, and datasets that are not over points of a study do not change.
    """
    if "status" not in dataset:
        return dataset
    changed: dict[str, xr.DataArray] = {}
    names = quantities(dataset)
    for name in [n for n in names if n not in {e for other in names for e in errors_beside(dataset, other)}]:
        values = dataset[name].values
        unit = units_of(dataset[name].attrs)
        if "," in unit or values.dtype.kind != "f":
            continue
        chosen = prefixed(values, unit)
        if chosen.factor == 1.0:
            continue
        for other in (name, *errors_beside(dataset, name), *(f"{name}_{suffix}" for suffix in BESIDE)):
            if other in dataset and units_of(dataset[other].attrs) == unit:
                changed[other] = _scaled(dataset[other], chosen.factor, chosen.unit)
        for axis in dataset.coords:
            if (other := f"{name}_{COVARIANCE_SUFFIX}_{axis}") in dataset:
                changed[other] = _scaled(dataset[other], chosen.factor**2, f"({chosen.unit})2")
    return _component(dataset.assign(changed))


def _scaled(array: xr.DataArray, factor: Any, unit: str) -> xr.DataArray:
    scaled: xr.DataArray = (array * factor).transpose(*array.dims)
    return scaled.assign_attrs(array.attrs | {"units": unit})


def _component(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset of one component, of several with units of their own, in the unit in which it reads best."""
    for name in [str(n) for n in dataset.coords if str(n).endswith("_unit") and not dataset[n].dims]:
        dimension = name.removesuffix("_unit")
        units = {n: units_of(dataset[n].attrs) for n in quantities(dataset)}
        own = [n for n, unit in units.items() if "," in unit and "(" not in unit]  # not products of two components
        if dimension not in dataset.coords or not own:
            continue
        chosen = prefixed(dataset[own[0]].values, str(dataset[name].item()))
        if chosen.factor == 1.0:
            continue
        family = [f"{n}_{suffix}" for n in own for suffix in BESIDE]
        changed = {n: _scaled(dataset[n], chosen.factor, chosen.unit) for n in [*own, *family] if n in dataset}
        dataset = dataset.assign(changed).assign_coords({name: dataset[name].copy(data=chosen.unit)})
    return dataset
