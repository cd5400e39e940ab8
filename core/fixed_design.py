"""The link while its design matrix is that of the true reference: matrix products of unit normals.

With the design a (4N, K) and the misclosure m in units of the sigma of the weights, and standardised errors z of the
satellite (reference - satellite: the sign is minus), the error of the estimate is b - g^T z with the gain g (4N, K) and
the bias b = g^T m, and the residuals are r - z + a g^T z with r = m - a b.  So chi2 follows from a^T z, g^T z, m^T z
and z^T z, and g^T z from a^T z, or for equal weights from (sigma^2 a)^T z: the objects enter only in products with
the columns P = [a, m] or [a, sigma^2 a, m] (4N, C), which nested catalogues with the same errors have in common.

The projected method draws these products, not the errors of every object.  With P = Q R, Q of orthonormal columns,
u = Q^T z are unit normals, P^T z = R^T u, and the squared length of z outside the columns of Q is an independent
chi-square of 4N - C degrees of freedom.  So C normals and a chi-square have exactly the distribution of 4N normals,
whatever N.  This needs normal, uncorrelated errors and a fixed design.  Where the reference has errors the design
changes with them, which is neglected here: `neglected` bounds the effect.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from linksweep.core.frames import Array, product_sum, transposed_product
from linksweep.core.link import LinkError, hold, inverse_and_condition, require_off_poles
from linksweep.core.setup import Prefixes, Setup, SharedSums, origin, parts
from linksweep.core.unknowns import ORIENTATION, link_unknowns

Solved = Callable[[], tuple[Array, Array]]
"""A function that returns, after the last tile, estimate - truth of each realisation of a chunk, (..., K, rows), and
the sum of their chi2, (...).
"""

LARGEST_NEGLECT = 0.01
"""Largest bound of `neglected` that is allowed, as a fraction of sigma.  Where it was tried, the effect was 13 to 75
times smaller than the bound: below the Monte-Carlo error of a million realisations.
"""


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
    gain_products: Array  # the covariance of g^T z, (..., K, K)
    condition_number: Array  # of A^T W A, (...)

    def begin(self, rows: int, drawn: Array | None, shared: SharedSums) -> Solved:
        """Ask for the sums of ``rows`` realisations, whose zonal errors are drawn already (``drawn``)."""
        setup, noise = self.setup, self.setup.satellite
        if not noise:
            return lambda: self.solved(np.zeros((*setup.stack, self.columns.shape[2], rows)), 0.0)
        ratio = noise.inflation if noise.is_drawn else 0.0
        measured, columns = setup.observables, setup.stacked(self.columns)
        alone = noise.factor is not None or drawn is not None  # its errors are those of no other point
        latest: dict[int, Array] = {}  # those of the tile that both sums are asked for

        def errors(normals: Array, place: slice) -> Array:
            """Return the errors of a tile in units of the sigma of the weights."""
            if place.start not in latest:
                latest.clear()
                latest[place.start] = ratio * noise.standardised(normals, place.start)
                if noise.field is not None and drawn is not None:
                    latest[place.start] += noise.field.values(drawn, place) / setup.sigma[place, :, None]
            return latest[place.start]

        def products(normals: Array, place: slice) -> Array:
            if alone:
                return transposed_product(columns[place], errors(normals, place))
            product = transposed_product(columns[..., place, :, :], normals)
            return product if ratio == 1.0 else ratio * product

        def squares(normals: Array, place: slice) -> Array:
            part = (errors(normals, place) if alone else normals)[..., measured, :]
            return product_sum(part, part) if alone else ratio**2 * product_sum(part, part)

        # nested catalogues of equal errors have columns that begin at the same place, and so share the first sum; the
        # second needs no columns at all
        which = id(self) if alone else ratio
        asked = (
            shared.ask(("products", origin(columns), which), setup.n_obj, products),
            shared.ask(("squares", measured.start, measured.stop, which), setup.n_obj, squares),
        )
        return lambda: self.solved(*(total() for total in asked))

    def predicted_covariance(self) -> Array:
        """Return the covariance of the unknowns; shape (..., K, K)."""
        sides = self.setup.reference, self.setup.satellite
        if not any(sides):
            return np.zeros_like(self.normal)
        if all(side.as_weighed for side in sides):  # then it was computed with the gain, without a pass over objects
            return self.gain_products
        gain = self.columns[..., self.solving] @ self.inverse / self.setup.sigma[..., None]
        return np.asarray(sum(side.covariance_through(gain) for side in sides))

    def chi2_variance(self) -> Array:
        """Return the variance of chi2 (...), of the noncentral law; NaN where weights are not those of the errors."""
        setup = self.setup
        dof = setup.n_obj * 2 * sum(setup.measured) - len(setup.truth) + len(setup.truth[setup.fixed])
        known = self.optimal and setup.reference.as_weighed and setup.satellite.as_weighed
        return (2.0 * dof + 4.0 * self.residual_squares) * (1.0 if known else np.nan)

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


def fixed_designs(setups: Sequence[Setup], shared: Prefixes) -> list[FixedDesign]:
    """Return the design of each setup at the true reference; that of the largest catalogue should come first.

    The small matrices of similar designs are computed together: one by one they would take longer than the objects of a
    small catalogue.  Raises LinkError where a catalogue does not determine the link.
    """
    designs: dict[int, FixedDesign] = {}
    alike: dict[Hashable, list[int]] = {}
    for k, setup in enumerate(setups):
        alike.setdefault((len(setup.truth), setup.scenario.weighting, setup.measured), []).append(k)
    for group in alike.values():
        first = setups[group[0]]
        unknowns, optimal = len(first.truth), first.scenario.weighting == "inverse-variance"
        columns = [_columns(setups[k], 1 if optimal else 2, shared) for k in group]
        # stacked: for one 6 x 6 matrix the calls take longer than the arithmetic
        products = np.stack([shared.products(setups[k].stacked(each)) for k, each in zip(group, columns, strict=True)])
        solving = slice(0, unknowns) if optimal else slice(unknowns, 2 * unknowns)
        matrices = _matrices(products, slice(0, unknowns), solving, first.fixed)
        for k, each, *small in zip(group, columns, *matrices, strict=True):
            designs[k] = FixedDesign(setups[k], each, solving, *small)
    return [designs[k] for k in range(len(setups))]


def _matrices(products: Array, design: slice, solving: slice, fixed: slice) -> tuple[Array, ...]:
    """Return the small matrices of `FixedDesign`, in its order, from the products (..., C, C) of the columns."""
    normal, design_misclosure = products[..., design, design], products[..., design, -1]
    # for equal weights the estimate is (A^T A)^-1 A^T y with A = sigma a, and A^T A = a^T (sigma^2 a)
    solved = products[..., design, solving].copy()
    hold(np.moveaxis(solved, (-2, -1), (0, 1)), fixed)
    inverse, condition_number = inverse_and_condition(solved)
    bias = (inverse @ products[..., solving, -1:])[..., 0]
    design_residual = design_misclosure - (normal @ bias[..., None])[..., 0]
    return (
        normal,
        inverse,
        bias,
        # a^T r of the optimal weights is zero but for rounding, which chi2 would multiply
        np.zeros_like(bias) if solving == design else design_residual,
        np.maximum(0.0, products[..., -1, -1] - np.vecdot(bias, design_misclosure + design_residual)),
        np.einsum("...ki,...ij,...jl->...kl", inverse, products[..., solving, solving], inverse),
        condition_number,
    )


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
        columns[:, left_out] = 0.0  # what is not measured has no weight
        # nor has an unknown that stays at its truth: `hold` puts 1 on its diagonal
        for k in range(unknowns)[setup.fixed]:
            columns[:, :, k::unknowns][:, :, :copies] = 0.0
        return columns

    settings = scenario.corrections, scenario.solve_glide, truth.tobytes()
    objects = catalogue.ra, catalogue.dec, catalogue.pmra, catalogue.pmdec
    plain = shared.once(("design", *settings), compute, *objects, setup.differences)
    return shared.once(("columns", copies, setup.measured), weigh, plain, setup.sigma)


class Projected:
    """The fixed design of a catalogue, reduced to the triangle R (at most C, C) of its columns."""

    def __init__(self, design: FixedDesign) -> None:
        setup = design.setup
        if setup.reference.factor is not None or setup.satellite.factor is not None:
            raise LinkError("the projected method needs uncorrelated errors: otherwise chi2 has no chi-square law")
        if not (setup.reference.as_weighed and setup.satellite.as_weighed):
            raise LinkError("the projected method needs true errors that equal those in the weights, and no zonal ones")
        worst = float(np.max(neglected(design)))
        if worst > LARGEST_NEGLECT:
            raise LinkError(
                f"the projected method would neglect {worst:.2g} of sigma with these errors of the reference: "
                f"at most {LARGEST_NEGLECT:g}"
            )
        self.design = design
        self.triangle = np.zeros((0, design.columns.shape[2]))
        # R of a matrix from R of its parts: Q is never formed, so memory stays that of a part
        for part in parts(len(design.columns)):
            rows = design.columns[part, setup.observables].reshape(-1, design.columns.shape[2])
            self.triangle = np.asarray(np.linalg.qr(np.concatenate([self.triangle, rows]), mode="r"))

    def draw(self, rows: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return estimate - truth of ``rows`` realisations (K, rows), and the sum of their chi2."""
        setup = self.design.setup
        if not setup.reference and not setup.satellite:
            return self.design.solved(np.zeros((self.triangle.shape[1], rows)), 0.0)
        normals = rng.standard_normal((rows, len(self.triangle))).T
        outside = self.design.columns[:, setup.observables, 0].size - len(self.triangle)
        # only the sum over the realisations is needed, and a sum of chi-squares is a chi-square too
        squares = float(np.vdot(normals, normals)) + (rng.chisquare(rows * outside) if outside else 0.0)
        return self.design.solved(self.triangle.T @ normals, squares)


def neglected(design: FixedDesign) -> Array:
    """Return a bound, in units of sigma, of the RMS error of each unknown from the fixed design; shape (K,).

    It is of first order in the change D of the design with the errors of the reference: with the gain (A^T W A)^-1 A^T
    W the estimate changes by (A^T W A)^-1 (D^T W e - A^T W D x), where e are errors and residuals and x is truth plus
    error of the estimate.  The mean of this change comes from the only product of an error with itself, e_ra and the
    turn of q with ra.  Its scatter is bounded by the squared norms of both terms, added up over objects for
    orientation, spin and glide, with the rows of (A^T W A)^-1 (Cauchy and Schwarz); E(a b)^2 <= 3 E a^2 E b^2 for
    normal a and b.
    """
    setup, unknowns = design.setup, len(design.bias)
    if not setup.reference:
        return np.zeros(unknowns)
    predicted = np.diag(design.predicted_covariance())
    # E x^2 of orientation, spin and glide
    size = 2.0 * np.square(np.abs(setup.truth) + np.abs(design.bias)) + 6.0 * predicted
    blocks = len(link_unknowns(setup.scenario.solve_glide).blocks)
    squares, mean = np.zeros(blocks), np.zeros(unknowns)
    for part in parts(len(design.columns)):
        squares += _squared_changes(design, part, size.reshape(blocks, -1).sum(axis=1))
        mean[ORIENTATION] += _mean_change(design, part)
    rows = np.square(design.inverse).reshape(unknowns, blocks, -1).sum(axis=2)
    bound = rows @ squares * len(squares) + np.square(design.inverse @ mean)
    return np.asarray(np.sqrt(np.divide(bound, predicted, out=np.zeros_like(bound), where=predicted > 0.0)))


def _squared_changes(design: FixedDesign, part: slice, size: Array) -> Array:
    """Return bounds of E|D^T W e - A^T W D x|^2, added up over objects, for orientation, spin and glide; (blocks,)."""
    setup, catalogue = design.setup, design.setup.catalogue
    counted = setup.counted[:, None]
    square_sec = np.cos(catalogue.dec[part]) ** -2.0
    reference, variance = np.square(setup.reference.sigma[part]).T, np.square(setup.sigma[part]).T
    weight = counted * (variance**-2.0 if design.optimal else np.ones_like(variance))  # squared
    error = 3.0 * variance * (1.0 + np.square(design.residual(part).T))
    # E|D|^2: p and q turn with ra and dec by at most 1/cos dec, pmdec eta and pmra eta with the motions too
    turn = square_sec * (reference[0] + reference[1])
    eta = square_sec * np.square([catalogue.pmdec[part], catalogue.pmra[part]])
    eta_turn = 2.0 * (square_sec * reference[[3, 2]] + eta * turn)
    if not setup.scenario.corrections:
        eta, eta_turn = np.zeros_like(eta), np.zeros_like(eta)
    positions = weight[:2] * turn * (error[:2] + size[0])
    misfit = 3.0 * (size[1:].sum() * turn + size[0] * eta_turn)
    motions = weight[2:] * (error[2:] * turn + misfit)
    turned = weight[2:] * (error[2:] * eta_turn + eta * misfit)
    # (a + ...)^2 <= 8 (a^2 + ...), both terms of four observables
    return 8.0 * np.array([positions.sum() + turned.sum(), *[motions.sum()] * (len(size) - 1)])


def _mean_change(design: FixedDesign, part: slice) -> Array:
    """Return E[D^T W e] of the orientation added up over objects; q changes by -tan dec p with ra*.  Shape (3,)."""
    catalogue, setup = design.setup.catalogue, design.setup
    ra, dec = catalogue.ra[part], catalogue.dec[part]
    size = np.tan(dec) * np.square(setup.reference.sigma[part, 0])
    if design.optimal:
        size /= np.square(setup.sigma[part, 0])
    return np.array([np.sum(size * np.sin(ra)), -np.sum(size * np.cos(ra)), 0.0])
