"""Labels: a symbol and its unit, as mathematics."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from linksweep.sweep.analysis.quantity import COVARIANCE_SUFFIX
from linksweep.sweep.formatting import plain as shown
from linksweep.sweep.formatting import units_of, written

GREEK = (
    *("alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "kappa", "lambda", "mu", "nu", "xi"),
    *("pi", "rho", "sigma", "tau", "phi", "chi", "psi", "omega"),
)
_NAME = re.compile(rf"({'|'.join(GREEK)}|[a-zA-Z])(\d*)(?:_(\w+))?")


def symbol(name: str, attributes: Mapping[str, Any] | None = None) -> str:
    """Return a name for a label: its symbol if it has one, or Greek and single letters as mathematics."""
    if attributes and (own := attributes.get("symbol")):
        return str(own)
    match = _NAME.fullmatch(name)
    if match is None:
        return name.replace("_", " ")
    letter, digits, index = match.groups()
    power = digits if letter == "chi" else ""  # for all others the number is an index
    index = "_".join(part for part in (digits.removeprefix(power), index) if part)
    letter = rf"\{letter}" if letter in GREEK else letter
    index = index and (index if len(index) == 1 else rf"\mathrm{{{index.replace('_', ',')}}}")
    return f"${letter}{f'_{{{index}}}' if index else ''}{f'^{power}' if power else ''}$"


def label(array: xr.DataArray, name: str, unit: str | None = None) -> str:
    """Return the label of an axis: symbol and unit."""
    unit = units_of(array.attrs) if unit is None else unit
    return f"{symbol(name, array.attrs)} [{written(unit)}]" if unit else symbol(name, array.attrs)


def axis_label(dataset: xr.Dataset, axis: str) -> str:
    """Return the label of an axis; axes zipped with it that have the same values stand beside it."""
    dimension = dataset[axis].dims
    names = [str(n) for n, c in dataset.coords.items() if c.dims == dimension and n != axis and c.dtype.kind in "if"]
    same = [n for n in names if np.array_equal(dataset[n].values, dataset[axis].values)]
    return " = ".join([label(dataset[axis], axis), *(label(dataset[n], n) for n in same)])


def explained_label(array: xr.DataArray, name: str) -> str:
    """Return the label of an axis with its name in words before the symbol that the experiment gives it, unless that
    is the name.
    """
    words, shown = name.replace("_", " "), label(array, name)
    own = plain(str(array.attrs.get("symbol", "")))
    return f"{words} {shown}" if own and own.lower() not in (words.lower(), name.lower()) else shown


def quantity_label(dataset: xr.Dataset, variable: str) -> str:
    """Return the label of a variable, or of its one component that the dataset holds."""
    return label(with_chosen_component(dataset)[variable], variable)


def with_chosen_component(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset of one component in which what has a unit for each component has the symbol and the unit of
    that one; afterwards it may be brought to another unit without losing its symbol.
    """
    chosen = [n for n in map(str, dataset.coords) if not dataset[n].dims and f"{n}_unit" in dataset.coords]
    if not chosen:
        return dataset
    inside = ", ".join(symbol(str(dataset[n].item())) for n in chosen)
    unit = str(dataset[f"{chosen[0]}_unit"].item()) if len(chosen) == 1 else ""
    changed = {}
    for name, array in dataset.data_vars.items():
        units, is_product = units_of(array.attrs), f"_{COVARIANCE_SUFFIX}_" in str(name)
        if "," in units and "(" not in units and not is_product:  # nor that of a product of two components
            changed[name] = array.assign_attrs(symbol=f"{symbol(str(name), array.attrs)}({inside})", units=unit)
    return dataset.assign(changed)


def value_text(dataset: xr.Dataset, axis: str, value: Any) -> str:
    """Return a value of an axis as a legend names it."""
    if isinstance(value, str):
        return symbol(value) if _NAME.fullmatch(value) and "_" in value else value
    unit = written(units_of(dataset[axis].attrs))
    return f"{symbol(axis, dataset[axis].attrs)} = {shown(value)}" + (f" {unit}" if unit else "")


def plain(text: str) -> str:
    """Return a text of a figure without mathematical markup.

    Examples:
        >>> plain(r"$\\sigma(\\omega)$ [mas/yr]"), plain(r"$V_\\mathrm{max}$")
        ('sigma(omega) [mas/yr]', 'V_max')
    """
    text = re.sub(r"\\(?:mathrm|overline|bar)\{?([^{}$]*)\}?", r"\1", text)
    text = re.sub(r"\\pm", "±", text)
    return re.sub(r"[${}]|\\", "", text).replace("\n", " ")
