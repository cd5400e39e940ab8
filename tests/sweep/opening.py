"""Stores as a run opens them."""

from linksweep.sweep.stores.create import create_store, find_store
from linksweep.sweep.stores.store import Store


def existing_store(where, study):
    """Return the store of a study, None where there is none."""
    found = find_store(where, study)
    return None if found is None else Store(found, study)


def create_or_resume(where, study, attributes):
    """Return the store of a study, made if there is none."""
    store = Store(find_store(where, study) or create_store(where, study, attributes), study)
    store.keep_copy()
    return store
