"""Checks that the functions of an experiment return exactly what it declares; nothing is broadcast or left out."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract.errors import shown, suggest

Array = NDArray[np.float64]


class ResultError(ValueError):
    """What a function of an experiment returned is not what is declared."""


class NotFiniteError(ResultError):
    """Numbers are NaN or infinite where that is not allowed."""


def checked(
    who: str, given: object, noun: str, expected: Mapping[str, tuple[int, ...]], beside: Sequence[str] = ()
) -> dict[str, Array]:
    """Return what the function ``who`` has ``given`` as arrays of 64-bit floats of exactly the ``expected`` names and
    shapes; names ``beside`` them are allowed, and ignored.

    The first axis of a shape counts points; it may be missing if there is only one.
    Raises ResultError that names everything that is wrong.
    """
    if not isinstance(given, Mapping):
        raise ResultError(f"{who} returns a {type(given).__name__}, not a mapping of {noun}s by name")
    problems = []
    for name in given:
        if name not in expected and name not in beside:
            missing = [known for known in expected if known not in given]
            problems.append(f"{who} returns {shown(name)}, which is no declared {noun}{suggest(str(name), missing)}")
    arrays: dict[str, Array] = {}
    for name, shape in expected.items():
        try:
            arrays[name] = _array(given[name], shape)
        except KeyError:
            problems.append(f"{who} does not return the {noun} {name!r}")
        except ResultError as error:
            problems.append(f"{who}: the {noun} {name!r} {error}")
    if problems:
        raise ResultError("; ".join(problems))
    return arrays


def check_finite(arrays: Mapping[str, Array], may_be_nan: Sequence[str]) -> None:
    """Raise NotFiniteError that says how many values of which array are NaN or infinite."""
    bounded = {name: array for name, array in arrays.items() if name not in may_be_nan}
    found = [not_finite(name, array, is_one=array.size == 1) for name, array in bounded.items()]
    if problems := [problem for problem in found if problem]:
        raise NotFiniteError("; ".join(problems))


def _array(given: Any, shape: tuple[int, ...]) -> Array:
    """Return one result as an array of this shape."""
    try:
        array = np.asarray(given)
    except ValueError as error:  # lists of different lengths
        raise ResultError(f"has parts of different lengths, expected the shape {shape}") from error
    if array.dtype.kind not in "biuf":
        raise ResultError(f"is of type {array.dtype}, expected real numbers")
    if array.shape != shape and not (shape[0] == 1 and array.shape == shape[1:]):
        raise ResultError(f"has the shape {array.shape}, expected {shape}")
    return array.astype(np.float64, copy=False).reshape(shape)


def not_finite(name: str, array: Array, is_one: bool) -> str | None:
    """Return a phrase on how many values are NaN or infinite, or which of the two a single one (``is_one``) is; None if
    all are finite.
    """
    finite = np.isfinite(array)
    if finite.all():
        return None
    bad = array[~finite]
    nan = int(np.isnan(bad).sum())
    if is_one:
        return f"{name} is {'NaN' if nan else 'infinite'}"
    counts = [f"{n} {word}" for n, word in ((nan, "NaN"), (bad.size - nan, "infinite")) if n]
    return f"{name} has {' and '.join(counts)} of {array.size} values"
