"""Checks what a study says of its results: its claims and its conclusion, against its grid and its experiment."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from string import Formatter
from typing import Any, TypeVar

from linksweep.sweep.contract import Experiment, Named, Value, shown, suggest
from linksweep.sweep.formatting import first_of
from linksweep.sweep.studies import form
from linksweep.sweep.studies.document import Problems
from linksweep.sweep.studies.values import is_number

FORMATS = ("", "error", "%")
"""What may follow a name: nothing for the number, ``:error`` for its error beside it, ``:%`` for percent."""

Quantity = form.Slope | form.Ratio | form.Reading
KEYS = {form.Slope: "slope", form.Ratio: "ratio", form.Reading: "value"}
"""The key of each kind of quantity."""

D = TypeVar("D", bound=form.Derived)


@dataclass(frozen=True)
class ClaimContext:
    """What a claim can refer to.  ``axes`` may hold None for an axis that is itself wrong.

    ``overridden`` are parameters that the command line changed: a claim that no longer fits them is not a mistake of
    the study, and is left for the comparison to report.
    """

    experiment: Experiment
    axes: Mapping[str, tuple[Value, ...] | None]
    zipped: Sequence[Sequence[str]]
    overridden: frozenset[str]


def checked_claim(claim: form.Claim, context: ClaimContext, problems: Problems) -> form.Claim:
    """Return the claim with the values of its axes parsed; ``problems`` takes what is wrong inside the claim."""
    _check_number(claim, problems)
    return _checked_quantity(claim, context, problems)


def checked_conclusion(conclusion: form.Conclusion, context: ClaimContext, problems: Problems) -> form.Conclusion:
    """Return the conclusion with the values of its axes parsed; ``problems`` takes what is wrong in it."""
    used: set[str] = set()
    for number, sentence in enumerate(conclusion.sentences):
        where = ("sentences", number)
        try:
            fields = _fields_of(sentence)
        except ValueError as error:
            problems.add(where, f"{shown(sentence)}: {error}; {{name}} stands for a value, and {{{{ for a brace")
            continue
        for name, written in fields:
            used.add(name)
            if name not in conclusion.values:
                problems.add(where, f"unknown value {shown(name)}{suggest(name, list(conclusion.values))}")
            if written not in FORMATS:
                problems.add(where, f"{shown(f'{{{name}:{written}}}')}: after the colon can be error or %")
    values = {}
    for name, value in conclusion.values.items():
        own = problems.inside("values", name)
        if name not in used:
            own.add((), f"{shown(name)} is in no sentence")
        values[name] = _checked_value(value, context, own)
    return conclusion.model_copy(update={"values": values})


def check_figure(figure: form.FigureForm, context: ClaimContext, problems: Problems) -> None:
    """Report what the table [figure] names and is no number of the study, and axes that cannot be logarithmic."""
    experiment = context.experiment
    known = [p.name for p in experiment.parameters] + [o.name for o in experiment.outputs] + [*experiment.coordinates]
    for key, names in figure:
        for i, name in enumerate(names):
            if name not in known and not experiment.undeclared:
                problems.add((key, i), f"{shown(name)} is neither a parameter nor an output{suggest(name, known)}")
            elif key == "linear" and name in figure.log:
                problems.add((key, i), f"{shown(name)} is in log too; leave out one of the two")
            elif key == "log" and name not in context.overridden:
                wrong = [value for value in context.axes.get(name) or () if not is_number(value) or value <= 0]
                for value in wrong[:1]:
                    problems.add((key, i), f"{name} = {shown(value)}: a logarithmic axis has only numbers above zero")


def _fields_of(sentence: str) -> list[tuple[str, str]]:
    """Return the names of the values in a sentence, and how each is written; raises ValueError for stray braces."""
    found = []
    for _, name, written, conversion in Formatter().parse(sentence):
        if name is None:
            continue
        if conversion or not name.isidentifier():
            raise ValueError(f"{shown(name)} is not the name of a value")
        found.append((name, written or ""))
    return found


def _checked_value(value: form.ConclusionValue, context: ClaimContext, problems: Problems) -> form.ConclusionValue:
    before = len(problems.found)
    checked = _checked_quantity(value, context, problems)
    of_quantity = len(problems.found) > before
    if value.above is not None and value.below is not None and not value.above < value.below:
        problems.add(("above",), f"{value.above:g} is not less than below = {value.below:g}")
    if not of_quantity and value.choose is None and (free := _not_fixed(checked, context)):
        problems.add((), f"{free[0]} has several values; fix it with 'where', or choose the least or largest number")
    return checked


def _not_fixed(value: form.ConclusionValue, context: ClaimContext) -> list[str]:
    """Return the axes with several values that nothing fixes, one of each group of zipped axes."""
    quantity = value.quantity()
    fixed = {*value.where, *(name for places in _places(quantity).values() for name in places)}
    if isinstance(quantity, form.Slope):
        fixed.add(quantity.over)
    for group in context.zipped:
        if fixed & set(group):
            fixed |= set(group)
    return [
        name
        for name, values in context.axes.items()
        if name not in fixed | context.overridden and values is not None and len(values) > 1
    ]


def _checked_quantity(claim: D, context: ClaimContext, problems: Problems) -> D:
    """Return a claim or a value of a conclusion with the values of its axes parsed."""
    where = _selection(claim.where, context, problems.inside("where"))
    with problems.at(()):
        quantity = claim.quantity()
        key = KEYS[type(quantity)]
        own = problems.inside(key)
        _check_variable(quantity, context, own)
        if isinstance(quantity, form.Slope):
            _check_over(quantity.over, where, context, own)
        found = {
            name: _selection(places, context, own.inside(name), beside=where)
            for name, places in _places(quantity).items()
        }
        if isinstance(quantity, form.Ratio):
            if set(quantity.of) != set(quantity.to):
                own.add((), "'of' and 'to' must give values of the same axes")
            elif found["of"] == found["to"]:
                own.add((), "'of' and 'to' are the same place")
        return claim.model_copy(update={"where": where, key: quantity.model_copy(update=found)})
    return claim


def _places(quantity: Quantity) -> dict[str, dict[str, Any]]:
    """Return the places of the grid that a quantity names, by their keys."""
    return {key: places for key, places in quantity if isinstance(places, dict)}


def _check_number(claim: form.Claim, problems: Problems) -> None:
    if not math.isfinite(form.printed_rounding(claim.published)) or not math.isfinite(float(claim.published)):
        problems.add(("published",), f"{shown(claim.published)}: must be a number as printed, in quotes, like '0.60'")
    if (claim.tolerance is None) != (claim.tolerance_reason is None):
        problems.add(("tolerance",), "a tolerance needs a tolerance_reason, and the other way round")
    if claim.not_comparable is not None and (claim.tolerance is not None or claim.null is not None):
        problems.add(("not_comparable",), "there is no verdict then; leave out tolerance and null")
    if claim.null is not None and not (math.isfinite(claim.null) and claim.published != str(claim.null)):
        problems.add(("null",), f"{shown(claim.null)}: must be a finite number that is not the published one")


def _check_variable(quantity: Quantity, context: ClaimContext, problems: Problems) -> None:
    where = ("variable",)
    outputs = {o.name: o for o in context.experiment.outputs}
    output = outputs.get(quantity.variable)
    if output is None:
        problems.add(where, f"unknown output {shown(quantity.variable)}{suggest(quantity.variable, list(outputs))}")
    elif output.name in context.axes:
        problems.add(where, f"{shown(output.name)} is an axis here, not a result")
    elif len(output.dims) > 1:
        problems.add(where, f"{output.name} has the dimensions {', '.join(output.dims)}; at most one is allowed")
    elif not output.dims:
        if quantity.component is not None:
            problems.add(("component",), f"{output.name} is one number and has no components")
    else:
        labels = context.experiment.coordinates[output.dims[0]]
        if quantity.component is None:
            problems.add(where, f"{output.name} needs a component: one of {', '.join(labels)}")
        elif quantity.component not in labels:
            hint = suggest(quantity.component, labels)
            problems.add(("component",), f"unknown component {shown(quantity.component)}{hint}")


def _check_over(over: str, where: Mapping[str, Value], context: ClaimContext, problems: Problems) -> None:
    place = ("over",)
    if over not in context.axes:
        if over not in context.overridden:
            problems.add(place, f"{shown(over)} is not an axis{_known_axes(over, context)}")
        return
    partners = next((group for group in context.zipped if over in group), [over])
    if fixed := [name for name in partners if name in where]:
        problems.add(place, f"{shown(over)} cannot vary, because 'where' fixes {', '.join(map(shown, fixed))}")
    values = context.axes[over]
    if values is None or over in context.overridden:
        return
    if context.experiment.parameter(over).kind not in ("float", "int"):
        problems.add(place, f"{shown(over)} is not an axis of numbers")
    elif len(values) < 2 or not all(isinstance(v, (int, float)) and v > 0 for v in values):
        problems.add(place, f"{shown(over)} needs at least two values, all above 0, for a power law")


def _selection(
    places: Mapping[str, object], context: ClaimContext, problems: Problems, beside: Collection[str] = ()
) -> dict[str, Value]:
    """Return values of axes as the grid has them; ``beside`` are axes whose values the claim gives elsewhere."""
    found: dict[str, Value] = dict.fromkeys(places)  # None where it is wrong
    for name, raw in places.items():
        where = (name,)
        if name in beside:
            problems.add(where, "is given by 'where' too; leave out one of the two")
        if name not in context.axes and name not in context.overridden:
            problems.add(where, f"{shown(name)} is not an axis{_known_axes(name, context)}")
            continue
        with problems.at(where):
            value = context.experiment.parameter(name).parse(raw)
            values = context.axes.get(name)
            if values is not None and name not in context.overridden and value not in values:
                listed = first_of([shown(value) for value in values], 20)
                problems.add(where, f"{shown(value)} is not on the axis, which has {listed}")
            found[name] = value.name if isinstance(value, Named) else value
    return found


def _known_axes(name: str, context: ClaimContext) -> str:
    known = [axis for axis in context.axes if axis in context.experiment.defaults()]
    return suggest(name, known) if known else "; the study has none"
