"""The arrays that a ledger consists of: their shapes, kinds and descriptions."""

from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from sweep.contract import Experiment
from sweep.planning.block_rows import KEY_BYTES
from sweep.stores.checksums import noting
from sweep.stores.chunked_rows import Column
from sweep.stores.location import Location

START_BYTES = 8
DIGEST_BYTES = 16
FEWEST_ROWS = 64
CHUNK_BYTES = {"index": 2**20, "digests": 2**20, "sums": 2**21, "samples": 2**22}
"""Few files for many blocks, against what each flush writes again."""

KINDS = {"samples": "float64", "sums": "float64", "digests": "uint8", "index": "uint8"}
"""What each array is of, in the order of writing."""


def shapes_of(experiment: Experiment, *, keep_samples: bool) -> dict[str, list[int]]:
    """Return rows and width of a chunk of each array, as a new store will remember them."""
    widths = {"index": KEY_BYTES + START_BYTES, "sums": experiment.sums_width, "digests": DIGEST_BYTES}
    if keep_samples:
        widths["digests"] = 2 * DIGEST_BYTES
        widths["samples"] = experiment.samples_width
    return {name: [_rows(name, width), width] for name, width in widths.items()}


def _rows(name: str, width: int) -> int:
    row = width if KINDS[name] == "uint8" else 8 * max(width, 1)
    return int(max(FEWEST_ROWS, 2 ** int(np.log2(max(1.0, CHUNK_BYTES[name] / row)))))


def columns_of(location: Location, shapes: Mapping[str, Sequence[int]], keys: Collection[str]) -> dict[str, Column]:
    """Return the arrays of a ledger, in the order of writing, with their chunks among the names of all files."""
    return {
        name: Column(location, f"blocks/{name}", shapes[name], dtype, keys)
        for name, dtype in KINDS.items()
        if name in shapes
    }


def damaged_descriptions(columns: Iterable[Column], documents: Mapping[str, bytes | None]) -> dict[str, str]:
    """Return what is wrong with which description of an array; one that is missing was not written yet, unless there
    are chunks.
    """
    damaged: dict[str, str] = {}
    for column in columns:
        with noting(damaged, column.description):
            if documents[column.description] is not None or column.chunks:
                column.check_description(documents[column.description])
    return damaged
