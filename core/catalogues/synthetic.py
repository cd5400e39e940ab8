"""Objects drawn from simple laws."""

import numpy as np

from linksweep.core.catalogue import Catalogue, synthetic
from linksweep.core.catalogues.kind import RANDOM_SKY, CatalogueKind, in_limits, sky_of
from linksweep.core.constants import MAS
from linksweep.sweep.contract import Point

BRIGHTEST_MAG, FAINTEST_MAG = 5.0, 15.0
"""The limits where a study gives none."""


class Synthetic(CatalogueKind):
    """`"synthetic"`: uniform magnitudes, isotropic proper motions."""

    parameters = RANDOM_SKY | {"v_min", "v_max", "mean_pm", "pm_distribution"}
    draws_several = True

    def available(self, point: Point) -> int:
        """Return 0: a study must say how many there are."""
        return 0

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return v_min and v_max."""
        v_min, v_max = point["v_min"], point["v_max"]
        return float(BRIGHTEST_MAG if v_min is None else v_min), float(FAINTEST_MAG if v_max is None else v_max)

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return objects with random positions, magnitudes and motions."""
        v_min, v_max = self.magnitudes(point)
        pm = (point["mean_pm"] * MAS, point["pm_distribution"])
        return synthetic(rng, self.size(point), v_min, v_max, sky_of(point), *pm)

    def problem(self, point: Point) -> str | None:
        """Return a problem without a number of objects, or without room between the limits."""
        if point["n_obj"] is None:
            return "n_obj: a synthetic catalogue needs a number of objects"
        return in_limits(*self.magnitudes(point))
