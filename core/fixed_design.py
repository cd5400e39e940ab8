"""The link while its design matrix is that of the true reference: matrix products of unit normals.

With the design a (4N, K) and the misclosure m in units of the sigma of the weights, and standardised errors z of the
satellite (reference - satellite: the sign is minus), the error of the estimate is b - g^T z with the gain g (4N, K) and
the bias b = g^T m, and the residuals are r - z + a g^T z with r = m - a b.  So chi2 follows from a^T z, g^T z, m^T z
and z^T z, and g^T z from a^T z, or for equal weights from (sigma^2 a)^T z: the objects enter only in products with
the columns [a, m] or [a, sigma^2 a, m], which nested catalogues with the same errors have in common.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from linksweep.core.arrays import Array, product_sum, transposed_product
from linksweep.core.design import link_unknowns
from linksweep.core.link import hold, inverse_and_condition, require_off_poles
from linksweep.core.noise import Tile
from linksweep.core.prepared import Setup
from linksweep.core.shared_arrays import Prefixes, origin
from linksweep.core.shared_sums import SharedSums
from linksweep.core.systematics import DrawnField


@dataclass(frozen=True)
class FixedDesign:
    """The columns (N, 4, C) that turn unit normals into estimates, and the small matrices of their products; of a stack
    of catalogues these have a leading axis.
    """

    setup: Setup
    columns: Array
    solving: slice  # which columns make the gain when multiplied by the inverse
    normal: Array  # a^T a, (..., K, K)
    inverse: Array  # of A^T W A, W the weights of the solution
    bias: Array  # (..., K)
    design_residual: Array  # a^T r, (..., K): zero for inverse-variance weights
    residual_squares: Array  # (...)
    gain_squares: Array  # the variance of g^T z, (..., K)
    condition_number: Array  # of A^T W A, (...)

    def begin(self, rows: int, field: DrawnField | None, shared: SharedSums) -> "FixedSums | OwnFixedSums":
        """Return empty sums of ``rows`` realisations, whose zonal errors are drawn already (``field``)."""
        noise = self.setup.satellite
        if not noise or noise.factor is not None or field is not None:
            return OwnFixedSums(self, np.zeros((*self.setup.stack, self.columns.shape[2], rows)), field)
        n_obj, ratio, measured = self.setup.n_obj, noise.ratio, self.setup.observables
        columns = self.setup.stacked(self.columns)

        def products(normals: Array, place: slice) -> Array:
            found = transposed_product(columns[..., place, :, :], normals)
            return found if ratio == 1.0 else ratio * found

        def squares(normals: Array, place: slice) -> Array:
            part = normals[..., measured, :]
            return ratio**2 * product_sum(part, part)

        return FixedSums(
            self,
            shared.ask(("products", origin(columns), ratio), n_obj, products),
            shared.ask(("squares", measured.start, measured.stop, ratio), n_obj, squares),
        )

    def predicted_variance(self) -> Array:
        """Return the variance of each unknown; shape (..., K)."""
        sides = self.setup.reference, self.setup.satellite
        if not any(sides):
            return np.zeros_like(self.bias)
        if all(side.as_weighed for side in sides):
            return self.gain_squares
        gain = self.columns[..., self.solving] @ self.inverse / self.setup.sigma[..., None]
        return np.asarray(sum(side.variance_through(gain) for side in sides))

    @property
    def optimal(self) -> bool:
        """Whether the weights are those of the errors, so that the gain follows from the design."""
        return self.setup.scenario.weighting == "inverse-variance"

    def residual(self, part: slice) -> Array:
        """Return r of some objects; shape (n, 4)."""
        return np.asarray(self.columns[part, :, -1] - self.columns[part, :, : len(self.bias)] @ self.bias)

    def solved(self, products: Array, squares: Array | float) -> tuple[Array, Array]:
        """Return estimate - truth (..., K, rows) and the sum of chi2 (...) from ``products`` = columns^T z
        (..., C, rows) and the sum of z^2.
        """
        a_z = products[..., : self.bias.shape[-1], :]
        g_z = self.inverse @ products[..., self.solving, :]
        r_z = products[..., -1, :] - (self.bias[..., None, :] @ a_z)[..., 0, :]
        chi2 = products.shape[-1] * self.residual_squares + squares - 2.0 * np.sum(r_z, axis=-1)
        terms = g_z * (self.normal @ g_z - 2.0 * a_z + 2.0 * self.design_residual[..., None])
        return self.bias[..., None] - g_z, chi2 + terms.reshape(*self.setup.stack, -1).sum(axis=-1)


@dataclass(frozen=True)
class FixedSums:
    """Sums that points share: products of the columns with the errors, and the squares of these."""

    design: FixedDesign
    products: Callable[[], Array]
    squares: Callable[[], Array]

    def solved(self) -> tuple[Array, Array]:
        """Return estimate - truth of each realisation, (..., K, rows), and the sum of chi2, (...)."""
        return self.design.solved(self.products(), self.squares())


@dataclass
class OwnFixedSums:
    """The same sums for a point that cannot share them: its errors are correlated, have zonal ones, or are zero."""

    design: FixedDesign
    products: Array
    field: DrawnField | None
    squares: Array | float = 0.0

    def add(self, satellite: Tile | None, reference: Tile | None) -> None:
        """Add the objects of a tile; the reference has no errors here."""
        setup = self.design.setup
        if satellite is None or satellite.start >= setup.n_obj or not setup.satellite:
            return
        place = slice(satellite.start, satellite.start + satellite.normals.shape[-3])
        errors = setup.satellite.ratio * setup.satellite.standardised(satellite.head(setup.n_obj), satellite.start)
        if self.field is not None:
            errors += self.field.values(place) / setup.sigma[place, :, None]
        self.products += transposed_product(self.design.columns[place], errors)
        measured = errors[..., setup.observables, :]
        self.squares += product_sum(measured, measured)

    def solved(self) -> tuple[Array, Array]:
        """Return estimate - truth of each realisation, (..., K, rows), and the sum of chi2, (...)."""
        return self.design.solved(self.products, self.squares)


def fixed_designs(setups: Sequence[Setup], shared: Prefixes) -> list[FixedDesign]:
    """Return the design of each setup at the true reference; that of the largest catalogue should come first.

    The small matrices of similar designs are computed together: one by one they would take longer than the objects of a
    small catalogue.  Raises LinkError where a catalogue does not determine the link.
    """
    found: dict[int, FixedDesign] = {}
    alike: dict[Hashable, list[int]] = {}
    for k, setup in enumerate(setups):
        alike.setdefault((len(setup.truth), setup.scenario.weighting, setup.measured), []).append(k)
    for group in alike.values():
        first = setups[group[0]]
        unknowns, optimal = len(first.truth), first.scenario.weighting == "inverse-variance"
        columns = [_columns(setups[k], 1 if optimal else 2, shared) for k in group]
        products = np.stack([shared.products(setups[k].stacked(own)) for k, own in zip(group, columns, strict=True)])
        solving = slice(0, unknowns) if optimal else slice(unknowns, 2 * unknowns)
        matrices = _matrices(products, slice(0, unknowns), solving, first.held)
        for k, own, *small in zip(group, columns, *matrices, strict=True):
            found[k] = FixedDesign(setups[k], own, solving, *small)
    return [found[k] for k in range(len(setups))]


def _matrices(products: Array, design: slice, solving: slice, held: slice) -> tuple[Array, ...]:
    """Return the small matrices of `FixedDesign`, in its order, from the products (..., C, C) of the columns."""
    normal, design_misclosure = products[..., design, design], products[..., design, -1]
    # for equal weights the estimate is (A^T A)^-1 A^T y with A = sigma a, and A^T A = a^T (sigma^2 a)
    solved = products[..., design, solving].copy()
    hold(np.moveaxis(solved, (-2, -1), (0, 1)), held)
    inverse, condition_number = inverse_and_condition(solved)
    bias = _times(inverse, products[..., solving, -1])
    design_residual = design_misclosure - _times(normal, bias)
    return (
        normal,
        inverse,
        bias,
        np.zeros_like(bias) if solving == design else design_residual,
        np.maximum(0.0, products[..., -1, -1] - np.vecdot(bias, design_misclosure + design_residual)),
        np.einsum("...ki,...ij,...jk->...k", inverse, products[..., solving, solving], inverse),
        condition_number,
    )


def _times(matrix: Array, vector: Array) -> Array:
    """Return the products of matrices (..., K, K) and vectors (..., K)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _columns(setup: Setup, copies: int, shared: Prefixes) -> Array:
    """Return the columns [a, m], or with two ``copies`` [a, sigma^2 a, m]; shape (N, 4, C)."""
    catalogue, scenario, truth = setup.catalogue, setup.scenario, setup.truth
    unknowns, left_out = len(truth), setup.counted == 0.0

    def compute(ra: Array, dec: Array, pmra: Array, pmdec: Array, differences: Array) -> Array:
        """Return [a, m] without weights, which are the same for all missions."""
        objects = shared.objects(ra, dec, pmra, pmdec)
        require_off_poles(dec, np.concatenate([here.triad.q[2] for _, here in objects]))
        columns = np.empty((len(ra), 4, unknowns + 1))
        for part, here in objects:
            _, derivatives = link_unknowns(scenario.solve_glide, scenario.corrections).derivatives(here)
            misclosure = differences[part].T.copy()
            for value, derivative in zip(truth, derivatives, strict=True):
                misclosure -= derivative * value  # one by one: a matrix product may round by an object's place
            columns[part, :, :unknowns] = np.moveaxis(derivatives, -1, 0).swapaxes(1, 2)
            columns[part, :, unknowns] = misclosure.T
        return columns

    def weigh(plain: Array, sigma: Array) -> Array:
        """Return the columns with weights."""
        columns = plain / sigma[:, :, None]
        if copies == 2:
            times_sigma = plain[:, :, :unknowns] * sigma[:, :, None]
            columns = np.concatenate([columns[:, :, :unknowns], times_sigma, columns[:, :, unknowns:]], axis=2)
        columns[:, left_out] = 0.0
        for k in range(unknowns)[setup.held]:
            columns[:, :, k::unknowns][:, :, :copies] = 0.0
        return columns

    settings = scenario.corrections, scenario.solve_glide, truth.tobytes()
    objects = catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec
    plain = shared.once(("design", *settings), compute, *objects, setup.differences)
    return shared.once(("columns", copies, setup.measured), weigh, plain, setup.sigma)
