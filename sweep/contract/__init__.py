"""The contract between the platform and an experiment: declared parameters, declared outputs, one function for a block.

This package and NumPy are all that an experiment needs; the platform knows nothing of what is inside one.
"""

from linksweep.sweep.contract.errors import FEW, DefinitionError, SweepError, shown, suggest
from linksweep.sweep.contract.experiment import Evaluate, Experiment, GeneratorPair, Summarise
from linksweep.sweep.contract.parameter import Define, Function, Kind, Named, Output, Parameter, Point, Value
from linksweep.sweep.contract.reducer import (
    FEWEST_SAMPLES,
    Array,
    NotFiniteError,
    Outcome,
    Reducer,
    ResultError,
    Rows,
    check_finite,
    checked,
    small_sample_factor,
)

__all__ = [
    "FEW",
    "FEWEST_SAMPLES",
    "Array",
    "Define",
    "DefinitionError",
    "Evaluate",
    "Experiment",
    "Function",
    "GeneratorPair",
    "Kind",
    "Named",
    "NotFiniteError",
    "Outcome",
    "Output",
    "Parameter",
    "Point",
    "Reducer",
    "ResultError",
    "Rows",
    "Summarise",
    "SweepError",
    "Value",
    "check_finite",
    "checked",
    "shown",
    "small_sample_factor",
    "suggest",
]
