"""The form of a study of one experiment as JSON Schema, for editors: what they complete and underline."""

import math
from typing import Any

from linksweep.sweep.contract import Experiment, Parameter
from linksweep.sweep.studies.form import Form
from linksweep.sweep.studies.values import DESIGNS

DIALECT = "https://json-schema.org/draft/2020-12/schema"

Schema = dict[str, Any]


def study_schema(experiment: Experiment) -> Schema:
    """Return the JSON Schema of studies of an experiment.

    A study that `sweep plan` accepts conforms to it.  What depends on several values at once is left to `sweep plan`.
    """
    schema = Form.model_json_schema()
    parameters = experiment.parameters
    definable = [p for p in parameters if p.define is not None]
    schema["properties"] |= {
        "axes": _table({p.name: _axis(p) for p in parameters if p.may_be_axis}),
        "fixed": _table({p.name: _value(p) for p in parameters}),
        "define": _table({p.name: {"type": "object", "description": f"own values of {p.name}"} for p in definable}),
    }
    schema["$defs"]["PointsForm"]["properties"] |= {
        "design": {"enum": list(DESIGNS), "description": "a design of points in the ranges"},
        "ranges": _table({p.name: _range(p) for p in parameters if p.may_be_axis}),
        "columns": _table({p.name: {"type": "array", "items": _value(p)} for p in parameters if p.may_be_axis}),
    }
    schema["properties"]["exclude"]["items"] = _table({p.name: _described(p) for p in parameters})
    return {"$schema": DIALECT, **schema, "title": f"a study of the experiment {experiment.name}"}


def _table(properties: Schema) -> Schema:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _described(parameter: Parameter) -> Schema:
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    return {"description": f"{parameter.meaning}{unit}"}


def _axis(parameter: Parameter) -> Schema:
    """Return the ways to write an axis: a list of values, or a range of numbers."""
    values = {"type": "array", "items": _value(parameter), "minItems": 1}
    ways = [values, _way({"values": values})]
    if parameter.kind in ("int", "float"):
        number = {"type": "number"}
        ends = {"start": number, "stop": number}
        count = {"type": "integer", "minimum": 1}
        ways += [_way({**ends, "step": number}), _way({**ends, "num": count}, {"spacing": {"enum": ["linear", "log"]}})]
    return {**_described(parameter), "anyOf": ways}


def _range(parameter: Parameter) -> Schema:
    """Return the ways to write the range of a parameter in a design."""
    number: Schema = {"type": "number"}
    ways = [_way({"values": {"type": "array", "items": _value(parameter), "minItems": 1}})]
    if parameter.kind in ("int", "float", "any") and not parameter.choices:
        ways.append({"type": "array", "items": number, "minItems": 2, "maxItems": 2})
        ways.append(_way({"low": number, "high": number}, {"spacing": {"enum": ["linear", "log"]}}))
    return {**_described(parameter), "anyOf": ways}


def _way(needed: Schema, possible: Schema | None = None) -> Schema:
    return {**_table({**needed, **(possible or {})}), "required": list(needed)}


def _value(parameter: Parameter) -> Schema:
    number: Schema = {"type": "integer" if parameter.kind == "int" else "number"}
    bounds = {"minimum": parameter.minimum, "maximum": parameter.maximum, "exclusiveMinimum": parameter.above}
    number |= {key: bound for key, bound in bounds.items() if bound is not None and math.isfinite(bound)}
    text: Schema = {"type": "string"}
    if parameter.choices:
        text |= {"enum" if parameter.define is None else "examples": list(parameter.choices)}
    kinds: dict[str, Schema] = {
        "float": number,
        "int": number,
        "str": text,
        "bool": {"type": "boolean"},
        "vector": {"type": "array", "items": number, "minItems": 3, "maxItems": 3},
        "map": {"type": "object", "additionalProperties": {"type": "string"}},
        "file": {"type": "string"},
        "any": {"type": ["number", "string", "boolean"]},
    }
    default = {} if parameter.default is None else {"default": parameter.written_default()}
    return {**_described(parameter), **kinds[parameter.kind], **default}
