"""Objects that a user's table lists."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from linksweep.core.catalogue import Catalogue
from linksweep.core.catalogues.kind import RANDOM_SKY, CatalogueKind, sky_of, too_few
from linksweep.core.table_catalogue import Table, catalogue_from_table
from linksweep.sweep.contract import Point

Names = tuple[tuple[str, str], ...]
Key = tuple[Table, Names, Names, bool | None]


class File(CatalogueKind):
    """`"file"`: the rows between the limits, or n_obj of them at random."""

    parameters = RANDOM_SKY | {"file", "columns", "units", "pmra_cos_dec", "positions", "v_min", "v_max"}
    draws_several = True

    def has_random_positions(self, point: Point) -> bool:
        """Return whether the rows are moved to other positions."""
        return bool(point["positions"] == "isotropic")

    def available(self, point: Point) -> int:
        """Return the number of rows between the limits."""
        return len(self.objects(point))

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return the magnitudes of the brightest and the faintest row, NaN for a table without magnitudes."""
        v_mag = self.objects(point).v_mag
        return float(np.min(v_mag)), float(np.max(v_mag))

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return the rows, at their own positions or at random ones."""
        n_obj = self.size(point)
        drawn = self.objects(point).some(rng, n_obj)
        return drawn.moved_to(*sky_of(point).positions(rng, n_obj)) if self.has_random_positions(point) else drawn

    def objects(self, point: Point) -> Catalogue:
        """Return the rows between the limits."""
        return _between(_key(point), point["v_min"], point["v_max"])[0]

    def listed(self, point: Point) -> tuple[Catalogue, Callable[[int], str]]:
        """Return the rows between the limits; they are named by their place in the table, label and magnitude."""
        objects, rows = _between(_key(point), point["v_min"], point["v_max"])

        def name(k: int) -> str:
            label, v_mag = point["file"].label(int(rows[k])), objects.v_mag[k]
            known = [label] * bool(label) + [f"V = {v_mag:.4g}"] * bool(np.isfinite(v_mag))
            return f"row {rows[k] + 1}" + (f" ({', '.join(known)})" if known else "")

        return objects, name

    def problem(self, point: Point) -> str | None:
        """Return a problem unless the table is given, readable, and has enough rows; limits need magnitudes."""
        if point["file"] is None:
            return "file: catalogue = 'file' needs a file, and other catalogues have none"
        limits = [name for name in ("v_min", "v_max") if point[name] is not None]
        if limits and np.any(np.isnan(_whole(_key(point)).v_mag)):
            return f"{limits[-1]} needs a magnitude column (v_mag, phot_g_mean_mag, vt_mag) in the file"
        return too_few(point, self.available(point), "objects of the file")


def _key(point: Point) -> Key:
    return point["file"], point["columns"], point["units"], point["pmra_cos_dec"]


@lru_cache(maxsize=4)
def _whole(key: Key) -> Catalogue:
    """Return all objects of a table, made once in a process; a table is identified by its content."""
    table, columns, units, pmra_cos_dec = key
    return catalogue_from_table(table, dict(columns), pmra_cos_dec, dict(units))


@lru_cache(maxsize=4)
def _between(key: Key, v_min: float | None, v_max: float | None) -> tuple[Catalogue, NDArray[np.intp]]:
    """Return the objects between two limits, and their rows."""
    whole = _whole(key)
    kept = np.full(len(whole), True)
    if v_min is not None:
        kept &= whole.v_mag >= v_min
    if v_max is not None:
        kept &= whole.v_mag <= v_max
    rows = np.flatnonzero(kept)
    return (whole if kept.all() else whole.take(rows)), rows
