"""The contract between the platform and an experiment: declared parameters, declared outputs, one function for a block.

This package and NumPy are all that an experiment needs; the platform knows nothing of what is inside one.
"""

from linksweep.sweep.contract.errors import FEW, DefinitionError, SweepError, nearest, shown, suggest
from linksweep.sweep.contract.experiment import Experiment, GeneratorPair
from linksweep.sweep.contract.parameter import Function, Kind, Named, Output, Parameter, Point, Value
from linksweep.sweep.contract.reducer import (
    FEWEST_SAMPLES,
    Array,
    NotFiniteError,
    Outcome,
    ResultError,
    Rows,
    small_sample_factor,
)

__all__ = [
    "FEW",
    "FEWEST_SAMPLES",
    "Array",
    "DefinitionError",
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
    "ResultError",
    "Rows",
    "SweepError",
    "Value",
    "nearest",
    "shown",
    "small_sample_factor",
    "suggest",
]
