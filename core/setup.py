"""What realisations and points have in common: the setup of one catalogue (differences without errors, weights and the
errors of both sides), and for the points of a block arrays that begin with the same objects, and sums over these.

Common random numbers give catalogues that are nested and missions that see the same sky.  What depends on an object
alone, to the last bit, is computed for the largest catalogue, and the others use the beginning of that array: the same
memory, by which common sums are recognised.  These are added up once, tile by tile, and each catalogue takes the sum as
it stands where its objects end.
"""

import math
from bisect import insort
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from linksweep.core.catalogue import Catalogue
from linksweep.core.errors import ErrorModel
from linksweep.core.frames import Array, Stack, along, exact_differences, stored_differences
from linksweep.core.link import OBSERVABLES, UnlikeError, combined_error, measured
from linksweep.core.noise import Tile
from linksweep.core.scenario import Scenario
from linksweep.core.systematics import DrawnField, Field, ZonalErrors
from linksweep.core.unknowns import ORIENTATION, SPIN, Objects

PART = 2048
"""Objects whose products are added up at a time: it decides how the sums are rounded."""

PREPARED = 16384
"""Objects that are prepared at a time, so that intermediate arrays of 128 KiB stay near the core."""

Term = Callable[[Array, slice], Array]
"""A function that returns what unit normals (..., m, 4, rows) of the objects at a place add to a sum."""


def parts(n_obj: int, size: int = PART) -> list[slice]:
    """Return the slices of at most ``size`` objects that make up a catalogue."""
    return [slice(start, min(start + size, n_obj)) for start in range(0, n_obj, size)]


def origin(rows: Array) -> Hashable:
    """Return what contiguous arrays in use have in common only if they begin at the same place in memory."""
    return rows.__array_interface__["data"][0], rows.shape[1:]


class Prefixes:
    """Arrays over objects that have been computed for a block; ask for those of the largest catalogue first."""

    def __init__(self) -> None:
        self._known: dict[Hashable, list[tuple[tuple[Array, ...], list[Hashable], Array]]] = {}
        self._products: dict[Hashable, Array] = {}
        self._objects: dict[Hashable, list[tuple[slice, Objects]]] = {}

    def once(self, settings: Hashable, compute: Callable[..., Array], *objects: Array) -> Array:
        """Return ``compute(*objects)``, arrays whose first axis is that of the objects.

        ``settings`` identify the computation; a row of the result may only depend on them and on that row of the
        arguments.
        """
        known, origins = self._known.setdefault(settings, []), [origin(rows) for rows in objects]
        n_obj = len(objects[0])
        for larger, theirs, result in known:
            pairs = zip(origins, theirs, objects, larger, strict=True)
            if n_obj <= len(result) and all(a == b or _begin_alike(part, whole) for a, b, part, whole in pairs):
                return result[:n_obj]
        result = compute(*objects)
        known.append((objects, origins, result))
        return result

    def objects(self, ra: Array, dec: Array, pmra: Array, pmdec: Array) -> list[tuple[slice, Objects]]:
        """Return the parts of a catalogue and the objects in each, made once for all callers."""
        key = tuple((origin(column), len(column)) for column in (ra, dec, pmra, pmdec))
        if key not in self._objects:
            slices = parts(len(ra), PREPARED)
            self._objects[key] = [(part, Objects(ra[part], dec[part], pmra[part], pmdec[part])) for part in slices]
        return self._objects[key]

    def products(self, columns: Array) -> Array:
        """Return the sum over objects and observables of the products of columns (..., N, 4, C); shape (..., C, C).

        It is added up part by part, and a part is multiplied once for all columns that begin there.
        """
        *stack, n_obj, _, number = columns.shape
        total = np.zeros((*stack, number, number))
        for part in parts(n_obj):
            rows = columns[..., part, :, :]
            place = origin(rows), rows.shape
            if (product := self._products.get(place)) is None:
                flat = rows.reshape(*stack, -1, number)
                product = self._products[place] = flat.swapaxes(-1, -2) @ flat
            total += product
        return total


def _begin_alike(part: Array, whole: Array) -> bool:
    """Whether the bits of an array are those that another one begins with."""
    return np.array_equal(part.view(np.uint64), whole[: len(part)].view(np.uint64))


class SharedSums:
    """The sums of one chunk of realisations over the satellite's normals."""

    def __init__(self) -> None:
        self._terms: dict[Hashable, Term] = {}
        self._sizes: dict[Hashable, list[int]] = {}
        self._totals: dict[Hashable, Array | float] = {}
        self._sums: dict[tuple[Hashable, int], Array | float] = {}

    def ask(self, what: Hashable, n_obj: int, term: Term) -> Callable[[], Array]:
        """Ask, before the first tile, for the sum of a term over ``n_obj`` objects, and return a function that gives
        it after the last one.

        ``what`` identifies the term among those that compute something else from the same objects; the term of the
        largest catalogue serves all.
        """
        sizes = self._sizes.setdefault(what, [])
        if n_obj not in sizes:
            insort(sizes, n_obj)
        if n_obj == sizes[-1]:
            self._terms[what] = term
        return lambda: np.asarray(self._sums[what, n_obj])

    def add(self, tile: Tile) -> None:
        """Add the objects of the next tile to all."""
        end = tile.start + tile.normals.shape[-3]
        for what, sizes in self._sizes.items():
            total, term = self._totals.get(what, 0.0), self._terms[what]
            while sizes and sizes[0] < end:
                n_obj = sizes.pop(0)
                self._sums[what, n_obj] = total + term(tile.head(n_obj), slice(tile.start, n_obj))
            if sizes:
                self._totals[what] = total + term(tile.normals, slice(tile.start, end))
            if sizes and sizes[0] == end:
                self._sums[what, sizes.pop(0)] = self._totals[what]


@dataclass(frozen=True)
class Noise:
    """True errors of one side: standard errors (N, 4) and, where they are correlated, Cholesky factors (N, 4, 4).

    They are ``inflation`` times the errors in the weights.  A ``field`` has further errors, which objects share.
    """

    sigma: Array
    factor: Array | None
    inflation: float = 1.0
    field: Field | None = None

    @staticmethod
    def of(model: ErrorModel, catalogue: Catalogue, shared: Prefixes) -> "Noise":
        """Return the errors that a model gives the objects of a catalogue."""

        def compute(*_: Array) -> Array:
            return np.ascontiguousarray(model.standard_errors(catalogue).T)

        correlation = model.correlation(catalogue)
        sigma = shared.once(("errors", model), compute, catalogue.v_mag) if model.is_elementwise() else compute()
        return Noise(sigma, None if correlation is None else np.asarray(np.linalg.cholesky(correlation)))

    def inflated(self, factor: float) -> "Noise":
        """Return errors ``factor`` times as large, with the same weights."""
        if factor == 1.0 or not self._any:
            return self
        return replace(self, sigma=factor * self.sigma, inflation=factor * self.inflation)

    def with_zonal(self, errors: ZonalErrors | None, catalogue: Catalogue) -> "Noise":
        """Return these errors with zonal errors of the objects of a catalogue added."""
        return self if errors is None else replace(self, field=Field(errors, catalogue.ra, catalogue.dec))

    def __bool__(self) -> bool:
        return self.field is not None or self._any

    @cached_property
    def _any(self) -> bool:
        return bool(np.any(self.sigma))

    @property
    def as_weighed(self) -> bool:
        """Whether all errors are independent and equal to those in the weights."""
        return self.factor is None and self.field is None and self.inflation == 1.0

    @property
    def ratio(self) -> float:
        """The errors of single objects over those in the weights; 0 where only a field has errors."""
        return self.inflation if self._any else 0.0

    def draw_field(self, rows: int, rng: np.random.Generator) -> DrawnField | None:
        """Return ``rows`` realisations of the errors that objects share, or None."""
        return None if self.field is None else self.field.draw(rows, rng)

    def standardised(self, normals: Array, start: int) -> Array:
        """Return errors in units of their sigma from the unit normals (m, 4, rows) of the objects from ``start`` on."""
        return normals if self.factor is None else self.factor[start : start + len(normals)] @ normals

    def variance_through(self, gain: Array) -> Array:
        """Return the variance of each unknown from these errors; ``gain`` (N, 4, K), result (K,)."""
        scaled = self.sigma[..., None] * gain
        if self.factor is not None:
            scaled = np.swapaxes(self.factor, 1, 2) @ scaled
        variance = np.asarray(np.einsum("nik,nik->k", scaled, scaled))
        return variance if self.field is None else variance + self.field.variance_through(gain)


@dataclass(frozen=True)
class Setup:
    """What all realisations of one catalogue share, in rad and rad/yr; K unknowns, N objects.

    In a ``stack`` of catalogues the objects of one follow those of the one before, and the truth is the same for all.
    """

    scenario: Scenario
    catalogue: Catalogue
    truth: Array  # (K,)
    differences: Array  # (N, 4) without errors, reference - satellite
    reference: Noise
    satellite: Noise
    sigma: Array  # (N, 4), as the link weighs the differences
    measured: tuple[bool, bool] = (True, True)  # positions, proper motions
    stack: Stack = ()

    @property
    def n_obj(self) -> int:
        """The number of objects of one catalogue."""
        return len(self.catalogue) // math.prod(self.stack)

    def stacked(self, rows: Array) -> Array:
        """Return an array over all objects with its first axis split into catalogues and objects."""
        return rows.reshape(*self.stack, self.n_obj, *rows.shape[1:])

    @property
    def observables(self) -> slice:
        """The observables that are measured."""
        positions, motions = self.measured
        return slice(OBSERVABLES[0 if positions else 1].start, OBSERVABLES[1 if motions else 0].stop)

    @property
    def counted(self) -> Array:
        """1 for each observable that is measured, 0 for the others; shape (4,)."""
        return np.repeat(self.measured, 2).astype(float)

    @property
    def fixed(self) -> slice:
        """The unknowns that no measured observable determines, which stay at their true values."""
        positions, motions = self.measured
        return slice(SPIN.start if positions else ORIENTATION.start, SPIN.start if motions else len(self.truth))


@dataclass(frozen=True)
class Draw:
    """One catalogue and the true orientation (rad) and spin (rad/yr) that go with it: steps A and B."""

    catalogue: Catalogue
    epsilon: Array
    omega: Array
    stack: Stack = ()

    @staticmethod
    def of(scenario: Scenario, catalogue: Catalogue, direction_rng: np.random.Generator, stack: Stack = ()) -> "Draw":
        """Draw the vectors that go with a catalogue, or with all of a stack, for which they are not random."""
        return Draw(catalogue, scenario.epsilon.draw(direction_rng), scenario.omega.draw(direction_rng), stack)


def prepare(scenario: Scenario, drawn: Draw, shared: Prefixes) -> Setup:
    """Return the errors and differences of the objects; raises LinkError where these cannot be weighed, UnlikeError
    for a stack in which only some catalogues have errors, or errors are correlated.
    """
    catalogue, glide = drawn.catalogue, np.array(scenario.aberration)
    reference = Noise.of(scenario.reference_errors, catalogue, shared)
    satellite = Noise.of(scenario.satellite_errors, catalogue, shared)
    for side in (reference, satellite) if drawn.stack else ():
        if side.factor is not None:
            raise UnlikeError("the errors of an object are correlated")
        any_errors = side.sigma.reshape(*drawn.stack, -1).any(axis=-1)
        if any_errors.any() and not any_errors.all():
            raise UnlikeError("some of the catalogues have no errors")

    def combine(*sides: Array) -> Array:
        return np.ascontiguousarray(combined_error(*(side.T for side in sides)).T)

    if np.all(satellite.sigma > 0.0):  # then the result of an object depends on no other one
        sigma, kinds = shared.once("combined errors", combine, reference.sigma, satellite.sigma), (True, True)
    else:
        sigma, kinds = combine(reference.sigma, satellite.sigma), measured(reference.sigma.T + satellite.sigma.T)
    return Setup(
        scenario=scenario,
        catalogue=catalogue,
        truth=np.concatenate([drawn.epsilon, drawn.omega, *([-glide] if scenario.solve_glide else [])]),
        differences=_differences(scenario, drawn, shared),
        reference=reference.inflated(scenario.reference_error_ratio),
        satellite=satellite.inflated(scenario.satellite_error_ratio).with_zonal(scenario.zonal, catalogue),
        sigma=sigma,
        measured=kinds,
        stack=drawn.stack,
    )


def _differences(scenario: Scenario, drawn: Draw, shared: Prefixes) -> Array:
    """Return the observables reference - satellite without random errors; shape (N, 4)."""
    catalogue, vectors = drawn.catalogue, np.array([drawn.epsilon, drawn.omega, scenario.aberration])
    epsilon, omega, glide = vectors
    systematics = scenario.systematics

    def compute(ra: Array, dec: Array, pmra: Array, pmdec: Array, *v_mag: Array) -> Array:
        differences = np.empty((len(ra), 4))
        for part, here in shared.objects(ra, dec, pmra, pmdec):
            observed = here.ra, here.dec, here.pmra, here.pmdec
            if scenario.arithmetic == "exact":
                differences[part] = exact_differences(*observed, epsilon, omega, here.triad).T
            else:
                differences[part] = stored_differences(*observed, epsilon, omega).T
            if np.any(glide):
                differences[part, 2] -= along(glide, here.triad.p)  # minus: the glide is in the satellite's motions
                differences[part, 3] -= along(glide, here.triad.q)
            if systematics:
                differences[part, 2:] += systematics.differences(here.ra, here.dec, *(v[part] for v in v_mag)).T
        return differences

    settings = "differences", scenario.arithmetic, vectors.tobytes(), systematics
    # magnitudes only where they matter, so that objects that differ in nothing else are shared
    v_mag = (catalogue.v_mag,) if systematics.need_magnitudes else ()
    return shared.once(settings, compute, catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec, *v_mag)
