"""Where a store was written: by whom, on which host, at which place."""

import getpass
import json
import os
from collections.abc import Mapping
from typing import Any

from sweep.stores.folder import Folder
from sweep.stores.location import Location
from sweep.studies.provenance import host

ORIGIN = "written_by"
"""The attribute of a store that holds it, as JSON."""


def origin(location: Location) -> str:
    """Return the host, the user and the place of a store that this process writes."""
    place = str(location.path.resolve()) if isinstance(location, Folder) else str(location)
    return json.dumps({"host": host(), "user": _user(), "path": place})


def was_written_here(location: Location, attributes: Mapping[str, Any]) -> bool:
    """Return whether the last run that wrote to a store was of this user, on this host, with the store at this place.

    It is what the store says: a guard against code that came with a copy, not against one who forges these three.
    """
    return bool(attributes.get(ORIGIN) == origin(location))


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a number without a name, as in a container
        return str(os.getuid())
