"""The contract between the platform and an experiment: declared parameters, declared outputs, one function for a block.

This package and NumPy are all that an experiment needs; the platform knows nothing of what is inside one.
"""

from linksweep.sweep.contract.experiment import *
from linksweep.sweep.contract.rows import *
