"""The quasars of the paper's counts."""

import numpy as np

from linksweep.core.catalogue import Catalogue
from linksweep.core.catalogues.kind import RANDOM_SKY, CatalogueKind, in_limits, sky_of, too_few
from linksweep.core.quasars import BRIGHTEST_MAG, V_MAX, quasar_count, quasars
from linksweep.sweep.contract import Point


class Quasars(CatalogueKind):
    """`"quasars"`: as many as the counts have between the limits."""

    parameters = RANDOM_SKY | {"v_min", "v_max", "counts"}
    draws_several = True

    def available(self, point: Point) -> int:
        """Return the count between the limits; raises ValueError outside of the counts."""
        completed, (brightest, faintest) = point["counts"] == "completed", self.magnitudes(point)
        brighter = quasar_count(brightest, completed) if brightest > BRIGHTEST_MAG else 0
        return quasar_count(faintest, completed) - brighter

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return v_min, or where the counts begin, and v_max."""
        v_min, v_max = point["v_min"], point["v_max"]
        brightest = BRIGHTEST_MAG if v_min is None else max(float(v_min), BRIGHTEST_MAG)
        return brightest, float(V_MAX[-1] if v_max is None else v_max)

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return all quasars between the limits, or n_obj of them at random."""
        brightest, faintest = self.magnitudes(point)
        whole = quasars(rng, faintest, sky_of(point), point["counts"] == "completed", brightest)
        return whole.some(rng, self.size(point))

    def problem(self, point: Point) -> str | None:
        """Return a problem unless there are enough quasars between limits within the counts."""
        brightest, faintest = self.magnitudes(point)
        if point["v_min"] is not None and (problem := in_limits(brightest, faintest)):
            return problem
        return too_few(point, self.available(point), "quasars")

    def is_nested(self, point: Point) -> bool:
        """Return whether the limit is one of the paper's, and all objects are taken."""
        return point["n_obj"] is None and self.magnitudes(point)[1] in V_MAX
