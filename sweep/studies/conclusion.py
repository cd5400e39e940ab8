"""Checks the conclusion of a study: its sentences against its values, these against the grid and the experiment."""

from string import Formatter

from sweep.contract import shown, suggest
from sweep.studies.claims import ClaimContext, checked_quantity
from sweep.studies.form import Conclusion, ConclusionValue, Ratio, Reading, Slope
from sweep.studies.problems import Problems

FORMATS = ("", "error", "%")
"""What may follow a name: nothing for the number, ``:error`` for its error beside it, ``:%`` for percent."""


def checked_conclusion(conclusion: Conclusion, context: ClaimContext, problems: Problems) -> Conclusion:
    """Return the conclusion with the values of its axes parsed; ``problems`` takes what is wrong in it."""
    used: set[str] = set()
    for number, sentence in enumerate(conclusion.sentences):
        where = ("sentences", number)
        try:
            fields = fields_of(sentence)
        except ValueError as error:
            problems.add(where, f"{shown(sentence)}: {error}; {{name}} stands for a value, and {{{{ for a brace")
            continue
        for name, form in fields:
            used.add(name)
            if name not in conclusion.values:
                problems.add(where, f"unknown value {shown(name)}{suggest(name, list(conclusion.values))}")
            if form not in FORMATS:
                problems.add(where, f"{shown(f'{{{name}:{form}}}')}: after the colon can be error or %")
    values = {}
    for name, value in conclusion.values.items():
        own = problems.inside("values", name)
        if name not in used:
            own.add((), f"{shown(name)} is in no sentence")
        values[name] = _checked_value(value, context, own)
    return conclusion.model_copy(update={"values": values})


def fields_of(sentence: str) -> list[tuple[str, str]]:
    """Return the names of the values in a sentence, and how each is written; raises ValueError for stray braces."""
    found = []
    for _, name, form, conversion in Formatter().parse(sentence):
        if name is None:
            continue
        if conversion or not name.isidentifier():
            raise ValueError(f"{shown(name)} is not the name of a value")
        found.append((name, form or ""))
    return found


def _checked_value(value: ConclusionValue, context: ClaimContext, problems: Problems) -> ConclusionValue:
    before = len(problems.found)
    checked = checked_quantity(value, context, problems)
    of_quantity = len(problems.found) > before
    if value.above is not None and value.below is not None and not value.above < value.below:
        problems.add(("above",), f"{value.above:g} is not less than below = {value.below:g}")
    if not of_quantity and value.choose is None and (free := _not_fixed(checked, context)):
        problems.add((), f"{free[0]} has several values; fix it with 'where', or choose the least or largest number")
    return checked


def _not_fixed(value: ConclusionValue, context: ClaimContext) -> list[str]:
    """Return the axes with several values that nothing fixes, one of each group of zipped axes."""
    quantity = value.quantity()
    fixed = set(value.where)
    if isinstance(quantity, Reading):
        fixed |= set(quantity.at)
    elif isinstance(quantity, Ratio):
        fixed |= set(quantity.of)
    elif isinstance(quantity, Slope):
        fixed.add(quantity.over)
    for group in context.zipped:
        if fixed & set(group):
            fixed |= set(group)
    return [
        name
        for name, values in context.axes.items()
        if name not in fixed | context.overridden and values is not None and len(values) > 1
    ]
