"""The options --where, a limit on a quantity with a unit, and --range: they are parsed, never evaluated as code."""

import math
import operator
import re
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from linksweep.sweep.contract import Array, SweepError, shown

Sign = Literal["<", "<=", ">", ">="]

_COMPARE = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}

_LIMIT = re.compile(
    r"\s*(?P<variable>\w+)\s*(?P<sign><=|>=|<|>)\s*(?P<number>[-+.\w]*\d[-+.\w]*?)(?:\s+(?P<unit>\S.*))?"
)


@dataclass(frozen=True)
class Limit:
    """A condition ``variable sign number``; the number is in ``unit``, or in that of the variable where it is empty."""

    variable: str
    sign: Sign
    number: float
    unit: str = ""

    def number_in(self, unit: str) -> float:
        """Return the number in a unit; raises SweepError if it cannot be converted."""
        if not self.unit:
            return self.number
        from astropy import units

        try:
            return float(units.Unit(self.unit).to(units.Unit(unit), self.number))
        except ValueError as error:  # of another kind, or a unit of an experiment that astropy does not know
            raise SweepError(f"{self.variable} is in {unit or 'no unit'}, not convertible to {self.unit}") from error

    def is_met(self, values: Array, number: float) -> NDArray[np.bool_]:
        """Return where values meet the condition; ``number`` is the limit in their unit."""
        return np.asarray(_COMPARE[self.sign](values, number))

    def __str__(self) -> str:
        return f"{self.variable} {self.sign} {self.number:g}" + (f" {self.unit}" if self.unit else "")


def parse_limit(text: str) -> Limit:
    """Return the limit that a text like "sigma_spin < 1 uas/yr" states; raises SweepError that says what is allowed."""
    wanted = "a condition is VARIABLE, one of < <= > >=, and a number with or without a unit, like 'sigma < 1 uas/yr'"
    match = _LIMIT.fullmatch(text.strip())
    if match is None:
        raise SweepError(f"{shown(text)}: {wanted}", "--where")
    try:
        number = float(match["number"])
    except ValueError as error:
        raise SweepError(f"{shown(text)}: {shown(match['number'])} is not a number; {wanted}", "--where") from error
    if not math.isfinite(number):
        raise SweepError(f"{shown(text)}: the number must be finite", "--where")
    if unit := match["unit"] or "":
        from astropy import units

        try:
            units.Unit(unit)
        except (ValueError, TypeError) as error:
            raise SweepError(f"{shown(text)}: {shown(unit)} is not a unit that astropy knows", "--where") from error
    return Limit(match["variable"], cast(Sign, match["sign"]), number, unit)


def parse_range(text: str) -> tuple[float, float]:
    """Return both ends of a range like "50:500", either of which may be left out; raises SweepError."""
    low, colon, high = text.partition(":")
    try:
        ends = (float(low or "-inf"), float(high or "inf"))
    except ValueError:
        ends = (math.nan, math.nan)
    if not colon or not ends[0] <= ends[1]:
        raise SweepError(f"{shown(text)}: a range is LOW:HIGH, two numbers of which one may be left out", "--range")
    return ends
