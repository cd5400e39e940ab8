"""Stores as a run opens them."""

import json
from pathlib import Path

import numpy as np

from linksweep.sweep.running.study_store import create_store, find_store, open_store
from linksweep.sweep.stores.ledger import path_of
from linksweep.sweep.stores.store import OpenStore


def existing_store(where, study):
    """Return the store of a study, None where there is none."""
    found = find_store(where, study)
    return None if found is None else open_store(found, study)


def create_or_resume(where, study, attributes):
    """Return the store of a study, made if there is none."""
    store = open_store(find_store(where, study) or create_store(where, study, attributes), study)
    store.keep_copy()
    return store


def flat(rows):
    """Return rows of sums as floats, (rows, width)."""
    return np.ascontiguousarray(rows).view("<f8").reshape(len(rows), -1)


def parts_of(store, column="rows"):
    """Return the names of the files of a column of the ledger, in a folder or a bucket, in their order."""
    return [path_of(getattr(part, column)) for part in OpenStore(store).ledger().parts]


def rows_on_disk(store):
    """Return how many rows the ledger of a store in a folder has now, whatever a run does meanwhile."""
    try:
        manifest = json.loads((Path(store) / "blocks" / "zarr.json").read_text())["attributes"]["manifest"]
    except FileNotFoundError:
        return 0
    return sum(part["records"] for part in manifest["parts"])
