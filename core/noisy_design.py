"""The link while the reference has errors too: its design differs from one realisation to the next.

Normal equations are added up over objects, for many realisations at once, without their design matrices.  With sin and
cos s, c of ra and S, C of dec (p = (-s, c, 0), q = (-S c, -S s, C), eta = (c, s, 0)/C), the entries of q q^T and p p^T
are linear in 1 and seven products of these; those of q p^T need five more.  One matrix product with the weights of the
four observables gives all blocks that proper motions do not enter; the terms A21 take a few sums of products.  All is
computed in arrays that are used again for the next objects: temporary ones would cost more than the arithmetic.
"""

import math
from typing import NamedTuple

import numpy as np

from linksweep.core.fixed_design import Solved
from linksweep.core.frames import Array, product_sum
from linksweep.core.link import POLE_LIMIT, UnlikeError, hold, pole_error, solve_normal
from linksweep.core.setup import Noise, Setup, SharedSums, Tile
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

    def products(self, out: Array, work: Array) -> Array:
        """Write the products of sin and cos into the first axis of ``out``: seven, or with a glide twelve."""
        s, c, sin_dec, cos_dec = self[:4]
        cc, cs, ss = out[:3]
        np.multiply(c, c, out=cc)
        np.multiply(c, s, out=cs)
        np.multiply(sin_dec, sin_dec, out=ss)
        np.multiply(ss, cc, out=out[3])
        np.multiply(ss, cs, out=out[4])
        mixed = np.multiply(sin_dec, cos_dec, out=work)
        np.multiply(mixed, c, out=out[5])
        np.multiply(mixed, s, out=out[6])
        if len(out) > 7:
            out[7] = sin_dec
            np.multiply(sin_dec, cc, out=out[8])
            np.multiply(sin_dec, cs, out=out[9])
            np.multiply(cos_dec, c, out=out[10])
            np.multiply(cos_dec, s, out=out[11])
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

    def add(self, which: slice, seen: Seen, products: Array, weights: Array, weighted: Array, scratch: Array) -> None:
        """Add objects of some of the catalogues, with ``weights`` (catalogues, m, 4) and weighted differences
        ``weighted`` (m, 4, catalogues, rows).
        """
        self.total_weight[which] += weights.sum(axis=1)
        # one matrix product for all four observables: their weights are the same in all realisations
        self.product_sums[:, which] += weights.swapaxes(1, 2) @ products.swapaxes(1, 2)
        right, (ra, dec, pmra, pmdec) = self.right[:, which], weighted.swapaxes(0, 1)
        _add_right(right[ORIENTATION], seen, ra, dec, scratch[0])
        _add_right(right[SPIN], seen, pmra, pmdec, scratch[0])
        if self.glide:
            _add_right(right[GLIDE], seen, pmdec, -pmra, scratch[0])
        if self.corrections:
            each = weights.transpose(1, 2, 0)[..., None]
            self._add_turns(self.turns[:, :, which], right, seen, products, each, weighted, scratch)

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
        return np.array(
            [[ss_cc + other - cc_p, xy, xz], [xy, ss - ss_cc + cc_p, yz], [xz, yz, whole - ss]],
        )

    def _crossed(self, observable: int) -> Array:
        """Return sum(w q p^T), w the weights of an observable; shape (3, 3, catalogues, rows)."""
        sin_dec, s_cc, s_cs, cos_c, cos_s = self.product_sums[7:, :, observable]
        none = np.zeros_like(sin_dec)
        return np.array([[s_cs, -s_cc, none], [sin_dec - s_cc, -s_cs, none], [-cos_s, cos_c, none]])

    def _add_turns(
        self, turns: Array, right: Array, seen: Seen, products: Array, weights: Array, weighted: Array, scratch: Array
    ) -> None:
        """Add the terms of A21, whose rows are -pmdec eta and pmra eta in the third and fourth observable."""
        s, c, sin_dec = seen[:3]
        cc, cs = products[:2]
        u, v = seen.pmdec_turn, seen.pmra_turn
        wu, wv, term, work = scratch
        np.multiply(weights[:, PMRA], u, out=wu)
        np.multiply(weights[:, PMDEC], v, out=wv)

        np.multiply(wu, u, out=term)  # of eta eta^T
        term += np.multiply(wv, v, out=work)
        xx, xy = _dot(term, cc), _dot(term, cs)
        turns[0, 0] += xx
        turns[0, 1] += xy
        turns[1, 1] += term.sum(axis=0) - xx

        np.multiply(v, weighted[:, PMDEC], out=term)  # of eta y
        term -= np.multiply(u, weighted[:, PMRA], out=work)
        right[0] += _dot(term, c)
        right[1] += _dot(term, s)

        _add_turned(turns[:, SPIN], np.multiply(wu, sin_dec, out=term), wv, cc, cs)
        np.multiply(weights[:, PMRA], seen.pmdec, out=work)
        turns[0, SPIN][2] -= _dot(work, c)
        turns[1, SPIN][2] -= _dot(work, s)
        if self.glide:
            wv *= sin_dec
            _add_turned(turns[:, GLIDE], np.negative(wv, out=term), wu, cc, cs)
            np.multiply(weights[:, PMDEC], seen.pmra, out=work)
            turns[0, GLIDE][2] += _dot(work, c)
            turns[1, GLIDE][2] += _dot(work, s)


def _add_right(right: Array, seen: Seen, along_q: Array, along_p: Array, work: Array) -> None:
    """Add sum(q a - p b) of a and b of shape (m, catalogues, rows)."""
    s, c, sin_dec, cos_dec = seen[:4]
    down = np.multiply(sin_dec, along_q, out=work)
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
        self.setup, self.catalogues = setup, math.prod(setup.stack)

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
            raise UnlikeError("some of the catalogues have objects whose errors are no small angles")
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
        # of full size also where fewer objects or catalogues are left, so that the same memory serves all parts
        columns = self.together, rows
        self.errors = np.empty((3, self.objects, 4, *columns))
        self.seen = np.empty((len(Seen._fields), self.objects, *columns))
        self.products = np.empty((len(self.sums[0].product_sums), self.objects, *columns))
        self.scratch = np.empty((4, self.objects, *columns))
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
        error = solve_normal(hold(normal, self.setup.fixed), right)
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
        scratch = self.scratch[:, *inside]
        seen = self._seen((part, which), shift, Seen(*self.seen[:, *inside]), scratch)
        # before the sums: they are then those of the error alone, however large the truth
        self._subtract_truth(seen, misclosure, scratch)
        products = seen.products(self.products[:, *inside], scratch[0])
        for sums, all_weights in zip(self.sums, self.weights, strict=True):
            weights = all_weights[which, part]
            np.multiply(misclosure, weights.transpose(1, 2, 0)[..., None], out=weighted)
            sums.add(which, seen, products, weights, weighted, scratch)
        # the last weights are those of chi2
        self.squares[which] += product_sum(weighted.transpose(2, 0, 1, 3), misclosure.transpose(2, 0, 1, 3))

    def _seen(self, at: tuple[slice, slice], shift: Array, seen: Seen, scratch: Array) -> Seen:
        """Write the objects with their errors ``shift``."""
        cos_dec = self.cos_dec[at]
        d_ra, d_dec = np.divide(shift[:, RA], cos_dec, out=scratch[0]), shift[:, DEC]
        if self.small[at].all():
            _turn(self.sin_ra[at], self.cos_ra[at], d_ra, scratch[1:3], seen.s, seen.c)
            _turn(self.sin_dec[at], cos_dec, d_dec, scratch[1:3], seen.sin_dec, seen.cos_dec)
        else:
            ra, dec = self.ra[at] + d_ra, self.dec[at] + d_dec
            np.sin(ra, out=seen.s)
            np.cos(ra, out=seen.c)
            np.sin(dec, out=seen.sin_dec)
            np.cos(dec, out=seen.cos_dec)
        if seen.cos_dec.min() < POLE_LIMIT:  # negative beyond the pole, where dec is above 90 deg
            item, catalogue, row = np.argwhere(seen.cos_dec < POLE_LIMIT)[0]
            dec = self.dec[at][item, catalogue, 0] + d_dec[item, catalogue, row]
            raise pole_error(at[0].start + int(item), float(dec))
        np.add(self.pmra[at], shift[:, PMRA], out=seen.pmra)
        np.add(self.pmdec[at], shift[:, PMDEC], out=seen.pmdec)
        np.divide(seen.pmra, seen.cos_dec, out=seen.pmra_turn)
        np.divide(seen.pmdec, seen.cos_dec, out=seen.pmdec_turn)
        return seen

    def _subtract_truth(self, seen: Seen, misclosure: Array, scratch: Array) -> None:
        """Subtract A times the truth, A the noisy design, so that the solution is estimate - truth."""
        scenario, truth = self.setup.scenario, self.setup.truth
        turn, work = scratch[:2]
        ra, dec, pmra, pmdec = misclosure.swapaxes(0, 1)
        if scenario.corrections:
            np.multiply(seen.c, truth[0], out=turn)
            turn += np.multiply(seen.s, truth[1], out=work)  # eta.epsilon cos dec
            pmra += np.multiply(seen.pmdec_turn, turn, out=work)
            pmdec -= np.multiply(seen.pmra_turn, turn, out=work)
        _add_field(ra, dec, seen, -truth[ORIENTATION], scratch)
        _add_field(pmra, pmdec, seen, -truth[SPIN], scratch)
        if scenario.solve_glide:  # g adds p.g and q.g
            along_p = np.zeros_like(pmra)
            _add_field(pmdec, along_p, seen, -truth[GLIDE], scratch)
            pmra -= along_p


def _add_field(along_q: Array, along_p: Array, seen: Seen, vector: Array, scratch: Array) -> None:
    """Add q.vector to the one and -p.vector to the other, in place."""
    x, y, z = vector
    field, work = scratch[:2]
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
