"""The galaxies of Tycho-2."""

import numpy as np

from linksweep.core.catalogue import GALAXY_FAINT_LIMIT_MAG, N_GALAXIES, Catalogue, galaxies
from linksweep.core.catalogues.kind import RANDOM_SKY, CatalogueKind, in_limits, sky_of
from linksweep.sweep.contract import Point

BRIGHTEST_MAG = 9.0
"""No galaxy is as bright: seven times the scatter above the mean."""

SMALLEST_V_MAX = 11.0


class Galaxies(CatalogueKind):
    """`"galaxies"`: 116 of them, whatever the limits between which their magnitudes are drawn."""

    parameters = RANDOM_SKY | {"v_min", "v_max"}
    draws_several = True

    def available(self, point: Point) -> int:
        """Return the number of certain galaxies."""
        return N_GALAXIES

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return v_min, or a limit that no galaxy is brighter than, and v_max."""
        v_min, v_max = point["v_min"], point["v_max"]
        brightest = BRIGHTEST_MAG if v_min is None else max(float(v_min), BRIGHTEST_MAG)
        return brightest, float(GALAXY_FAINT_LIMIT_MAG if v_max is None else v_max)

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return galaxies with random positions and magnitudes."""
        return galaxies(rng, self.size(point), self.magnitudes(point)[1], sky_of(point), point["v_min"])

    def problem(self, point: Point) -> str | None:
        """Return a problem unless the limits leave some of the distribution of magnitudes."""
        brightest, faintest = self.magnitudes(point)
        if not SMALLEST_V_MAX <= faintest <= GALAXY_FAINT_LIMIT_MAG:
            span = f"from {SMALLEST_V_MAX:g} to {GALAXY_FAINT_LIMIT_MAG} mag"
            return f"v_max = {faintest:g} mag: the galaxies have magnitudes {span}"
        return in_limits(brightest, faintest)
