"""Records where a store was written: by whom, on which host, at which place."""

import getpass
import json
import os
from collections.abc import Mapping
from typing import Any

from linksweep.sweep.stores.folder import Folder
from linksweep.sweep.stores.location import Location
from linksweep.sweep.studies.record import host

ORIGIN = "written_by"
"""The attribute of a store that holds its origin, as JSON."""


def origin(location: Location) -> str:
    """Return the host, the user and the place of a store that this process writes."""
    place = str(location.path.resolve()) if isinstance(location, Folder) else str(location)
    return json.dumps({"host": host(), "user": _user(), "path": place})


def was_written_here(location: Location, attributes: Mapping[str, Any]) -> bool:
    """Return whether the last run that wrote to a store was of this user, on this host, with the store at this place.

    The store itself says so: this guards against code in a copied store, not against someone who forges these three.
    """
    return bool(attributes.get(ORIGIN) == origin(location))


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in a container
        return str(os.getuid())
