"""Objects drawn from simple laws."""

import numpy as np

from core.catalogue import Catalogue, synthetic
from core.catalogues.kind import RANDOM_SKY, CatalogueKind, in_limits, sky_of
from core.constants import MAS
from sweep.contract import Point

BRIGHTEST_MAG, FAINTEST_MAG = 5.0, 15.0
"""Where a study gives no limits."""


class Synthetic(CatalogueKind):
    """`"synthetic"`: uniform magnitudes, isotropic proper motions."""

    def uses(self, point: Point) -> frozenset[str]:
        """Return its limits, motions and sky; how the motions are distributed if there are any."""
        return RANDOM_SKY | {"v_min", "v_max", "mean_pm", *(["pm_distribution"] if point["mean_pm"] > 0.0 else [])}

    def available(self, point: Point) -> int:
        """Raise ValueError: there are as many as a study says."""
        raise ValueError("n_obj: a synthetic catalogue needs a number of objects")

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
        """There must be a number of objects, and room between the limits."""
        self.size(point)
        return in_limits(point, *self.magnitudes(point))
