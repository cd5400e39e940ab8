"""Checks the exclusions of a study."""

from collections.abc import Collection, Mapping

from sweep.contract import shown
from sweep.studies.axes import number_problem
from sweep.studies.study import Condition
from sweep.studies.values import Values


def exclusion(
    index: int, clause: Mapping[str, object], given: Collection[str], values: Values
) -> tuple[Condition, ...]:
    """Return the conditions of one exclusion; ``given`` are the parameters that the study sets."""
    if not clause:
        values.problems.add(("exclude", index), "is empty and would leave out every point")
    return tuple(_condition(index, name, rule, given, values) for name, rule in clause.items())


def _condition(index: int, name: str, rule: object, given: Collection[str], values: Values) -> Condition:
    where, problems = ("exclude", index, name), values.problems
    try:
        parameter = values.experiment.parameter(name)
    except ValueError as error:
        problems.add(where, str(error))
        return Condition(name)
    if not isinstance(rule, dict):
        return Condition(name, among=(values.one(where, name, rule),))
    unknown = [key for key in rule if key not in ("above", "below", "equal", "in")]
    if unknown or not rule:
        wrong = f"unknown condition {shown(unknown)}" if unknown else "has no condition"
        problems.add(where, f"{wrong}; allowed are above, below, equal, in")
        return Condition(name)
    listed = [rule["equal"]] if "equal" in rule else rule.get("in")
    if listed is not None:
        if not isinstance(listed, list) or len(rule) > 1:
            problems.add(where, "'in' takes a list, and 'in' or 'equal' stands alone")
            return Condition(name)
        return Condition(name, among=tuple(values.one(where, name, raw) for raw in listed))
    if parameter.kind not in ("float", "int"):
        problems.add(where, f"{name} has no order: use equal or in")
    elif parameter.default is None and name not in given:
        problems.add(where, f"{name} has no value to compare: it is neither an axis nor fixed, and has no default")
    bounds: dict[str, float] = {}
    for key, raw in rule.items():
        if problem := number_problem(raw):
            problems.add((*where, key), problem)
        else:
            bounds[key] = float(raw)
    return Condition(name, above=bounds.get("above"), below=bounds.get("below"))
