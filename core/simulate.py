"""Steps A-F of the simulation for a block of realisations, in bounded memory."""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from itertools import zip_longest
from typing import Any, TypeVar, cast

import numpy as np

from linksweep.core.catalogues import Catalogue
from linksweep.core.designs import FixedDesign, NoisyDesign, Projected, Solved, fixed_designs
from linksweep.core.frames import MAS, Array, LinkError, Stack
from linksweep.core.setup import ROWS, Prefixes, Scenario, SharedSums, prepare, tiles
from linksweep.core.unknowns import ALWAYS, GLIDE, ORIENTATION, SPIN

Streams = tuple[np.random.Generator, np.random.Generator]
"""The generators of the errors of a catalogue and of the catalogue itself."""

Sums = dict[str, Array]
"""Sums over realisations by name, for the K = 6 unknowns orientation (mas) and spin (mas/yr).

``error`` (K + 3,) of estimate - truth of these and of a glide, ``error_products`` (K, K) and ``glide_squares`` (3,);
``chi2``; ``batch_mean_squares`` (K + 5,), the squares of error, chi2 and the sum of condition numbers over n_sim, and
``batches``, which is 1.  Counted once per realisation of the catalogue: the closed form's ``predicted_variance``
(K + 3,), its ``predicted_bias`` and the squares of that; of the mean square error of each unknown, and of its means
over orientation and over spin, the squares and cubes, ``predicted_powers`` (2, K + 5), and the variance of one
realisation, ``predicted_square_variance``; that of chi2, NaN where it has no closed form; the ``condition_number`` of
the normal matrix and ``n_obj``.  ``estimate`` are the realisations themselves, where they are kept: (n_sim, K), or
(n_sim, K + 3) with a glide. Errors and estimates are NaN for unknowns that no measured observable determines, or that
are not solved for; their other sums are zero. For a stack of catalogues all arrays have a leading axis.
"""


def simulate(
    scenarios: Sequence[Scenario],
    n_sim: int,
    rng: np.random.Generator,
    catalogue_rng: np.random.Generator,
    keep_estimates: bool = False,
) -> list[Sums]:
    """Draw a catalogue for each scenario, link ``n_sim`` error realisations of it and add up what came out.

    ``catalogue_rng`` decides the catalogue (step A) and the truth, ``rng`` the errors (steps C and D): all scenarios
    start from the same state of the first, and share the normals from streams spawned from the second (see
    `linksweep.core.setup`).  These are drawn once, and the sums of a scenario do not depend, to the last bit, on the
    other scenarios.  Memory does not grow with ``n_sim``, except for estimates that are kept.  Raises LinkError where a
    catalogue does not determine the link.
    """
    return _simulate(scenarios, n_sim, [(rng, catalogue_rng)], (), keep_estimates)


def simulate_stack(scenario: Scenario, n_sim: int, streams: Sequence[Streams]) -> Sums:
    """Return what `simulate` returns for a catalogue from each pair of generators ``streams``, to the last bit, from
    operations on all of them at once.

    Raises UnlikeError for catalogues that cannot be computed together (see `can_stack`), and LinkError as `simulate`;
    the generators cannot be used again then.
    """
    return _simulate([scenario], n_sim, streams, (len(streams),), False)[0]


def can_stack(scenario: Scenario, n_sim: int) -> bool:
    """Return whether catalogues of a scenario may be computed together.

    They may not where each has its own truth or draws more than normals, nor for a single realisation, because sums
    over objects would be added in another order.
    """
    return (
        scenario.draw_catalogue.takes_several
        and scenario.method == "catalogue"
        and scenario.zonal is None
        and not scenario.random_directions
        and 1 < n_sim <= ROWS
        and scenario.reference_error_ratio == scenario.satellite_error_ratio == 1.0
    )


def _simulate(
    scenarios: Sequence[Scenario], n_sim: int, streams: Sequence[Streams], stack: Stack, keep_estimates: bool
) -> list[Sums]:
    """Return the sums of each scenario, for a catalogue from one pair of streams or a stack from several pairs."""
    drawn, prefixes = _draws(scenarios, [catalogue_rng for _, catalogue_rng in streams], stack), Prefixes()
    # the largest first: what is computed for it serves the catalogues that are its beginning
    order = sorted(range(len(drawn)), key=lambda k: -len(drawn[k][0]))
    setups = [prepare(scenarios[k], *drawn[k], prefixes, stack) for k in order]
    designs = dict(zip(order, fixed_designs(setups, prefixes), strict=True))
    points = [_Point(designs[k], n_sim, keep_estimates) for k in range(len(drawn))]
    noisy = [point.path for point in points if isinstance(point.path, NoisyDesign)]
    zonal = any(scenario.zonal is not None for scenario in scenarios)
    # each side is drawn as far as its largest catalogue goes, and not at all where no point has errors on it
    satellite_objects, reference_objects = (max(counts) for counts in zip(*(p.drawn for p in points), strict=True))
    for start in range(0, n_sim, ROWS):
        rows = min(ROWS, n_sim - start)
        # a stream for each side, so that a side without errors does not change the normals of the other
        satellite_rngs, reference_rngs = zip(*(rng.spawn(2) for rng, _ in streams), strict=True)
        field_rng = satellite_rngs[0].spawn(1)[0] if zonal else satellite_rngs[0]  # which draws nothing
        shared = SharedSums()
        solved = [point.begin(rows, satellite_rngs[0], field_rng, shared) for point in points]
        for satellite, reference in zip_longest(
            tiles(satellite_rngs, stack, rows, satellite_objects), tiles(reference_rngs, stack, rows, reference_objects)
        ):
            if satellite is not None:
                shared.add(satellite)
            if reference is not None:
                for path in noisy:
                    path.add(satellite, reference)
        for point, result in zip(points, solved, strict=True):
            point.add(*result())
    return [point.sums() for point in points]


class _Point:
    """How one scenario gets its estimates, and the sums over these."""

    def __init__(self, design: FixedDesign, n_sim: int, keep_estimates: bool) -> None:
        setup = design.setup
        unknowns = len(setup.truth)
        self.setup, self.n_sim, self.design = setup, n_sim, design
        self.covariance = design.predicted_covariance() / MAS**2
        self.path: FixedDesign | NoisyDesign | Projected = design
        if setup.scenario.method == "projected":
            self.path = Projected(design)
        elif setup.reference:
            self.path = NoisyDesign(setup)
        self.error, self.chi2 = np.zeros((*setup.stack, unknowns)), np.zeros(setup.stack)
        self.products = np.zeros((*setup.stack, unknowns, unknowns))
        self.kept: list[Array] | None = [] if keep_estimates else None

    @property
    def drawn(self) -> tuple[int, int]:
        """Objects for which normals of the satellite and of the reference are drawn."""
        if isinstance(self.path, Projected):
            return 0, 0
        return self.setup.n_obj * bool(self.setup.satellite), self.setup.n_obj * bool(self.setup.reference)

    def begin(self, rows: int, rng: np.random.Generator, field_rng: np.random.Generator, shared: SharedSums) -> Solved:
        """Return what gives the solutions of ``rows`` realisations, having asked for the sums that it needs; the
        projected method draws from the beginning of the satellite's stream, zonal errors from that of their own.
        """
        if isinstance(self.path, Projected):
            drawn = _from_start(rng, partial(self.path.draw, rows))
            return lambda: drawn
        return self.path.begin(rows, _from_start(field_rng, partial(self.setup.satellite.draw_field, rows)), shared)

    def add(self, error: Array, chi2: Array) -> None:
        """Add realisations: their estimate - truth (..., K, rows), and the sum of their chi2."""
        # sums of estimate - truth, not of estimates: the truth may be a million times as large as its error
        self.error += error.sum(axis=-1)
        self.products += error @ error.swapaxes(-1, -2)
        self.chi2 += chi2
        if self.kept is not None:
            # each catalogue has its own truth where directions are random, and nothing would tell it
            truth = 0.0 if self.setup.scenario.random_directions else self.setup.truth
            self.kept.append((error.T + truth) / MAS)

    def sums(self) -> Sums:
        """Return what has been added up."""
        if not np.all(np.isfinite(self.error)):  # NaN is only for what is not determined
            raise LinkError("the solution is not finite")
        stack, n_sim, fixed = self.setup.stack, self.n_sim, self.setup.fixed
        error, products = self.error / MAS, self.products / MAS**2
        error[..., fixed] = np.nan  # they stayed at the truth, which is no result
        bias, covariance, condition = self.design.bias / MAS, self.covariance, self.design.condition_number
        variance = np.einsum("...kk->...k", covariance)
        mean_squares = variance + np.square(bias)
        # x_k^2 and x_l^2 of normal x with the mean b and the covariance V have the covariance 2 V_kl (V_kl + 2 b_k b_l)
        # (Isserlis 1918, Biometrika 12, 134)
        of_squares = 2.0 * covariance * (covariance + 2.0 * bias[..., :, None] * bias[..., None, :])
        parts = ORIENTATION, SPIN
        means = [mean_squares[..., part].sum(axis=-1) / 3 for part in parts]
        of_means = [of_squares[..., part, part].sum(axis=(-2, -1)) / 9 for part in parts]
        whole = self._whole(mean_squares, means=means)
        sums = {
            "error": self._whole(error, np.nan),
            "error_products": products[..., ALWAYS, ALWAYS],
            "glide_squares": self._whole(np.einsum("...kk->...k", products))[..., GLIDE],
            "chi2": self.chi2,
            "predicted_variance": n_sim * self._whole(variance),
            "predicted_powers": n_sim * np.stack([whole**2, whole**3], axis=-2),
            "predicted_square_variance": n_sim * self._whole(np.einsum("...kk->...k", of_squares), means=of_means),
            "predicted_bias": n_sim * self._whole(bias),
            "predicted_bias_squares": n_sim * self._whole(np.square(bias)),
            "condition_number": n_sim * condition,
            "n_obj": np.full(stack, float(n_sim * self.setup.n_obj)),
            "chi2_variance": n_sim * self.design.chi2_variance(),
            "batch_mean_squares": np.square(self._whole(error, np.nan, (self.chi2, n_sim * condition))) / n_sim,
            "batches": np.ones(stack),
        }
        if self.kept is not None:
            sums["estimate"] = np.concatenate(self.kept)
            sums["estimate"][:, fixed] = np.nan
        return sums

    def _whole(self, values: Array, missing: float = 0.0, means: Sequence[Array] = ()) -> Array:
        """Return values with something for a glide that is not solved for, and with their means."""
        glide = np.full((*self.setup.stack, GLIDE.stop - values.shape[-1]), missing)
        return np.concatenate([values, glide, *(mean[..., None] for mean in means)], axis=-1)


def _draws(
    scenarios: Sequence[Scenario], catalogue_rngs: Sequence[np.random.Generator], stack: Stack
) -> list[tuple[Catalogue, Array]]:
    """Return the catalogue and the true vectors (2, 3) of each scenario, all from the same state: directions have a
    stream of their own, so that they are the same for catalogues of any size.
    """
    if stack:  # directions are fixed
        (scenario,) = scenarios
        several: Any = Generators(catalogue_rngs)
        drawn = scenario.draw_catalogue(cast(np.random.Generator, several))
        whole = drawn.repeated(len(catalogue_rngs)) if drawn.ra.ndim == 1 else drawn
        return [(whole.flattened(), _truth(scenario, catalogue_rngs[0]))]
    (catalogue_rng,) = catalogue_rngs
    (directions,) = catalogue_rng.spawn(1)  # spawning leaves the state of the parent as it is
    largest: dict[Hashable, Catalogue] = {}
    draws = [scenario.draw_catalogue for scenario in scenarios]
    for draw in sorted(draws, key=lambda draw: -draw.n_obj):
        if draw.family not in largest:
            largest[draw.family] = _from_start(catalogue_rng, draw)
    truths = [_from_start(directions, partial(_truth, scenario)) for scenario in scenarios]
    return [(largest[draw.family].take(slice(draw.n_obj)), truth) for draw, truth in zip(draws, truths, strict=True)]


class Generators:
    """Several generators as one: the arrays that a method returns have a first axis of generators."""

    def __init__(self, generators: Sequence[np.random.Generator]) -> None:
        self._generators = generators

    def __getattr__(self, name: str) -> Callable[..., Array]:
        methods = [getattr(generator, name) for generator in self._generators]
        return lambda *arguments, **options: np.stack([method(*arguments, **options) for method in methods])


def _truth(scenario: Scenario, rng: np.random.Generator) -> Array:
    """Return the true orientation (rad) and spin (rad/yr) of one catalogue; shape (2, 3)."""
    vectors = np.array([scenario.epsilon, scenario.omega])
    for vector in vectors if scenario.random_directions else ():
        direction = rng.standard_normal(3)
        vector[:] = np.linalg.norm(vector) * direction / np.linalg.norm(direction)
    return vectors


Drawn = TypeVar("Drawn")


def _from_start(rng: np.random.Generator, draw: Callable[[np.random.Generator], Drawn]) -> Drawn:
    """Return what is drawn from the state of a generator, which is then reset, so that other points draw the same."""
    state = rng.bit_generator.state
    drawn = draw(rng)
    rng.bit_generator.state = state
    return drawn
