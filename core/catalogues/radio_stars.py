"""The radio stars of the Hipparcos link."""

import numpy as np

from linksweep.core.catalogue import Catalogue, radio_stars, resample
from linksweep.core.catalogues.kind import RANDOM_SKY, CatalogueKind, sky_of
from linksweep.core.radio_stars import RADIO_STARS
from linksweep.sweep.contract import Point


class RadioStars(CatalogueKind):
    """`"radio-stars"`: drawn from the eleven with replacement."""

    parameters = RANDOM_SKY | {"positions"}
    extragalactic = False
    draws_several = True

    def has_random_positions(self, point: Point) -> bool:
        """Return whether positions are not those of the stars."""
        return bool(point["positions"] != "own")

    def available(self, point: Point) -> int:
        """Return the number of stars."""
        return len(RADIO_STARS.v_mag)

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return the brightest and the faintest of them."""
        return float(np.min(RADIO_STARS.v_mag)), float(np.max(RADIO_STARS.v_mag))

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return some of the stars; one may occur more than once."""
        return resample(
            rng, radio_stars(), self.size(point), sky_of(point) if self.has_random_positions(point) else None
        )

    def objects(self, point: Point) -> Catalogue:
        """Return the eleven."""
        return radio_stars()

    def problem(self, point: Point) -> str | None:
        """Return a problem if there are limits: all stars are drawn from, whatever their magnitudes."""
        if point["v_max"] is None and point["v_min"] is None:
            return None
        given = "v_min" if point["v_max"] is None else "v_max"
        return f"{given}: the radio stars have no limiting magnitude, all {self.available(point)} are drawn from"
