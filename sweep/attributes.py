"""Attributes of variables by the conventions of xarray and CF: unit, short name for labels, meaning."""

import re
from collections.abc import Mapping
from typing import Any

DESCRIPTION = "description"
"""The whole meaning, where ``long_name`` is only the beginning of it."""

ERRORS = "errors"
"""The attribute with the names of the variables that are one-sigma errors of a variable, each of another kind."""

LOGARITHMIC_UNITS = ("mag", "dB", "dex")
"""Units that are logarithms already: plots and interpolation use a logarithmic scale for them only if one is chosen."""

TRUTH: Mapping[str, Any] = {"flag_values": [0, 1], "flag_meanings": "False True"}
"""Attributes of truth values, some of which are missing: these are stored as floats, with NaN."""

_END = re.compile(r" \(|, |; |: ")


def described(unit: str, meaning: str) -> dict[str, Any]:
    """Return units, long_name and description of a variable, without those that would be empty.

    The labels of xarray's own plots are made from the first two.

    Examples:
        >>> described("mas / yr", "RMS error of the spin, over its three components")["long_name"]
        'RMS error of the spin'
        >>> described("", "reference catalogue (step A)")
        {'long_name': 'reference catalogue', 'description': 'reference catalogue (step A)'}
    """
    short = short_meaning(meaning)
    attributes = {"units": unit, "long_name": short, DESCRIPTION: meaning if meaning != short else ""}
    return {name: text for name, text in attributes.items() if text}


def short_meaning(meaning: str) -> str:
    """Return the first phrase of a meaning, up to a comma, a semicolon, a colon or a bracket.

    Examples:
        >>> short_meaning("chi2 of the fit; NaN without one"), short_meaning("f(a, b), of all")
        ('chi2 of the fit', 'f(a, b)')
    """
    for end in _END.finditer(meaning):
        before = meaning[: end.start()]
        if before and before.count("(") == before.count(")"):
            return before
    return meaning


def units_of(attributes: Mapping[Any, Any]) -> str:
    """Return the unit of a variable from its attributes, '' where it has none."""
    return str(attributes.get("units", ""))


def is_truth(array: Any) -> bool:
    """Return whether an array of xarray has truth values, as such or as floats with NaN where one is missing."""
    return bool(array.dtype.kind == "b" or array.attrs.get("flag_meanings") == TRUTH["flag_meanings"])


def meaning_beside(name: str, attributes: Mapping[Any, Any]) -> str:
    """Return the whole meaning of a variable for a place that has its name, '' where it says no more than the name.

    Examples:
        >>> meaning_beside("flow", {"long_name": "flow"}), meaning_beside("flow", {"long_name": "flow of water"})
        ('', 'flow of water')
    """
    meaning = meaning_of(attributes)
    return "" if meaning.replace("_", " ") == name.replace("_", " ") else meaning


def meaning_of(attributes: Mapping[Any, Any]) -> str:
    """Return the whole meaning of a variable from its attributes, '' where they say none."""
    return str(attributes.get(DESCRIPTION, attributes.get("long_name", "")))
