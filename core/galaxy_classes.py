"""How sure a match of a star with a galaxy is: the rules of the classes, and how many pairs chance would make.

Source: Metz & Geffert 2004, Sect. 3; the rules replace the paper's inspection by eye.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.constants import ARCSEC
from linksweep.core.sky_pairs import chord, uniform_pairs

CERTAIN, UNCERTAIN, SUPPLEMENT = 0, 1, 2

CLASS_NAMES = ("certain", "uncertain", "supplement")
"""Names of the codes `CERTAIN`, `UNCERTAIN` and `SUPPLEMENT`.  Source: Metz & Geffert 2004, Sect. 3.1."""

CROWDED, OFFSET, RIVAL = 1, 2, 4

REASON_NAMES = {CROWDED: "crowded", OFFSET: "offset", RIVAL: "rival"}
"""Names of the bits in `Matches.reason`."""

RING = (5.0, 10.0)
"""Chance pairs are counted in a ring between these multiples of the radius, where no true counterpart is left."""


@dataclass(frozen=True)
class Rules:
    """What makes a match uncertain: a normalised offset above ``k_sigma``, or at least ``crowding_stars`` other stars
    within ``crowding_radius`` (rad).

    ``merge_radius`` (rad) is how far apart entries of two galaxy catalogues may be one galaxy; None for the sum of
    their match radii, so that two entries found at one star are one galaxy.
    """

    k_sigma: float = 3.0
    crowding_radius: float = 120.0 * ARCSEC
    crowding_stars: int = 3
    merge_radius: float | None = None


@dataclass(frozen=True)
class Chance:
    """One catalogue's pairs within its radius, and how many of them chance would make.

    ``uniform`` is for two uniform skies, ``local`` (+- ``local_error``) from the pairs in a ring about the galaxies.
    """

    pairs: int
    uniform: float
    local: float
    local_error: float


def classify(
    supplement: Flags, n_sigma: Array, n_near: Indices, n_rival: Indices, rules: Rules
) -> tuple[Indices, Indices]:
    """Return the class of each match and the bits of the reasons for doubt; all of shape (M,).

    A match is in doubt if its star field is crowded (`CROWDED`), if its offset exceeds k sigma (`OFFSET`) or if there
    was another candidate for the star or the galaxy (`RIVAL`).  Stars of the supplement are a class of their own, as
    in the paper, whatever the doubts.
    """
    reason = (
        CROWDED * (n_near >= rules.crowding_stars) + OFFSET * (n_sigma > rules.k_sigma) + RIVAL * (n_rival > 0)
    ).astype(np.int64)
    code = np.where(supplement, SUPPLEMENT, np.where(reason > 0, UNCERTAIN, CERTAIN))
    return code.astype(np.int64), reason


def chance_pairs(stars: KDTree, galaxies: KDTree, radius: float, n_pairs: int) -> Chance:
    """Return the chance pairs of two sky trees within ``radius`` (rad), beside the ``n_pairs`` that were found."""
    inner, outer = (chord(multiple * radius) for multiple in RING)
    in_inner, in_outer = np.asarray(stars.count_neighbors(galaxies, np.array([inner, outer])), dtype=np.float64)
    to_circle = chord(radius) ** 2 / (outer**2 - inner**2)  # the area of a cap is pi chord^2
    in_ring = float(in_outer - in_inner)
    return Chance(
        pairs=n_pairs,
        uniform=uniform_pairs(stars.n, galaxies.n, radius),
        local=in_ring * to_circle,
        local_error=float(np.sqrt(max(in_ring, 1.0))) * to_circle,  # at least one pair, also where there is none
    )


def second_epoch_pm_error(first_error: float, second_error: float, years: float) -> float:
    """Return the error of a proper motion from two positions ``years`` apart: sqrt(s1^2 + s2^2)/years, in the unit of
    the errors per year.

    Raises ValueError unless ``years`` is above 0.  Source: Metz & Geffert 2004, Sect. 3.2: 117 and 127 mas give about
    6 mas/yr, which is 20 yr with a second epoch without error.
    """
    if not years > 0.0:
        raise ValueError(f"years = {years:g}: two epochs must be some time apart")
    return float(np.hypot(first_error, second_error)) / years
