"""Stored results of `sweep tie` and `sweep forecast`, as opposed to stores of studies."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linksweep.sweep.contract import SweepError
from linksweep.sweep.stores.folder import Folder
from linksweep.sweep.stores.location import reading

if TYPE_CHECKING:
    import xarray as xr

RESULTS = ("tie", "forecast")


def result_at(where: Any) -> "xr.Dataset | None":
    """Return a stored link or forecast, loaded into memory; None for anything else.

    Raises SweepError for one that is damaged.
    """
    folder = Path(str(where))
    try:
        attributes = json.loads(Folder(folder).get("zarr.json") or b"{}").get("attributes", {})
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    if not isinstance(attributes, dict) or attributes.get("result") not in RESULTS:
        return None
    import xarray as xr

    with reading(Folder(folder)):
        Folder(folder).require_plain()
    try:
        with xr.open_zarr(folder) as stored:
            result: xr.Dataset = stored.load()
    except Exception as error:  # decoders of a damaged file may raise anything
        raise SweepError(f"is damaged: {' '.join(str(error).split())}", str(where)) from error
    return result
