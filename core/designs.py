"""The link of a catalogue for many realisations of its errors: with matrix products of unit normals while its design
matrix is that of the true reference, and with normal equations of its own in each where the reference has errors too.

Fixed design: with the design a (4N, K) and the misclosure m in units of the sigma of the weights, and standardised
errors z of the satellite (reference - satellite: the sign is minus), the error of the estimate is b - g^T z with the
gain g (4N, K) and the bias b = g^T m, and the residuals are r - z + a g^T z with r = m - a b.  So chi2 follows from
a^T z, g^T z, m^T z and z^T z, and g^T z from a^T z, or for equal weights from (sigma^2 a)^T z: the objects enter only
in products with the columns P = [a, m] or [a, sigma^2 a, m] (4N, C), which nested catalogues with the same errors have
in common.

The projected method draws these products, not the errors of every object.  With P = Q R, Q of orthonormal columns,
u = Q^T z are unit normals, P^T z = R^T u, and the squared length of z outside the columns of Q is an independent
chi-square of 4N - C degrees of freedom.  So C normals and a chi-square have exactly the distribution of 4N normals,
whatever N.  This needs normal, uncorrelated errors and a fixed design.  Where the reference has errors the design
changes with them, which is neglected here: `neglected` says how large the effect is.

Noisy design: normal equations are added up over objects, for many realisations at once, without their design matrices.
With sin and cos s, c of ra and S, C of dec (p = (-s, c, 0), q = (-S c, -S s, C), eta = (c, s, 0)/C), the entries of
q q^T and p p^T are linear in 1 and seven products of these; those of q p^T need five more.  One matrix product with the
weights of the four observables gives all blocks that proper motions do not enter; the terms A21 take a few sums of
products.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from linksweep.core import frames
from linksweep.core.frames import Array, LinkError, product_sum
from linksweep.core.setup import Noise, Prefixes, Setup, SharedSums, Tile, origin, parts, tiles
from linksweep.core.unknowns import GLIDE, ORIENTATION, SPIN, link_unknowns

# A function that returns, after the last tile of a chunk, what `Matrices.solved` needs, or of a noisy design what that
# gives.
Solved = Callable[[], tuple[Array, Array]]

# Largest effect of `neglected` that is allowed, as a fraction of sigma: about the Monte-Carlo error of a million
# realisations.  So many are tried.
LARGEST_NEGLECT, TRIED = 0.001, 16


@dataclass(frozen=True)
class Matrices:
    """The small matrices of the products of columns [a, ..., m]; of several designs, or of a stack of catalogues, these
    have leading axes.
    """

    normal: Array  # a^T a, (..., K, K)
    inverse: Array  # of A^T W A, W the weights of the solution
    bias: Array  # (..., K)
    design_residual: Array  # a^T r, (..., K): zero for inverse-variance weights
    residual_squares: Array  # (...)
    gain_products: Array  # the covariance of g^T z, (..., K, K)
    condition_number: Array  # of A^T W A, (...)

    def solved(self, products: Array, squares: Array) -> tuple[Array, Array]:
        """Return estimate - truth (..., K, rows) and the sum of chi2 (...) from ``products`` = columns^T z
        (..., C, rows) and the sum of z^2.
        """
        a_z = products[..., : self.bias.shape[-1], :]
        g_z = self.inverse @ products[..., self.solving, :]
        r_z = products[..., -1, :] - (self.bias[..., None, :] @ a_z)[..., 0, :]
        chi2 = products.shape[-1] * self.residual_squares + squares - 2.0 * np.sum(r_z, axis=-1)
        terms = g_z * (self.normal @ g_z - 2.0 * a_z + 2.0 * self.design_residual[..., None])
        return self.bias[..., None] - g_z, chi2 + terms.reshape(*chi2.shape, -1).sum(axis=-1)

    @property
    def solving(self) -> slice:
        """Which columns make the gain when multiplied by the inverse: those before the misclosure."""
        return slice(-1 - self.bias.shape[-1], -1)


@dataclass(frozen=True)
class FixedDesign(Matrices):
    """The columns (N, 4, C) that turn unit normals into estimates, and their matrices."""

    setup: Setup
    columns: Array

    def begin(self, rows: int, drawn: Array | None, shared: SharedSums) -> Solved:
        """Ask for the sums of ``rows`` realisations, whose zonal errors are drawn already (``drawn``)."""
        setup, noise = self.setup, self.setup.satellite
        if not noise:
            return lambda: (np.zeros((*setup.stack, self.columns.shape[2], rows)), np.zeros(setup.stack))
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
                return frames.transposed_product(columns[place], errors(normals, place))
            product = frames.transposed_product(columns[..., place, :, :], normals)
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
        return lambda: (asked[0](), asked[1]())

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
        known = setup.optimal and setup.reference.as_weighed and setup.satellite.as_weighed
        return (2.0 * dof + 4.0 * self.residual_squares) * (1.0 if known else np.nan)


def fixed_designs(setups: Sequence[Setup], shared: Prefixes) -> tuple[list[FixedDesign], Matrices]:
    """Return the designs of setups that are alike at the true reference, and their matrices; that of the largest
    catalogue should come first.

    The small matrices are computed together: one by one they would take longer than the objects of a small catalogue.
    Raises LinkError where a catalogue does not determine the link.
    """
    columns = [_columns(setup, shared) for setup in setups]
    products = np.stack([shared.products(setup.stacked(each)) for setup, each in zip(setups, columns, strict=True)])
    matrices = _matrices(products, len(setups[0].truth), setups[0].fixed)
    designs = [FixedDesign(*each) for each in zip(*matrices, setups, columns, strict=True)]
    return designs, Matrices(*matrices)


def _matrices(products: Array, unknowns: int, fixed: slice) -> tuple[Array, ...]:
    """Return the small matrices of `Matrices`, in its order, from the products (..., C, C) of the columns."""
    design, solving = slice(unknowns), slice(-1 - unknowns, -1)
    normal, design_misclosure = products[..., design, design], products[..., design, -1]
    # for equal weights the estimate is (A^T A)^-1 A^T y with A = sigma a, and A^T A = a^T (sigma^2 a)
    solved = products[..., design, solving].copy()
    frames.hold(np.moveaxis(solved, (-2, -1), (0, 1)), fixed)
    inverse, condition_number = frames.inverse_and_condition(solved)
    bias = (inverse @ products[..., solving, -1:])[..., 0]
    design_residual = design_misclosure - (normal @ bias[..., None])[..., 0]
    return (
        normal,
        inverse,
        bias,
        # a^T r of the optimal weights is zero but for rounding, which chi2 would multiply
        np.zeros_like(bias) if products.shape[-1] == unknowns + 1 else design_residual,
        np.maximum(0.0, products[..., -1, -1] - np.vecdot(bias, design_misclosure + design_residual)),
        np.einsum("...ki,...ij,...jl->...kl", inverse, products[..., solving, solving], inverse),
        condition_number,
    )


def _columns(setup: Setup, shared: Prefixes) -> Array:
    """Return the columns [a, m], or for equal weights [a, sigma^2 a, m]; shape (N, 4, C)."""
    catalogue, scenario, truth = setup.catalogue, setup.scenario, setup.truth
    unknowns, left_out, copies = len(truth), setup.counted == 0.0, 1 if setup.optimal else 2

    def compute(ra: Array, dec: Array, pmra: Array, pmdec: Array, differences: Array) -> Array:
        """Return [a, m] without weights, which are the same for all missions."""
        objects = shared.objects(ra, dec, pmra, pmdec)
        frames.require_off_poles(dec, np.concatenate([here.triad.q[2] for _, here in objects]))
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
        worst = float(np.max(neglected(design)))
        if worst > LARGEST_NEGLECT:
            said = f"the projected method would neglect {worst:.2g} of sigma with these errors of the reference:"
            raise LinkError(f"{said} at most {LARGEST_NEGLECT:g}")
        self.design = design
        self.triangle = np.zeros((0, design.columns.shape[2]))
        # R of a matrix from R of its parts: Q is never formed, so memory stays that of a part
        for part in parts(len(design.columns)):
            rows = design.columns[part, setup.observables].reshape(-1, design.columns.shape[2])
            self.triangle = np.asarray(np.linalg.qr(np.concatenate([self.triangle, rows]), mode="r"))

    def draw(self, rows: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return the products (C, rows) of the columns and the normals of ``rows`` realisations, and the sum of the
        squares of the normals.
        """
        setup = self.design.setup
        if not setup.reference and not setup.satellite:
            return np.zeros((self.triangle.shape[1], rows)), np.zeros(())
        normals = rng.standard_normal((rows, len(self.triangle))).T
        outside = self.design.columns[:, setup.observables, 0].size - len(self.triangle)
        # only the sum over the realisations is needed, and a sum of chi-squares is a chi-square too
        squares = float(np.vdot(normals, normals)) + (rng.chisquare(rows * outside) if outside else 0.0)
        return self.triangle.T @ normals, np.asarray(squares)


def neglected(design: FixedDesign) -> Array:
    """Return the RMS, in units of sigma, of what the fixed design changes in each unknown, in a few realisations that
    are solved with their own designs too; shape (K,).
    """
    setup, columns = design.setup, design.columns
    if not setup.reference:
        return np.zeros(len(design.bias))
    noisy, products = NoisyDesign(setup), np.zeros((columns.shape[2], TRIED))
    solved = noisy.begin(TRIED, None, SharedSums())
    both = (tiles([rng], (), TRIED, setup.n_obj) for rng in np.random.default_rng(1).spawn(2))
    for satellite, reference in zip(*both, strict=True):
        noisy.add(satellite, reference)
        place = slice(reference.start, reference.start + len(reference.normals))
        sides = (setup.satellite, satellite), (setup.reference, reference)
        one, other = (side.sigma[place, :, None] * tile.normals for side, tile in sides)
        products += frames.transposed_product(columns[place], (one - other) / setup.sigma[place, :, None])
    change = np.sqrt(np.mean((solved()[0] - design.solved(products, np.zeros(()))[0]) ** 2, axis=1))
    sigma = np.sqrt(np.diag(design.predicted_covariance()))
    return np.asarray(np.divide(change, sigma, out=np.zeros_like(change), where=sigma > 0.0))


# ---- noisy design

RA, DEC, PMRA, PMDEC = range(4)

# Objects x realisations in one array operation, so that its arrays of 64 KiB stay near the core.
ELEMENTS = 8192

# Angle (rad) below which two terms of the series of sin x and 1 - cos x are exact to rounding: x^5/120 and x^6/720 are
# below 1e-17.
SMALL_ANGLE = 1e-3

# Largest normal deviate that is expected, in sigma; one beyond has a probability of 1e-23.
FARTHEST = 10.0


class Seen(NamedTuple):
    """Noisy reference objects, each (m, catalogues, rows): sin and cos of ra and dec, proper motions, and these divided
    by cos dec.
    """

    s: Array
    c: Array
    sin_dec: Array
    cos_dec: Array
    pmra: Array
    pmdec: Array
    pmra_turn: Array
    pmdec_turn: Array

    def products(self, out: Array) -> Array:
        """Write the products of sin and cos into the first axis of ``out``: seven, or with a glide twelve."""
        s, c, sin_dec, cos_dec = self[:4]
        cc, cs, ss = out[:3]
        mixed = sin_dec * cos_dec
        pairs: list[tuple[Array, Array | float]]
        pairs = [(c, c), (c, s), (sin_dec, sin_dec), (ss, cc), (ss, cs), (mixed, c), (mixed, s)]
        pairs += [(sin_dec, 1.0), (sin_dec, cc), (sin_dec, cs), (cos_dec, c), (cos_dec, s)]
        for product, (a, b) in zip(out, pairs, strict=False):  # ``out`` ends before those of a glide
            np.multiply(a, b, out=product)
        return out


class NormalSums:
    """A^T W A and A^T W y of ``rows`` realisations of each of some catalogues."""

    def __init__(self, catalogues: int, rows: int, corrections: bool, glide: bool) -> None:
        unknowns, number = len(link_unknowns(glide)), 12 if glide else 7
        self.corrections, self.glide = corrections, glide
        self.total_weight = np.zeros((catalogues, 4))
        self.product_sums = np.zeros((number, catalogues, 4, rows))
        # what A21 adds to the upper rows of A^T W A, those of epsilon
        self.turns = np.zeros((ORIENTATION.stop, unknowns, catalogues, rows))
        self.right = np.zeros((unknowns, catalogues, rows))

    def add(self, which: slice, seen: Seen, products: Array, weights: Array, weighted: Array) -> None:
        """Add objects of some of the catalogues, with ``weights`` (catalogues, m, 4) and weighted differences
        ``weighted`` (m, 4, catalogues, rows).
        """
        self.total_weight[which] += weights.sum(axis=1)
        # one matrix product for all four observables: their weights are the same in all realisations
        self.product_sums[:, which] += weights.swapaxes(1, 2) @ products.swapaxes(1, 2)
        right, (ra, dec, pmra, pmdec) = self.right[:, which], weighted.swapaxes(0, 1)
        _add_right(right[ORIENTATION], seen, ra, dec)
        _add_right(right[SPIN], seen, pmra, pmdec)
        if self.glide:
            _add_right(right[GLIDE], seen, pmdec, -pmra)
        if self.corrections:
            each = weights.transpose(1, 2, 0)[..., None]
            self._add_turns(self.turns[:, :, which], right, seen, products, each, weighted)

    def equations(self) -> tuple[Array, Array]:
        """Return A^T W A, shape (K, K, catalogues, rows), and A^T W y, shape (K, catalogues, rows)."""
        unknowns = len(self.right)
        normal = np.zeros((unknowns, *self.right.shape))
        normal[ORIENTATION, ORIENTATION] = self._squares(RA, DEC)
        normal[SPIN, SPIN] = self._squares(PMRA, PMDEC)
        if self.glide:
            normal[GLIDE, GLIDE] = self._squares(PMDEC, PMRA)
            normal[SPIN, GLIDE] = self._crossed(PMRA) - np.swapaxes(self._crossed(PMDEC), 0, 1)
        normal[ORIENTATION] += self.turns
        for k in range(1, unknowns):
            normal[k, :k] = normal[:k, k]
        return normal, self.right

    def _squares(self, along_q: int, along_p: int) -> Array:
        """Return sum(w q q^T + w' p p^T), w and w' the weights of two observables; shape (3, 3, catalogues, rows)."""
        # C^2 = 1 - S^2 and s^2 = 1 - c^2: with the sum of the weights, two products fewer
        ss, ss_cc, ss_cs, sc_c, sc_s = self.product_sums[2:7, :, along_q]
        whole, other = (self.total_weight[:, [k]] for k in (along_q, along_p))
        cc_p, cs_p = self.product_sums[:2, :, along_p]
        xy, xz, yz = ss_cs - cs_p, -sc_c, -sc_s
        return np.array([[ss_cc + other - cc_p, xy, xz], [xy, ss - ss_cc + cc_p, yz], [xz, yz, whole - ss]])

    def _crossed(self, observable: int) -> Array:
        """Return sum(w q p^T), w the weights of an observable; shape (3, 3, catalogues, rows)."""
        sin_dec, s_cc, s_cs, cos_c, cos_s = self.product_sums[7:, :, observable]
        none = np.zeros_like(sin_dec)
        return np.array([[s_cs, -s_cc, none], [sin_dec - s_cc, -s_cs, none], [-cos_s, cos_c, none]])

    def _add_turns(
        self, turns: Array, right: Array, seen: Seen, products: Array, weights: Array, weighted: Array
    ) -> None:
        """Add the terms of A21, whose rows are -pmdec eta and pmra eta in the third and fourth observable."""
        s, c, sin_dec = seen[:3]
        cc, cs = products[:2]
        u, v = seen.pmdec_turn, seen.pmra_turn
        wu, wv = weights[:, PMRA] * u, weights[:, PMDEC] * v
        squares = wu * u + wv * v  # of eta eta^T
        xx, xy = _dot(squares, cc), _dot(squares, cs)
        turns[0, 0] += xx
        turns[0, 1] += xy
        turns[1, 1] += squares.sum(axis=0) - xx
        misfit = v * weighted[:, PMDEC] - u * weighted[:, PMRA]  # of eta y
        right[0] += _dot(misfit, c)
        right[1] += _dot(misfit, s)
        _add_turned(turns[:, SPIN], wu * sin_dec, wv, cc, cs)
        across = weights[:, PMRA] * seen.pmdec
        turns[0, SPIN][2] -= _dot(across, c)
        turns[1, SPIN][2] -= _dot(across, s)
        if self.glide:
            _add_turned(turns[:, GLIDE], -(wv * sin_dec), wu, cc, cs)
            across = weights[:, PMDEC] * seen.pmra
            turns[0, GLIDE][2] += _dot(across, c)
            turns[1, GLIDE][2] += _dot(across, s)


def _add_right(right: Array, seen: Seen, along_q: Array, along_p: Array) -> None:
    """Add sum(q a - p b) of a and b of shape (m, catalogues, rows)."""
    s, c, sin_dec, cos_dec = seen[:4]
    down = sin_dec * along_q
    right[0] += _dot(s, along_p) - _dot(c, down)
    right[1] -= _dot(c, along_p) + _dot(s, down)
    right[2] += _dot(cos_dec, along_q)


def _add_turned(block: Array, a: Array, b: Array, cc: Array, cs: Array) -> None:
    """Add sum((c, s) (a c + b s, a s - b c)^T), the x and y columns of eta (-u q - v p)^T and eta (v q - u p)^T."""
    xx, xy = _dot(a, cc) + _dot(b, cs), _dot(a, cs) - _dot(b, cc)
    block[0, 0] += xx
    block[0, 1] += xy
    block[1, 0] += xy + b.sum(axis=0)
    block[1, 1] += a.sum(axis=0) - xx


def _dot(a: Array, b: Array) -> Array:
    """Return the sum over objects of a b; shape (catalogues, rows)."""
    return np.asarray(np.einsum("o...,o...->...", a, b))


class NoisyDesign:
    """The link of a catalogue, or a stack of them, whose reference has errors.

    Arrays are (N, catalogues, rows), or (N, 4, catalogues, rows) with the observables: the realisations of several
    catalogues lie side by side, so that operations on few realisations of each are as fast as those on many of one.
    What does not differ between realisations has 1 in place of ``rows``.
    """

    def __init__(self, setup: Setup) -> None:
        catalogue = setup.catalogue
        self.setup, self.catalogues = setup, int(np.prod(setup.stack))

        def each(objects: Array) -> Array:
            return objects.reshape(self.catalogues, setup.n_obj, *objects.shape[1:])

        def beside(objects: Array) -> Array:
            return np.moveaxis(each(objects), 0, -1)[..., None]

        ra, dec = beside(catalogue.ra), beside(catalogue.dec)
        self.ra, self.dec = ra, dec
        self.sin_ra, self.cos_ra, self.sin_dec, self.cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
        self.pmra, self.pmdec = beside(catalogue.pmra), beside(catalogue.pmdec)
        self.differences = beside(setup.differences)
        self.reference_sigma, self.satellite_sigma = beside(setup.reference.sigma), beside(setup.satellite.sigma)
        self.small = FARTHEST * self.reference_sigma[:, :2].max(axis=1) < SMALL_ANGLE * self.cos_dec
        # the two ways round differently, so a stack must go the same way as each of its catalogues alone
        if setup.stack and not self.small.all():
            raise LinkError("some of the catalogues have objects whose errors are no small angles")
        inverse_variance = setup.counted * each(setup.sigma) ** -2.0
        equal = setup.scenario.weighting == "equal"
        # the weights of the solution, then those of chi2 where they differ; (catalogues, N, 4)
        self.weights = [np.ones_like(inverse_variance) * setup.counted] * equal + [inverse_variance]

    def begin(self, rows: int, drawn: Array | None, shared: SharedSums) -> Solved:
        """Begin a chunk of ``rows`` realisations, whose zonal errors are drawn already (``drawn``)."""
        setup = self.setup
        self.drawn, self.squares = drawn, np.zeros(self.catalogues)
        self.objects = min(max(1, ELEMENTS // rows), setup.n_obj)
        self.together = min(max(1, ELEMENTS // (rows * self.objects)), self.catalogues)
        # an orientation that stays at its true value has no derivatives
        turns, glide = setup.scenario.corrections and setup.measured[0], setup.scenario.solve_glide
        self.sums = [NormalSums(self.catalogues, rows, turns, glide) for _ in self.weights]
        # the largest arrays are used again for the next objects: temporary ones would be given back to the system
        columns = self.together, rows
        self.errors = np.empty((3, self.objects, 4, *columns))
        self.products = np.empty((len(self.sums[0].product_sums), self.objects, *columns))
        return self.solved

    def add(self, satellite: Tile | None, reference: Tile) -> None:
        """Add the objects of a tile, the same on both sides; None for a satellite without errors."""
        setup = self.setup
        normals = self._beside(reference, setup.reference)
        others = self._beside(satellite, setup.satellite) if satellite is not None and setup.satellite else None
        for first in range(0, self.catalogues, self.together):
            which = slice(first, min(first + self.together, self.catalogues))
            for start in range(0, len(normals), self.objects):
                part = slice(start, start + self.objects), slice(None), which
                self._add(which, reference.start + start, normals[part], None if others is None else others[part])

    def _beside(self, tile: Tile, noise: Noise) -> Array:
        """Return the errors of a tile in units of their sigma, (m, 4, catalogues, rows)."""
        normals = noise.standardised(tile.head(self.setup.n_obj), tile.start)
        return normals.reshape(self.catalogues, *normals.shape[-3:]).transpose(1, 2, 0, 3)

    def solved(self) -> tuple[Array, Array]:
        """Return estimate - truth of each realisation, (..., K, rows), and the sum of chi2, (...)."""
        stack, (normal, right) = self.setup.stack, self.sums[0].equations()
        error = frames.solve_normal(frames.hold(normal, self.setup.fixed), right)
        # chi2 has the weights of the errors, also where the solution has equal ones
        normal, right = self.sums[-1].equations()
        terms = error * (np.einsum("kl...,l...->k...", normal, error) - 2.0 * right)
        error, terms = (np.ascontiguousarray(array.swapaxes(0, 1)) for array in (error, terms))
        chi2 = self.squares + terms.reshape(self.catalogues, -1).sum(axis=-1)
        return error.reshape(*stack, *error.shape[1:]), chi2.reshape(stack)

    def _add(self, which: slice, start: int, reference: Array, satellite: Array | None) -> None:
        """Add objects of some of the catalogues with these errors, (m, 4, catalogues, rows) in units of their sigma."""
        setup, (n_obj, _, catalogues, _) = self.setup, reference.shape
        part, inside = slice(start, start + n_obj), (slice(n_obj), slice(catalogues))
        at = part, slice(None), which
        shift, misclosure, weighted = self.errors[:, :n_obj, :, :catalogues]
        np.multiply(reference, self.reference_sigma[at], out=shift)
        np.add(shift, self.differences[at], out=misclosure)
        if satellite is not None:
            misclosure -= np.multiply(satellite, self.satellite_sigma[at], out=weighted)
        if setup.satellite.field is not None and self.drawn is not None:
            misclosure -= setup.satellite.field.values(self.drawn, part)[:, :, None]
        seen = self._seen((part, which), shift)
        # before the sums: they are then those of the error alone, however large the truth
        self._subtract_truth(seen, misclosure)
        products = seen.products(self.products[:, *inside])
        for sums, all_weights in zip(self.sums, self.weights, strict=True):
            weights = all_weights[which, part]
            np.multiply(misclosure, weights.transpose(1, 2, 0)[..., None], out=weighted)
            sums.add(which, seen, products, weights, weighted)
        # the last weights are those of chi2
        self.squares[which] += product_sum(weighted.transpose(2, 0, 1, 3), misclosure.transpose(2, 0, 1, 3))

    def _seen(self, at: tuple[slice, slice], shift: Array) -> Seen:
        """Return the objects with their errors ``shift``."""
        d_ra, d_dec = shift[:, RA] / self.cos_dec[at], shift[:, DEC]
        if self.small[at].all():
            s, c = _turn(self.sin_ra[at], self.cos_ra[at], d_ra)
            sin_dec, cos_dec = _turn(self.sin_dec[at], self.cos_dec[at], d_dec)
        else:
            ra, dec = self.ra[at] + d_ra, self.dec[at] + d_dec
            s, c, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
        if cos_dec.min() < frames.POLE_LIMIT:  # negative beyond the pole, where dec is above 90 deg
            item, catalogue, row = np.argwhere(cos_dec < frames.POLE_LIMIT)[0]
            dec = self.dec[at][item, catalogue, 0] + d_dec[item, catalogue, row]
            raise frames.pole_error(at[0].start + int(item), float(dec))
        pmra, pmdec = self.pmra[at] + shift[:, PMRA], self.pmdec[at] + shift[:, PMDEC]
        return Seen(s, c, sin_dec, cos_dec, pmra, pmdec, pmra / cos_dec, pmdec / cos_dec)

    def _subtract_truth(self, seen: Seen, misclosure: Array) -> None:
        """Subtract A times the truth, A the noisy design, so that the solution is estimate - truth."""
        scenario, truth = self.setup.scenario, self.setup.truth
        ra, dec, pmra, pmdec = misclosure.swapaxes(0, 1)
        if scenario.corrections:
            turn = seen.c * truth[0] + seen.s * truth[1]  # eta.epsilon cos dec
            pmra += seen.pmdec_turn * turn
            pmdec -= seen.pmra_turn * turn
        _add_field(ra, dec, seen, -truth[ORIENTATION])
        _add_field(pmra, pmdec, seen, -truth[SPIN])
        if scenario.solve_glide:  # g adds p.g and q.g
            along_p = np.zeros_like(pmra)
            _add_field(pmdec, along_p, seen, -truth[GLIDE])
            pmra -= along_p


def _add_field(along_q: Array, along_p: Array, seen: Seen, vector: Array) -> None:
    """Add q.vector to the one and -p.vector to the other, in place."""
    x, y, z = vector
    along_q += (seen.c * -x - seen.s * y) * seen.sin_dec
    along_q += seen.cos_dec * z
    along_p += seen.s * x
    along_p -= seen.c * y


def _turn(sin: Array, cos: Array, angle: Array) -> tuple[Array, Array]:
    """Return sin and cos of the sum of two angles by the addition theorem; ``angle`` is below `SMALL_ANGLE`."""
    square = angle * angle
    minus = (square * (1.0 / 24.0) - 0.5) * square  # cos x - 1, without its cancellation
    small_sin = (square * (-1.0 / 6.0) + 1.0) * angle
    return sin * minus + cos * small_sin + sin, cos * minus - small_sin * sin + cos
