"""The radio stars of the Hipparcos link."""

import numpy as np

from core.catalogue import Catalogue, radio_stars, resample
from core.catalogues.kind import RANDOM_SKY, CatalogueKind, sky_of
from core.radio_stars import RADIO_STARS
from sweep.contract import Point


class RadioStars(CatalogueKind):
    """`"radio-stars"`: drawn from the eleven with replacement."""

    extragalactic = False

    def uses(self, point: Point) -> frozenset[str]:
        """Return whose positions, and the sky of random ones."""
        return frozenset({"positions"}) | (frozenset() if point["positions"] == "own" else RANDOM_SKY)

    def available(self, point: Point) -> int:
        """Return how many there are."""
        return len(RADIO_STARS.v_mag)

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return the brightest and the faintest of them."""
        return float(np.min(RADIO_STARS.v_mag)), float(np.max(RADIO_STARS.v_mag))

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return some, which may be the same star more than once."""
        return resample(rng, radio_stars(), self.size(point), None if point["positions"] == "own" else sky_of(point))

    def objects(self, point: Point) -> Catalogue:
        """Return the eleven."""
        return radio_stars()

    def names(self, point: Point, objects: Catalogue) -> tuple[str, ...]:
        """Return their names."""
        return tuple(map(str, RADIO_STARS.name))

    def problem(self, point: Point) -> str | None:
        """All are drawn from, whatever their magnitudes."""
        if point["v_max"] is None and point["v_min"] is None:
            return None
        given = "v_min" if point["v_max"] is None else "v_max"
        return f"{given}: the radio stars have no limiting magnitude, all {self.available(point)} are drawn from"
