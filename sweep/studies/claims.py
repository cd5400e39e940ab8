"""Checks what a study says of its results: its claims and its conclusion, against its grid and its experiment."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from string import Formatter
from typing import Any, TypeVar

from linksweep.sweep.contract import Experiment, Named, Value, shown, suggest
from linksweep.sweep.formatting import first_of
from linksweep.sweep.studies.document import Problems
from linksweep.sweep.studies.study import (
    Claim,
    Conclusion,
    ConclusionValue,
    Derived,
    FigureForm,
    Ratio,
    Reading,
    Slope,
    printed_rounding,
)
from linksweep.sweep.studies.values import is_number

FORMATS = ("", "error", "%")
"""What may follow a name: nothing for the number, ``:error`` for its error beside it, ``:%`` for percent."""

Quantity = Slope | Ratio | Reading
KEYS = {Slope: "slope", Ratio: "ratio", Reading: "value"}
"""The key of each kind of quantity."""

D = TypeVar("D", bound=Derived)


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

    def no_axis(self, name: str) -> str:
        """Return the sentence that a name is no axis."""
        known = [axis for axis in self.axes if axis in self.experiment.defaults()]
        return f"{shown(name)} is not an axis{suggest(name, known) if known else '; the study has none'}"


def checked_claim(claim: Claim, context: ClaimContext, problems: Problems) -> Claim:
    """Return the claim with the values of its axes parsed; ``problems`` takes what is wrong inside the claim."""
    published, null, tolerance = claim.published, claim.null, claim.tolerance
    if not math.isfinite(printed_rounding(published)) or not math.isfinite(float(published)):
        problems.add(("published",), f"{shown(published)}: must be a number as printed, in quotes, like '0.60'")
    if (tolerance is None) != (claim.tolerance_reason is None):
        problems.add(("tolerance",), "a tolerance needs a tolerance_reason, and the other way round")
    if claim.not_comparable is not None and (tolerance is not None or null is not None):
        problems.add(("not_comparable",), "there is no verdict then; leave out tolerance and null")
    if null is not None and not (math.isfinite(null) and published != str(null)):
        problems.add(("null",), f"{shown(null)}: must be a finite number that is not the published one")
    return _checked(claim, context, problems)


def checked_conclusion(conclusion: Conclusion, context: ClaimContext, problems: Problems) -> Conclusion:
    """Return the conclusion with the values of its axes parsed; ``problems`` takes what is wrong in it."""
    used: set[str] = set()
    for number, sentence in enumerate(conclusion.sentences):
        where = ("sentences", number)
        try:
            for _, name, written, conversion in Formatter().parse(sentence):
                if name is None:
                    continue
                if conversion or not name.isidentifier():
                    raise ValueError(f"{shown(name)} is not the name of a value")
                used.add(name)
                if name not in conclusion.values:
                    problems.add(where, f"unknown value {shown(name)}{suggest(name, list(conclusion.values))}")
                if (written or "") not in FORMATS:
                    problems.add(where, f"{shown(f'{{{name}:{written}}}')}: after the colon can be error or %")
        except ValueError as error:  # of stray braces too
            problems.add(where, f"{shown(sentence)}: {error}; {{name}} stands for a value, and {{{{ for a brace")
    values = {}
    for name, value in conclusion.values.items():
        inside = problems.inside("values", name)
        if name not in used:
            inside.add((), f"{shown(name)} is in no sentence")
        before = len(problems.sentences)
        values[name] = checked = _checked(value, context, inside)
        is_right = len(problems.sentences) == before
        if value.above is not None and value.below is not None and not value.above < value.below:
            inside.add(("above",), f"{value.above:g} is not less than below = {value.below:g}")
        if is_right and value.choose is None and (free := _not_fixed(checked, context)):
            inside.add((), f"{free} has several values; fix it with 'where', or choose the least or largest number")
    return conclusion.model_copy(update={"values": values})


def check_figure(figure: FigureForm, context: ClaimContext, problems: Problems) -> None:
    """Report what the table [figure] names and is no number of the study, and axes that cannot be logarithmic."""
    experiment = context.experiment
    known = [p.name for p in experiment.parameters] + [o.name for o in experiment.outputs] + [*experiment.coordinates]
    for key, i, name in ((key, i, name) for key, names in figure for i, name in enumerate(names)):
        if name not in known and not experiment.undeclared:
            problems.add((key, i), f"{shown(name)} is neither a parameter nor an output{suggest(name, known)}")
        elif key == "linear" and name in figure.log:
            problems.add((key, i), f"{shown(name)} is in log too; leave out one of the two")
        elif key == "log" and name not in context.overridden:
            wrong = [value for value in context.axes.get(name) or () if not is_number(value) or value <= 0]
            for value in wrong[:1]:
                problems.add((key, i), f"{name} = {shown(value)}: a logarithmic axis has only numbers above zero")


def _not_fixed(value: ConclusionValue, context: ClaimContext) -> str | None:
    """Return the first axis with several values that nothing fixes."""
    quantity = value.quantity()
    fixed = {*value.where, *(name for places in _places(quantity).values() for name in places), *context.overridden}
    if isinstance(quantity, Slope):
        fixed.add(quantity.over)
    for group in context.zipped:
        if fixed & set(group):
            fixed |= set(group)
    return next((name for name, values in context.axes.items() if name not in fixed and len(values or ()) > 1), None)


def _checked(claim: D, context: ClaimContext, problems: Problems) -> D:
    """Return a claim or a value of a conclusion with the values of its axes parsed."""
    where = _selection(claim.where, context, problems.inside("where"))
    with problems.at(()):
        quantity = claim.quantity()
        key = KEYS[type(quantity)]
        inside = problems.inside(key)
        _check_variable(quantity, context, inside)
        if isinstance(quantity, Slope):
            _check_over(quantity.over, where, context, inside)
        places = {
            name: _selection(place, context, inside.inside(name), beside=where)
            for name, place in _places(quantity).items()
        }
        if isinstance(quantity, Ratio) and set(quantity.of) != set(quantity.to):
            inside.add((), "'of' and 'to' must give values of the same axes")
        elif isinstance(quantity, Ratio) and places["of"] == places["to"]:
            inside.add((), "'of' and 'to' are the same place")
        return claim.model_copy(update={"where": where, key: quantity.model_copy(update=places)})
    return claim


def _places(quantity: Quantity) -> dict[str, dict[str, Any]]:
    """Return the places of the grid that a quantity names, by their keys."""
    return {key: place for key, place in quantity if isinstance(place, dict)}


def _check_variable(quantity: Quantity, context: ClaimContext, problems: Problems) -> None:
    outputs = {output.name: output for output in context.experiment.outputs}
    name, component, output = quantity.variable, quantity.component, outputs.get(quantity.variable)
    labels = context.experiment.coordinates[output.dims[0]] if output is not None and len(output.dims) == 1 else ()
    if output is None:
        problems.add(("variable",), f"unknown output {shown(name)}{suggest(name, list(outputs))}")
    elif name in context.axes:
        problems.add(("variable",), f"{shown(name)} is an axis here, not a result")
    elif len(output.dims) > 1:
        problems.add(("variable",), f"{name} has the dimensions {', '.join(output.dims)}; at most one is allowed")
    elif component is None and labels:
        problems.add(("variable",), f"{name} needs a component: one of {', '.join(labels)}")
    elif component is not None and not labels:
        problems.add(("component",), f"{name} is one number and has no components")
    elif component is not None and component not in labels:
        problems.add(("component",), f"unknown component {shown(component)}{suggest(component, labels)}")


def _check_over(over: str, where: Mapping[str, Value], context: ClaimContext, problems: Problems) -> None:
    place, is_changed = ("over",), over in context.overridden
    if over not in context.axes:
        if not is_changed:
            problems.add(place, context.no_axis(over))
        return
    partners = next((group for group in context.zipped if over in group), [over])
    if fixed := [name for name in partners if name in where]:
        problems.add(place, f"{shown(over)} cannot vary, because 'where' fixes {', '.join(map(shown, fixed))}")
    values = context.axes[over]
    if values is None or is_changed:
        return
    if context.experiment.parameter(over).kind not in ("float", "int"):
        problems.add(place, f"{shown(over)} is not an axis of numbers")
    elif len(values) < 2 or not all(isinstance(v, (int, float)) and v > 0 for v in values):
        problems.add(place, f"{shown(over)} needs at least two values, all above 0, for a power law")


def _selection(
    places: Mapping[str, object], context: ClaimContext, problems: Problems, beside: Collection[str] = ()
) -> dict[str, Value]:
    """Return values of axes as the grid has them; ``beside`` are axes whose values the claim gives elsewhere."""
    selected: dict[str, Value] = dict.fromkeys(places)  # None where it is wrong
    for name, raw in places.items():
        if name in beside:
            problems.add((name,), "is given by 'where' too; leave out one of the two")
        if name not in context.axes and name not in context.overridden:
            problems.add((name,), context.no_axis(name))
            continue
        with problems.at((name,)):
            value = context.experiment.parameter(name).parse(raw)
            values = context.axes.get(name)
            if values is not None and name not in context.overridden and value not in values:
                listed = first_of([shown(value) for value in values], 20)
                problems.add((name,), f"{shown(value)} is not on the axis, which has {listed}")
            selected[name] = value.name if isinstance(value, Named) else value
    return selected
