"""Begins a store anew where there is one already."""

from collections.abc import Mapping
from typing import Any

from sweep.stores import snapshot
from sweep.stores.location import Where, located, writing
from sweep.stores.opened import OpenStore
from sweep.stores.root import find_root
from sweep.stores.store import RESERVED, create_store
from sweep.studies.study import Study


def replace_store(where: Where, study: Study, attributes: Mapping[str, Any]) -> OpenStore | None:
    """Begin a store anew: remove the ledger and the results of the one that is there; None where none is.

    Files that linksweep did not write are left alone.  Raises SweepError where something else than a store is.
    """
    location = located(where)
    root = find_root(location)
    if root is None:
        return None
    with writing(location):
        keys = location.keys()
        arrays = snapshot.leftovers(keys, snapshot.arrays_of(root))
        ours = {*arrays, *(key for key in keys if key.partition("/")[0] in RESERVED)}
        # The index first: killed from here on, the old store is one that has lost its blocks.
        for key in sorted(ours, key=lambda key: not key.startswith("blocks/index/c/")):
            location.delete(key)
        return create_store(location, study, attributes)
