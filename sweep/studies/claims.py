"""Checks the claims of a study, and the numbers of its conclusion, against its grid and its experiment."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from sweep.contract import Experiment, Named, Output, Value, shown, suggest
from sweep.formatting import first_of
from sweep.studies.study import Claim, Derived, Ratio, Reading, Slope, printed_rounding

D = TypeVar("D", bound=Derived)

Problem = Callable[[tuple[str, ...], str], None]
"""Takes the place of a problem inside the claim, and a sentence."""


@dataclass(frozen=True)
class ClaimContext:
    """What a claim speaks of.  ``axes`` may hold None for an axis that is itself wrong.

    ``overridden`` are parameters that the command line changed: a claim that no longer fits them is not a mistake of
    the study, and is left for the comparison to report.
    """

    experiment: Experiment
    axes: Mapping[str, tuple[Value, ...] | None]
    zipped: Sequence[Sequence[str]]
    overridden: frozenset[str]


def checked_claim(claim: Claim, around: ClaimContext, problem: Problem) -> Claim:
    """Return the claim with the values of its axes parsed; ``problem`` is told of everything that is wrong."""
    _check_number(claim, problem)
    return checked_quantity(claim, around, problem)


def checked_quantity(claim: D, around: ClaimContext, problem: Problem) -> D:
    """Return what is derived from the grid with the values of its axes parsed, as `checked_claim`."""
    where = _selection(claim.where, ("where",), around, problem)
    try:
        quantity = claim.quantity()
    except ValueError as error:
        problem((), str(error))
        return claim
    if isinstance(quantity, Slope):
        _check_variable(quantity, "slope", around, problem)
        _check_over(quantity.over, where, around, problem)
        return claim.model_copy(update={"where": where})
    if isinstance(quantity, Ratio):
        _check_variable(quantity, "ratio", around, problem)
        of, to = (
            _selection(places, ("ratio", key), around, problem, beside=where)
            for key, places in (("of", quantity.of), ("to", quantity.to))
        )
        if set(quantity.of) != set(quantity.to):
            problem(("ratio",), "'of' and 'to' must give values of the same axes")
        elif of == to:
            problem(("ratio",), "'of' and 'to' are the same place")
        return claim.model_copy(update={"where": where, "ratio": quantity.model_copy(update={"of": of, "to": to})})
    _check_variable(quantity, "value", around, problem)
    at = _selection(quantity.at, ("value", "at"), around, problem, beside=where)
    return claim.model_copy(update={"where": where, "value": quantity.model_copy(update={"at": at})})


def _check_number(claim: Claim, problem: Problem) -> None:
    if not math.isfinite(printed_rounding(claim.published)) or not math.isfinite(float(claim.published)):
        problem(("published",), f"{shown(claim.published)}: must be a number as printed, in quotes, like '0.60'")
    if (claim.tolerance is None) != (claim.tolerance_reason is None):
        problem(("tolerance",), "a tolerance needs a tolerance_reason, and the other way round")
    if claim.not_comparable is not None and (claim.tolerance is not None or claim.null is not None):
        problem(("not_comparable",), "there is no verdict then; leave out tolerance and null")
    if claim.null is not None and not (math.isfinite(claim.null) and claim.published != str(claim.null)):
        problem(("null",), f"{shown(claim.null)}: must be a finite number that is not the published one")


def _check_variable(quantity: Slope | Ratio | Reading, kind: str, around: ClaimContext, problem: Problem) -> None:
    experiment, where = around.experiment, (kind, "variable")
    outputs = {o.name: o for o in experiment.outputs}
    output = outputs.get(quantity.variable)
    if output is None:
        problem(where, f"unknown output {shown(quantity.variable)}{suggest(quantity.variable, list(outputs))}")
    elif output.name in around.axes:
        problem(where, f"{shown(output.name)} is an axis here, not a result")
    else:
        _check_component(output, quantity.component, kind, around, problem)


def _check_component(output: Output, component: str | None, kind: str, around: ClaimContext, problem: Problem) -> None:
    if not output.dims:
        if component is not None:
            problem((kind, "component"), f"{output.name} is one number and has no components")
    elif len(output.dims) > 1:
        problem(
            (kind, "variable"), f"{output.name} has the dimensions {', '.join(output.dims)}; at most one is allowed"
        )
    else:
        labels = around.experiment.coordinates[output.dims[0]]
        if component is None:
            problem((kind, "variable"), f"{output.name} needs a component: one of {', '.join(labels)}")
        elif component not in labels:
            problem((kind, "component"), f"unknown component {shown(component)}{suggest(component, labels)}")


def _check_over(over: str, where: Mapping[str, Value], around: ClaimContext, problem: Problem) -> None:
    place = ("slope", "over")
    if over not in around.axes:
        if over not in around.overridden:
            problem(place, f"{shown(over)} is not an axis{_known_axes(over, around)}")
        return
    partners = next((group for group in around.zipped if over in group), [over])
    if fixed := [name for name in partners if name in where]:
        problem(place, f"{shown(over)} cannot vary, because 'where' fixes {', '.join(map(shown, fixed))}")
    values = around.axes[over]
    if values is None or over in around.overridden:
        return
    if around.experiment.parameter(over).kind not in ("float", "int"):
        problem(place, f"{shown(over)} is not an axis of numbers")
    elif len(values) < 2 or not all(isinstance(v, (int, float)) and v > 0 for v in values):
        problem(place, f"{shown(over)} needs at least two values, all above 0, for a power law")


def _selection(
    places: Mapping[str, object],
    where: tuple[str, ...],
    around: ClaimContext,
    problem: Problem,
    beside: Mapping[str, Value] | None = None,
) -> dict[str, Value]:
    """Return values of axes as the grid has them; ``beside`` are those that the claim gives elsewhere."""
    return {name: _on_axis(name, raw, (*where, name), around, problem, beside or {}) for name, raw in places.items()}


def _on_axis(
    name: str,
    raw: object,
    where: tuple[str, ...],
    around: ClaimContext,
    problem: Problem,
    beside: Mapping[str, Value],
) -> Value:
    if name in beside:
        problem(where, "is given by 'where' too; leave out one of the two")
    if name not in around.axes and name not in around.overridden:
        problem(where, f"{shown(name)} is not an axis{_known_axes(name, around)}")
        return None
    try:
        value = around.experiment.parameter(name).parse(raw)
    except ValueError as error:
        problem(where, str(error))
        return None
    values = around.axes.get(name)
    if values is not None and name not in around.overridden and value not in values:
        problem(where, f"{shown(value)} is not on the axis, which has {_listed(values)}")
    return value.name if isinstance(value, Named) else value


def _known_axes(name: str, around: ClaimContext) -> str:
    known = [axis for axis in around.axes if axis in around.experiment.defaults()]
    return suggest(name, known) if known else "; the study has none"


def _listed(values: Sequence[Any], most: int = 20) -> str:
    return first_of([shown(v) for v in values], most)
