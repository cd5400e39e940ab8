"""Numbers, units, tables and attributes of variables as text, and what text of others may not hold.

SI prefixes make numbers easy to read: tables, figures, sentences and pages use the prefix with which numbers have few
zeros, and pages the micro sign; stores and files for programs keep their units.
"""

import json
import platform
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from itertools import pairwise
from math import floor, inf, isfinite, isnan, log10
from typing import Any, NamedTuple

WIDTH = 80  # sentences are broken into lines of at most this many characters

# What changes a terminal instead of being shown by it, or the order in which text is shown: the control characters of
# ASCII and Latin-1, separators of lines and paragraphs, marks of the direction of writing.
ESCAPED = {
    code: f"\\u{code:04x}"
    for codes in (range(0x20), range(0x7F, 0xA0), (0x61C, 0x200E, 0x200F), range(0x2028, 0x202F), range(0x2066, 0x206A))
    for code in codes
}
LINES_ESCAPED = {code: escaped for code, escaped in ESCAPED.items() if chr(code) not in "\t\n"}

# The words of the `sweep` command that this process runs; a script of the user's runs none, whatever its own are.
COMMAND: list[str] = []

_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]*://)(?:[^\s?#'\"]*@)?([^\s/?#'\"]*)([^\s?#'\"]*)(?:[?#][^\s'\"]*)?", re.I)
_TOKEN = re.compile(r"[A-Za-zµμ]+")
# The u of micro before a unit, and not that of users.
_MICRO = re.compile(r"\bu(?=(?:as|arcsec|rad|s|m|g|Hz|K|mol|J|W|N|V|A|Pa|eV|Jy|mag|pc)\b)")
_POWER = re.compile(r"(?<=[A-Za-z])(?<!\de)(?:\*\*|\^|(?=-))(-?\d+)\b(?!\.)")
_END = re.compile(r" \(|, |; |: ")

RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

LEAST, MOST = 0.1, 1000.0  # a number from the first to below the second needs no other prefix
STEPS = {"n": -9, "u": -6, "m": -3, "": 0, "k": 3, "M": 6, "G": 9}
# The powers of ten of units that do not take all: nobody writes 3000 s as 3 ks.  Those that take none mostly have
# multiples with other names, are logarithms, or are counted.
TAKEN: Mapping[str, range] = {
    **dict.fromkeys(("s", "rad", "g", "K"), range(-9, 1)),
    **dict.fromkeys(("pc", "yr", "lyr", "AU", "bit", "byte"), range(10)),
    **dict.fromkeys(("d", "h", "min", "deg", "arcmin", "hourangle", "dex", "dB", "t", "ct", "ph", "mag"), range(0)),
    **dict.fromkeys(("erg", "dyn", "AA", "Angstrom", "solMass", "solLum", "solRad", "count", "adu", "pix"), range(0)),
}
# Angles by their powers of ten.  Smaller ones are not widely known, and for these astropy need not be imported, which
# takes longer than everything else at the end of a run.
ANGLES = {"uas": -6, "mas": -3, "arcsec": 0}

DESCRIPTION = "description"  # the whole meaning, where ``long_name`` is only the beginning of it
ERRORS = "errors"  # the attribute with the names of the variables that are errors of a variable, each of another kind
RAGGED = "ragged"  # the attribute with the dimension of a variable NAME along which it has NAME_length values
# Units that are logarithms already: plots and interpolation use a logarithmic scale for them only if one is chosen.
LOGARITHMIC_UNITS = ("mag", "dB", "dex")
# Attributes of truth values, some of which are missing: these are stored as floats, with NaN.
TRUTH: Mapping[str, Any] = {"flag_values": [0, 1], "flag_meanings": "False True"}


def host() -> str:
    """Return the name of this machine."""
    return platform.node()


def typed(name: object) -> str:
    """Return a name as it is typed in bash and shells like it after the words of a command.

    Examples:
        >>> print(typed("s.zarr"), typed("a b.zarr"), typed("-o.zarr"), typed("two\\nlines"))
        s.zarr 'a b.zarr' ./-o.zarr $'two\\u000alines'
    """
    text = f"./{name}" if str(name).startswith("-") else str(name)
    escaped = text.replace("\\", "\\\\").replace("'", "\\'").translate(ESCAPED)
    return f"$'{escaped}'" if ESCAPED.keys() & {*map(ord, text)} else shlex.quote(text)


def command_line() -> str:
    """Return the `sweep` command that this process runs, as a person would type it but for secrets; '' in a script."""
    return without_secrets(shlex.join(COMMAND))


def now() -> str:
    """Return the time as ISO 8601 in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def without_secrets(text: str) -> str:
    """Return text whose addresses have no passwords, keys and tokens: of a bucket's its name and the path are left, of
    others the host and the port.

    Examples:
        >>> without_secrets("sweep run x --scheduler=tls://me:secret@host:8786/?token=1 -o s3://key:secret@b/s.zarr")
        'sweep run x --scheduler=tls://host:8786 -o s3://b/s.zarr'
    """
    return _ADDRESS.sub(lambda match: match[1] + match[2] + (match[3] if match[1].lower() == "s3://" else ""), text)


def harmless(text: str) -> str:
    """Return text with its control characters escaped as in JSON, but for tabs and line ends.

    Examples:
        >>> print(harmless("red \x1b[31m"))
        red \\u001b[31m
    """
    return text.translate(LINES_ESCAPED)


def with_error(value: Any, error: float, step: float = 0.0, digits: int = 4) -> str:
    """Return a number and its error with two digits of the error, or of a step where it has no error.

    Args:
        value: Any number; NaN gives an empty string.  Texts, truth values and integers are not rounded.
        error: One standard error; it is left out where it is not finite, or no larger than rounding.
        step: What says the digits of a number without an error, such as that of an axis.
        digits: How many digits it has without a step.

    Examples:
        >>> with_error(0.66, 0.0027)
        '0.6600 ± 0.0027'
        >>> with_error(0.66, 1e-16)
        '0.66'
    """
    if 0.0 < error < inf and error > 1e-14 * abs(value):
        return f"{rounded(value, error)} ± {rounded(error, error)}"
    return rounded(value, step, digits)


def digits_of(values: Iterable[Any]) -> int:
    """Return how many digits numbers without errors have: four, or as many as show by what close ones differ, but for
    rounding.

    Examples:
        >>> digits_of([1.0, 2.0]), digits_of([2460000.5, 2460000.75]), digits_of([0.3, 0.1 + 0.2])
        (4, 9, 4)
    """
    known = [float(value) for value in values if isinstance(value, int | float) and isfinite(value)]
    largest, span = max(map(abs, known), default=0.0), max(known, default=0.0) - min(known, default=0.0)
    return 3 + floor(log10(largest / span)) if 1e-12 * largest < span < 0.1 * largest else 4


def rounded(value: Any, error: float = 0.0, digits: int = 4) -> str:
    """Return a number to two digits of its error, or to so many ``digits`` where it has none; '' for NaN.

    Examples:
        >>> rounded(1234.5678, 3.0), rounded(12345.678), rounded(-0.001, 0.1), rounded(2e25, 3.1e22)
        ('1234.6', '12346', '0.00', '2.0000e+25')
    """
    if is_missing(value):
        return ""
    if isinstance(value, str | int):
        return str(value)
    if 0.0 < error < inf and isfinite(value):
        decimals = 1 - floor(log10(error) + 1e-6)  # a step of 0.1 may be a little less
        if -5 < decimals < 10:
            return f"{value:z.{max(0, decimals)}f}"
        many = decimals + floor(log10(abs(value) or error)) + 1
        return f"{value:#.{max(2, many)}g}" if many < 13 else f"{value:.12g}"  # more are of exact laws
    is_long = 10.0**digits <= abs(value) < 1e7  # which no power of ten makes shorter
    exact = float(value).is_integer() and abs(value) < 2**53  # beyond it a float may stand for another integer
    return f"{value:z.0f}" if exact or is_long else f"{value:.{digits}g}"


def plain(values: Sequence[Any]) -> list[str]:
    """Return the values of an axis as texts, numbers by short ones that read back as the same numbers, '' for NaN.

    Where some need more than 15 digits, as sums and random numbers do, those of more than 12 have as many as tell them
    apart: they are off by at most a hundredth of the smallest step.

    Examples:
        >>> plain([2460000.0, 2460000.25]), plain([1e6, 2e6]), plain([0.1 + 0.2, 1 / 3]), plain([0.1 + 0.2, 0.3])
        (['2460000', '2460000.25'], ['1e+06', '2e+06'], ['0.3', '0.333333'], ['0.30000000000000004', '0.3'])
    """
    known = sorted({v for v in values if isinstance(v, int | float) and isfinite(v)})
    fine = min((b - a for a, b in pairwise(known)), default=5e-13 * max(map(abs, known), default=0.0)) / 100.0
    floats = {float(v) for v in known if isinstance(v, float)}
    most = 15 if all(float(f"{v:.15g}") == v for v in floats) else 12
    off = {v: 0.0 if float(f"{v:.{most}g}") == v else fine for v in floats}
    digits = next((d for d in range(6, 17) if all(abs(float(f"{v:.{d}g}") - v) <= off[v] for v in off)), 17)
    texts = {v: min(f"{v:.{digits}g}", repr(v).removesuffix(".0"), key=len) for v in floats}
    return ["" if is_missing(v) else texts.get(v, str(v)) if isinstance(v, float) else str(v) for v in values]


def is_missing(value: Any) -> bool:
    """Return whether a value is a NaN."""
    return isinstance(value, float) and isnan(value)


def counted(n: int, noun: str) -> str:
    """Return a count with its noun.

    Examples:
        >>> counted(1, "point"), counted(12345, "point")
        ('1 point', '12,345 points')
    """
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def per_second(number: int, seconds: float, noun: str) -> str:
    """Return a speed, with two digits below ten a second.

    Examples:
        >>> per_second(2, 7.0, "points"), per_second(999, 100.0, "points"), per_second(12_345, 1.0, "points")
        ('0.29 points/s', '10 points/s', '12,345 points/s')
    """
    speed = number / max(seconds, 1e-9)
    return f"{speed:.2g} {noun}/s" if speed < 9.95 else f"{speed:,.0f} {noun}/s"


def in_words(seconds: float) -> str:
    """Return a duration with two of its units.

    >>> [in_words(seconds) for seconds in (12.3, 200, 7500, 273600)]
    ['12 s', '3 min 20 s', '2 h 05 min', '3 d 4 h']
    """
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    if whole < 86400:
        return f"{whole // 3600} h {whole % 3600 // 60:02} min"
    return f"{whole // 86400} d {whole % 86400 // 3600} h"


def first_of(words: Sequence[Any], most: int, separator: str = ", ") -> str:
    """Return the first of several words, and how many more there are.

    Examples:
        >>> first_of(["a", "b"], 2), first_of(range(9), 3)
        ('a, b', '0, 1, 2 and 6 more')
    """
    listed = separator.join(str(word) for word in words[:most])
    return f"{listed} and {len(words) - most:,} more" if len(words) > most else listed


def split_assignment(text: str) -> tuple[str, str]:
    """Return name and value of ``NAME=VALUE`` without the blanks around them; both are empty for any other text.

    Examples:
        >>> split_assignment("v_max = 16"), split_assignment("v_max=")
        (('v_max', '16'), ('', ''))
    """
    name, _, value = (piece.strip() for piece in text.partition("="))
    return (name, value) if name and value else ("", "")


def to_json(value: Any) -> str:
    """Return JSON for programs: NaN is null, and infinity a text; arrays, dataclasses and paths are allowed.

    Examples:
        >>> print(to_json({"sigma": float("nan"), "n": [3, -inf]}))
        {
         "sigma": null,
         "n": [
          3,
          "-Infinity"
         ]
        }
    """
    from pydantic_core import to_jsonable_python

    def listed(other: Any) -> Any:
        return other.tolist() if hasattr(other, "tolist") else str(other)  # of NumPy

    text = json.dumps(to_jsonable_python(value, inf_nan_mode="constants", fallback=listed))
    return json.dumps(json.loads(text, parse_constant=lambda one: None if one == "NaN" else one), indent=1)


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
        >>> prefixed([1e-320, 1.0], "m / s")
        Prefixed(unit='m / s', factor=1.0)
    """
    import numpy as np  # not needed where no number is printed

    choices = (Prefixed(unit, 1.0), *_choices(unit))  # the first of those that read alike
    if len(choices) == 1:
        return choices[0]
    sizes = np.abs(np.asarray(values, dtype=float))
    powers = np.log10(sizes[(sizes > 0.0) & (sizes < inf)])

    def zeros(choice: Prefixed) -> Any:
        """Return how many zeros, or digits beyond the third, each number has."""
        there = powers + log10(choice.factor)
        return np.where(there < log10(MOST), np.fmax(0.0, log10(LEAST) - there), there - log10(MOST) + 1.0)

    best = min(choices, key=lambda choice: round(float(zeros(choice).sum()), 9))
    # A number with more than three zeros has an exponent in any unit.
    return best if (zeros(best) <= 3.0).any() else choices[0]


def written(unit: str) -> str:
    """Return a unit as people write it: no blanks around the slash, powers raised, and the micro sign.

    Examples:
        >>> written("uas / yr"), written("mas yr-1"), written("users / d"), written("W m^-2 Hz**-1")
        ('µas/yr', 'mas/yr', 'users/d', 'W m⁻² Hz⁻¹')
    """
    text = _POWER.sub(lambda power: power[1].translate(RAISED), in_ascii(unit))
    return _MICRO.sub("µ", text)


def in_ascii(unit: str) -> str:
    """Return a unit as terminals show it: `written` without raised letters and the micro sign.

    Examples:
        >>> in_ascii("uas / yr"), in_ascii("mas yr-1")
        ('uas/yr', 'mas/yr')
    """
    return re.sub(r"^(\w+) (\w+)-1$", r"\1/\2", unit.replace(" / ", "/")).replace("µ", "u")


def with_micro_signs(sentence: str) -> str:
    """Return a sentence of `with_unit` or `in_short` as pages show it, with the micro sign in its units.

    Examples:
        >>> with_micro_signs("0.54 uas/yr of 28 users, 3 us")
        '0.54 µas/yr of 28 users, 3 µs'
    """
    return re.sub(rf"(?<=\d ){_MICRO.pattern}", "µ", sentence)


@lru_cache(maxsize=256)
def _choices(unit: str) -> tuple[Prefixed, ...]:
    """Return the units with other prefixes; none for a unit that takes none."""
    token = _TOKEN.match(unit)
    if token is None or TAKEN.get(token[0]) == range(0):
        return ()
    name, rest = token[0], unit[token.end() :]
    if name in ANGLES:
        simple = re.fullmatch(r"( ?/ ?\w+| \w+-1)?", rest)  # and no square, and no list of units
        return tuple(Prefixed(n + rest, 10.0 ** (ANGLES[name] - p)) for n, p in ANGLES.items() if simple and n != name)
    from astropy import units

    try:
        whole, token_unit = units.Unit(unit), units.Unit(name)
        base, power = name, 0
        if isinstance(token_unit, units.PrefixUnit):
            base = str(token_unit.represents.bases[0])
            power = round(log10(float(token_unit.to(base))))
        steps = {prefix: step for prefix, step in STEPS.items() if step in TAKEN.get(base, range(-9, 10))}
        others = {f"{prefix}{base}{rest}": 10.0 ** (power - step) for prefix, step in steps.items() if step != power}
        # astropy has the last word: of a square the factor is another one
        return tuple(Prefixed(n, f) for n, f in others.items() if abs(float(whole.to(units.Unit(n))) / f - 1.0) < 1e-9)
    except (ValueError, TypeError, AttributeError):
        return ()


def with_unit(value: float, error: float = 0.0, unit: str = "", form: Any = with_error) -> str:
    """Return a number with its error, in a form, in the unit in which it reads best, for a terminal.

    Examples:
        >>> with_unit(0.0005411, 0.0000038, "mas / yr"), with_unit(100.0)
        ('0.5411 ± 0.0038 uas/yr', '100')
    """
    chosen = prefixed(value, unit)
    if chosen.factor != 1.0:  # an integer stays one
        value, error = value * chosen.factor, error * chosen.factor
    return f"{form(value, error)} {in_ascii(chosen.unit)}".rstrip()


def in_short(value: float, error: float = 0.0, unit: str = "") -> str:
    """Return a number as sentences show it: two digits (three if it begins with 1 or has no error), none that its error
    makes meaningless, and commas between thousands.

    Examples:
        >>> in_short(0.0005411, 0.0000038, "mas / yr"), in_short(15533.0), in_short(2.004, 0.001), in_short(1.7112, 0.2)
        ('0.54 uas/yr', '15,533', '2.0', '1.7')
        >>> in_short(1.7112, 0.001), in_short(1.7112)
        ('1.71', '1.71')
    """
    return with_unit(value, error, unit, _short)


def _short(value: float, error: float) -> str:
    if value == 0.0 or not isfinite(value):
        return f"{value:g}"
    known, size = 0.0 < error < inf, floor(log10(abs(value)))
    if not known and 0 <= size < 7 and (float(value).is_integer() or size >= 4):
        return f"{value:,.0f}"
    digits = 2 if known and abs(value) / 10.0**size >= 2.0 else 3
    last = size - digits + 1
    if known:
        last = max(last, floor(log10(error)))
    if last < -6 or size >= 7:
        return f"{value:.{digits}g}"
    return f"{round(value, -last):z,.{max(0, -last)}f}"


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
    meaning = str(attributes.get(DESCRIPTION, attributes.get("long_name", "")))
    return "" if meaning.replace("_", " ") == name.replace("_", " ") else meaning
