"""Finds the store of a study, begins one at a free place, and begins one anew."""

import itertools
from collections.abc import Mapping
from contextlib import suppress
from typing import Any
from uuid import uuid4

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores import chunk_names, snapshot
from linksweep.sweep.stores.checksums import sealed
from linksweep.sweep.stores.identity import changed_points, differences, identity
from linksweep.sweep.stores.location import Location, Where, located, writing
from linksweep.sweep.stores.manifest import MANIFEST, STORE
from linksweep.sweep.stores.opened import OpenStore
from linksweep.sweep.stores.origin import ORIGIN, origin
from linksweep.sweep.stores.root import LEDGER_THEN, ROOT, find_root
from linksweep.sweep.studies.study import Study

RESERVED = {"blocks", "failures"}

RESCUED = "rescued_of"
"""The attribute of a store of results alone: of which store they are that was lost while a run wrote to it."""


def find_store(where: Where, study: Study) -> OpenStore | None:
    """Return the store at a place, None where the place is free.

    Raises SweepError where something else is there, or results that cannot be mixed with this study's.
    """
    location = located(where)
    names = {*study.axes, *study.experiment.coordinates}
    names |= {output.name for output in (*study.experiment.outputs, *study.experiment.sample_outputs)}
    if taken := sorted(RESERVED & names):
        raise SweepError(f"no axis or result can be named {', '.join(taken)}: a store has a group of that name")
    root = find_root(location)
    if root is None:
        if obstacle := location.obstacle():
            raise SweepError(obstacle, str(location))
        return None
    if RESCUED in root["attributes"]:
        raise SweepError(
            "holds results of a store that was lost, and no ledger; give another one with -o", str(location)
        )
    if different := differences(root["attributes"], study):
        raise SweepError(
            ["holds results of a different study, which would be mixed up; give another store with -o", *different],
            str(location),
        )
    return OpenStore(location, root)


def check_points(found: OpenStore, study: Study) -> None:
    """Raise SweepError where rows of a study's table of points differ from those of a store."""
    if changed := changed_points(found.attributes, study):
        raise SweepError(
            [
                "holds a table of other points; a table may only grow at its end: give another store with -o, or "
                "--fresh replaces this one",
                *changed,
            ],
            str(found.location),
        )


def create_store(where: Where, study: Study, attributes: Mapping[str, Any]) -> OpenStore:
    """Make a store at a free place, in one step, in which nothing is done yet."""
    location = located(where)
    with writing(location):
        root = put_root(location, {**attributes, **identity(study), ORIGIN: origin(location), STORE: uuid4().hex})
    return OpenStore(location, root)


def replace_store(where: Where, study: Study, attributes: Mapping[str, Any]) -> OpenStore | None:
    """Begin a store anew: remove the ledger and the results of the one that is there; None where there is none.

    Files that linksweep did not write are left alone.  Raises SweepError where something other than a store is.
    """
    location = located(where)
    root = find_root(location)
    if root is None:
        return None
    emptied = {key: value for key, value in root["attributes"].items() if key not in (LEDGER_THEN, snapshot.CHECKSUMS)}
    with writing(location):
        keys = location.keys()
        arrays = chunk_names.leftovers(keys, snapshot.arrays_of(root))
        ours = {*arrays, *(key for key in keys if key.partition("/")[0] in RESERVED)} - {MANIFEST}
        # If the process is killed after any of these, the old store has merely lost its results, then its blocks.
        put_root(location, emptied)
        for key in (MANIFEST, *sorted(ours)):
            location.delete(key)
        return create_store(location, study, attributes)


def put_root(location: Location, attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Write the root document of a store without results."""
    root = snapshot.root_document({**attributes, "complete": 0, "generation": 0}, {})
    location.put(ROOT, sealed(root, ROOT))
    return root


def free_beside(location: Location) -> Location:
    """Return a free place beside a store, for what was computed for it."""
    for number in itertools.count(1):
        place = located(f"{location}.rescued{number if number > 1 else ''}")
        with suppress(SweepError):
            if find_root(place) is None:
                return place
    raise AssertionError
