"""Normal equations added up over objects, for many realisations at once, without their design matrices.

With sin and cos s, c of ra and S, C of dec (p = (-s, c, 0), q = (-S c, -S s, C), eta = (c, s, 0)/C), the entries of
q q^T and p p^T are linear in 1 and seven products of these; those of q p^T need five more.  One matrix product with the
weights of the four observables gives all blocks that proper motions do not enter; the terms A21 take a few sums of
products.
"""

from typing import NamedTuple

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.design import GLIDE, ORIENTATION, SPIN, link_unknowns

RA, DEC, PMRA, PMDEC = range(4)
Z = 2
"""The last component of a block that is a vector."""


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
    """A^T W A and A^T W y of ``rows`` realisations of a catalogue, or of each of a ``stack``; at most ``objects``
    objects of a catalogue are added at a time.
    """

    def __init__(self, objects: int, rows: int, corrections: bool, glide: bool, stack: tuple[int, ...] = ()) -> None:
        unknowns = len(link_unknowns(glide))
        self.corrections, self.glide = corrections, glide
        self.total_weight = np.zeros((*stack, 4))
        self.products = np.empty((12 if glide else 7, *stack, objects, rows))
        self.product_sums = np.zeros((len(self.products), *stack, 4, rows))
        self.scratch = np.empty((4, *stack, objects, rows))
        # what A21 adds to the upper rows of A^T W A, those of epsilon
        self.turns = np.zeros((ORIENTATION.stop, unknowns, *stack, rows))
        self.right = np.zeros((unknowns, *stack, rows))

    def add(self, seen: Seen, weights: Array, weighted: Array) -> None:
        """Add objects with ``weights`` (..., m, 4, 1) and weighted differences ``weighted`` (..., m, 4, rows)."""
        self.total_weight += weights[..., 0].sum(axis=-2)
        products = self._products(seen)
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
        turns[0, SPIN][Z] -= _dot(work, c)
        turns[1, SPIN][Z] -= _dot(work, s)
        if self.glide:
            wv *= sin_dec
            _add_turned(turns[:, GLIDE], np.negative(wv, out=term), wu, cc, cs)
            np.multiply(weight_pmdec, seen.pmra, out=work)
            turns[0, GLIDE][Z] += _dot(work, c)
            turns[1, GLIDE][Z] += _dot(work, s)


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
