"""Reads what a store has recorded of the experiment of a plain function."""

from collections.abc import Mapping
from typing import Any

from linksweep.sweep.contract import Output, Parameter, SweepError
from linksweep.sweep.functions.adapter import FunctionExperiment, undeclared_experiment
from linksweep.sweep.functions.layout import Layout, layout_of_json


def experiment_of_record(record: Mapping[str, Any], parameters: tuple[Parameter, ...]) -> FunctionExperiment:
    """Return the experiment that a store has recorded, which computes nothing."""
    told = record["function"]
    outputs = tuple(Output(**{**one, "dims": tuple(one["dims"])}) for one in told["outputs"])
    empty = undeclared_experiment(record["name"], parameters, outputs, told["rng"])
    return empty if told["layout"] is None else empty.with_layout(layout_of_json(told["layout"]))


def layout_of_record(record: Mapping[str, Any]) -> Layout | None:
    """Return the layout of results that a store has recorded; None where there is none."""
    layout = record.get("function", {}).get("layout")
    try:
        return None if layout is None else layout_of_json(layout)
    except (KeyError, TypeError) as error:
        raise SweepError(f"the record of its experiment cannot be read ({error})") from error
