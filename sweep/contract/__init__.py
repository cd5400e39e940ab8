"""The contract between the platform and an experiment: declared parameters, declared outputs, one function for a block.

This package and NumPy are all that an experiment needs; the platform knows nothing of what is inside one.
"""

from linksweep.sweep.contract.checked import Array, NotFiniteError, ResultError, check_finite, checked
from linksweep.sweep.contract.errors import FEW, DefinitionError, SweepError, shown, suggest
from linksweep.sweep.contract.experiment import Evaluate, Experiment, GeneratorPair, Summarise
from linksweep.sweep.contract.output import Output
from linksweep.sweep.contract.parameter import Define, Function, Kind, Named, Parameter, Point, Value
from linksweep.sweep.contract.samples import FEWEST_SAMPLES, small_sample_factor

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
    "Output",
    "Parameter",
    "Point",
    "ResultError",
    "Summarise",
    "SweepError",
    "Value",
    "check_finite",
    "checked",
    "shown",
    "small_sample_factor",
    "suggest",
]
