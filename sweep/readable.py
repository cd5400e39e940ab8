"""SI prefixes that make numbers easy to read: units in which they have few zeros, and the micro sign.

Stores and files for programs keep their units; tables, figures, sentences and pages use these.
"""

import re
from functools import lru_cache
from math import floor, inf, isfinite, log10
from typing import Any, NamedTuple

from linksweep.sweep.formatting import with_error

LEAST, MOST = 0.1, 1000.0
"""A number from the first to below the second needs no other prefix."""

SMALL = 1e-4
"""A smaller number with an error is written with a power of ten."""

STEPS = {"n": -9, "u": -6, "m": -3, "": 0, "k": 3, "M": 6, "G": 9}
"""Prefixes that are chosen between, and their powers of ten."""

ONLY_SMALLER = ("s", "arcsec", "rad", "g")
"""Units that take only prefixes below one: nobody writes 3000 s as 3 ks."""

ONLY_LARGER = ("pc", "yr", "lyr", "AU", "bit", "byte")

NEVER = ("d", "h", "min", "deg", "arcmin", "hourangle", "dex", "dB", "t", "ct", "ph", "mag")
"""Units that take no prefix, mostly because their multiples have other names or they are logarithms."""

SPELLED = {"narcsec": "nas", "uarcsec": "uas", "marcsec": "mas"}

ANGLES = {"uas": -6, "mas": -3, "arcsec": 0}
"""Angles of link results by their powers of ten: converted without astropy, whose import takes longer than everything
else at the end of a run.
"""

SMALLEST_ANGLE = -6
"""The power of ten of a microarcsecond: smaller units are not widely known."""

_TOKEN = re.compile(r"[A-Za-zµμ]+")


class Prefixed(NamedTuple):
    """A unit, and the factor that converts numbers in the old unit to it."""

    unit: str
    factor: float


def prefixed(values: Any, unit: str) -> Prefixed:
    """Return the unit, of those that differ from ``unit`` by an SI prefix, in which numbers read best.

    Args:
        values: Numbers in ``unit``, of any shape; NaN, infinity and 0 do not count.
        unit: Any unit; it stays as it is if astropy cannot parse it or it takes no prefix.

    Examples:
        >>> prefixed([0.00054, 0.0017], "mas / yr")
        Prefixed(unit='uas / yr', factor=1000.0)
        >>> prefixed(0.65, "mas / yr"), prefixed(0.002, "d")
        (Prefixed(unit='mas / yr', factor=1.0), Prefixed(unit='d', factor=1.0))
    """
    here = Prefixed(unit, 1.0)
    choices = _choices(unit)
    sizes = _sizes(values) if choices else []
    if not sizes:
        return here
    return min((here, *choices), key=lambda choice: sum(_zeros(size * choice.factor) for size in sizes))


def written(unit: str) -> str:
    """Return a unit as people write it: no blanks around the slash, and the micro sign.

    Examples:
        >>> written("uas / yr"), written("mas yr-1"), written("users / d")
        ('µas/yr', 'mas/yr', 'users/d')
    """
    text = unit.replace(" / ", "/")
    text = re.sub(r"^(\w+) (\w+)-1$", r"\1/\2", text)
    return _TOKEN.sub(lambda token: _with_micro_sign(token[0]), text)


def in_ascii(unit: str) -> str:
    """Return a unit as terminals show it: `written` without the micro sign.

    Examples:
        >>> in_ascii("uas / yr"), in_ascii("mas yr-1")
        ('uas/yr', 'mas/yr')
    """
    return written(unit).replace("µ", "u")


def with_micro_signs(sentence: str) -> str:
    """Return a sentence of `with_unit` or `in_short` as pages show it, with the micro sign in its units.

    Examples:
        >>> with_micro_signs("0.54 uas/yr of 28 users, 3 us")
        '0.54 µas/yr of 28 users, 3 µs'
    """
    return re.sub(r"(?<=\d )[A-Za-z]+(?=[/\s.,;)]|$)", lambda token: _with_micro_sign(token[0]), sentence)


def _sizes(values: Any) -> list[float]:
    listed: Any = values.reshape(-1).tolist() if hasattr(values, "reshape") else values
    numbers = listed if isinstance(listed, list | tuple) else [listed]
    return [size for number in numbers if 0.0 < (size := abs(float(number))) < inf]


def _zeros(size: float) -> float:
    """Return how many zeros, or digits beyond the third, a number has."""
    return log10(LEAST / size) if size < LEAST else log10(size / MOST) + 1.0 if size >= MOST else 0.0


@lru_cache(maxsize=256)
def _choices(unit: str) -> tuple[Prefixed, ...]:
    """Return the units with other prefixes; none for a unit that takes none."""
    token = _TOKEN.match(unit)
    if token is None or token[0] in NEVER:
        return ()
    rest = unit[token.end() :]
    if (own_power := ANGLES.get(token[0])) is not None and re.fullmatch("( ?/ ?yr| yr-1)?", rest):
        others = ((name, power) for name, power in ANGLES.items() if power != own_power)
        return tuple(Prefixed(name + rest, 10.0 ** (own_power - power)) for name, power in others)
    from astropy import units

    try:
        whole = units.Unit(unit)
        base, power = _base(token[0])
        if [power for power in whole.powers if power > 0] != [1] or base in NEVER:
            return ()
        found = []
        for prefix, exponent in STEPS.items():
            if (
                exponent == power
                or (exponent > 0 and base in ONLY_SMALLER)
                or (exponent < 0 and base in ONLY_LARGER)
                or (base == "arcsec" and exponent < SMALLEST_ANGLE)
            ):
                continue
            new = SPELLED.get(prefix + base, prefix + base) + rest
            factor = 10.0 ** (power - exponent)
            if abs(float(whole.to(units.Unit(new))) / factor - 1.0) < 1e-9:
                found.append(Prefixed(new, factor))
    except (ValueError, TypeError, AttributeError):
        return ()
    return tuple(found)


def _base(name: str) -> tuple[str, int]:
    """Return a unit without its prefix, and the prefix's power of ten; raises ValueError for one not in `STEPS`."""
    from astropy import units

    unit = units.Unit(name)
    if not isinstance(unit, units.PrefixUnit) and name not in ("mas", "uas"):
        return name, 0
    (base,) = unit.represents.bases
    scale = float(unit.to(base))
    (power,) = (p for p in STEPS.values() if abs(scale / 10.0**p - 1.0) < 1e-9)
    return str(base), power


def _with_micro_sign(token: str) -> str:
    if not re.fullmatch(r"u[A-Za-z]+", token):
        return token
    if token not in ANGLES:
        from astropy import units

        try:
            units.Unit(token)
        except ValueError:
            return token
    return "µ" + token[1:]


def with_unit(value: float, error: float = 0.0, unit: str = "") -> str:
    """Return a number with its error in the unit in which it reads best, for a terminal.

    Examples:
        >>> with_unit(0.0005411, 0.0000038, "mas / yr"), with_unit(100.0)
        ('0.5411 ± 0.0038 uas/yr', '100')
    """
    chosen = prefixed(value, unit)
    if chosen.factor != 1.0:  # an integer stays one
        value, error = value * chosen.factor, error * chosen.factor
    if 0.0 < abs(value) < SMALL and 0.0 < error < inf:
        power = 10.0 ** floor(log10(abs(value)))
        text = f"({with_error(value / power, error / power)})e{floor(log10(abs(value))):+03d}"
    else:
        text = with_error(value, error)
    return f"{text} {in_ascii(chosen.unit)}" if unit else text


def in_short(value: float, error: float = 0.0, unit: str = "") -> str:
    """Return a number as sentences show it: two digits (three if it begins with 1 or has no error), none that its error
    makes meaningless, and commas between thousands.

    Examples:
        >>> in_short(0.0005411, 0.0000038, "mas / yr"), in_short(15533.0), in_short(2.004, 0.001), in_short(1.7112, 0.2)
        ('0.54 uas/yr', '15,533', '2.0', '1.7')
    """
    chosen = prefixed(value, unit)
    value, error = value * chosen.factor, error * chosen.factor
    return f"{_short(value, error)} {in_ascii(chosen.unit)}" if unit else _short(value, error)


def in_three_digits(value: float, unit: str = "") -> str:
    """Return a number with three digits in the unit in which it reads best.

    Examples:
        >>> in_three_digits(0.00054119, "mas / yr")
        '0.541 uas/yr'
    """
    chosen = prefixed(value, unit)
    return f"{value * chosen.factor:.3g} {in_ascii(chosen.unit)}".strip()


def _short(value: float, error: float) -> str:
    if value == 0.0 or not isfinite(value):
        return f"{value:g}"
    known = 0.0 < error < inf
    if not known and float(value).is_integer():
        return f"{value:,.0f}"
    size = floor(log10(abs(value)))
    if abs(value) >= MOST * 10.0 and not known:
        return f"{value:,.0f}" if size < 6 else f"{value:.2e}"
    leading = abs(value) / 10.0**size
    last = size - (1 if known and leading >= 2.0 else 2)
    if known:
        last = max(last, floor(log10(error)))
    if last < -6:
        return f"{value:.2g}"
    rounded_value = round(value, -last) + 0.0  # and not -0.0
    return f"{rounded_value:,.{max(0, -last)}f}" if abs(value) < 1e7 else f"{value:.2e}"
