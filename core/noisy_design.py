"""The link while the reference has errors too: its design differs from one realisation to the next.

Normal equations are added up over objects, for many realisations at once, without their design matrices.  With sin and
cos s, c of ra and S, C of dec (p = (-s, c, 0), q = (-S c, -S s, C), eta = (c, s, 0)/C), the entries of q q^T and p p^T
are linear in 1 and seven products of these; those of q p^T need five more.  One matrix product with the weights of the
four observables gives all blocks that proper motions do not enter; the terms A21 take a few sums of products.  All is
computed in arrays that are used again for the next objects: temporary ones would cost more than the arithmetic.
"""

from typing import NamedTuple

import numpy as np

from linksweep.core.fixed_design import Solved
from linksweep.core.frames import Array, product_sum
from linksweep.core.link import POLE_LIMIT, UnlikeError, hold, pole_error, solve_normal
from linksweep.core.setup import Setup, SharedSums, Tile
from linksweep.core.unknowns import GLIDE, ORIENTATION, SPIN, link_unknowns

RA, DEC, PMRA, PMDEC = range(4)

ELEMENTS = 8192
"""Objects x realisations in one array operation, so that its arrays of 64 KiB stay near the core."""

SMALL_ANGLE = 1e-3
"""Angle (rad) below which two terms of the series of sin x and 1 - cos x are exact to rounding: x^5/120 and x^6/720 are
below 1e-17.
"""

FARTHEST = 10.0
"""Largest normal deviate that is expected, in sigma; one beyond has a probability of 1e-23."""


class Seen(NamedTuple):
    """Noisy reference objects, each (..., m, rows): sin and cos of ra and dec, proper motions, and these divided by
    cos dec.
    """

    s: Array
    c: Array
    sin_dec: Array
    cos_dec: Array
    pmra: Array
    pmdec: Array
    pmra_turn: Array
    pmdec_turn: Array


class NormalSums:
    """A^T W A and A^T W y of ``rows`` realisations of a catalogue, or of each of a stack.

    At most so many objects of a catalogue are added at a time as ``arrays`` have, of shape (..., objects).
    """

    def __init__(self, arrays: tuple[int, ...], rows: int, corrections: bool, glide: bool) -> None:
        unknowns, stack = len(link_unknowns(glide)), arrays[:-1]
        self.corrections, self.glide = corrections, glide
        self.total_weight = np.zeros((*stack, 4))
        self.products = np.empty((12 if glide else 7, *arrays, rows))
        self.product_sums = np.zeros((len(self.products), *stack, 4, rows))
        self.scratch = np.empty((4, *arrays, rows))
        # what A21 adds to the upper rows of A^T W A, those of epsilon
        self.turns = np.zeros((ORIENTATION.stop, unknowns, *stack, rows))
        self.right = np.zeros((unknowns, *stack, rows))

    def add(self, seen: Seen, weights: Array, weighted: Array) -> None:
        """Add objects with ``weights`` (..., m, 4, 1) and weighted differences ``weighted`` (..., m, 4, rows)."""
        self.total_weight += weights[..., 0].sum(axis=-2)
        products = self._products(seen)
        # one matrix product for all four observables: their weights are the same in all realisations
        self.product_sums += np.swapaxes(weights[..., 0], -1, -2) @ products
        ra, dec, pmra, pmdec = (weighted[..., k, :] for k in (RA, DEC, PMRA, PMDEC))
        self._add_right(self.right[ORIENTATION], seen, ra, dec)
        self._add_right(self.right[SPIN], seen, pmra, pmdec)
        if self.glide:
            self._add_right(self.right[GLIDE], seen, pmdec, -pmra)
        if self.corrections:
            self._add_turns(seen, products, weights, weighted)

    def equations(self) -> tuple[Array, Array]:
        """Return A^T W A, shape (K, K, ..., rows), and A^T W y, shape (K, ..., rows)."""
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

    def _products(self, seen: Seen) -> Array:
        s, c, sin_dec, cos_dec = seen[:4]
        products = self.products[..., : s.shape[-2], :]
        cc, cs, ss = products[:3]
        np.multiply(c, c, out=cc)
        np.multiply(c, s, out=cs)
        np.multiply(sin_dec, sin_dec, out=ss)
        np.multiply(ss, cc, out=products[3])
        np.multiply(ss, cs, out=products[4])
        mixed = np.multiply(sin_dec, cos_dec, out=self.scratch[0, ..., : s.shape[-2], :])
        np.multiply(mixed, c, out=products[5])
        np.multiply(mixed, s, out=products[6])
        if self.glide:
            products[7] = sin_dec
            np.multiply(sin_dec, cc, out=products[8])
            np.multiply(sin_dec, cs, out=products[9])
            np.multiply(cos_dec, c, out=products[10])
            np.multiply(cos_dec, s, out=products[11])
        return products

    def _squares(self, along_q: int, along_p: int) -> Array:
        """Return sum(w q q^T + w' p p^T), w and w' the weights of two observables; shape (3, 3, ..., rows)."""
        # C^2 = 1 - S^2 and s^2 = 1 - c^2: with the sum of the weights, two products fewer
        ss, ss_cc, ss_cs, sc_c, sc_s = self.product_sums[2:7, ..., along_q, :]
        whole, other = (self.total_weight[..., [k]] for k in (along_q, along_p))
        cc_p, cs_p = self.product_sums[:2, ..., along_p, :]
        xy, xz, yz = ss_cs - cs_p, -sc_c, -sc_s
        return np.array(
            [[ss_cc + other - cc_p, xy, xz], [xy, ss - ss_cc + cc_p, yz], [xz, yz, whole - ss]],
        )

    def _crossed(self, observable: int) -> Array:
        """Return sum(w q p^T), w the weights of an observable; shape (3, 3, ..., rows)."""
        sin_dec, s_cc, s_cs, cos_c, cos_s = self.product_sums[7:, ..., observable, :]
        none = np.zeros_like(sin_dec)
        return np.array([[s_cs, -s_cc, none], [sin_dec - s_cc, -s_cs, none], [-cos_s, cos_c, none]])

    def _add_right(self, right: Array, seen: Seen, along_q: Array, along_p: Array) -> None:
        """Add sum(q a - p b) of a and b of shape (..., m, rows)."""
        s, c, sin_dec, cos_dec = seen[:4]
        down = np.multiply(sin_dec, along_q, out=self.scratch[0, ..., : s.shape[-2], :])
        right[0] += _dot(s, along_p) - _dot(c, down)
        right[1] -= _dot(c, along_p) + _dot(s, down)
        right[2] += _dot(cos_dec, along_q)

    def _add_turns(self, seen: Seen, products: Array, weights: Array, weighted: Array) -> None:
        """Add the terms of A21, whose rows are -pmdec eta and pmra eta in the third and fourth observable."""
        s, c, sin_dec = seen[:3]
        cc, cs = products[:2]
        turns, right = self.turns, self.right
        u, v = seen.pmdec_turn, seen.pmra_turn
        wu, wv, term, work = self.scratch[..., : s.shape[-2], :]
        weight_pmra, weight_pmdec = weights[..., PMRA, :], weights[..., PMDEC, :]
        np.multiply(weight_pmra, u, out=wu)
        np.multiply(weight_pmdec, v, out=wv)

        np.multiply(wu, u, out=term)  # of eta eta^T
        term += np.multiply(wv, v, out=work)
        xx, xy = _dot(term, cc), _dot(term, cs)
        turns[0, 0] += xx
        turns[0, 1] += xy
        turns[1, 1] += term.sum(axis=-2) - xx

        np.multiply(v, weighted[..., PMDEC, :], out=term)  # of eta y
        term -= np.multiply(u, weighted[..., PMRA, :], out=work)
        right[0] += _dot(term, c)
        right[1] += _dot(term, s)

        _add_turned(turns[:, SPIN], np.multiply(wu, sin_dec, out=term), wv, cc, cs)
        np.multiply(weight_pmra, seen.pmdec, out=work)
        turns[0, SPIN][2] -= _dot(work, c)
        turns[1, SPIN][2] -= _dot(work, s)
        if self.glide:
            wv *= sin_dec
            _add_turned(turns[:, GLIDE], np.negative(wv, out=term), wu, cc, cs)
            np.multiply(weight_pmdec, seen.pmra, out=work)
            turns[0, GLIDE][2] += _dot(work, c)
            turns[1, GLIDE][2] += _dot(work, s)


def _add_turned(block: Array, a: Array, b: Array, cc: Array, cs: Array) -> None:
    """Add sum((c, s) (a c + b s, a s - b c)^T), the x and y columns of eta (-u q - v p)^T and eta (v q - u p)^T."""
    xx, xy = _dot(a, cc) + _dot(b, cs), _dot(a, cs) - _dot(b, cc)
    block[0, 0] += xx
    block[0, 1] += xy
    block[1, 0] += xy + b.sum(axis=-2)
    block[1, 1] += a.sum(axis=-2) - xx


def _dot(a: Array, b: Array) -> Array:
    """Return the sum over objects of a b; shape (..., rows)."""
    return np.asarray(np.einsum("...or,...or->...r", a, b))


class NoisyDesign:
    """The link of a catalogue, or a stack of them, whose reference has errors; its arrays (..., N, 1) and (..., N, 4,
    1) broadcast against (..., N, 4, rows).
    """

    def __init__(self, setup: Setup) -> None:
        catalogue, stacked = setup.catalogue, setup.stacked
        ra, dec = stacked(catalogue.ra)[..., None], stacked(catalogue.dec)[..., None]
        self.setup = setup
        self.ra, self.dec = ra, dec
        self.sin_ra, self.cos_ra, self.sin_dec, self.cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
        self.pmra, self.pmdec = stacked(catalogue.pmra)[..., None], stacked(catalogue.pmdec)[..., None]
        self.differences = stacked(setup.differences)[..., None]
        reference_sigma = stacked(setup.reference.sigma)
        self.reference_sigma = reference_sigma[..., None]
        self.satellite_sigma = stacked(setup.satellite.sigma)[..., None]
        self.small = FARTHEST * reference_sigma[..., :2].max(axis=-1) < SMALL_ANGLE * self.cos_dec[..., 0]
        # the two ways round differently, so a stack must go the same way as each of its catalogues alone
        if setup.stack and not self.small.all():
            raise UnlikeError("some of the catalogues have objects whose errors are no small angles")
        counted = setup.counted[:, None]
        inverse_variance = counted * stacked(setup.sigma)[..., None] ** -2.0
        equal = setup.scenario.weighting == "equal"
        # the weights of the solution, then those of chi2 where they differ
        self.weights = [np.ones_like(inverse_variance) * counted, inverse_variance] if equal else [inverse_variance]

    def begin(self, rows: int, drawn: Array | None, shared: SharedSums) -> Solved:
        """Begin a chunk of ``rows`` realisations, whose zonal errors are drawn already (``drawn``)."""
        setup = self.setup
        self.drawn, self.squares = drawn, np.zeros(setup.stack)
        self.objects = min(max(1, ELEMENTS // rows), setup.n_obj)
        arrays = (*setup.stack, self.objects)
        # of full size also where fewer objects are left, so that the same memory serves all parts
        self.errors = np.empty((3, *arrays, 4, rows))
        self.seen = np.empty((len(Seen._fields), *arrays, rows))
        self.scratch = np.empty((3, *arrays, rows))
        # an orientation that stays at its true value has no derivatives
        turns = setup.scenario.corrections and setup.measured[0]
        self.sums = [NormalSums(arrays, rows, turns, setup.scenario.solve_glide) for _ in self.weights]
        return self.solved

    def add(self, satellite: Tile | None, reference: Tile) -> None:
        """Add the objects of a tile, the same on both sides; None for a satellite without errors."""
        normals = reference.head(self.setup.n_obj)
        others = satellite.normals if satellite is not None and self.setup.satellite else None
        for first in range(0, normals.shape[-3], self.objects):
            part = normals[..., first : first + self.objects, :, :]
            inside = slice(first, first + part.shape[-3])
            self._add(reference.start + first, part, None if others is None else others[..., inside, :, :])

    def solved(self) -> tuple[Array, Array]:
        """Return estimate - truth of each realisation, (..., K, rows), and the sum of chi2, (...)."""
        normal, right = self.sums[0].equations()
        error = solve_normal(hold(normal, self.setup.fixed), right)
        # chi2 has the weights of the errors, also where the solution has equal ones
        normal, right = self.sums[-1].equations()
        terms = error * (np.einsum("kl...,l...->k...", normal, error) - 2.0 * right)
        error, terms = (np.ascontiguousarray(np.moveaxis(array, 0, -2)) for array in (error, terms))
        return error, self.squares + terms.reshape(*self.setup.stack, -1).sum(axis=-1)

    def _add(self, start: int, reference: Array, satellite: Array | None) -> None:
        setup, n_obj = self.setup, reference.shape[-3]
        part = slice(start, start + n_obj)
        shift, misclosure, weighted = self.errors[..., :n_obj, :, :]
        standardised = setup.reference.standardised(reference, start)
        np.multiply(standardised, self.reference_sigma[..., part, :, :], out=shift)
        np.add(shift, self.differences[..., part, :, :], out=misclosure)
        if satellite is not None:
            noise = setup.satellite.standardised(satellite, start)
            misclosure -= np.multiply(noise, self.satellite_sigma[..., part, :, :], out=weighted)
        if setup.satellite.field is not None and self.drawn is not None:
            misclosure -= setup.satellite.field.values(self.drawn, part)
        seen = self._seen(part, shift)
        # before the sums: they are then those of the error alone, however large the truth
        self._subtract_truth(seen, misclosure)
        for sums, all_weights in zip(self.sums, self.weights, strict=True):
            weights = all_weights[..., part, :, :]
            sums.add(seen, weights, np.multiply(misclosure, weights, out=weighted))
        self.squares += product_sum(weighted, misclosure)  # the last weights are those of chi2

    def _seen(self, part: slice, shift: Array) -> Seen:
        n_obj = shift.shape[-3]
        seen, scratch = Seen(*self.seen[..., :n_obj, :]), self.scratch[..., :n_obj, :]
        sin_ra, cos_ra, sin_dec, cos_dec, pmra, pmdec = (
            array[..., part, :]
            for array in (self.sin_ra, self.cos_ra, self.sin_dec, self.cos_dec, self.pmra, self.pmdec)
        )
        d_ra, d_dec = np.divide(shift[..., 0, :], cos_dec, out=scratch[0]), shift[..., 1, :]
        if self.small[..., part].all():
            _turn(sin_ra, cos_ra, d_ra, scratch[1:], seen.s, seen.c)
            _turn(sin_dec, cos_dec, d_dec, scratch[1:], seen.sin_dec, seen.cos_dec)
        else:
            ra, dec = self.ra[..., part, :] + d_ra, self.dec[..., part, :] + d_dec
            np.sin(ra, out=seen.s)
            np.cos(ra, out=seen.c)
            np.sin(dec, out=seen.sin_dec)
            np.cos(dec, out=seen.cos_dec)
        if seen.cos_dec.min() < POLE_LIMIT:  # negative beyond the pole, where dec is above 90 deg
            at = tuple(np.argwhere(seen.cos_dec < POLE_LIMIT)[0])
            item = part.start + int(at[-2])
            raise pole_error(item, float(self.dec[(*at[:-2], item, 0)] + d_dec[at]))
        np.add(pmra, shift[..., 2, :], out=seen.pmra)
        np.add(pmdec, shift[..., 3, :], out=seen.pmdec)
        np.divide(seen.pmra, seen.cos_dec, out=seen.pmra_turn)
        np.divide(seen.pmdec, seen.cos_dec, out=seen.pmdec_turn)
        return seen

    def _subtract_truth(self, seen: Seen, misclosure: Array) -> None:
        """Subtract A times the truth, A the noisy design, so that the solution is estimate - truth."""
        scenario, truth = self.setup.scenario, self.setup.truth
        turn, work = self.scratch[:2, ..., : misclosure.shape[-3], :]
        ra, dec, pmra, pmdec = (misclosure[..., k, :] for k in range(4))
        if scenario.corrections:
            np.multiply(seen.c, truth[0], out=turn)
            turn += np.multiply(seen.s, truth[1], out=work)  # eta.epsilon cos dec
            pmra += np.multiply(seen.pmdec_turn, turn, out=work)
            pmdec -= np.multiply(seen.pmra_turn, turn, out=work)
        self._add_field(ra, dec, seen, -truth[ORIENTATION])
        self._add_field(pmra, pmdec, seen, -truth[SPIN])
        if scenario.solve_glide:  # g adds p.g and q.g
            along_p = np.zeros_like(pmra)
            self._add_field(pmdec, along_p, seen, -truth[GLIDE])
            pmra -= along_p

    def _add_field(self, along_q: Array, along_p: Array, seen: Seen, vector: Array) -> None:
        """Add q.vector to the one and -p.vector to the other, in place."""
        x, y, z = vector
        field, work = self.scratch[:2, ..., : along_q.shape[-2], :]
        np.multiply(seen.c, -x, out=field)
        field -= np.multiply(seen.s, y, out=work)
        field *= seen.sin_dec
        along_q += field
        along_q += np.multiply(seen.cos_dec, z, out=work)
        along_p += np.multiply(seen.s, x, out=work)
        along_p -= np.multiply(seen.c, y, out=work)


def _turn(sin: Array, cos: Array, angle: Array, scratch: Array, sin_out: Array, cos_out: Array) -> None:
    """Write sin and cos of the sum of two angles by the addition theorem; ``angle`` is below `SMALL_ANGLE`."""
    small_sin, minus = scratch  # sin of the small angle, and its cos - 1
    np.multiply(angle, angle, out=small_sin)
    np.multiply(small_sin, 1.0 / 24.0, out=minus)
    minus -= 0.5  # cos x - 1 = x^2 (x^2/24 - 1/2), without the cancellation of cos x and 1
    minus *= small_sin
    small_sin *= -1.0 / 6.0
    small_sin += 1.0
    small_sin *= angle
    np.multiply(sin, minus, out=sin_out)
    np.multiply(cos, small_sin, out=cos_out)
    sin_out += cos_out
    sin_out += sin
    np.multiply(cos, minus, out=cos_out)
    small_sin *= sin
    cos_out -= small_sin
    cos_out += cos
