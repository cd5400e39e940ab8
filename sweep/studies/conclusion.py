"""Checks the conclusion of a study: its sentences against its values, these against the grid and the experiment."""

from collections.abc import Callable
from functools import partial
from string import Formatter

from sweep.contract import shown, suggest
from sweep.studies.claims import ClaimContext, Problem, checked_quantity
from sweep.studies.source import Place
from sweep.studies.study import Conclusion, ConclusionValue, Ratio, Reading, Slope

PlaceProblem = Callable[[Place, str], None]
"""Takes the place of a problem in the study, and a sentence."""

FORMATS = ("", "error", "%")
"""What may follow a name: nothing for the number, ``:error`` for its error beside it, ``:%`` for percent."""


def checked_conclusion(conclusion: Conclusion, around: ClaimContext, problem: PlaceProblem) -> Conclusion:
    """Return the conclusion with the values of its axes parsed; ``problem`` is told of everything that is wrong."""
    used: set[str] = set()
    for number, sentence in enumerate(conclusion.sentences):
        where = ("conclusion", "sentences", number)
        try:
            fields = fields_of(sentence)
        except ValueError as error:
            problem(where, f"{shown(sentence)}: {error}; {{name}} stands for a value, and {{{{ for a brace")
            continue
        for name, form in fields:
            used.add(name)
            if name not in conclusion.values:
                problem(where, f"unknown value {shown(name)}{suggest(name, list(conclusion.values))}")
            if form not in FORMATS:
                problem(where, f"{shown(f'{{{name}:{form}}}')}: after the colon can be error or %")
    values = {}
    for name, value in conclusion.values.items():
        own = partial(_at, ("conclusion", "values", name), problem)
        if name not in used:
            own((), f"{shown(name)} is in no sentence")
        values[name] = _checked_value(value, around, own)
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


def _at(place: tuple[str, ...], problem: PlaceProblem, inside: tuple[str, ...], text: str) -> None:
    problem((*place, *inside), text)


def _checked_value(value: ConclusionValue, around: ClaimContext, problem: Problem) -> ConclusionValue:
    told: list[str] = []

    def noting(place: tuple[str, ...], text: str) -> None:
        told.append(text)
        problem(place, text)

    checked = checked_quantity(value, around, noting)
    if value.above is not None and value.below is not None and not value.above < value.below:
        problem(("above",), f"{value.above:g} is not less than below = {value.below:g}")
    if not told and value.choose is None and (free := _not_fixed(checked, around)):
        problem((), f"{free[0]} has several values; fix it with 'where', or choose the least or largest number")
    return checked


def _not_fixed(value: ConclusionValue, around: ClaimContext) -> list[str]:
    """Return the axes with several values that nothing fixes, one of each group of zipped axes."""
    quantity = value.quantity()
    fixed = set(value.where)
    if isinstance(quantity, Reading):
        fixed |= set(quantity.at)
    elif isinstance(quantity, Ratio):
        fixed |= set(quantity.of)
    elif isinstance(quantity, Slope):
        fixed.add(quantity.over)
    for group in around.zipped:
        if fixed & set(group):
            fixed |= set(group)
    return [
        name
        for name, values in around.axes.items()
        if name not in fixed | around.overridden and values is not None and len(values) > 1
    ]
