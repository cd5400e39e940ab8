"""Reference catalogues (step A): their objects, the laws and tables that they come from, and where they may stand.

A new one is a subclass of `CatalogueKind` and its entry in `CATALOGUES`.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from linksweep.core.frames import DEGREE, GALACTIC_AXES, MAS, Array, Indices, position
from linksweep.sweep.contract import Point

SIDES = ("reference", "satellite")
NEEDS_MAGNITUDES = "needs a magnitude column (v_mag, phot_g_mean_mag, vt_mag) in the file"


class OwnErrors(NamedTuple):
    """Errors that a catalogue lists: ``sigma`` (N, 4) of (ra*, dec, pmra, pmdec) in rad and rad/yr, ``correlation``
    (N, 4, 4) of an object's four errors.
    """

    sigma: Array
    correlation: Array | None = None


@dataclass(frozen=True)
class Catalogue:
    """Objects as arrays of shape (N,): ra, dec (rad), pmra, pmdec (rad/yr, pmra with cos dec) and V magnitude.  While
    several catalogues are drawn together the shape is (catalogues, N).

    ``errors`` are those that the catalogue lists, unless it has others for the ``reference`` or the ``satellite``.
    """

    ra: Array
    dec: Array
    pmra: Array
    pmdec: Array
    v_mag: Array
    errors: OwnErrors | None = None
    reference: OwnErrors | None = None
    satellite: OwnErrors | None = None

    def __len__(self) -> int:
        return int(self.ra.shape[-1])

    def take(self, index: Indices | slice) -> "Catalogue":
        """Return the objects at these indices."""
        return self._each(lambda column: column[index])

    def some(self, rng: np.random.Generator, n_obj: int) -> "Catalogue":
        """Return ``n_obj`` objects at random, in their order; if there are no more, all of them without a draw."""
        # no draw where all are taken: an n_obj of all of them gives what no n_obj gives, to the last bit
        if n_obj >= len(self):
            return self
        # sorted, so that a catalogue in order of magnitude stays so, and a part of a file has the order of its rows
        chosen = np.sort(rng.choice(len(self), n_obj, replace=False))
        if self.ra.ndim == 1:
            return self.take(chosen)
        # one draw for each catalogue: the k-th catalogue begins at row k N of the flattened one
        return self.flattened().take(chosen + len(self) * np.arange(len(self.ra))[:, None])

    def repeated(self, catalogues: int) -> "Catalogue":
        """Return the same objects for each of several catalogues; shape (catalogues, N)."""
        return self.take(np.tile(np.arange(len(self)), (catalogues, 1)))

    def flattened(self) -> "Catalogue":
        """Return the objects of all catalogues that are drawn together, one after the other."""
        return self._each(lambda column: column.reshape(-1, *column.shape[self.ra.ndim :]))

    def own_errors(self, side: str) -> OwnErrors | None:
        """Return the errors that the catalogue lists for a side, "reference" or "satellite"; None if there are none."""
        listed = self.reference if side == "reference" else self.satellite
        return self.errors if listed is None else listed

    def _each(self, function: Callable[[Array], Array]) -> "Catalogue":
        """Return a catalogue with a function applied to all arrays, whose first axes are those of the objects."""

        def mapped(column: Array | OwnErrors | None) -> Any:
            if isinstance(column, OwnErrors):
                return OwnErrors(*map(mapped, column))
            return None if column is None else function(column)

        return Catalogue(**{name: mapped(column) for name, column in vars(self).items()})


@dataclass(frozen=True)
class NestedDraw:
    """Draw a catalogue of ``n_obj`` objects; from equal generators it is the beginning of any larger one of its family.

    With ``takes_several`` it also draws several together, see `CatalogueKind.draws_several`.
    """

    family: Hashable
    n_obj: int
    draw: Callable[[np.random.Generator], Catalogue]
    takes_several: bool = False


def isotropic(
    rng: np.random.Generator, n_obj: int, zone_of_avoidance: float = 0.0, contrast: float = 0.0
) -> tuple[Array, Array]:
    """Return ra, dec (rad) of shape (n_obj,), or (catalogues, n_obj) of several that are drawn together: uniform over
    the sky with two exceptions.

    There are none at Galactic latitudes |b| < ``zone_of_avoidance`` (rad), and (1 + contrast)/(1 - contrast) times as
    many north of the Galactic plane as south of it (-1 < ``contrast`` < 1).
    """
    longitude = rng.uniform(0.0, 2.0 * np.pi, n_obj)
    height = rng.uniform(-1.0, 1.0, n_obj) + contrast  # uniform on each side of the plane, more on one
    north = height > 0.0
    fraction = height / np.where(north, 1.0 + contrast, 1.0 - contrast)
    floor = np.sin(zone_of_avoidance)
    sin_b = np.where(north, floor, -floor) + (1.0 - floor) * fraction
    cos_b = np.sqrt(1.0 - sin_b**2)
    galactic = np.stack([cos_b * np.cos(longitude), cos_b * np.sin(longitude), sin_b], axis=-2)
    return position(np.moveaxis(GALACTIC_AXES.T @ galactic, -2, 0))


# Parameters of random positions.
RANDOM_SKY = frozenset({"zone_of_avoidance", "sky_contrast"})


class CatalogueKind:
    """One value of the parameter `catalogue`: which parameters it uses, how many objects it has, how it is drawn.

    It may read ``n_obj`` of a point and the parameters that `uses` names.
    """

    # Parameters that it may use, beside n_obj.
    parameters: frozenset[str]

    extragalactic = True

    # Whether `draw` also takes several generators as one, whose methods return arrays with a first axis of catalogues,
    # and then returns a `Catalogue` of shape (catalogues, N), or (N,) where all are the same: this makes many small
    # catalogues faster.
    draws_several = False

    # Where objects stand if a point does not say so: at random ("isotropic") or at their "own" positions.
    positions = "isotropic"

    def has_random_positions(self, point: Point) -> bool:
        """Return whether positions are drawn, so that `RANDOM_SKY` matters."""
        return "positions" not in self.parameters or (point["positions"] or self.positions) == "isotropic"

    def uses(self, point: Point) -> frozenset[str]:
        """Return the parameters, beside n_obj, on which the catalogue of a point depends."""
        return self.parameters if self.has_random_positions(point) else self.parameters - RANDOM_SKY

    # How many objects there are if a point does not set n_obj, unless that depends on the point.
    number = 0

    def available(self, point: Point) -> int:
        """Return how many objects there are if a point does not set n_obj; raises ValueError or SweepError where that
        is not known.
        """
        return self.number

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return two magnitudes between which all objects lie; NaN where they are not known."""
        raise NotImplementedError

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return the catalogue that a generator gives."""
        raise NotImplementedError

    def placed(self, objects: Catalogue, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return objects at random positions, with their motions along the local triad there, or at their own."""
        if not self.has_random_positions(point):
            return objects
        ra, dec = _positions(point, rng, len(objects))
        return replace(objects if ra.ndim == objects.ra.ndim else objects.repeated(len(ra)), ra=ra, dec=dec)

    def objects(self, point: Point) -> Catalogue | None:
        """Return the objects of a catalogue that lists them, None for one that is drawn from a law."""
        return None

    def problem(self, point: Point) -> str | None:
        """Return why there is no such catalogue, or None; it may raise as `available`."""
        return None

    def is_nested(self, point: Point) -> bool:
        """Return whether a fainter v_max only adds objects at the end, for equal generators."""
        return False

    def size(self, point: Point) -> int:
        """Return the number of objects of a point's catalogue."""
        n_obj = point["n_obj"]  # first: where it is set, nothing else matters
        return self.available(point) if n_obj is None else int(n_obj)

    def nested_draw(self, point: Point) -> NestedDraw:
        """Return the draw of a point's catalogue, with what decides which family it belongs to."""
        nested = self.is_nested(point)  # then those of a brighter v_max are the beginning of the same draw
        decides = sorted({*self.uses(point), "catalogue", "n_obj"} - ({"v_max"} if nested else set()))
        family: Hashable = (nested, *((name, point[name]) for name in decides))
        return NestedDraw(family, self.size(point), partial(self.draw, point), self.draws_several)


def _positions(point: Point, rng: np.random.Generator, n_obj: int) -> tuple[Array, Array]:
    return isotropic(rng, n_obj, point["zone_of_avoidance"] * DEGREE, point["sky_contrast"])


def _limits(point: Point, brightest: float, faintest: float) -> tuple[float, float]:
    """Return v_min and v_max of a point, or these where it sets none."""
    v_min, v_max = point["v_min"], point["v_max"]
    return float(brightest if v_min is None else v_min), float(faintest if v_max is None else v_max)


def _in_limits(brightest: float, faintest: float) -> str | None:
    """Return why no object can lie between two limits, the brighter of which may be v_min, or None."""
    if faintest > brightest:
        return None
    return f"v_max = {faintest:g} mag: must be fainter than the brightest object, v_min = {brightest:g} mag"


def _too_few(point: Point, available: int, what: str) -> str | None:
    """Return a sentence if a catalogue has too few objects between its limits, None if there are enough."""
    wanted = max(2, point["n_obj"] or 0)
    if available >= wanted:
        return None
    words = {"v_max": "brighter than v_max", "v_min": "fainter than v_min"}
    limits = [f"{text} = {point[name]:g} mag" for name, text in words.items() if point[name] is not None]
    return f"n_obj = {wanted}: only {available} {what} are {' and '.join(limits) or 'there'}"


class Synthetic(CatalogueKind):
    """`"synthetic"`: uniform magnitudes, isotropic proper motions; a study must say how many objects there are.

    The paper has "equally distributed apparent brightnesses and proper motions" (Metz & Geffert 2004, Sect. 4.1); that
    the modulus of a proper motion is uniform between 0 and twice its mean is our reading of it.  "rayleigh" is that of
    two normal components, "constant" the same for all.
    """

    parameters = RANDOM_SKY | {"v_min", "v_max", "mean_pm", "pm_distribution"}
    draws_several = True

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return v_min and v_max."""
        return _limits(point, 5.0, 15.0)

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return objects with random positions, magnitudes and motions."""
        n_obj = self.size(point)
        ra, dec = _positions(point, rng, n_obj)
        v_mag = rng.uniform(*self.magnitudes(point), n_obj)
        # drawn for constant moduli too, so that directions do not change with the distribution
        uniform = rng.random(n_obj)
        moduli = {"uniform": 2.0 * uniform, "constant": np.ones(n_obj)}
        moduli["rayleigh"] = np.sqrt(-4.0 / np.pi * np.log1p(-uniform))
        modulus = moduli[point["pm_distribution"]] * (point["mean_pm"] * MAS)
        direction = rng.uniform(0.0, 2.0 * np.pi, n_obj)
        return Catalogue(ra, dec, modulus * np.sin(direction), modulus * np.cos(direction), v_mag)

    def problem(self, point: Point) -> str | None:
        """Return a problem without a number of objects, or without room between the limits."""
        if point["n_obj"] is None:
            return "n_obj: a synthetic catalogue needs a number of objects"
        return _in_limits(*self.magnitudes(point))


V_MAX = np.arange(14.0, 20.5, 0.5)
# Quasars brighter than each of `V_MAX`.  Source: Metz & Geffert 2004, Table 1 (from Veron-Cetty & Veron 2001).
COUNT = np.array([28, 49, 88, 163, 315, 624, 1156, 2056, 3453, 5542, 8095, 11442, 15533])

# Bright end of the counts; 3C 273 has V = 12.9.
BRIGHTEST_MAG = 12.8

# Fraction of all quasars brighter than V that the catalogue holds.  Source: Metz & Geffert 2004, Sect. 5.1 (57 +- 16
# % and 5.4 +- 0.1 %, from the SDSS).
_COMPLETENESS = ((16.5, 0.57), (19.0, 0.054))


@lru_cache(maxsize=1024)
def quasar_count(v_max: float, completed: bool = False) -> int:
    """Return how many quasars are brighter than ``v_max``: the paper's number at its half magnitudes, log-linear
    between.

    Below V = 14 the first slope is extrapolated.  ``completed`` divides by `completeness`.  Raises ValueError outside
    12.8 <= v_max <= 20.
    """
    if not BRIGHTEST_MAG <= v_max <= V_MAX[-1]:
        said = f"v_max = {v_max:g} mag is outside the quasar counts: the brightest object has V = {BRIGHTEST_MAG},"
        raise ValueError(f"{said} the counts end at V = {V_MAX[-1]:g}")
    log_count = np.log(COUNT)
    # np.interp holds the first value below the table, where the counts go on with the first slope
    below = min(0.0, v_max - V_MAX[0]) * (log_count[1] - log_count[0]) / (V_MAX[1] - V_MAX[0])
    in_catalogue = np.exp(np.interp(v_max, V_MAX, log_count) + below)
    return round(float(in_catalogue / (completeness(v_max) if completed else 1.0)))


def completeness(v_max: float) -> float:
    """Return which fraction of the quasars brighter than ``v_max`` the paper's catalogue holds.

    Log-linear through the two values of the paper, also beyond them, and at most 1: everything brighter than V = 15.9
    is known.  At V = 20 this gives 2.1 % of 740 000 quasars; the paper speaks of about 500 000 for GAIA.
    """
    (bright, f_bright), (faint, f_faint) = _COMPLETENESS
    slope = np.log(f_faint / f_bright) / (faint - bright)
    return float(min(1.0, f_bright * np.exp(slope * (v_max - bright))))


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
        brightest, faintest = _limits(point, BRIGHTEST_MAG, V_MAX[-1])
        return max(brightest, BRIGHTEST_MAG), faintest

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return all quasars between the limits, or n_obj of them: without proper motion, brightest bin first.

        Catalogues drawn from equal generators are nested: that of a brighter v_max at a half magnitude is the beginning
        of that of a fainter one.  Within a half-magnitude bin log N is linear in V; quasars that the extrapolation
        would put above V = 12.8 stand at 12.8, as in the calibration of the mission curves.
        """

        def drawn(bright: float, faint: float, low: int, high: int) -> tuple[Array, Array, Array]:
            ra, dec = _positions(point, rng, high - low)
            # a rank for each object of the bin; in (low, high], so that its logarithm is never that of 0
            rank = high - (high - low) * rng.random(high - low)
            if low == 0:  # a law that is log-linear in the counts has no magnitudes below the first object
                return ra, dec, np.full_like(rank, faint)
            return ra, dec, bright + (faint - bright) * np.log(rank / low) / np.log(high / low)

        v_min, v_max = self.magnitudes(point)
        edges = [v_min, *V_MAX[(v_min < V_MAX) & (v_max > V_MAX)].tolist(), v_max]
        counts = [quasar_count(v, point["counts"] == "completed") for v in edges]
        if v_min <= BRIGHTEST_MAG:
            edges, counts = [0.0, *edges], [0, *counts]
        bins = map(drawn, edges, edges[1:], counts, counts[1:])
        ra, dec, v_mag = (np.concatenate(column, axis=-1) for column in zip(*bins, strict=True))
        return Catalogue(ra, dec, np.zeros_like(ra), np.zeros_like(ra), v_mag).some(rng, self.size(point))

    def problem(self, point: Point) -> str | None:
        """Return a problem unless there are enough quasars between limits within the counts."""
        return _in_limits(*self.magnitudes(point)) or _too_few(point, self.available(point), "quasars")

    def is_nested(self, point: Point) -> bool:
        """Return whether the limit is one of the paper's, and all objects are taken."""
        return point["n_obj"] is None and self.magnitudes(point)[1] in V_MAX


# Certain galaxies in Tycho-2.  Source: Metz & Geffert 2004, Sect. 3.2 and Table 1.
N_GALAXIES = 116

# V_T of the galaxies in Tycho-2.  Source: Metz & Geffert 2004, Sect. 3.2 (mean 12.5); scatter and limit are
# estimates.
GALAXY_MEAN_MAG, GALAXY_SCATTER_MAG, GALAXY_FAINT_LIMIT_MAG = 12.5, 0.5, 13.5

# No galaxy is as bright as the first: seven times the scatter above the mean.
BRIGHTEST_GALAXY_MAG, SMALLEST_V_MAX = 9.0, 11.0


class Galaxies(CatalogueKind):
    """`"galaxies"`: 116 of them, whatever the limits between which their magnitudes are drawn."""

    parameters = RANDOM_SKY | {"v_min", "v_max"}
    draws_several = True
    number = N_GALAXIES

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return v_min, or a limit that no galaxy is brighter than, and v_max."""
        brightest, faintest = _limits(point, BRIGHTEST_GALAXY_MAG, GALAXY_FAINT_LIMIT_MAG)
        return max(brightest, BRIGHTEST_GALAXY_MAG), faintest

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return galaxies without proper motion, their magnitudes normal about 12.5 +- 0.5 and cut off at the faint
        limit, and at v_min if there is any.
        """
        from scipy.special import ndtr, ndtri  # here: importing it takes a tenth of the start of every other study

        n_obj = self.size(point)
        ra, dec = _positions(point, rng, n_obj)
        limits = np.array([-np.inf if point["v_min"] is None else point["v_min"], self.magnitudes(point)[1]])
        # by inversion, which takes one uniform number for each object whatever the limits: draws are comparable
        low, high = ndtr((limits - GALAXY_MEAN_MAG) / GALAXY_SCATTER_MAG)
        v_mag = GALAXY_MEAN_MAG + GALAXY_SCATTER_MAG * ndtri(low + (high - low) * (1.0 - rng.random(n_obj)))
        return Catalogue(ra, dec, np.zeros_like(ra), np.zeros_like(ra), v_mag)

    def problem(self, point: Point) -> str | None:
        """Return a problem unless the limits leave some of the distribution of magnitudes."""
        brightest, faintest = self.magnitudes(point)
        if not SMALLEST_V_MAX <= faintest <= GALAXY_FAINT_LIMIT_MAG:
            span = f"from {SMALLEST_V_MAX:g} to {GALAXY_FAINT_LIMIT_MAG} mag"
            return f"v_max = {faintest:g} mag: the galaxies have magnitudes {span}"
        return _in_limits(brightest, faintest)


# The 11 radio stars that tied Hipparcos to the extragalactic frame; ICRS positions, VLBI proper motions.
#
# Source: Lestrade et al. 1999, A&A 344, 1014 (VLBI proper motions and errors); V from the Hipparcos Catalogue (ESA
# 1997), as Metz & Geffert 2004, Sect. 5.3, say they did.  Algol's row and all V are from compilations of the Hipparcos
# era and were not confirmed in print.
# name, HIP, V, ra and dec (deg), pmra (with cos dec), its error, pmdec, its error (mas/yr)
RADIO_STARS = (
    ("LS I +61 303", 12469, 10.75, 40.1319, 61.2293, 0.967, 0.26, -1.21, 0.32),
    ("Algol", 14576, 2.12, 47.0422, 40.9556, 2.70, 0.07, -0.80, 0.09),
    ("UX Ari", 16042, 6.47, 51.6473, 28.7154, 41.617, 0.186, -104.01, 0.20),
    ("HR 1099", 16846, 5.82, 54.1971, 0.5881, -31.588, 0.33, -161.69, 0.31),
    ("HD 283447", 19762, 10.7, 63.5538, 28.2035, 0.423, 0.291, -23.25, 0.28),
    ("HR 5110", 66257, 4.91, 203.6990, 37.1824, 85.496, 0.131, -9.22, 0.16),
    ("sigma2 CrB", 79607, 5.23, 243.6711, 33.8589, -267.048, 0.037, -86.66, 0.05),
    ("Cyg X-1", 98298, 8.84, 299.5903, 35.2016, -3.787, 0.172, -6.25, 0.21),
    ("HD 199178", 103144, 7.2, 313.4735, 44.3864, 26.595, 0.407, -1.24, 0.43),
    ("AR Lac", 109303, 6.1, 332.1702, 45.7422, -52.08, 0.126, 47.03, 0.19),
    ("IM Peg", 112997, 5.9, 343.2595, 16.8412, -20.587, 0.459, -27.53, 0.40),
)


class RadioStars(CatalogueKind):
    """`"radio-stars"`: drawn from the eleven with replacement."""

    parameters = RANDOM_SKY | {"positions"}
    extragalactic = False
    draws_several = True
    number = len(RADIO_STARS)

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return the brightest and the faintest of them."""
        v_mag = [star[2] for star in RADIO_STARS]
        return min(v_mag), max(v_mag)

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return some of the stars; one may occur more than once.  Its magnitude, motion and errors stay together."""
        drawn = self.objects(point).take(rng.integers(0, self.number, self.size(point)))
        return self.placed(drawn, point, rng)

    def objects(self, point: Point) -> Catalogue:
        """Return the stars with their proper motions and VLBI errors; no position errors are given for them."""
        v_mag, ra, dec, pmra, pmra_error, pmdec, pmdec_error = np.array([star[2:] for star in RADIO_STARS]).T
        none = np.zeros(len(v_mag))
        sigma = np.stack([none, none, pmra_error, pmdec_error], axis=1) * MAS
        return Catalogue(ra * DEGREE, dec * DEGREE, pmra * MAS, pmdec * MAS, v_mag, OwnErrors(sigma))


OBSERVABLES = ("ra", "dec", "pmra", "pmdec")
CORRELATIONS = {f"{a}_{b}_corr": (i, j) for i, a in enumerate(OBSERVABLES) for j, b in enumerate(OBSERVABLES) if i < j}
ERRORS = (*(f"{observable}_error" for observable in OBSERVABLES), *CORRELATIONS)
# What is read of a table.  Errors and correlations may be those of one side: reference_pmra_error beside
# satellite_pmra_error.
QUANTITIES = (*OBSERVABLES, "v_mag", *ERRORS, *(f"{side}_{name}" for side in SIDES for name in ERRORS))

# A table with one of these columns is Gaia's, so its pmra is known to include cos(dec).
GAIA_MARKS = frozenset({"source_id", "designation", "solution_id"})


def catalogue_from_table(
    table: Any, columns: Mapping[str, str], pmra_cos_dec: bool | None, units: Mapping[str, str] | None = None
) -> Catalogue:
    """Return the objects of a table (`linksweep.sweep.tables.columns.TableFile`); ``columns`` maps a quantity of
    `QUANTITIES` to the table's name for it.

    Positions are required; proper motions are zero where the table has none, magnitudes NaN.  Errors are read if
    both proper motions have them, or the position alone; a quantity without an error column counts as exact.  A side
    with columns of its own, like reference_pmra_error, uses only these.  ``units`` are those of quantities for which
    the table has none.  ``pmra_cos_dec`` says whether pmra includes cos(dec); None is allowed only for a table of
    Gaia's, a column pm_ra_cosdec or one in seconds of time.  Raises an error that says what is ambiguous, impossible
    or missing, with rows counted from 1.
    """
    read = table.columns(columns, units or {}, QUANTITIES)
    for name in ERRORS:
        pair = {read.name(f"{side}_{name}") for side in SIDES}
        if len(pair) == 1 and pair != {None}:
            read.problems.append(f"columns: reference_{name} and satellite_{name} are both column {pair.pop()!r}")
    moving = read.has("pmra") or read.has("pmdec")
    for quantity in OBSERVABLES if moving else OBSERVABLES[:2]:
        read.require(quantity)
    read.finish()  # columns that are not there are all named before any is read
    ra, dec = read.quantity("ra"), read.quantity("dec")
    read.check(np.abs(dec) >= 90.0, "a dec at a pole", dec)
    pmra, pmdec = np.zeros((2, len(ra)))
    if moving:
        name = read.name("pmra")
        known = read.in_time("pmra") or name == "pm_ra_cosdec" or not GAIA_MARKS.isdisjoint(read.names)
        if pmra_cos_dec is None and not known:
            read.problems.append(f"column {name!r} may or may not include cos(dec): say pmra_cos_dec = true or false")
        pmra, pmdec = read.quantity("pmra", cos_dec=pmra_cos_dec), read.quantity("pmdec")
    both, reference, satellite = (_own_errors(read, side, len(ra)) for side in ("", "reference_", "satellite_"))
    v_mag = read.quantity("v_mag") if read.has("v_mag") else np.full(len(ra), np.nan)
    read.finish()
    return Catalogue(ra * DEGREE, dec * DEGREE, pmra * MAS, pmdec * MAS, v_mag, both, reference, satellite)


def _own_errors(read: Any, prefix: str, n_obj: int) -> OwnErrors | None:
    """Return the errors in columns with a prefix, that of a side or none; None if there are none.

    A side with some of its own, but neither those of both motions nor those of the position alone, is a problem.
    """
    present = [name for name in ERRORS if read.has(prefix + name)]
    position, motions = {"ra_error", "dec_error"}, {"pmra_error", "pmdec_error"}
    if not motions.issubset(present) and (motions.intersection(present) or not position.issubset(present)):
        if prefix and present:
            needed = f"{prefix}pmra_error and {prefix}pmdec_error"
            read.problems.append(f"columns: {prefix}{present[0]} needs {needed} beside it")
        return None
    sigma, correlation = np.zeros((n_obj, 4)), np.tile(np.eye(4), (n_obj, 1, 1))
    for k, observable in enumerate(OBSERVABLES):
        if (name := f"{observable}_error") in present:
            sigma[:, k] = read.quantity(prefix + name)
    pairs = [name for name in CORRELATIONS if name in present]
    for name in pairs:
        i, j = CORRELATIONS[name]
        correlation[:, i, j] = correlation[:, j, i] = np.nan_to_num(read.quantity(prefix + name))
    if not pairs:
        return OwnErrors(sigma * MAS)
    # a matrix that is singular to rounding has no Cholesky factor, from which noise is drawn
    read.check(np.linalg.eigvalsh(correlation)[:, 0] <= 1e-9, "impossible correlations (not positive definite)")
    return OwnErrors(sigma * MAS, correlation)


class File(CatalogueKind):
    """`"file"`: the rows of a user's table between the limits, or n_obj of them at random."""

    parameters = RANDOM_SKY | {"file", "columns", "units", "pmra_cos_dec", "positions", "v_min", "v_max"}
    draws_several = True
    positions = "own"

    def available(self, point: Point) -> int:
        """Return the number of rows between the limits."""
        return len(self.objects(point))

    def magnitudes(self, point: Point) -> tuple[float, float]:
        """Return the magnitudes of the brightest and the faintest row, NaN for a table without magnitudes."""
        v_mag = self.objects(point).v_mag
        return float(np.min(v_mag)), float(np.max(v_mag))

    def draw(self, point: Point, rng: np.random.Generator) -> Catalogue:
        """Return the rows, at their own positions or at random ones."""
        return self.placed(self.objects(point).some(rng, self.size(point)), point, rng)

    def objects(self, point: Point) -> Catalogue:
        """Return the rows between the limits."""
        return _between(_key(point), point["v_min"], point["v_max"])[0]

    def row_name(self, point: Point, k: int) -> str:
        """Return the place of the k-th of these objects in the table, with its label and magnitude."""
        objects, rows = _between(_key(point), point["v_min"], point["v_max"])
        label, v_mag = point["file"].label(int(rows[k])), objects.v_mag[k]
        known = [label] * bool(label) + [f"V = {v_mag:.4g}"] * bool(np.isfinite(v_mag))
        return f"row {rows[k] + 1}" + (f" ({', '.join(known)})" if known else "")

    def problem(self, point: Point) -> str | None:
        """Return a problem unless the table is readable and has enough rows; limits need magnitudes."""
        limits = [name for name in ("v_min", "v_max") if point[name] is not None]
        if limits and np.any(np.isnan(_whole(_key(point)).v_mag)):
            return f"{limits[-1]} {NEEDS_MAGNITUDES}"
        return _too_few(point, self.available(point), "objects of the file")


def _key(point: Point) -> tuple[Any, ...]:
    return point["file"], point["columns"], point["units"], point["pmra_cos_dec"]


# Each block of a study asks for the table again: reading and cutting it would take longer than the block.
@lru_cache(maxsize=4)
def _whole(key: tuple[Any, ...]) -> Catalogue:
    """Return all objects of a table, made once in a process; a table is identified by its content."""
    table, columns, units, pmra_cos_dec = key
    return catalogue_from_table(table, dict(columns), pmra_cos_dec, dict(units))


@lru_cache(maxsize=4)
def _between(key: tuple[Any, ...], v_min: float | None, v_max: float | None) -> tuple[Catalogue, Indices]:
    """Return the objects between two limits, and their rows."""
    whole = _whole(key)
    kept = np.full(len(whole), True)  # without a limit objects without a magnitude too
    if v_min is not None:
        kept &= whole.v_mag >= v_min
    if v_max is not None:
        kept &= whole.v_mag <= v_max
    rows = np.flatnonzero(kept)
    return (whole if len(rows) == len(whole) else whole.take(rows)), rows


# The catalogues by the name that a study gives them.
CATALOGUES: Mapping[str, CatalogueKind] = {
    "synthetic": Synthetic(),
    "quasars": Quasars(),
    "galaxies": Galaxies(),
    "radio-stars": RadioStars(),
    "file": File(),
}
