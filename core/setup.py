"""The physics of a point, from its parameters: catalogue, errors, truth and solution, and the errors to be expected
before any catalogue is drawn.

And what realisations and points have in common: the setup of one catalogue (differences without errors, weights and the
errors of both sides), and for the points of a block arrays that begin with the same objects, and sums over these.

Common random numbers give catalogues that are nested and missions that see the same sky.  What depends on an object
alone, to the last bit, is computed for the largest catalogue, and the others use the beginning of that array: the same
memory, by which common sums are recognised.  These are added up once, tile by tile, and each catalogue takes the sum as
it stands where its objects end.

Unit normals come in the order that every link draws them: realisations in chunks of `ROWS`, each with a stream of its
own for the satellite and one for the reference.  A stream runs through the objects: 4 observables of object 0 in all
realisations of the chunk, then object 1.  So what object i gets depends neither on how many objects follow nor on what
the other side or another point needs.
"""

import math
from bisect import insort
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from linksweep.core import frames
from linksweep.core.catalogues import CATALOGUES, Catalogue, CatalogueKind, NestedDraw
from linksweep.core.errors import ErrorModel, error_models
from linksweep.core.fields import Field, Pattern, Systematics, Vector, ZonalErrors, parse_pattern, rms
from linksweep.core.frames import DEGREE, GALACTIC_AXES, MAS, OBSERVABLES, Array, LinkError, Stack, Weighting, along
from linksweep.core.unknowns import ORIENTATION, SPIN, Objects
from linksweep.sweep.contract import Point

# Glide towards the Galactic centre.  Source: Kovalevsky 2003, as quoted by Metz & Geffert 2004, Sect. 5.1; Gaia EDR3
# has since measured 5.05.
GALACTIC_GLIDE_UAS_YR = 4.0


@dataclass(frozen=True)
class Scenario:
    """One point's physics: how a catalogue is drawn, its errors, the truth (rad, rad/yr) and how the link is solved.

    With ``random_directions`` each catalogue has a truth of its own, of the length of ``epsilon`` and ``omega``.
    ``aberration`` is a glide (rad/yr) added to the satellite's proper motions; ``solve_glide`` adds it to the unknowns.
    ``method`` says whether the errors of every object are drawn or their effect on the link.  The true errors of a side
    are its ``error_ratio`` times those of its model, which give the weights; ``zonal`` are further errors of the
    satellite, and ``systematics`` are errors of proper motions that are the same in all realisations.
    """

    draw_catalogue: NestedDraw
    reference_errors: ErrorModel
    satellite_errors: ErrorModel
    epsilon: Vector
    omega: Vector
    random_directions: bool = False
    aberration: Vector = (0.0, 0.0, 0.0)
    solve_glide: bool = False
    corrections: bool = True
    weighting: Weighting = "inverse-variance"
    arithmetic: Literal["exact", "stored"] = "exact"
    method: Literal["catalogue", "projected"] = "catalogue"
    reference_error_ratio: float = 1.0
    satellite_error_ratio: float = 1.0
    zonal: ZonalErrors | None = None
    systematics: Systematics = field(default_factory=Systematics)


def scenario(point: Point) -> Scenario:
    """Return the physics of a point (its parameters by name, in the units of `PARAMETERS`)."""
    same = (
        *("solve_glide", "corrections", "weighting", "arithmetic", "method"),
        *("reference_error_ratio", "satellite_error_ratio"),
    )
    glide = point["glide"]
    reference_errors, satellite_errors = error_models(point)
    glide_rad = frames.MICROARCSEC * (GALACTIC_GLIDE_UAS_YR * GALACTIC_AXES[0] if glide is None else np.array(glide))
    return Scenario(
        draw_catalogue=catalogue_kind(point).nested_draw(point),
        reference_errors=reference_errors,
        satellite_errors=satellite_errors,
        epsilon=_radians(point, "epsilon"),
        omega=_radians(point, "omega"),
        random_directions=point["directions"] == "random",
        aberration=tuple(glide_rad.tolist()) if point["aberration"] else (0.0, 0.0, 0.0),
        zonal=zonal_errors(point),
        systematics=systematics(point),
        **{name: point[name] for name in same},
    )


def zonal_errors(point: Point) -> ZonalErrors | None:
    """Return the zonal errors of the satellite at a point, or None."""
    position, motion = point["zonal_pos"], point["zonal_pm"]
    # before zonal_length is read, which does not matter then: the platform asks again only where what was read differs
    if not position and not motion:
        return None
    return ZonalErrors(position * MAS, motion * MAS, point["zonal_length"] * DEGREE)


def systematics(point: Point) -> Systematics:
    """Return the systematic errors of the proper motions at a point; raises ValueError for an invalid motion_field."""
    pattern: Pattern = ()
    if (text := point["motion_field"]) is not None:
        pattern, size = parse_pattern(text), point["motion_field_size"]
        scale = MAS if size is None else MAS * size / rms(pattern)
        pattern = tuple((term, coefficient * scale) for term, coefficient in pattern)
    return Systematics(
        omega_slope=_radians(point, "omega_slope"),
        magnitude_equation=(point["magnitude_equation_pmra"] * MAS, point["magnitude_equation_pmdec"] * MAS),
        v_zero=point["v_zero"],
        pattern=pattern,
    )


def catalogue_kind(point: Point) -> CatalogueKind:
    """Return the kind of a point's catalogue."""
    return CATALOGUES[point["catalogue"]]


def expected_errors(point: Point, models: Sequence[ErrorModel]) -> Array:
    """Return the errors (mas, mas/yr) of the reference and the satellite before a catalogue is drawn, shape (2, N, 4):
    those of the objects that it lists, or of a single one at the faint limit of a catalogue that follows a law.
    """
    kind = catalogue_kind(point)
    if (objects := kind.objects(point)) is None:
        limits = [model.at_limit(point, kind) for model in models]
        return np.array([[(position, position, motion, motion)] for position, motion in limits])
    with np.errstate(over="ignore"):  # far beyond its range a curve is infinite, which is refused later
        return np.stack([model.standard_errors(objects) for model in models]) / MAS


def _radians(point: Point, name: str) -> Vector:
    """Return a vector of a point, of the length that its parameter NAME_size sets, if it does."""
    size, vector = point[f"{name}_size"], np.array(point[name])
    if size is not None:
        scaled = vector * MAS
        length = np.linalg.norm(scaled)
        # a direction of zeros may be one that is random
        vector = scaled / length * size if length > 0.0 else np.array([size, 0.0, 0.0])
    x, y, z = (vector * MAS).tolist()
    return x, y, z


# ---- what realisations and points have in common

# Realisations drawn at a time.
ROWS = 512

# Normals drawn at a time: 512 KiB stay in a core's own cache.
TILE = 65536

# Objects whose products are added up at a time: it decides how the sums are rounded.
PART = 2048

# Objects that are prepared at a time, so that intermediate arrays of 128 KiB stay near the core.
PREPARED = 16384


class Tile(NamedTuple):
    """Unit normals (..., objects, 4, rows) of one side, for the objects from ``start`` on; for a stack of catalogues
    the first axis is that of the catalogues.
    """

    start: int
    normals: Array

    def head(self, n_obj: int) -> Array:
        """Return the part that belongs to a catalogue of ``n_obj`` objects."""
        return self.normals[..., : max(0, n_obj - self.start), :, :]


def tiles(rngs: Sequence[np.random.Generator], stack: Stack, rows: int, n_obj: int) -> Iterator[Tile]:
    """Yield the unit normals of ``n_obj`` objects of the catalogues of a stack, from a generator of each; a tile is
    valid until the next one.
    """
    objects = max(1, TILE // (4 * rows))  # from the rows alone, so that other points do not change the tiles
    # full size even for few objects: where an array begins in memory must not depend on the points that share it
    buffer = np.empty((*stack, min(objects, n_obj) if stack else objects, 4, rows))
    for start in range(0, n_obj, objects):
        part = buffer[..., : n_obj - start, :, :]
        for rng, normals in zip(rngs, part if stack else [part], strict=True):
            rng.standard_normal(out=normals)
        yield Tile(start, part)


def parts(n_obj: int, size: int = PART) -> list[slice]:
    """Return the slices of at most ``size`` objects that make up a catalogue."""
    return [slice(start, min(start + size, n_obj)) for start in range(0, n_obj, size)]


def origin(rows: Array) -> Hashable:
    """Return what contiguous arrays in use have in common only if they begin at the same place in memory."""
    return rows.__array_interface__["data"][0], rows.shape[1:]


class Prefixes:
    """Arrays over objects that have been computed for a block; ask for those of the largest catalogue first."""

    def __init__(self) -> None:
        self._known: dict[Hashable, list[tuple[tuple[Array, ...], Array]]] = {}
        self._products: dict[Hashable, Array] = {}
        self._objects: dict[Hashable, list[tuple[slice, Objects]]] = {}

    def once(self, settings: Hashable, compute: Callable[..., Array], *objects: Array) -> Array:
        """Return ``compute(*objects)``, arrays whose first axis is that of the objects.

        ``settings`` identify the computation; a row of the result may only depend on them and on that row of the
        arguments.
        """
        # the largest catalogue comes first, so a later one is at most the beginning of a result that is there
        known, n_obj = self._known.setdefault(settings, []), len(objects[0])
        for larger, result in known:
            if n_obj <= len(result) and all(map(_begins, larger, objects)):
                return result[:n_obj]
        result = compute(*objects)
        known.append((objects, result))
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
        total, beginning = np.zeros((*stack, number, number)), origin(columns)
        # parts of fixed size: the sum of a catalogue rounds as that of a larger one that begins with it
        for part in parts(n_obj):
            place = beginning, part.start, part.stop
            if (product := self._products.get(place)) is None:
                flat = columns[..., part, :, :].reshape(*stack, -1, number)
                product = self._products[place] = flat.swapaxes(-1, -2) @ flat
            total += product
        return total


def _begins(whole: Array, part: Array) -> bool:
    """Whether an array begins with another one, to the last bit: in most cases it is the same memory."""
    return origin(whole) == origin(part) or np.array_equal(part.view(np.uint64), whole[: len(part)].view(np.uint64))


# A function that returns what unit normals (..., m, 4, rows) of the objects at a place add to a sum.
Term = Callable[[Array, slice], Array]


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
        if n_obj == sizes[-1]:  # the term of a smaller catalogue would end too early for this one
            self._terms[what] = term
        return lambda: np.asarray(self._sums[what, n_obj])

    def add(self, tile: Tile) -> None:
        """Add the objects of the next tile to all."""
        end = tile.start + tile.normals.shape[-3]
        for what, sizes in self._sizes.items():
            total, term = self._totals.get(what, 0.0), self._terms[what]
            while sizes and sizes[0] < end:  # catalogues that end inside the tile take what is there of it
                n_obj = sizes.pop(0)
                self._sums[what, n_obj] = total + term(tile.head(n_obj), slice(tile.start, n_obj))
            if sizes:
                self._totals[what] = total + term(tile.normals, slice(tile.start, end))
            if sizes and sizes[0] == end:
                self._sums[what, sizes.pop(0)] = self._totals[what]


@dataclass(frozen=True)
class Noise:
    """True errors of one side: ``inflation`` times standard errors (N, 4), those of the weights; where they are
    correlated with Cholesky factors (N, 4, 4).  A ``field`` has further errors, which objects share.
    """

    stated: Array
    factor: Array | None
    inflation: float = 1.0
    field: Field | None = None

    @cached_property
    def is_drawn(self) -> bool:
        """Whether objects have errors of their own."""
        return bool(np.any(self.stated))

    def __bool__(self) -> bool:
        return self.field is not None or self.is_drawn

    @cached_property
    def sigma(self) -> Array:
        """The true standard errors; shape (N, 4)."""
        return self.stated if self.inflation == 1.0 else self.inflation * self.stated

    @property
    def as_weighed(self) -> bool:
        """Whether all errors are independent and equal to those in the weights."""
        return self.factor is None and self.field is None and (self.inflation == 1.0 or not self.is_drawn)

    def standardised(self, normals: Array, start: int) -> Array:
        """Return errors in units of their sigma from the unit normals (m, 4, rows) of the objects from ``start`` on."""
        return normals if self.factor is None else self.factor[start : start + len(normals)] @ normals

    def covariance_through(self, gain: Array) -> Array:
        """Return the covariance of the unknowns from these errors; ``gain`` (N, 4, K), result (K, K)."""
        scaled = self.sigma[..., None] * gain  # L^T D g: its square is g^T D R D g
        if self.factor is not None:
            scaled = np.swapaxes(self.factor, 1, 2) @ scaled
        covariance = np.asarray(np.einsum("nik,nil->kl", scaled, scaled))
        return covariance if self.field is None else covariance + self.field.covariance_through(gain)


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
    def drawn(self) -> tuple[int, int]:
        """Objects for which normals of the satellite and of the reference are drawn."""
        drawn = self.scenario.method != "projected"
        return self.n_obj * (drawn and bool(self.satellite)), self.n_obj * (drawn and bool(self.reference))

    @property
    def optimal(self) -> bool:
        """Whether the weights are those of the errors, so that the gain follows from the design."""
        return self.scenario.weighting == "inverse-variance"

    @property
    def counted(self) -> Array:
        """1 for each observable that is measured, 0 for the others; shape (4,)."""
        return np.repeat(self.measured, 2).astype(float)

    @property
    def fixed(self) -> slice:
        """The unknowns that no measured observable determines, which stay at their true values."""
        positions, motions = self.measured
        return slice(SPIN.start if positions else ORIENTATION.start, SPIN.start if motions else len(self.truth))


def prepare(scenario: Scenario, catalogue: Catalogue, vectors: Array, shared: Prefixes, stack: Stack = ()) -> Setup:
    """Return the errors and differences of the objects of a catalogue; ``vectors`` (2, 3) are its true orientation
    (rad) and spin (rad/yr).

    Raises LinkError where they cannot be weighed, and for a stack in which only some catalogues have errors, or errors
    are correlated.
    """
    reference, satellite = (_noise(scenario, side, catalogue, shared) for side in ("reference", "satellite"))
    for side in (reference, satellite) if stack else ():
        if side.factor is not None:
            raise LinkError("the errors of an object are correlated")
        have_errors = np.any(side.stated.reshape(*stack, -1), axis=-1)
        if np.any(have_errors) != np.all(have_errors):
            raise LinkError("some of the catalogues have no errors")
    stated = reference.stated, satellite.stated
    by_object = bool(np.all(satellite.stated > 0.0))  # then the result of an object depends on no other one
    if by_object:
        sigma, kinds = shared.once("combined errors", frames.combined_error, *stated), (True, True)
    else:
        sigma, kinds = frames.combined_error(*stated), frames.measured(np.add(*stated))
    glide = [-np.array(scenario.aberration)] if scenario.solve_glide else []
    truth, differences = np.concatenate([*vectors, *glide]), _differences(scenario, catalogue, vectors, shared)
    return Setup(scenario, catalogue, truth, differences, reference, satellite, sigma, kinds, stack)


def _noise(scenario: Scenario, side: str, catalogue: Catalogue, shared: Prefixes) -> Noise:
    """Return the true errors of one side of the objects of a catalogue."""
    is_satellite = side == "satellite"
    model = scenario.satellite_errors if is_satellite else scenario.reference_errors

    def compute(*_: Array) -> Array:
        return model.standard_errors(catalogue)

    correlation = model.correlation(catalogue)
    field = Field(scenario.zonal, catalogue.ra, catalogue.dec) if is_satellite and scenario.zonal is not None else None
    return Noise(
        stated=shared.once(("errors", model), compute, catalogue.v_mag) if model.is_elementwise else compute(),
        factor=None if correlation is None else np.asarray(np.linalg.cholesky(correlation)),
        inflation=scenario.satellite_error_ratio if is_satellite else scenario.reference_error_ratio,
        field=field,
    )


def _differences(scenario: Scenario, catalogue: Catalogue, vectors: Array, shared: Prefixes) -> Array:
    """Return the observables reference - satellite without random errors; shape (N, 4)."""
    (epsilon, omega), glide, systematics = vectors, np.array(scenario.aberration), scenario.systematics

    def compute(ra: Array, dec: Array, pmra: Array, pmdec: Array, *v_mag: Array) -> Array:
        differences = np.empty((len(ra), 4))
        for part, here in shared.objects(ra, dec, pmra, pmdec):
            observed = here.ra, here.dec, here.pmra, here.pmdec
            if scenario.arithmetic == "exact":
                differences[part] = frames.exact_differences(*observed, epsilon, omega, here.triad).T
            else:
                differences[part] = frames.stored_differences(*observed, epsilon, omega).T
            if np.any(glide):
                differences[part, 2] -= along(glide, here.triad.p)  # minus: the glide is in the satellite's motions
                differences[part, 3] -= along(glide, here.triad.q)
            if systematics:
                differences[part, 2:] += systematics.differences(here.ra, here.dec, *(v[part] for v in v_mag)).T
        return differences

    settings = "differences", scenario.arithmetic, vectors.tobytes(), scenario.aberration, systematics
    # magnitudes only where they matter, so that objects that differ in nothing else are shared
    v_mag = (catalogue.v_mag,) if systematics.need_magnitudes else ()
    return shared.once(settings, compute, catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec, *v_mag)
