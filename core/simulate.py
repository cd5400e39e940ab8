"""Steps A-F of the simulation for a block of realisations, in bounded memory."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from linksweep.core.arrays import Array, Stack
from linksweep.core.catalogue import Catalogue, NestedDraw
from linksweep.core.constants import MAS
from linksweep.core.design import ALWAYS, ORIENTATION, SPIN
from linksweep.core.fixed_design import FixedDesign, FixedSums, OwnFixedSums, fixed_designs
from linksweep.core.link import LinkError
from linksweep.core.noise import ROWS, chunks, tiles
from linksweep.core.noisy_design import FullPath, FullSums
from linksweep.core.prepared import Draw, prepare
from linksweep.core.projected import Drawn, Projected
from linksweep.core.scenario import Scenario
from linksweep.core.shared_arrays import Prefixes
from linksweep.core.shared_sums import SharedSums
from linksweep.core.stacks import stacked_catalogue

Streams = tuple[np.random.Generator, np.random.Generator]
"""The generators of the errors of a catalogue and of the catalogue itself."""


@dataclass(frozen=True)
class BlockSums:
    """Sums over realisations; errors (estimate - truth) in mas and mas/yr, K = 6 unknowns or 9 with a glide.

    ``error`` (K,), ``error_products`` (K, K), ``chi2``; and, counted once per realisation of the catalogue, the closed
    form's ``predicted_variance`` (K,), the squares of its elements and of its mean over orientation and over spin, its
    ``predicted_bias`` (K,) and the squares of that, the condition number of the normal matrix and the number of
    objects.  ``estimates`` (n_sim, K) are the realisations themselves, where they are kept.  ``error`` and
    ``estimates`` are NaN for unknowns that no measured observable determines; their other sums are zero.  For a stack
    of catalogues all arrays have a leading axis.
    """

    error: Array
    error_products: Array
    chi2: Array
    predicted_variance: Array
    predicted_variance_squared: Array
    predicted_bias: Array
    predicted_bias_squares: Array
    condition_number: Array
    n_obj: Array
    estimates: Array | None = None


def simulate(
    scenarios: Sequence[Scenario],
    n_sim: int,
    rng: np.random.Generator,
    catalogue_rng: np.random.Generator,
    keep_estimates: bool = False,
) -> list[BlockSums]:
    """Draw a catalogue for each scenario, link ``n_sim`` error realisations of it and add up what came out.

    ``catalogue_rng`` decides the catalogue (step A) and the truth, ``rng`` the errors (steps C and D): all scenarios
    start from the same state of the first, and share the normals from streams spawned from the second (see
    `core.noise`).  These are drawn once, and the sums of a scenario do not depend, to the last bit, on the other
    scenarios.  Memory does not grow with ``n_sim``, except for estimates that are kept.  Raises LinkError where a
    catalogue does not determine the link.
    """
    return _simulate(scenarios, n_sim, [(rng, catalogue_rng)], (), keep_estimates)


def simulate_stack(scenario: Scenario, n_sim: int, streams: Sequence[Streams]) -> BlockSums:
    """Return what `simulate` returns for a catalogue from each pair of generators ``streams``, to the last bit, from
    operations on all of them at once.

    Raises UnlikeError for catalogues that cannot be computed together (see `can_stack`), and LinkError as `simulate`;
    the generators cannot be used again then.
    """
    (sums,) = _simulate([scenario], n_sim, streams, (len(streams),), False)
    return sums


def can_stack(scenario: Scenario, n_sim: int) -> bool:
    """Return whether catalogues of a scenario may be computed together.

    They may not where each has its own truth or draws more than normals, nor for a single realisation, because sums
    over objects would be added in another order.
    """
    draw = scenario.draw_catalogue
    return (
        isinstance(draw, NestedDraw)
        and draw.takes_several
        and scenario.method == "catalogue"
        and scenario.zonal is None
        and not scenario.random_directions
        and 1 < n_sim <= ROWS
        and scenario.reference_error_ratio == scenario.satellite_error_ratio == 1.0
    )


def _simulate(
    scenarios: Sequence[Scenario], n_sim: int, streams: Sequence[Streams], stack: Stack, keep_estimates: bool
) -> list[BlockSums]:
    """Return the sums of each scenario, for a catalogue from one pair of streams or a stack from several pairs."""
    points = _points(scenarios, n_sim, [catalogue_rng for _, catalogue_rng in streams], stack, keep_estimates)
    zonal = any(scenario.zonal is not None for scenario in scenarios)
    satellite_objects, reference_objects = (max(counts) for counts in zip(*(p.drawn for p in points), strict=True))
    for rows in chunks(n_sim):
        satellite_rngs, reference_rngs = zip(*(rng.spawn(2) for rng, _ in streams), strict=True)
        field_rng = satellite_rngs[0].spawn(1)[0] if zonal else satellite_rngs[0]  # which draws nothing
        shared = SharedSums()
        begun = [point.begin(rows, satellite_rngs[0], field_rng, shared) for point in points]
        others = [sums for sums in begun if isinstance(sums, OwnFixedSums | FullSums)]
        for satellite, reference in zip_longest(
            tiles(satellite_rngs, stack, rows, satellite_objects), tiles(reference_rngs, stack, rows, reference_objects)
        ):
            if satellite is not None:
                shared.add(satellite)
            for own in others:
                own.add(satellite, reference)
        for point, sums in zip(points, begun, strict=True):
            point.add(*sums.solved())
    return [point.sums() for point in points]


class _Point:
    """How one scenario gets its estimates, and the sums over these."""

    def __init__(self, design: FixedDesign, n_sim: int, keep_estimates: bool) -> None:
        setup = design.setup
        unknowns = len(setup.truth)
        self.setup, self.n_sim = setup, n_sim
        self.predicted, self.bias = design.predicted_variance() / MAS**2, design.bias / MAS
        self.condition_number = design.condition_number
        self.path = _path(design)
        self.error, self.chi2 = np.zeros((*setup.stack, unknowns)), np.zeros(setup.stack)
        self.products = np.zeros((*setup.stack, unknowns, unknowns))
        self.kept: list[Array] | None = [] if keep_estimates else None

    @property
    def drawn(self) -> tuple[int, int]:
        """Objects for which normals of the satellite and of the reference are drawn."""
        n_obj, setup = self.setup.n_obj, self.setup
        projected = isinstance(self.path, Projected)
        return (
            n_obj if setup.satellite and not projected else 0,
            n_obj if setup.reference and not projected else 0,
        )

    def begin(
        self, rows: int, rng: np.random.Generator, field_rng: np.random.Generator, shared: SharedSums
    ) -> FixedSums | OwnFixedSums | FullSums | Drawn:
        """Return sums of ``rows`` realisations, having asked for those that points share; the projected method draws
        from the beginning of the satellite's stream, zonal errors from that of their own, and both are reset for other
        points.
        """
        path = self.path
        if isinstance(path, Projected):
            state = rng.bit_generator.state
            drawn = path.draw(rows, rng)
            rng.bit_generator.state = state
            return drawn
        state = field_rng.bit_generator.state
        field = self.setup.satellite.draw_field(rows, field_rng)
        field_rng.bit_generator.state = state
        return path.begin(rows, field) if isinstance(path, FullPath) else path.begin(rows, field, shared)

    def add(self, error: Array, chi2: Array) -> None:
        """Add realisations: their estimate - truth (..., K, rows), and the sum of their chi2."""
        self.error += error.sum(axis=-1)
        self.products += error @ error.swapaxes(-1, -2)
        self.chi2 += chi2
        if self.kept is not None:
            self.kept.append((error.T + self.setup.truth) / MAS)

    def sums(self) -> BlockSums:
        """Return what has been added up."""
        held = self.setup.held
        if not np.all(np.isfinite(self.error)):  # NaN is only for what is held
            raise LinkError("the solution is not finite")
        error, estimates = self.error / MAS, None if self.kept is None else np.concatenate(self.kept)
        error[..., held] = np.nan
        if estimates is not None:
            estimates[:, held] = np.nan
        both = self.predicted[..., ALWAYS].reshape(*self.setup.stack, len((ORIENTATION, SPIN)), -1)  # as many of each
        means = both.sum(axis=-1) / both.shape[-1]
        return BlockSums(
            error=error,
            error_products=self.products / MAS**2,
            chi2=self.chi2,
            predicted_variance=self.n_sim * self.predicted,
            predicted_variance_squared=self.n_sim * np.square(np.concatenate([self.predicted, means], axis=-1)),
            predicted_bias=self.n_sim * self.bias,
            predicted_bias_squares=self.n_sim * np.square(self.bias),
            condition_number=self.n_sim * self.condition_number,
            n_obj=np.full(self.setup.stack, float(self.n_sim * self.setup.n_obj)),
            estimates=estimates,
        )


def _path(design: FixedDesign) -> FixedDesign | FullPath | Projected:
    if design.setup.scenario.method == "projected":
        return Projected(design)
    return FullPath(design.setup) if design.setup.reference else design


def _points(
    scenarios: Sequence[Scenario],
    n_sim: int,
    catalogue_rngs: Sequence[np.random.Generator],
    stack: Stack,
    keep_estimates: bool,
) -> list[_Point]:
    """Return the scenarios, of which the largest is prepared first, since the others may be the beginning of it."""
    drawn, shared = _draws(scenarios, catalogue_rngs, stack), Prefixes()
    order = sorted(range(len(drawn)), key=lambda k: -len(drawn[k].catalogue))
    setups = [prepare(scenarios[k], drawn[k], shared) for k in order]
    designs = dict(zip(order, fixed_designs(setups, shared), strict=True))
    return [_Point(designs[k], n_sim, keep_estimates) for k in range(len(drawn))]


def _draws(scenarios: Sequence[Scenario], catalogue_rngs: Sequence[np.random.Generator], stack: Stack) -> list[Draw]:
    """Return what each scenario draws, all from the same state: directions have a stream of their own, so that they are
    the same for catalogues of any size.
    """
    if stack:
        (scenario,) = scenarios
        catalogue = stacked_catalogue(scenario.draw_catalogue, catalogue_rngs)
        return [Draw.of(scenario, catalogue, catalogue_rngs[0], stack)]  # fixed directions: nothing is drawn
    (catalogue_rng,) = catalogue_rngs
    objects, (directions,) = catalogue_rng.bit_generator.state, catalogue_rng.spawn(1)
    start = directions.bit_generator.state
    draws = [scenario.draw_catalogue for scenario in scenarios]
    nests = [(d.family, d.n_obj) if isinstance(d, NestedDraw) else (k, None) for k, d in enumerate(draws)]
    largest: dict[Hashable, Catalogue] = {}
    drawn: dict[int, Draw] = {}
    for k in sorted(range(len(draws)), key=lambda k: -(nests[k][1] or 0)):  # a family's largest first
        family, n_obj = nests[k]
        if family not in largest:
            catalogue_rng.bit_generator.state = objects
            largest[family] = draws[k](catalogue_rng)
        directions.bit_generator.state = start
        drawn[k] = Draw.of(scenarios[k], largest[family].take(slice(n_obj)), directions)
    return [drawn[k] for k in range(len(draws))]
