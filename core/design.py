"""The unknowns of the simulated link, where each block of them stands, and the design matrix."""

import numpy as np

from linksweep.core.arrays import Array
from linksweep.core.blocks import Glide, Objects, Orientation, Rotation
from linksweep.core.link import require_off_poles
from linksweep.core.unknowns import Unknowns


def link_unknowns(glide: bool = False, corrections: bool = True) -> Unknowns:
    """Return the blocks of unknowns: orientation (rad), spin (rad/yr), and the glide (rad/yr) on request.

    ``corrections=False`` drops the terms A21 of the orientation.
    """
    return Unknowns((Orientation(corrections), Rotation(), *([Glide()] if glide else [])))


LABELS = link_unknowns().labels
"""The unknowns that are always solved for, in their order."""
GLIDE_LABELS = Glide().labels
ALWAYS = slice(0, len(LABELS))
ORIENTATION, SPIN, GLIDE = (link_unknowns(glide=True).part(name) for name in link_unknowns(glide=True).names)
"""Where the blocks stand among the unknowns."""


def design_matrix(
    ra: Array, dec: Array, pmra: Array, pmdec: Array, corrections: bool = True, glide: bool = False
) -> Array:
    """Return the derivatives of the observables by the unknowns, shape (4, ..., K): observable, object, unknown.

    Positions (rad) and proper motions (rad/yr, pmra = mu_alpha*) are those of the reference catalogue, of one shape
    ``(...)``.  Rows: ``d alpha* = q.eps``, ``d dec = -p.eps``, ``d pmra = -pmdec eta.eps + q.omega`` and
    ``d pmdec = pmra eta.eps - p.omega`` with ``eta = (cos ra, sin ra, 0)/cos dec``: the triad turns by eta.eps about
    the line of sight, which is what the paper's A21 says for mu_alpha* (see `paper_design_matrix`).
    ``corrections=False`` drops these terms; ``glide=True`` adds three unknowns g with ``d pmra = p.g`` and
    ``d pmdec = q.g``.
    Raises LinkError for a source at a pole, where ra is undefined.
    """
    objects = Objects(ra, dec, pmra, pmdec)
    require_off_poles(dec, objects.triad.q[2])
    _, derivatives = link_unknowns(glide, corrections).derivatives(objects)
    return np.moveaxis(derivatives, 0, -1)


def paper_design_matrix(ra: Array, dec: Array, mu_alpha: Array, mu_delta: Array) -> Array:
    """Return the paper's matrix for mu_alpha = d(alpha)/dt *without* cos dec; shape (4, N, 6).

    Its third observable is ``(mu_alpha,ref - mu_alpha,sat) cos(dec_ref)``, not a difference of mu_alpha*.
    Source: Metz & Geffert 2004, Eqs. 11-13.  A21 as printed is right; Eq. 9 has ``cos^2 dec`` for ``1/cos^2 dec``.
    """
    design = design_matrix(ra, dec, mu_alpha, mu_delta, corrections=False)
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    design[2, :, 0] = -cos_ra / cos_dec * mu_delta + sin_dec * sin_ra * mu_alpha
    design[2, :, 1] = -sin_ra / cos_dec * mu_delta - sin_dec * cos_ra * mu_alpha
    design[3, :, 0] = cos_ra * mu_alpha
    design[3, :, 1] = sin_ra * mu_alpha
    return design
