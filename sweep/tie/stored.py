"""Results of `sweep tie` and `sweep forecast` in a file, told apart from the stores of studies."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweep.contract import SweepError

if TYPE_CHECKING:
    import xarray as xr

RESULTS = ("tie", "forecast")


def result_at(where: Any) -> "xr.Dataset | None":
    """Return the link or forecast that is stored somewhere, in memory, or None for anything else.

    Raises SweepError for one that is damaged.
    """
    folder = Path(str(where))
    try:
        with (folder / "zarr.json").open(encoding="utf-8") as file:
            attributes = json.load(file).get("attributes", {})
    except (OSError, ValueError, AttributeError):
        return None
    if not isinstance(attributes, dict) or attributes.get("result") not in RESULTS:
        return None
    import xarray as xr

    try:
        with xr.open_zarr(folder) as stored:
            result: xr.Dataset = stored.load()
    except Exception as error:  # whatever a damaged file makes of the decoders
        raise SweepError(f"is damaged: {' '.join(str(error).split())}", str(where)) from error
    return result
