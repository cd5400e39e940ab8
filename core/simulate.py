"""Steps A-F of the simulation for a block of realisations, in bounded memory."""

from collections.abc import Callable, Hashable, Iterator, Sequence
from functools import partial
from itertools import chain, zip_longest
from typing import Any, TypeVar, cast

import numpy as np

from linksweep.core.catalogues import Catalogue
from linksweep.core.designs import FixedDesign, NoisyDesign, Projected, Solved, fixed_designs
from linksweep.core.frames import MAS, Array, LinkError, Stack
from linksweep.core.setup import ROWS, Prefixes, Scenario, Setup, SharedSums, prepare, tiles
from linksweep.core.unknowns import ALWAYS, GLIDE, ORIENTATION, SPIN

# The generators of the errors of a catalogue and of the catalogue itself.
Streams = tuple[np.random.Generator, np.random.Generator]

# Sums over realisations by name, for the K = 6 unknowns orientation (mas) and spin (mas/yr).
#
# ``error`` (K + 3,) of estimate - truth of these and of a glide, ``error_products`` (K, K) and ``glide_squares`` (3,);
# ``chi2``; ``batch_mean_squares`` (K + 5,), the squares of error, chi2 and the sum of condition numbers over n_sim, and
# ``batches``, which is 1.  Counted once per realisation of the catalogue: the closed form's ``predicted_variance``
# (K + 3,), its ``predicted_bias`` and the squares of that; of the mean square error of each unknown, and of its means
# over orientation and over spin, the squares and cubes, ``predicted_powers`` (2, K + 5), and the variance of one
# realisation, ``predicted_square_variance``; that of chi2, NaN where it has no closed form; the ``condition_number`` of
# the normal matrix and ``n_obj``.  ``estimate`` are the realisations themselves, where they are kept: (n_sim, K), or
# (n_sim, K + 3) with a glide. Errors and estimates are NaN for unknowns that no measured observable determines, or that
# are not solved for; their other sums are zero. For a stack of catalogues all arrays have a leading axis.
Sums = dict[str, Array]


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


def simulate(
    scenarios: Sequence[Scenario],
    n_sim: int,
    streams: Sequence[Streams],
    stack: Stack = (),
    keep_estimates: bool = False,
) -> list[Sums]:
    """Draw a catalogue for each scenario, link ``n_sim`` error realisations of it and add up what came out.

    A pair of generators, ``streams``, decides the errors (steps C and D), the catalogue (step A) and the truth: all
    scenarios start from the same state of the generator of the catalogue, and share the normals from streams spawned
    from that of the errors (see `linksweep.core.setup`).  These are drawn once, and the sums of a scenario do not
    depend, to the last bit, on the other scenarios.  With a ``stack``, (number of pairs,), one scenario has a catalogue
    from each pair, from operations on all of them at once and with the bits of each alone; the generators cannot be
    used again after an error.  Memory does not grow with ``n_sim``, except for estimates that are kept.  Raises
    LinkError where a catalogue does not determine the link, or where several cannot be computed together (see
    `can_stack`).
    """
    drawn, prefixes = _draws(scenarios, [catalogue_rng for _, catalogue_rng in streams], stack), Prefixes()
    # the largest first: what is computed for it serves the catalogues that are its beginning
    order = sorted(range(len(drawn)), key=lambda k: -len(drawn[k][0]))
    setups = {k: prepare(scenarios[k], *drawn[k], prefixes, stack) for k in order}
    alike: dict[Hashable, list[int]] = {}
    for k, one in setups.items():
        kind = len(one.truth), one.scenario.weighting, one.scenario.method, one.measured, bool(one.reference)
        alike.setdefault(kind, []).append(k)
    groups = [_Group([setups[k] for k in some], prefixes, n_sim, keep_estimates) for some in alike.values()]
    noisy = [path for group in groups for path in group.paths if isinstance(path, NoisyDesign)]
    zonal = any(scenario.zonal is not None for scenario in scenarios)
    # each side is drawn as far as its largest catalogue goes, and not at all where no point has errors on it
    satellite_objects, reference_objects = map(max, zip(*(setup.drawn for setup in setups.values()), strict=True))
    for start in range(0, n_sim, ROWS):
        rows = min(ROWS, n_sim - start)
        # a stream for each side, so that a side without errors does not change the normals of the other
        satellite_rngs, reference_rngs = zip(*(rng.spawn(2) for rng, _ in streams), strict=True)
        field_rng = satellite_rngs[0].spawn(1)[0] if zonal else satellite_rngs[0]  # which draws nothing
        shared = SharedSums()
        solved = [[_begun(path, rows, satellite_rngs[0], field_rng, shared) for path in g.paths] for g in groups]
        for satellite, reference in zip_longest(
            tiles(satellite_rngs, stack, rows, satellite_objects), tiles(reference_rngs, stack, rows, reference_objects)
        ):
            if satellite is not None:
                shared.add(satellite)
            if reference is not None:
                for path in noisy:
                    path.add(satellite, reference)
        for group, results in zip(groups, solved, strict=True):
            group.add([result() for result in results])
    sums = dict(zip(chain(*alike.values()), chain(*(group.sums() for group in groups)), strict=True))
    return [sums[k] for k in range(len(scenarios))]


Path = FixedDesign | NoisyDesign | Projected


def _begun(
    path: Path, rows: int, rng: np.random.Generator, field_rng: np.random.Generator, shared: SharedSums
) -> Solved:
    """Return what gives the solutions of ``rows`` realisations, having asked for the sums that it needs; the projected
    method draws from the beginning of the satellite's stream, zonal errors from that of their own.
    """
    if isinstance(path, Projected):
        drawn = _from_start(rng, partial(path.draw, rows))
        return lambda: drawn
    field = path.setup.satellite.field
    return path.begin(rows, None if field is None else _from_start(field_rng, partial(field.draw, rows)), shared)


class _Group:
    """How points that are alike get their estimates, and the sums over these: arrays have a first axis of points."""

    def __init__(self, setups: Sequence[Setup], shared: Prefixes, n_sim: int, keep_estimates: bool) -> None:
        designs, self.matrices = fixed_designs(setups, shared)
        self.setups, self.n_sim, self.shape = setups, n_sim, self.matrices.condition_number.shape
        self.covariance = np.stack([design.predicted_covariance() for design in designs]) / MAS**2
        self.chi2_variance = np.stack([design.chi2_variance() for design in designs])
        self.paths: Sequence[Path] = designs
        if setups[0].scenario.method == "projected":
            self.paths = [Projected(design) for design in designs]
        elif setups[0].reference:
            self.paths = [NoisyDesign(setup) for setup in setups]
        self.error, self.chi2 = np.zeros_like(self.matrices.bias), np.zeros(self.shape)
        self.products = np.zeros_like(self.covariance)
        self.kept: list[Array] | None = [] if keep_estimates else None

    def add(self, results: Sequence[tuple[Array, Array]]) -> None:
        """Add what the paths of all points return of some realisations."""
        products, squares = (np.stack(each) for each in zip(*results, strict=True))
        is_noisy = isinstance(self.paths[0], NoisyDesign)
        error, chi2 = (products, squares) if is_noisy else self.matrices.solved(products, squares)
        # sums of estimate - truth, not of estimates: the truth may be a million times as large as its error
        self.error += error.sum(axis=-1)
        self.products += error @ error.swapaxes(-1, -2)
        self.chi2 += chi2
        if self.kept is not None:
            # each catalogue has its own truth where directions are random, and nothing would tell it
            truths = [np.zeros_like(one.truth) if one.scenario.random_directions else one.truth for one in self.setups]
            self.kept.append((error.swapaxes(-1, -2) + np.stack(truths)[:, None]) / MAS)

    def sums(self) -> Iterator[Sums]:
        """Yield what has been added up of each point."""
        if not np.all(np.isfinite(self.error)):  # NaN is only for what is not determined
            raise LinkError("the solution is not finite")
        n_sim, fixed = self.n_sim, self.setups[0].fixed
        error, products = self.error / MAS, self.products / MAS**2
        error[..., fixed] = np.nan  # they stayed at the truth, which is no result
        bias, covariance, condition = self.matrices.bias / MAS, self.covariance, self.matrices.condition_number
        variance = np.einsum("...kk->...k", covariance)
        mean_squares = variance + np.square(bias)
        # x_k^2 and x_l^2 of normal x with the mean b and the covariance V have the covariance 2 V_kl (V_kl + 2 b_k b_l)
        # (Isserlis 1918, Biometrika 12, 134)
        of_squares = 2.0 * covariance * (covariance + 2.0 * bias[..., :, None] * bias[..., None, :])
        parts = ORIENTATION, SPIN
        means = [mean_squares[..., part].sum(axis=-1) / 3 for part in parts]
        of_means = [of_squares[..., part, part].sum(axis=(-2, -1)) / 9 for part in parts]
        whole = _whole(mean_squares, means=means)
        sums = {
            "error": _whole(error, np.nan),
            "error_products": products[..., ALWAYS, ALWAYS],
            "glide_squares": _whole(np.einsum("...kk->...k", products))[..., GLIDE],
            "chi2": self.chi2,
            "predicted_variance": n_sim * _whole(variance),
            "predicted_powers": n_sim * np.stack([whole**2, whole**3], axis=-2),
            "predicted_square_variance": n_sim * _whole(np.einsum("...kk->...k", of_squares), means=of_means),
            "predicted_bias": n_sim * _whole(bias),
            "predicted_bias_squares": n_sim * _whole(np.square(bias)),
            "condition_number": n_sim * condition,
            "n_obj": np.stack([np.full(one.stack, float(n_sim * one.n_obj)) for one in self.setups]),
            "chi2_variance": n_sim * self.chi2_variance,
            "batch_mean_squares": np.square(_whole(error, np.nan, (self.chi2, n_sim * condition))) / n_sim,
            "batches": np.ones(self.shape),
        }
        if self.kept is not None:
            sums["estimate"] = np.concatenate(self.kept, axis=1)
            sums["estimate"][..., fixed] = np.nan
        for k in range(len(self.setups)):
            yield {name: values[k] for name, values in sums.items()}


def _whole(values: Array, missing: float = 0.0, means: Sequence[Array] = ()) -> Array:
    """Return values with something for a glide that is not solved for, and with their means."""
    glide = np.full((*values.shape[:-1], GLIDE.stop - values.shape[-1]), missing)
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
        drawn = scenario.draw_catalogue.draw(cast(np.random.Generator, several))
        whole = drawn.repeated(len(catalogue_rngs)) if drawn.ra.ndim == 1 else drawn
        return [(whole.flattened(), _truth(scenario, catalogue_rngs[0]))]
    (catalogue_rng,) = catalogue_rngs
    (directions,) = catalogue_rng.spawn(1)  # spawning leaves the state of the parent as it is
    largest: dict[Hashable, Catalogue] = {}
    draws = [scenario.draw_catalogue for scenario in scenarios]
    for draw in sorted(draws, key=lambda draw: -draw.n_obj):
        if draw.family not in largest:
            largest[draw.family] = _from_start(catalogue_rng, draw.draw)
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
