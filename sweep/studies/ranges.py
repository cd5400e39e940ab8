"""Ranges of parameters in a design: numbers of the unit interval become values of a parameter."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from linksweep.sweep.contract import Array, Parameter, shown
from linksweep.sweep.studies.values import number_problem

WAYS = 'write [low, high], { low, high, spacing = "log" } or { values = [...] }'


@dataclass(frozen=True)
class Range:
    """Equally probable values of one parameter: between ``low`` and ``high``, on a linear or ``log`` scale, or
    ``values``.

    Integers go from ``low`` to ``high``, both included.
    """

    name: str
    low: float = 0.0
    high: float = 1.0
    log: bool = False
    whole: bool = False
    values: tuple[Any, ...] = ()

    def __call__(self, unit: Array) -> list[Any]:
        """Return the values at places of the unit interval.

        >>> Range("k", 1, 3, whole=True)(np.array([0.0, 0.4, 1.0]))
        [1, 2, 3]
        >>> Range("x", 0.01, 1.0, log=True)(np.array([0.0, 0.5, 1.0]))
        [0.01, 0.1, 1.0]
        """
        if self.values:
            return [self.values[i] for i in _steps(unit, len(self.values))]
        if self.whole and not self.log:
            return [int(self.low) + i for i in _steps(unit, int(self.high) - int(self.low) + 1)]
        if self.log:
            top = self.high + self.whole
            exponents = math.log(self.low) + unit * (math.log(top) - math.log(self.low))
            numbers = [float(f"{x:.12g}") for x in np.exp(exponents).tolist()]
        else:
            numbers = (self.low + (self.high - self.low) * unit).tolist()
        numbers = [min(max(x, self.low), self.high) for x in numbers]
        return [math.floor(x) for x in numbers] if self.whole else numbers

    def places(self, values: Array) -> Array:
        """Return the places of values in the unit interval; for integers and listed values the middle of their part."""
        if self.values:
            order = {value: i for i, value in enumerate(self.values)}
            return np.array([(order[value] + 0.5) / len(self.values) for value in values.tolist()])
        numbers = values.astype(float)
        if self.whole:
            numbers = numbers + 0.5
        top = self.high + self.whole
        if self.log:
            return np.asarray((np.log(numbers) - math.log(self.low)) / (math.log(top) - math.log(self.low)))
        return np.asarray((numbers - self.low) / (top - self.low))

    @property
    def levels(self) -> float:
        """How many different values there are, infinity for real numbers."""
        if self.values:
            return len(self.values)
        return self.high - self.low + 1 if self.whole else math.inf


def read_range(parameter: Parameter, spec: object) -> Range:
    """Return the range that a study writes for a parameter; raises ValueError that says what is allowed."""
    if not parameter.may_be_axis:
        raise ValueError(f"a {parameter.kind} has no range")
    if isinstance(spec, dict) and set(spec) == {"values"}:
        return Range(parameter.name, values=_listed(parameter, spec["values"]))
    if isinstance(spec, list) and len(spec) == 2:
        spec = {"low": spec[0], "high": spec[1]}
    if not isinstance(spec, dict) or {"low", "high"} - set(spec) or set(spec) - {"low", "high", "spacing"}:
        raise ValueError(f"{shown(spec)}: {WAYS}")
    if parameter.kind not in ("float", "int", "any") or (parameter.choices and parameter.kind != "float"):
        raise ValueError(f"{parameter.name} is {parameter.allowed()}: write {{ values = [...] }}")
    low, high = spec["low"], spec["high"]
    for key in ("low", "high"):
        if wrong := number_problem(spec[key]):
            raise ValueError(f"{key} = {wrong}")
        parameter.parse(spec[key])
    if not low < high:
        raise ValueError(f"low = {shown(low)} must be less than high = {shown(high)}")
    spacing = spec.get("spacing", "linear")
    if spacing not in ("linear", "log"):
        raise ValueError(f"spacing = {shown(spacing)}: must be 'linear' or 'log'")
    if spacing == "log" and low <= 0:
        raise ValueError(f"log spacing needs low > 0, not {shown(low)}")
    return Range(parameter.name, low, high, spacing == "log", whole=parameter.kind == "int")


def _listed(parameter: Parameter, values: object) -> tuple[Any, ...]:
    if not isinstance(values, list) or not values:
        raise ValueError(f"values = {shown(values)}: must be a list with at least one value")
    parsed = [parameter.parse(value) for value in values]
    if len(set(parsed)) < len(parsed):
        raise ValueError(f"values = {shown(values)}: a value is listed twice")
    return tuple(values)


def _steps(unit: Array, n: int) -> list[int]:
    return [int(i) for i in np.minimum(np.floor(unit * n), n - 1).tolist()]
