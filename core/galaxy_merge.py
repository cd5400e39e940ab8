"""Entries of several galaxy catalogues that are one galaxy: by a shared identifier, else by position."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from linksweep.core.arrays import Array, Indices
from linksweep.core.sky_pairs import Positions, one_to_one, pairs_within

_Links = tuple[Indices, Indices, Array, Array, Array]
"""Galaxies and entries that may be one, their offsets, and ra and dec of the galaxies' entries, which settle ties."""


@dataclass(frozen=True)
class GalaxyCatalogue:
    """Positions, an identifier that galaxy catalogues share (the PGC number; 0 for none; shape (N,)) and the match
    radius (rad).
    """

    positions: Positions
    identifier: Indices
    radius: float


def merge_galaxies(
    catalogues: Sequence[GalaxyCatalogue], trees: Sequence[KDTree], merge_radius: float | None = None
) -> tuple[list[Indices], Indices]:
    """Return a galaxy's number for every entry of every catalogue, and the identifier of every galaxy (0 for none).

    Entries with the same identifier are one galaxy wherever they stand.  Otherwise an entry is the galaxy of an entry
    of an earlier catalogue within ``merge_radius`` (see `Rules`), one to one and closest first, unless both have
    identifiers.  ``trees`` are the catalogues' sky trees.  Raises ValueError as `pairs_within`.
    """
    labels: list[Indices] = []
    known = np.empty(0, dtype=np.int64)  # identifier of each galaxy so far
    for c, catalogue in enumerate(catalogues):
        label = _label_by_identifier(catalogue.identifier, known)
        linked = np.zeros(len(known), dtype=bool)
        linked[label[label >= 0]] = True
        links: list[_Links] = []
        for earlier, tree, earlier_label in zip(catalogues[:c], trees[:c], labels, strict=True):
            radius = earlier.radius + catalogue.radius if merge_radius is None else merge_radius
            pairs = pairs_within(tree, trees[c], radius)
            galaxy, entry = earlier_label[pairs.first], pairs.second
            # neither side is linked yet, and at most one has an identifier
            free = ~linked[galaxy] & (label[entry] < 0) & ((known[galaxy] == 0) | (catalogue.identifier[entry] == 0))
            where, at = earlier.positions, pairs.first[free]
            links.append((galaxy[free], entry[free], pairs.offset[free], where.ra[at], where.dec[at]))
        if links:
            galaxy, entry = _closest_links(links, catalogue, known)
            label[entry] = galaxy
            known = known.copy()
            known[galaxy] = np.maximum(known[galaxy], catalogue.identifier[entry])
            label = np.where(label < 0, _label_by_identifier(catalogue.identifier, known), label)
        known = _number_the_rest(label, catalogue.identifier, known)
        labels.append(label)
    return labels, known


def _label_by_identifier(identifier: Indices, known: Indices) -> Indices:
    """Return the number of the galaxy with each entry's identifier, -1 for none."""
    label = np.full(len(identifier), -1, dtype=np.int64)
    named = np.flatnonzero(known)
    if len(named):
        named = named[np.argsort(known[named])]
        at = np.minimum(np.searchsorted(known[named], identifier), len(named) - 1)
        hit = (identifier > 0) & (known[named[at]] == identifier)
        label[hit] = named[at[hit]]
    return label


def _closest_links(links: Sequence[_Links], catalogue: GalaxyCatalogue, known: Indices) -> tuple[Indices, Indices]:
    """Return galaxies and their entries, one to one, closest first; entries of one identifier count as one."""
    galaxy, entry, offset, ra, dec = (np.concatenate(column) for column in zip(*links, strict=True))
    where, identifier = catalogue.positions, catalogue.identifier
    ties = (known[galaxy], identifier[entry], where.ra[entry], where.dec[entry], ra, dec)
    order = np.lexsort((*ties, offset))
    galaxy, entry = galaxy[order], entry[order]
    object_of_entry = np.where(identifier > 0, identifier, -1 - np.arange(len(identifier)))[entry]
    _, number = np.unique(object_of_entry, return_inverse=True)
    first = np.sort(np.unique(galaxy * (len(number) + 1) + number, return_index=True)[1])
    first = first[one_to_one(galaxy[first], number[first])]
    return galaxy[first], entry[first]


def _number_the_rest(label: Indices, identifier: Indices, known: Indices) -> Indices:
    """Number the entries that have no galaxy yet, in place; return the identifiers of all galaxies."""
    new = np.flatnonzero(label < 0)
    named, nameless = new[identifier[new] > 0], new[identifier[new] == 0]
    names, inverse = np.unique(identifier[named], return_inverse=True)
    label[named] = len(known) + inverse
    label[nameless] = len(known) + len(names) + np.arange(len(nameless))
    return np.concatenate([known, names, np.zeros(len(nameless), dtype=np.int64)])
