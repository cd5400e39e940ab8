"""A block of a point: what a worker computes in one piece, and its key in the ledger."""

import struct
from typing import NamedTuple


class Block(NamedTuple):
    """A point's realisations ``part`` of the catalogues of one ``group``: the unit of work, ledger and resuming.

    Catalogues are numbered from ``first_catalogue``; each gets ``n_sim`` realisations from a stream of its own.

    >>> Block(group=0, part=1, first_catalogue=0, n_cat=16, n_sim=512).realisations
    8192
    """

    group: int
    part: int
    first_catalogue: int
    n_cat: int
    n_sim: int

    @property
    def realisations(self) -> int:
        """Realisations in this block."""
        return self.n_cat * self.n_sim


def ledger_key(digest: bytes, block: Block) -> bytes:
    """Return the key of a block in the ledger, 32 bytes: digest, group, part, catalogues, realisations of each.

    Two runs agree on a key if and only if the block's sums are the same numbers.
    """
    return digest + struct.pack("<4I", block.group, block.part, block.n_cat, block.n_sim)
