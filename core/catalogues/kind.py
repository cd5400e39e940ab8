"""What a reference catalogue is to a study (step A): which parameters it uses, how many objects it has, how it is
drawn.
"""

from collections.abc import Callable, Hashable
from functools import partial

import numpy as np

from linksweep.core.catalogue import Catalogue, NestedDraw, Sky
from linksweep.core.constants import DEGREE
from linksweep.sweep.contract import Point, SweepError

RANDOM_SKY = frozenset({"zone_of_avoidance", "sky_contrast"})
"""Parameters of random positions."""


class CatalogueKind:
    """One value of the parameter `catalogue`.

    A new one is a module with a subclass and a line in `core.catalogues.CATALOGUES`.  It may read ``n_obj`` of a point
    and the parameters that `uses` names.
    """

    parameters: frozenset[str]
    """Parameters that it may use, beside n_obj."""

    extragalactic = True

    draws_several = False
    """Whether `draw` also takes several generators as one, whose methods return arrays with a first axis of catalogues,
    and then returns a `Catalogue` of shape (catalogues, N), or (N,) where all are the same: this makes many small
    catalogues faster.
    """

    def has_random_positions(self, point: Point) -> bool:
        """Return whether positions are drawn, so that `RANDOM_SKY` matters."""
        return True

    def uses(self, point: Point) -> frozenset[str]:
        """Return the parameters, beside n_obj, on which the catalogue of a point depends."""
        return self.parameters if self.has_random_positions(point) else self.parameters - RANDOM_SKY

    def available(self, point: Point) -> int:
        """Return how many objects there are if a point does not set n_obj; raises ValueError or SweepError where that
        is not known.
        """
        raise NotImplementedError

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return two magnitudes between which all objects lie; NaN where they are not known."""
        raise NotImplementedError

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return the catalogue that a generator gives."""
        raise NotImplementedError

    def objects(self, point: Point) -> Catalogue | None:
        """Return the objects of a catalogue that lists them, None for one that is drawn from a law."""
        return None

    def listed(self, point: Point) -> tuple[Catalogue, Callable[[int], str]] | None:
        """Return the objects that a user listed, and a function that names the k-th of them; None without a list."""
        return None

    def problem(self, point: Point) -> str | None:
        """Return why there is no such catalogue, or None; it may raise as `available`."""
        return None

    def is_nested(self, point: Point) -> bool:
        """Return whether a fainter v_max only adds objects at the end, for equal generators."""
        return False

    def size(self, point: Point) -> int:
        """Return the number of objects of a point's catalogue."""
        n_obj = point["n_obj"]
        return self.available(point) if n_obj is None else int(n_obj)

    def nested_draw(self, point: Point) -> NestedDraw:
        """Return the draw of a point's catalogue, with what decides which family it belongs to."""
        nested = self.is_nested(point)
        decides = sorted({*self.uses(point), "catalogue", "n_obj"} - ({"v_max"} if nested else set()))
        family: Hashable = (nested, *((name, point[name]) for name in decides))
        return NestedDraw(family, self.size(point), partial(self.draw, point), self.draws_several)

    def why_not(self, point: Point) -> str | None:
        """Return `problem` as a sentence, also where it or reading a table raises an error."""
        try:
            return self.problem(point)
        except ValueError as error:
            path = getattr(point["file"], "path", None) if "file" in self.parameters else None
            return str(error) if path is None else f"{error} ({path})"
        except SweepError as error:
            return f"{error} ({error.where})"


def sky_of(point: Point) -> Sky:
    """Return where random positions may be."""
    return Sky(point["zone_of_avoidance"] * DEGREE, point["sky_contrast"])


def in_limits(brightest: float, faintest: float) -> str | None:
    """Return why no object can lie between two limits, the brighter of which may be v_min, or None."""
    if faintest > brightest:
        return None
    return f"v_max = {faintest:g} mag: must be fainter than the brightest object, v_min = {brightest:g} mag"


def too_few(point: Point, available: int, what: str) -> str | None:
    """Return a sentence if a catalogue has too few objects between its limits, None if there are enough."""
    wanted = max(2, point["n_obj"] or 0)
    if available >= wanted:
        return None
    limits = [f"brighter than v_max = {point['v_max']:g} mag"] if point["v_max"] is not None else []
    limits += [f"fainter than v_min = {point['v_min']:g} mag"] if point["v_min"] is not None else []
    return f"n_obj = {wanted}: only {available} {what} are {' and '.join(limits) or 'there'}"
