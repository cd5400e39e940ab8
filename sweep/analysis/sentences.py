"""Sentences about any quantity: its range, what changes it, its errors, how it agrees with its prediction."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from linksweep.sweep.analysis.gaps import ends_of, exact
from linksweep.sweep.analysis.quantity import PREDICTION_SUFFIXES, prediction_name, standard_error, unknown_parts
from linksweep.sweep.analysis.selection import coordinates_along, place_in_words
from linksweep.sweep.contract import Array
from linksweep.sweep.formatting import counted, is_truth, with_unit
from linksweep.sweep.planning.point_status import Status
from linksweep.sweep.studies.record import outer_draw_of
from linksweep.sweep.studies.study import POINT

ERRORS_ALLOWED = 3.0
"""A value agrees with its prediction if it differs by at most this many of its errors."""

ERROR_WORDS = {"mc_error": "Monte Carlo", "catalogue_error": "the choice of catalogues"}
"""Where the errors of `sweep.analysis.quantity.ERROR_SUFFIXES` come from."""

VISIBLE_FACTOR = 1.005
"""An axis that changes a quantity by a smaller factor is not mentioned."""

NEGLIGIBLE = 1e-5
"""Where at most a quarter of the values are smaller than all others by this factor, as in a corner of the grid without
errors, these do not count for the factor by which an axis changes a quantity: it would be uselessly large.
"""

ROUNDING = 1e-12
"""Values that differ by a smaller share are equal except for rounding."""


def sentences(part: xr.Dataset, variable: str, unit: str) -> Iterator[str]:
    """Yield sentences about a variable with one value per point, in a unit; '' for a sentence with nothing to say."""
    dims = [str(d) for d in part["status"].dims]
    part = part.transpose(*dims, ...)
    values = part[variable].values.astype(float)
    known = standard_error(part, variable)
    errors = np.zeros(values.shape) if known is None else known.transpose(*dims).values.astype(float)
    finite = np.isfinite(values)
    if not finite.any():
        yield "No point has a value yet."
        return
    unfinished = bool(part["status"].isin([Status.MISSING, Status.FAILED]).any())
    all_of = "" if unfinished else "all "
    if is_truth(part[variable]):
        true, count = int(values[finite].sum()), int(finite.sum())
        yield f"It is True at {true:,} of {counted(count, 'point')}." if count > 1 else f"It is {bool(true)}."
        return
    values = np.where(finite, values, np.nan)
    of = {words: part.get(f"{variable}_{suffix}") for suffix, words in ERROR_WORDS.items()}
    known_ones = [words for words, error in of.items() if error is not None and bool(error.notnull().any())]
    origin = " and ".join(known_ones).replace("catalogue", outer_draw_of(part.attrs))
    yield _range(part, variable, finite, errors, unit, all_of)
    yield "" if unfinished else _what_changes_it(dims, values)
    yield _accuracy(values[finite], errors[finite], origin)
    for whole in unknown_parts(part, variable):
        sentence = whole.removeprefix(f"{variable}: ")
        yield f"{sentence[0].upper()}{sentence[1:]}."
    predicted = part.get(prediction_name(part, variable))
    if predicted is not None:
        whole_name, errors_alone = (f"{variable}_{suffix}" for suffix in PREDICTION_SUFFIXES)
        without_bias = whole_name not in part and errors_alone in part and "bias" in part
        left_out = ", which leaves a bias out" if without_bias else ""
        yield _agreement(values, errors, predicted.transpose(*dims).values, left_out, all_of)
    if infinite := int(np.sum((part["status"].values == Status.DONE) & ~finite)):
        points = "1 point that is" if infinite == 1 else f"{infinite} points that are"
        yield f"At {points} done it is not a finite number."


def _range(part: xr.Dataset, variable: str, finite: NDArray[np.bool_], errors: Array, unit: str, all_of: str) -> str:
    values = exact(part[variable].values)

    def number(index: tuple[Any, ...]) -> str:
        return with_unit(values[index].item(), float(errors[index]), unit)

    low, high = ends_of(values, finite)
    count = int(finite.sum())
    if values.size == 1:
        return f"It is {number(low)}."
    if count == 1:
        return f"One point has a value: {number(low)} at {_place(part, low)}."
    if values[low] == values[high]:
        return f"It is {number(low)} at {_counted(all_of, count, 'point')}."
    return (
        f"Over {count:,} points it goes from {number(low)}, at {_place(part, low)}, "
        f"to {number(high)}, at {_place(part, high)}."
    )


def _place(part: xr.Dataset, index: tuple[Any, ...]) -> str:
    point = part.isel(dict(zip(part["status"].dims, map(int, index), strict=True)))
    names = [name for d in part["status"].dims for name in coordinates_along(part, str(d))]
    return place_in_words({name: point[name].item() for name in names})


def _what_changes_it(dims: list[str], values: Array) -> str:
    """Return by what factor a positive quantity changes at most along each axis, all else being equal."""
    if values.ndim == 0 or np.nanmin(values) < 0.0 or np.nanmax(values) == np.nanmin(values):
        return ""
    kept = values >= _least(values)
    left_out = int(np.isfinite(values).sum() - kept.sum())
    values = np.where(kept, values, np.nan)
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
    equal = ", all else being equal" if len(dims) > 1 else ""
    rest = f" ({counted(left_out, 'value')} at or close to zero left out)" if left_out else ""
    return f"What changes it: {', '.join(words)}{equal}{rest}."


def _least(values: Array) -> float:
    """Return the least of the values that are not `NEGLIGIBLE` beside the others."""
    known = np.sort(values[values > 0.0])
    low = known[: known.size // 4 + 1]
    jumps = np.flatnonzero(low[:-1] < NEGLIGIBLE * low[1:])
    return float(low[jumps[-1] + 1] if jumps.size else low[0])


def _factor(factor: float) -> str:
    return f"{factor:.2f}" if factor < 10.0 else f"{float(f'{factor:.3g}'):,g}" if factor < 1e6 else f"{factor:.1e}"


def _in_two_digits(number: float) -> str:
    return f"{number:.2g}" if number < 99.5 else f"{float(f'{number:.2g}'):,.0f}"


def _accuracy(values: Array, errors: Array, origin: str) -> str:
    use = (errors > 0.0) & (values != 0.0)
    if not use.any():
        return ""
    relative = 100.0 * errors[use] / np.abs(values[use])
    low, high = _in_two_digits(relative.min()), _in_two_digits(relative.max())
    share = low if low == high else f"{low} to {high}"
    return f"Its one-sigma error, from {origin}, is {share} % of it."


def _agreement(values: Array, errors: Array, predicted: Array, left_out: str, all_of: str) -> str:
    both = np.isfinite(values) & np.isfinite(predicted) & (predicted != 0.0)
    count = int(both.sum())
    if not count:
        return ""
    farthest = float(np.max(np.abs(values[both] / predicted[both] - 1.0)))
    if farthest < ROUNDING:
        everywhere = "" if count == 1 else f" at {_counted(all_of, count, 'point')}"
        return f"It equals its prediction{left_out}{everywhere}, except for rounding."
    text = f"{_in_two_digits(100.0 * farthest)} %"
    if not (errors[both] > 0.0).all():
        return f"It differs from its prediction{left_out} by {'' if count == 1 else 'at most '}{text}."
    deviations = np.abs(values[both] - predicted[both]) / errors[both]
    within = int(np.sum(deviations <= ERRORS_ALLOWED))
    largest = math.floor(10.0 * float(deviations.max()) + 0.5) / 10.0
    apart = f"{largest:,.1f}".removesuffix(".0") if largest else "less than 0.1"
    apart += " error" if largest == 1.0 else " errors"
    if count == 1:
        return f"It is {apart}, or {text}, from its prediction{left_out}."
    share = f"{_counted(all_of, count, 'value')} are" if within == count else f"{within} of {count:,} values are"
    return (
        f"{share.capitalize()} within {ERRORS_ALLOWED:g} of their errors of the prediction{left_out}; "
        f"the largest difference is {apart}, or up to {text}."
    )


def _counted(all_of: str, count: int, noun: str) -> str:
    return f"both {noun}s" if count == 2 and all_of else f"{all_of}{counted(count, noun)}"
