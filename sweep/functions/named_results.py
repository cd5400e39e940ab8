"""What a function returned, by the names of its outputs."""

import dataclasses
import struct
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from linksweep.sweep.contract import Output, ResultError, shown
from linksweep.sweep.functions.layout import Coordinate, Layout
from linksweep.sweep.functions.values import coordinate_of, is_xarray


@dataclasses.dataclass(frozen=True)
class Declared:
    """What results are checked against: the ``outputs`` that a function declares, the names of its ``parameters``, and
    the name of a ``single`` result.
    """

    function: str
    single: str
    outputs: tuple[Output, ...] = ()
    parameters: tuple[str, ...] = ()

    @cached_property
    def by_name(self) -> dict[str, Output]:
        """The outputs by name."""
        return {output.name: output for output in self.outputs}

    @cached_property
    def coordinates(self) -> dict[str, Coordinate]:
        """The coordinates that outputs declare, by dimension."""
        pairs = [(dim, given) for output in self.outputs for dim, given in (output.coords or {}).items()]
        return {dim: coordinate_of(dim, given) for dim, given in pairs}

    @cached_property
    def without_dimensions(self) -> bool:
        """Whether no declared output is an array."""
        return not any(output.dims for output in self.outputs)

    @cached_property
    def layouts(self) -> dict[Any, tuple[Layout, struct.Struct] | None]:
        """The layouts of results of scalars that have occurred, by names and types."""
        return {}


def named_results(result: Any, declared: Declared) -> dict[str, Any]:
    """Return the outputs by name that a function has returned."""
    if result is None:
        raise ResultError(f"{declared.function} returns nothing (None); it must return its results")
    if hasattr(result, "to_xarray") and not isinstance(result, type):  # of pandas
        result = result.to_xarray()
    if isinstance(result, Mapping) and not is_xarray(result):
        named = dict(result)
    elif dataclasses.is_dataclass(result) and not isinstance(result, type):
        named = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    elif hasattr(result, "_asdict"):
        named = dict(result._asdict())
    elif is_xarray(result):
        own = dict(result.data_vars) if hasattr(result, "data_vars") else {result.name or declared.single: result}
        named = own | _beside_dimensions(result, declared)
    elif isinstance(result, tuple) and len(declared.outputs) > 1:
        named = _in_order(result, declared)
    else:
        return {declared.single: result}
    if not named:
        raise ResultError(f"{declared.function} returns no results: an empty {type(result).__name__}")
    if strange := [name for name in named if not isinstance(name, str)]:
        raise ResultError(f"{declared.function}: the name {shown(strange[0])} of an output is no text")
    return named


def _in_order(result: tuple[Any, ...], declared: Declared) -> dict[str, Any]:
    """Return the values of a tuple by the names of the declared outputs, in their order."""
    names = [output.name for output in declared.outputs]
    if len(result) != len(names):
        expected = f"one for each declared output: {', '.join(names)}"
        raise ResultError(f"{declared.function} returns a tuple of {len(result)} values, expected {expected}")
    return dict(zip(names, result, strict=True))


def _beside_dimensions(result: Any, declared: Declared) -> dict[str, Any]:
    """Return the non-dimension coordinates: they are results too, unless they repeat a parameter."""
    return {
        str(name): array.reset_coords(drop=True)
        for name, array in result.coords.items()
        if name not in result.dims and name not in declared.parameters
    }
