"""The galaxy search: matches of a star catalogue with galaxy catalogues on the sphere, and how sure each one is.

All positions are for one epoch (`core.sky_pairs.at_epoch`).  Every star-galaxy pair within a catalogue's radius is
found (`core.sky_pairs`), entries that are one galaxy are merged (`core.galaxy_merge`), the rest is resolved one to one,
closest pair first, and each match is classified (`core.galaxy_classes`).

Source: Metz & Geffert 2004, Sect. 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from linksweep.core.arrays import Array, Flags, Indices
from linksweep.core.galaxy_classes import Chance, Rules, chance_pairs, classify
from linksweep.core.galaxy_merge import GalaxyCatalogue, merge_galaxies
from linksweep.core.sky_pairs import (
    Positions,
    count_near,
    displacement,
    occurrences,
    one_to_one,
    pairs_within,
    sky_tree,
)


@dataclass(frozen=True)
class Matches:
    """M star-galaxy matches in order of the star's ra and dec at the epoch of the search; none occurs twice.

    ``star`` indexes the stars, ``catalogue`` and ``entry`` the closest galaxy entry, ``galaxy`` the merged galaxies.
    ``offset`` (rad) and its components ``d_ra`` (with cos dec) and ``d_dec`` are galaxy - star, ``n_sigma`` is the
    offset in units of the combined errors.  ``n_near`` counts other stars within the crowding radius, ``n_rival`` the
    other stars and galaxies within the match radius.  ``found_in`` (M, number of catalogues) says which catalogues
    have the galaxy within their radius, ``code`` is the class, ``reason`` the bits that made it uncertain, and
    ``identifier`` the galaxy's (0 for none).
    """

    star: Indices
    catalogue: Indices
    entry: Indices
    galaxy: Indices
    identifier: Indices
    offset: Array
    d_ra: Array
    d_dec: Array
    n_sigma: Array
    n_near: Indices
    n_rival: Indices
    found_in: Flags
    code: Indices
    reason: Indices
    chance: tuple[Chance, ...]
    n_galaxies: int

    def __len__(self) -> int:
        return len(self.star)


def cross_match(
    stars: Positions, supplement: Flags, catalogues: Sequence[GalaxyCatalogue], rules: Rules | None = None
) -> Matches:
    """Return the one-to-one matches of stars with galaxies, with their class.

    All positions are for one epoch.  ``supplement`` (N,) marks stars of the supplement, which match like the others.
    The result does not depend on the order of rows: pairs at equal offset are ordered by the place of their
    catalogue, then by position and identifier.  Raises ValueError as `pairs_within`.
    """
    rules = rules or Rules()
    star_tree, trees = sky_tree(stars), [sky_tree(c.positions) for c in catalogues]
    found = [pairs_within(star_tree, tree, c.radius) for tree, c in zip(trees, catalogues, strict=True)]
    labels, identifiers = merge_galaxies(catalogues, trees, rules.merge_radius)
    pairs = _Pairs(
        star=np.concatenate([pairs.first for pairs in found]),
        catalogue=np.repeat(np.arange(len(found)), [len(pairs.first) for pairs in found]),
        entry=np.concatenate([pairs.second for pairs in found]),
        galaxy=np.concatenate([label[pairs.second] for label, pairs in zip(labels, found, strict=True)]),
        offset=np.concatenate([pairs.offset for pairs in found]),
    )
    kept, n_rival, found_in = _resolve(pairs, stars, supplement, catalogues, identifiers)

    here = _gather([stars], np.zeros(len(kept.star), dtype=np.int64), kept.star)
    there = _gather([c.positions for c in catalogues], kept.catalogue, kept.entry)
    d_ra, d_dec, n_sigma = displacement(here, there)
    n_near = count_near(star_tree, here, rules.crowding_radius)
    code, reason = classify(supplement[kept.star], n_sigma, n_near, n_rival, rules)
    chance = tuple(
        chance_pairs(star_tree, tree, c.radius, len(pairs.first))
        for tree, c, pairs in zip(trees, catalogues, found, strict=True)
    )
    return Matches(
        **kept._asdict(),
        identifier=identifiers[kept.galaxy],
        d_ra=d_ra,
        d_dec=d_dec,
        n_sigma=n_sigma,
        n_near=n_near,
        n_rival=n_rival,
        found_in=found_in,
        code=code,
        reason=reason,
        chance=chance,
        n_galaxies=len(identifiers),
    )


class _Pairs(NamedTuple):
    """Star-galaxy pairs of all catalogues, each of shape (M,); as in `Matches`."""

    star: Indices
    catalogue: Indices
    entry: Indices
    galaxy: Indices
    offset: Array


def _resolve(
    pairs: _Pairs, stars: Positions, supplement: Flags, catalogues: Sequence[GalaxyCatalogue], identifiers: Indices
) -> tuple[_Pairs, Indices, Flags]:
    """Return the pairs that are matches in order of the star's position, and their ``n_rival`` and ``found_in``."""
    star, which, entry, galaxy, offset = pairs
    there = _gather([c.positions for c in catalogues], which, entry)
    ra, dec = stars.ra[star], stars.dec[star]
    best_first = np.lexsort((identifiers[galaxy], there.ra, there.dec, ra, dec, supplement[star], which, offset))
    _, first, inverse = np.unique(
        (star * len(identifiers) + galaxy)[best_first], return_index=True, return_inverse=True
    )
    nearest = best_first[np.sort(first)]  # the closest entry of each star-galaxy pair
    rivals = occurrences(star[nearest]) + occurrences(galaxy[nearest]) - 2
    winner = np.flatnonzero(one_to_one(star[nearest], galaxy[nearest]))
    winner = winner[np.lexsort((dec[nearest[winner]], ra[nearest[winner]]))]
    kept = nearest[winner]

    match_of_pair = np.full(len(nearest), -1)  # by number of the pair in `inverse`
    match_of_pair[inverse[np.argsort(best_first)[kept]]] = np.arange(len(kept))
    row = match_of_pair[inverse]
    found_in = np.zeros((len(kept), len(catalogues)), dtype=bool)
    found_in[row[row >= 0], which[best_first][row >= 0]] = True
    return _Pairs(*(column[kept] for column in pairs)), rivals[winner], found_in


def _gather(tables: Sequence[Positions], which: Indices, row: Indices) -> Positions:
    """Return the positions in rows of several tables; ``which`` and ``row`` have shape (M,)."""
    columns = np.empty((4, len(row)))
    for t, table in enumerate(tables):
        mine = which == t
        for column, values in zip(columns, (table.ra, table.dec, table.ra_error, table.dec_error), strict=True):
            column[mine] = values[row[mine]]
    return Positions(*columns)
