"""A noise floor under any error model: errors that every object has, added in quadrature."""

from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.catalogue import Catalogue
from linksweep.core.errors.model import ErrorKind, ErrorModel, Errors
from linksweep.core.errors.normal import NormalErrors
from linksweep.sweep.contract import Point


@dataclass(frozen=True)
class FlooredErrors(ErrorModel):
    """The errors of ``model`` and an independent one of ``floor`` in each observable, in quadrature."""

    model: ErrorModel
    floor: Errors

    def standard_errors(self, catalogue: Catalogue) -> Array:
        """Return the root of the sum of both squares; shape (4, N)."""
        floor = NormalErrors(*self.floor).standard_errors(catalogue)
        return np.asarray(np.hypot(self.model.standard_errors(catalogue), floor))

    def correlation(self, catalogue: Catalogue) -> Array | None:
        """Return the correlations of the sums: smaller than those of the model, since floors are independent."""
        correlation = self.model.correlation(catalogue)
        if correlation is None:
            return None
        own, total = self.model.standard_errors(catalogue).T, self.standard_errors(catalogue).T
        share = np.divide(own, total, out=np.ones_like(own), where=total > 0.0)
        found = correlation * share[:, :, None] * share[:, None, :]
        found[:, range(4), range(4)] = 1.0
        return np.asarray(found)


def floor_of(point: Point, kind: ErrorKind, side: str) -> Errors | None:
    """Return the floor of one side's errors; None where it has none or its kind of errors cannot have one."""
    floor = Errors(point[f"{side}_floor_pos"], point[f"{side}_floor_pm"])
    return floor if any(floor) and f"{side}_floor_pos" in kind.uses(side) else None
