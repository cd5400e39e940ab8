"""What a store records of an experiment, so that the store can be read without importing the experiment."""

import json
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from linksweep.sweep.code.load import Code, SourceFunction
from linksweep.sweep.contract import Experiment, Named, Output, Parameter, SweepError, shown
from linksweep.sweep.functions.adapter import FunctionExperiment
from linksweep.sweep.functions.record import experiment_of_record, layout_of_record
from linksweep.sweep.studies.reader import study_of_attributes
from linksweep.sweep.studies.study import Study
from linksweep.sweep.tables.file import as_json

RECORD = "experiment_record"
"""The attribute of a store that holds the record, as JSON."""


class Recorded(Code):
    """The code of a study that a store holds, to be looked at: its recorded experiment, and no way to load any."""

    def __init__(self, experiment: Experiment) -> None:
        super().__init__()
        self.recorded = experiment

    def experiment(self, reference: str, folder: Path) -> Experiment:
        """Return the recorded experiment, whatever is named."""
        return self.recorded

    def function(self, reference: str, folder: Path) -> SourceFunction:
        """Raise SweepError: looking at a store never runs what it names."""
        raise SweepError(f"names {shown(reference)}, and looking at a store never runs what it names")


Costs = tuple[tuple[str, ...], Mapping[tuple[Any, ...], float]]
"""The axes on which the cost of a point depends, and the cost by their values."""


def recorded(study: Study, costs: Costs | None) -> str:
    """Return the record of a study's experiment: all that it declares, and the costs of the study's points if known."""
    experiment = study.experiment
    return json.dumps(
        {
            "name": experiment.name,
            "version": experiment.version,
            "parameters": [_declared(parameter) for parameter in experiment.parameters],
            "outputs": [_declared(output) for output in experiment.outputs],
            "sample_outputs": [_declared(output) for output in experiment.sample_outputs],
            "sums": dict(experiment.sums),
            "coordinates": dict({} if isinstance(experiment, FunctionExperiment) else experiment.coordinates),
            "component_units": dict(experiment.component_units),
            "shared": list(experiment.shared),
            "nan_sums": list(experiment.nan_sums),
            **({"function": experiment.as_record()} if isinstance(experiment, FunctionExperiment) else {}),
            **({} if costs is None else {"cost_axes": costs[0], "costs": {_key(k): v for k, v in costs[1].items()}}),
        }
    )


def recorded_study(attributes: Mapping[str, Any], where: str) -> Study:
    """Return the study of a store, with an experiment that is made from the store's record and computes nothing.

    Raises SweepError if the record, or a table that the study names, is missing or does not fit.
    """
    if RECORD not in attributes:
        raise SweepError("has no record of its experiment: it was written by an older version", where)
    try:
        code = Recorded(_experiment(json.loads(attributes[RECORD])))
        document = json.loads(attributes["study_document"])
        plain = {
            key: value for key, value in document.items() if key not in ("define", "published", "claim", "conclusion")
        }
        return study_of_attributes({**attributes, "study_document": json.dumps(plain)}, where, code)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, MemoryError, RecursionError) as error:
        raise SweepError(f"the record of its experiment cannot be read ({error})", where) from error


def as_recorded(study: Study, attributes: Mapping[str, Any]) -> Study:
    """Return a study; if it is of a plain function, with the layout of results that the store has recorded, if any."""
    experiment = study.experiment
    if not isinstance(experiment, FunctionExperiment) or RECORD not in attributes:
        return study
    layout = layout_of_record(json.loads(attributes[RECORD]))
    return study if layout is None else replace(study, experiment=experiment.with_layout(layout))


def _experiment(record: Mapping[str, Any]) -> Experiment:
    parameters = tuple(_made(Parameter, parameter) for parameter in record["parameters"])
    if "function" in record:
        return experiment_of_record(record, parameters)
    outputs, samples = (tuple(_made(Output, o) for o in record[key]) for key in ("outputs", "sample_outputs"))
    same = ("name", "version", "sums", "coordinates", "component_units", "shared")
    return Experiment(
        **{key: _tuples(record[key]) for key in same},
        parameters=parameters,
        outputs=outputs,
        evaluate=_computes_nothing,
        summarise=_computes_nothing,
        samples=_computes_nothing if samples else None,
        sample_outputs=samples,
        nan_sums=tuple(record.get("nan_sums", ())),
        **_cost(record),
    )


def _cost(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the function for the cost of a point; none if all points cost 1, as is the default of an experiment."""
    if "costs" not in record:
        return {"cost": _computes_nothing}
    names, costs = record["cost_axes"], record["costs"]
    if costs == {_key(()): 1.0}:
        return {}
    return {"cost": lambda point: float(costs[_key(tuple(point[name] for name in names))])}


def _key(values: tuple[Any, ...]) -> str:
    return as_json(list(values))


def _computes_nothing(*_arguments: Any, **_named: Any) -> Any:
    raise SweepError("the record of an experiment computes nothing")


def _declared(declared: Parameter | Output) -> dict[str, Any]:
    """Return the fields that differ from their defaults, as JSON has them."""
    found: dict[str, Any] = {}
    for field in fields(declared):
        value = getattr(declared, field.name)
        if field.name == "defined":
            value = [[named.name, named.identity] for named in value]
        if not callable(value) and value not in (field.default, []):
            found[field.name] = value.item() if hasattr(value, "item") else value
    return found


def _made(kind: Any, stored: Mapping[str, Any]) -> Any:
    known = {field.name for field in fields(kind)}
    values = {name: _tuples(value) for name, value in stored.items() if name in known}
    if "defined" in values:
        values["defined"] = tuple(Named(name, identity, None) for name, identity in values["defined"])
    return kind(**({"default": None} if kind is Parameter else {}) | values)


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuples(one) for name, one in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
