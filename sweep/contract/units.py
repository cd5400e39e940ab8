"""Checks and compares units: texts that astropy understands, as readers of results will."""

import re
from functools import lru_cache

# Recognised without astropy, whose import takes longer than a command that needs nothing else from it.
FAMILIAR = frozenset(
    [
        *("m", "cm", "mm", "km", "g", "kg", "s", "min", "h", "d", "yr"),
        *("Hz", "K", "mol", "J", "W", "N", "V", "A", "Pa"),
        *("rad", "deg", "arcmin", "arcsec", "mas", "uas", "mag", "pc", "kpc", "au", "eV"),
    ]
)


def unit_problem(text: object) -> str | None:
    """Return what is wrong with a unit, None if nothing is."""
    if not isinstance(text, str):
        return f"the unit {text!r} is no text"
    known = all(word in FAMILIAR for word in re.findall(r"[^\W\d]+", text)) and re.fullmatch(r"[\w\s/(),-]*", text)
    if known and not re.search(r"/\s*([/),]|$)", text) and text.count("(") == text.count(")"):
        return None
    from astropy.units import Unit

    try:
        Unit(text)
    except (ValueError, TypeError) as error:
        hint = str(error).partition("Did you mean ")[2].partition("?")[0]
        return f"the unit {text!r} is none that astropy knows{f'; did you mean {hint}?' if hint else ''}"
    return None


def is_quantity(value: object) -> bool:
    """Return whether a value, or a type, is a quantity of astropy, without importing astropy."""
    return hasattr(value, "unit") and hasattr(value, "to_value")


@lru_cache(maxsize=256)
def factor_between(one: str, other: str) -> float | None:
    """Return the factor that converts numbers from one unit to another; None for units of different kinds."""
    if one == other:
        return 1.0
    from astropy.units import Unit, UnitsError

    try:
        return float(Unit(one).to(Unit(other)))
    except (UnitsError, TypeError, ValueError):
        return None


def same_unit(one: str, other: str) -> bool:
    """Return whether two texts are the same unit."""
    return factor_between(one, other) == 1.0
